"""Screening: the scores of a whole library against a fit, with a false-alarm rate that holds for all of them together.

No refit is made: the null fit gives residuals and slopes, one sweep all sensitivities, and draws the threshold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from casadi_engine.discrepancy.candidate import Candidate, with_finite_columns
from casadi_engine.discrepancy.compression import (
    Compressed,
    candidate_columns,
    compress,
)
from casadi_engine.discrepancy.leftover import Leftover, leftover
from casadi_engine.discrepancy.library_candidates import library_candidates
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.noise_choice import (
    ColourChoice,
    NoiseChoice,
    choose_noise,
    scatter_of,
)
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_distribution import NullDistribution, library_rows, split_alpha
from casadi_engine.discrepancy.null_model import NullModel, null_model
from casadi_engine.discrepancy.requests import Request, check_alpha, read_request
from casadi_engine.discrepancy.score import Scores, score
from casadi_engine.discrepancy.second_names import second_names_of
from casadi_engine.distributions import normal_isf, p_words
from casadi_engine.effects.candidate import Known
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.options import whole
from casadi_engine.model.term import NotApplicable

# Degrees of freedom below which a score tells little.
_FEW = 5
# Candidates that are printed.
_SHOWN = 10


@dataclass(frozen=True, eq=False)
class Screened:
    """Scores of a library against a fit.

    null, candidates, columns : as linearised (record -> output -> (N, k)); choice : the noise and how it was chosen
    compressed, scores : of the candidates; law : their smallest p-value under the null
    alpha : false-alarm rate of the library's tests and the leftover's together; share : that of the library alone
    threshold_p : p-value of one test at which the library's smallest falls with probability ``share``
    request : what was looked for, and what could not act where
    """

    null: NullModel
    candidates: tuple[Candidate, ...]
    columns: Mapping[str, Mapping[str, Array]]
    choice: NoiseChoice
    compressed: Compressed
    scores: Scores
    law: NullDistribution
    alpha: float
    share: float
    threshold_p: float
    request: Request = field(default_factory=lambda: Request((), {}))
    seed: int = 0
    timing: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        """The best candidates with |z| and p-value, and what else is rejected."""
        rate = f"false alarms {100 * self.alpha:.3g} % over all tests, |z| > {self.threshold:.2f}"
        lines = [f"Scores of {len(self.candidates)} candidates: {len(self.significant)} significant; {rate}"]
        for k in self.order[:_SHOWN]:
            label, p = self.candidates[k].label, float(self.scores.p_value[k])
            lines.append(f"  {label:<60}{float(self.scores.statistic[k]):>10.2f}  p = {p:.2g}")
        lines += [f"  {name}: {p_words(p)}" for name, p in self.leftover.alarms.items()]
        lines += [f"Not applicable: {one}" for one in self.not_applicable]
        return "\n".join([*lines, *(f"Note: {text}" for text in self.choice.messages)])

    @property
    def noise(self) -> NoiseModel:
        """The noise of the tests."""
        return self.choice.noise

    @property
    def not_applicable(self) -> tuple[NotApplicable, ...]:
        """The effects that cannot act at a port, and why."""
        return self.request.skipped

    @property
    def threshold(self) -> float:
        """The |z| of a two-sided test at the threshold."""
        return float(normal_isf(self.threshold_p / 2))

    @property
    def order(self) -> list[int]:
        """Testable candidates by rising p-value, then by falling statistic."""
        p, size = self.scores.p_value, self.scores.statistic
        return sorted((int(k) for k in np.flatnonzero(self.scores.testable)), key=lambda k: (p[k], -size[k]))

    @property
    def significant(self) -> list[int]:
        """Candidates beyond the threshold, the best first."""
        return [k for k in self.order if self.scores.p_value[k] <= self.threshold_p]

    def pooled(self, k: int) -> float:
        """p-value of a candidate's score pooled over the library."""
        return self.law.pooled(float(self.scores.p_value[k]))

    @cached_property
    def second_names(self) -> dict[tuple[str, str], tuple[tuple[str, str], ...]]:
        """See ``second_names_of``."""
        return second_names_of(self.candidates, self.columns, self.order)

    @cached_property
    def leftover(self) -> Leftover:
        """The tests beside the library: whiteness of the residuals, and families of unknown functions."""
        return leftover(self)

    @property
    def alarm(self) -> bool:
        """True if anything is missing: a candidate is significant, or a test beside the library."""
        return bool(self.significant) or bool(self.leftover.alarms)


def screen(
    fit: Fit,
    effects: Any = None,
    *,
    at: Sequence[str] | str | None = None,
    alpha: float = 0.01,
    noise: NoiseModel | None = None,
    colour: ColourChoice = "auto",
    scatter: Any = "assumed",
    seed: int = 0,
) -> Screened:
    """Score every effect at every port against a fit, all its parameters and initial states free.

    fit : a converged Fit of output error; effects, at : as in ``repair``
    alpha : false-alarm rate over all tests together: four fifths for the library, one fifth for whiteness and families
    noise : a noise model to hold; None chooses one: the levels that the fit was told, or those of the residual that the
    library leaves; colour : True, False or "auto"; scatter : cylinder ports whose combustion scatters from cycle to
    cycle, "assumed" for those with an assumed pressure, or None
    Levels and colours that are estimated make every score Student's t, by the restricted likelihood (Harville 1977) and
    the degrees of freedom of each (Satterthwaite 1946).
    Raises EffectError for effects or ports that do not fit, EstimationError for a predictor's fit, an alpha outside
    (0, 1), another colour, or scatter at ports that are no cylinders.

    >>> import numpy as np, casadi_engine as ce
    >>> from casadi_engine.discrepancy import screen
    >>> t = np.arange(400) * 0.01
    >>> exp = ce.Experiment.from_arrays("run", time=t, units={"T": "N m"}, T=2 * np.sin(3 * t))
    >>> model = ce.one_inertia().with_effect(ce.effects.CoulombFriction(0.05), at="engine", values={"torque": 0.2})
    >>> run = ce.simulate(model, exp, initial={"omega_eng": 0.0})
    >>> noisy = run["omega"].values + 0.01 * np.random.default_rng(0).standard_normal(400)
    >>> exp = ce.Experiment.from_arrays("run", time=t, units={"T": "N m", "omega": "rad/s"}, T=exp["T"].values,
    ...     omega=noisy)
    >>> fit = ce.estimate(ce.one_inertia(), exp, noise=ce.Noise(omega=0.01), progress=False)
    >>> screened = screen(fit, ["coulomb_friction", "quadratic_drag"])
    >>> screened.candidates[screened.order[0]].label
    'coulomb_friction at engine'
    """
    _check(fit, noise, alpha)
    if noise is None:
        return screen_in_turn(
            fit, effects, at=at, alpha=alpha, colour=colour, scatter=scatter, seed=seed, wait=False
        )
    null, candidates, columns, request = _linearised(fit, effects, at)
    random = scatter_of(null, fit.data, scatter) if noise.scatter else ()
    return _scored(
        null, candidates, columns, NoiseChoice(noise, random, scatter), alpha, whole("seed", seed, 0), request
    )


def screen_in_turn(
    fit: Fit,
    effects: Any = None,
    *,
    at: Sequence[str] | str | None = None,
    alpha: float = 0.01,
    colour: ColourChoice = "auto",
    scatter: Any = "assumed",
    seed: int = 0,
    wait: bool = True,
    known: Known | None = None,
) -> Screened:
    """As ``screen``, but the colour of the residual may wait (``choice.waits``): a large effect colours the
    residual of a model that lacks it, and a refit with the effect tells that sooner than a search for the colour.
    ``coloured`` goes on where it does not. known : as in ``candidates``"""
    seed = whole("seed", seed, 0)
    null, candidates, columns, request = _linearised(fit, effects, at, known)
    choice = choose_noise(
        null, candidates, columns, fit.noise, data=fit.data, cylinders=scatter, colour=colour, wait=wait
    )
    return _scored(null, candidates, columns, choice, alpha, seed, request)


def _linearised(
    fit: Fit, effects: Any, at: Any, known: Known | None = None
) -> tuple[NullModel, tuple[Candidate, ...], dict[str, dict[str, Array]], Request]:
    """The null model, the candidates that are wanted, their columns, and what was asked for."""
    request = read_request(fit.model, effects, at)
    null = null_model(fit)
    skipped: list[NotApplicable] = []
    every = library_candidates(null, fit.data, request.effects, skipped, known)
    candidates = [one for one in every if request.wants(one)]
    with np.errstate(all="ignore"):  # what is no number is left out
        columns = {record.name: candidate_columns(record, candidates) for record in null.records}
    candidates, columns, without = with_finite_columns(candidates, columns)
    request = replace(request, skipped=(*request.skipped, *dict.fromkeys((*skipped, *without))))
    return null, tuple(candidates), columns, request


def _check(fit: Any, noise: Any, alpha: Any) -> None:
    if not isinstance(fit, Fit):
        raise EstimationError(
            "there is no fit to score effects against",
            seen=type(fit).__name__,
            allowed="a Fit of output error",
            cure="give screen(estimate(model, data)); the fit of a repair is repair.fit",
        )
    if noise is not None and not isinstance(noise, NoiseModel):
        raise EstimationError(
            "the noise to score with is not acceptable",
            seen=repr(noise),
            allowed="a NoiseModel, such as the noise of another screening, or None",
            cure="leave it out: the levels that the fit was told count, or those of its residual",
        )
    check_alpha(alpha)


def coloured(screened: Screened, fit: Fit) -> Screened:
    """The same scores with the colour that the residual asks for, where that waited; fit : the one screened."""
    return _chosen_again(screened, fit, "auto")


def _chosen_again(screened: Screened, fit: Fit, colour: ColourChoice) -> Screened:
    one = screened
    choice = choose_noise(
        one.null, one.candidates, one.columns, fit.noise, data=fit.data, cylinders=one.choice.cylinders, colour=colour,
        white=one.choice.white,
    )  # fmt: skip
    return _scored(one.null, one.candidates, one.columns, choice, one.alpha, one.seed, one.request)


def _scored(
    null: NullModel,
    candidates: tuple[Candidate, ...],
    columns: Mapping[str, Mapping[str, Array]],
    choice: NoiseChoice,
    alpha: float,
    seed: int,
    request: Request,
) -> Screened:
    compressed = choice.compressed
    if compressed is None:
        compressed = compress(null, candidates, choice.noise, scatter=choice.scatter, columns=columns)
    scores = score(compressed)
    choice = replace(choice, messages=(*choice.messages, *_cannot_tell(scores), *_flat(candidates)))
    share, _ = split_alpha(alpha)
    law = NullDistribution(library_rows(scores), seed=seed)
    return Screened(
        null,
        candidates,
        columns,
        choice,
        compressed,
        scores,
        law,
        alpha,
        share,
        law.threshold(share),
        request,
        seed,
    )


def _flat(candidates: Sequence[Candidate]) -> tuple[str, ...]:
    """That effects were looked for from other sizes than 0, where they have no slope."""
    flat: dict[str, list[float]] = {}
    for one in candidates:
        if one.source is not None and one.source.is_flat and one.size is not None:
            flat.setdefault(f"{one.effect} at {one.port}", []).append(abs(one.size))
    return tuple(
        f"{name} does nothing to first order at amplitude 0 (a square, a magnitude): it is not testable by a slope, "
        f"and was looked for from amplitudes of {min(sizes):.2g} to {max(sizes):.2g}"
        for name, sizes in flat.items()
    )


def _cannot_tell(scores: Scores) -> tuple[str, ...]:
    """What to say where the noise is known too little for most candidates."""
    if scores.freedom is None:
        return ()
    few = int((scores.testable & (scores.freedom < _FEW)).sum())
    every = int(scores.testable.sum())
    if 2 * few <= every:
        return ()
    return (
        f"strongly autocorrelated noise: few effective samples. The scores of {few} of {every} candidates have fewer "
        f"than {_FEW} degrees of freedom, so that these effects were not found says little; record for longer",
    )
