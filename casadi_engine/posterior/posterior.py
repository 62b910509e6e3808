"""posterior: the distribution of a fit's parameters, given its records and priors."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.blas_threads import one_blas_thread
from casadi_engine.errors import PosteriorError, UntrustedPosteriorError
from casadi_engine.estimation.few_samples import UNKNOWN
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.options import check_likelihood, chosen, whole
from casadi_engine.posterior.box import Box
from casadi_engine.posterior.comparison import compare
from casadi_engine.posterior.drawing import OPTIMA, Drawing, Met
from casadi_engine.posterior.drawn import Drawn
from casadi_engine.posterior.left_out import SCATTER, with_all_data
from casadi_engine.posterior.modes import Modes, along, find_modes, inverse, separate
from casadi_engine.posterior.open_ends import check_ends
from casadi_engine.posterior.result import Posterior, made
from casadi_engine.posterior.scan import dips
from casadi_engine.posterior.target import Target

Array = NDArray[np.float64]

METHODS = ("auto", "importance", "ensemble")
# Shares of the information that may be left out of the likelihood that is drawn from, one tried after the other.
LEFT_OUT = (0.1, 0.02, 0.0)
# Where a quadratic does not foretell what was left out, so many times less is left out of what all draws are seen with.
NEARER = 5.0
# Independent draws that have to be left once all data are looked at.
LEAST = 100.0
# Searches for other optima that start around the fit's, for each dimension; where an evaluation is a simulation, none.
WIDE = 4
# Share of an output below which its estimated noise is that of rounding.
ROUNDING = 1e-9
# How often optima are looked for at most: again where a draw lies higher than all of them.
TRIALS = 4
# So often at most after the integration has been made finer.
REFINED = 4
# Draws about optima and valleys at which the integration is looked at, for each parameter.
LOOKED = 8


@one_blas_thread
def posterior(
    fit: Fit,
    *,
    draws: int = 1000,
    method: str = "auto",
    seed: int = 0,
    evaluations: int = 60_000,
    progress: Callable[[str, int], Any] | bool | None = None,
) -> Posterior:
    """The distribution of the free parameters and unknown noise levels of a fit, given its records and priors.

    Unlike standard errors it does not take the likelihood for a quadratic: it holds where there are several optima,
    bounds, or a curved valley.

    Parameters
    ----------
    fit : a converged Fit with the loss "square", without a predictor. Its bounds are the prior's: flat between them in
        the logarithm of a parameter whose lower bound is positive, else in its value; a normal prior of the set is
        taken as it is; ties and constraints hold. A noise level that was estimated is flat in its logarithm. A
        parameter of an effect that has no bound on a side needs none where the data end what is drawn
    draws : number of draws that the result keeps
    method : "importance" for few smooth optima, "ensemble" for walkers (extra "bayes"); "auto" takes the first that can
        be trusted
    seed : of the random numbers; the same seed gives the same draws
    evaluations : of the likelihood by an ensemble, at most
    progress : None or False for nothing, or a function of (what is done, evaluations so far)

    Returns
    -------
    Posterior : draws, intervals, optima with their mass, evidence

    Raises
    ------
    PosteriorError : no fit, a fit that did not converge, a parameter without bounds, a direction that the data do not
        determine, or options that do not fit
    UntrustedPosteriorError : the draws do not agree or are too few, or Ctrl-C came before they were drawn; nothing is
        returned then
    MissingDependencyError : an ensemble is needed, and emcee is not installed

    Notes
    -----
    Initial states are integrated out. Their prior is normal: as the states along the record are in the fit, or as wide
    as they are large, or, of linear models, near the state of a later moment at which the drives go on as they do at
    the beginning. Which of these, and its width, is integrated out as well. For linear models on complete records the
    integral is exact (the prior is that of the sum of the first state and the last one, to which it leads), and chi-
    squared is computed in the frequency bins in which the parameters act; all others enter when the draws are there.
    For other models it is that of a normal density about the best initial states (Laplace).

    Importance sampling draws from a mixture of t-distributions at the optima, which learns from its draws (Cappe et al.
    2008), and is trusted if Pareto k-hat is at most 0.7 and the draws are worth 400 independent ones, in their tails
    too. Where it is not, two ensembles of walkers start from the optima and along the directions that the data tell
    least of, and importance sampling goes on from where they have been. If that is not to be trusted either, the
    ensembles themselves draw until the rank-normalised split R-hat of every walker's draws is at most 1.02 and they are
    worth 400 in the middle and in the tails.

    Examples
    --------
    >>> import numpy as np, casadi_engine as ce
    >>> t = np.arange(200) * 0.01
    >>> noise = 0.02 * np.random.default_rng(1).standard_normal(200)
    >>> exp = ce.Experiment.from_arrays("run_up", time=t, units={"T": "N m", "omega": "rad/s"}, hold="zero",
    ...     T=np.full(200, 2.0), omega=4 * (1 - np.exp(-t / 0.8)) + noise)
    >>> fit = ce.estimate(ce.one_inertia(), exp, noise=ce.Noise(omega=0.02), progress=False)
    >>> post = ce.posterior(fit)
    >>> low, high = post.interval("J_eng", 0.8)
    >>> print(f"{low:.3f} to {high:.3f} kg m2")
    0.399 to 0.402 kg m2
    """
    _check(fit)
    chosen("method", method, METHODS)
    count, seed = whole("draws", draws, 100), whole("seed", seed, 0)
    most = whole("evaluations", evaluations, 1000)
    begun = time.process_time()
    target = Target(fit)
    tell, said = _teller(progress, target)
    try:
        modes, drawn = _found(target, fit, method, count, seed, most, tell)
    except (FloatingPointError, np.linalg.LinAlgError) as error:
        raise _improper(f"the model has no value there: {error}") from None
    except KeyboardInterrupt:
        raise UntrustedPosteriorError(
            "the posterior was stopped before its draws could be trusted",
            seen=f"Ctrl-C while {said[-1]}, after {target.evaluations} evaluations" if said else "Ctrl-C",
            allowed="draws that pass their diagnostics",
            cure="let it run; progress=print tells where it is",
        ) from None
    check_ends(fit, target.within, target.names, target.values(drawn.u))
    return made(fit, target, modes, separate(modes, target), drawn, seed, time.process_time() - begun)


def _found(
    target: Target, fit: Fit, method: str, count: int, seed: int, most: int, tell: Callable[[str], Any]
) -> tuple[Modes, Drawn]:
    """The optima and the draws, from as much of the data as it takes."""
    first = target.squares(target.start[: target.nv])
    if first is None:
        raise _improper("the slopes at the optimum are not finite")
    # what a bound alone holds is as uncertain as there are numbers
    low, high = target.low[: target.nv], target.high[: target.nv]
    weak = [np.clip(v, low, high) for v in along(target.start[: target.nv], inverse(first.matrix))]
    for left_out in LEFT_OUT:
        drawing = Drawing(target, method, np.random.default_rng(seed), count, most, tell)
        target.choose([target.start[: target.nv], *weak[:2]], left_out)
        modes, found = _met(drawing, fit, weak[:2], left_out)
        if isinstance(found, Drawn):
            tell("looking at all data")
            points, bins = [*modes.at[:OPTIMA, : target.nv], *weak[:2]], target.likelihood.bins

            def nearer(points: list[Array] = points, left_out: float = left_out / NEARER) -> None:
                target.choose(points, left_out)

            drawn, scatter = with_all_data(target, found, drawing.random, nearer)
            modes = modes if target.likelihood.bins == bins else modes.again(target)
            left = float(min(drawn.bulk.min(), drawn.tail.min()))
            if scatter <= SCATTER and left >= LEAST:
                break
    if left < LEAST:
        raise UntrustedPosteriorError(
            "what all data say leaves too few of the draws that were made from a part of them",
            seen=f"draws worth {left:.0f} independent ones",
            allowed=f"{LEAST:.0f} or more: two or three beyond each end of an interval of 95 %",
            cure="fit again from several starts, estimate(..., starts=10), as the fit may be at one optimum of many, "
            'or by predictions, approach="prediction"',
        )
    return modes, drawn


def _met(drawing: Drawing, fit: Fit, weak: list[Array], left_out: float) -> tuple[Modes, Drawn | Met]:
    """The optima and the draws, or why there are none, with this share of the information left out.

    weak : points v along what the data tell least of, where they have to tell something too
    """
    target, found = drawing.target, Met()
    bins = target.likelihood.bins is not None
    wide = WIDE * len(target.names) + 6 if bins else 0
    met: list[Array] = []
    if not bins:
        drawing.tell("looking along each parameter")
        met = dips(target)
    for trial in range(TRIALS):
        drawing.tell("looking for optima")
        modes = find_modes(target, fit, drawing.random, wide=wide, met=[*found.higher, *met])
        for _ in range(REFINED):
            if modes is None or not target.integrate_finely(_places(target, modes)):
                break  # what the steps at the optimum make of a place far off may hide that it is likely
            drawing.tell("integrating more finely, and looking for optima again")
            modes = find_modes(target, fit, drawing.random, wide=wide, met=[*found.higher, *met])
        if modes is None:
            raise _improper("the optimum's information matrix is singular")
        target.choose([*modes.at[:OPTIMA, : target.nv], *weak], left_out)
        best = modes.again(target)
        drawn = drawing.draws(best, last=trial == TRIALS - 1)
        if isinstance(drawn, Drawn) or not drawn.higher:
            break
        found = drawn
    return best, drawn


def _places(target: Target, modes: Modes) -> Array:
    """The optima, their valleys and draws about both, as v (k, nv): where what is integrated has to be right."""
    drawn = modes.mixture(Box.none(target.low)).draw(LOOKED * target.nv, np.random.default_rng(0))
    drawn = np.clip(drawn, target.low, target.high)[:, : target.nv]
    return np.concatenate([modes.places(target.nv), drawn])


def _teller(
    progress: Callable[[str, int], Any] | bool | None, target: Target
) -> tuple[Callable[[str], Any], list[str]]:
    """A function that is told what is done, and all that it was told."""
    if progress is not None and progress is not False and not callable(progress):
        raise PosteriorError(
            "invalid `progress`",
            seen=repr(progress),
            allowed="None or False, or a function of (what is done, evaluations so far)",
            cure="leave it out",
        )
    said: list[str] = []

    def tell(words: str) -> None:
        said.append(words)
        if callable(progress):
            progress(words, target.evaluations)

    return tell, said


def _improper(seen: str) -> PosteriorError:
    return PosteriorError(
        "the data leave a direction of the parameters open, so that its posterior is the bounds alone",
        seen=seen,
        allowed="free parameters that the data or priors determine",
        cure="fix one of these parameters, tie it, give it a prior, or add a record that excites it",
    )


def _check(fit: Any) -> None:
    """Raise PosteriorError for what has no posterior here."""
    check_likelihood(fit, "a posterior", PosteriorError)
    unknown = next((words for words in fit.messages if UNKNOWN in words), None)
    if unknown is not None:
        raise PosteriorError(
            "a noise level is not told by the samples that are left of its output",
            seen=unknown.partition("; state it")[0],
            allowed="more samples than parameters and initial states take of them, or a level that is known",
            cure="state the level, noise=ce.Noise(...), and fit again",
        )
    if fit.innovations is not None:
        raise PosteriorError(
            "the posterior of a model with a predictor is not available",
            seen=f"a gain, {fit.innovations.kind}",
            allowed="a fit whose noise is that of the measurement alone",
            cure="fit again with ce.Noise(output=sigma), without gain or process noise",
        )
    equal = next((one for one in fit.parameters.constraints if one.min == one.max), None)
    if equal is not None:
        raise PosteriorError(
            "an equality leaves no room to draw from: what meets it has no volume",
            seen=str(equal),
            allowed="inequalities, and ties for what is equal",
            cure='solve it for one parameter and tie that one, pars.tie("name", "expression of the others")',
        )
    for name, (sigma, free) in fit.noise.items():
        seen = [own[name].measured[own[name].mask] for own in fit.traces.values() if name in own]
        size = max((float(np.abs(one).max(initial=0.0)) for one in seen), default=0.0)
        if free and sigma < ROUNDING * size:
            raise PosteriorError(
                "the model explains the data to rounding, so that there is no noise to make a posterior of",
                seen=f"sigma({name}) = {sigma:.2g}, estimated, beside values up to {size:.3g}",
                allowed=f"noise of {ROUNDING:g} of the output or more",
                cure=f"state the noise of the measurement, ce.Noise({name}=...), and fit again",
            )
    if fit.undetermined:
        raise _improper("; ".join(direction.text for direction in fit.undetermined))


# the function has the name of its room: what stands beside it there is reached through it too
posterior.compare = compare  # type: ignore[attr-defined]
