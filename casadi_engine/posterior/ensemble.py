"""Draws by ensembles of walkers, for surfaces with many optima (Goodman & Weare 2010; ter Braak & Vrugt 2008).

Walkers alone cross from one optimum to another slowly. A mixture that is fitted to where they have been, at the
beginning, proposes every other step from the whole (an independence sampler), and is not changed while draws are kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import MissingDependencyError
from casadi_engine.posterior.diagnostics import bulk_size, rhat, tail_size
from casadi_engine.posterior.mixture import Mixture, around

Array = NDArray[np.float64]
LogDensity = Callable[[Array], Array]
# (steps so far, evaluations so far, largest R-hat, smallest effective size)
Progress = Callable[[int, int, float, float], Any]

# What chains have to be: their disagreement, and the draws they are worth; sampling goes on until the first is reached
# or the evaluations are spent, and the second is still accepted then.
GOAL, LARGEST, FEWEST = 1.01, 1.02, 400.0
# Steps between two looks; looks at the beginning, after which lost walkers are set beside the others.
BLOCK, EARLY = 100, 3
# Components of the mixture that is proposed from, and the share of the steps that is. Walkers' draws go together: more
# components would be fitted to single walkers.
COMPONENTS, WHOLE = 4, 0.5
# A walker so far below the best one, beside the half chi-squared of the dimensions, is lost.
LOST = 12.0


@dataclass(frozen=True)
class Chains:
    """Draws x (m, t, d) of m walkers with their log densities (m, t).

    rhat, bulk, tail : (d,) of each coordinate; ensembles : number of them, walkers of one follow another
    evaluations : of the density; steps : of every walker, those before the kept ones among them; accepted : share
    """

    x: Array
    density: Array
    rhat: Array
    bulk: Array
    tail: Array
    ensembles: int
    evaluations: int
    steps: int
    accepted: float

    @property
    def size(self) -> float:
        """The smallest effective sample size."""
        return float(min(self.bulk.min(), self.tail.min()))

    @property
    def trusted(self) -> bool:
        """True if the chains agree and are worth enough draws."""
        return bool(self.rhat.max() <= LARGEST) and self.size >= FEWEST


def emcee() -> Any:
    """The package emcee.

    Raises MissingDependencyError without it.
    """
    try:
        import emcee as package
    except ImportError:
        raise MissingDependencyError(
            "drawing from a posterior with many optima needs the package emcee",
            seen="emcee is not installed",
            allowed="the extra `bayes`",
            cure='run pip install "casadi-engine[bayes]", or take method="importance" where the optima are few',
        ) from None
    return package


@dataclass(frozen=True)
class Explored:
    """Where walkers have been before draws are kept.

    states : (w, d) of each ensemble, where they are; proposal : a mixture fitted to the later ones
    steps : of each walker
    """

    states: list[Array]
    proposal: Mixture
    steps: int


def explore(
    density: LogDensity, starts: list[Array], random: np.random.Generator, known: Mixture | None = None
) -> Explored:
    """Walk from ``starts``, one (w, d) for each ensemble, and forget it but for where the walkers came to.

    known : a proposal that was fitted to the density before
    """
    states: list[Any] = list(starts)
    proposal, been = known, []
    for _ in range(EARLY):
        samplers = [_sampler(density, state, random, proposal) for state in states]
        for k, sampler in enumerate(samplers):
            end = sampler.run_mcmc(states[k], BLOCK, skip_initial_state_check=True)
            states[k] = _gathered(end, random)
        been += [sampler.get_chain(flat=True, discard=BLOCK // 2) for sampler in samplers]
        proposal = around(np.concatenate(been[len(been) // 3 :]), COMPONENTS, random).guarded()
        proposal = proposal if known is None else proposal.beside(known)
    assert proposal is not None
    return Explored(states, proposal, EARLY * BLOCK)


def walk(
    density: LogDensity,
    explored: Explored,
    random: np.random.Generator,
    *,
    most: int,
    progress: Progress | None = None,
) -> Chains:
    """Draw until the walkers agree, or so many evaluations are spent."""
    samplers = [_sampler(density, state, random, explored.proposal) for state in explored.states]
    states: list[Any] = list(explored.states)
    walkers, taken, found = sum(len(state) for state in states), explored.steps, None
    while found is None or (taken + BLOCK) * walkers <= most:
        for k, sampler in enumerate(samplers):
            states[k] = sampler.run_mcmc(states[k], BLOCK, skip_initial_state_check=True)
        taken += BLOCK
        found = _looked_at(samplers, taken, walkers)
        if progress is not None:
            progress(taken, found.evaluations, float(found.rhat.max()), found.size)
        if found.rhat.max() <= GOAL and found.size >= FEWEST:
            break
    return found


def _sampler(density: LogDensity, start: Array, random: np.random.Generator, proposal: Mixture | None) -> Any:
    moves = emcee().moves
    chosen = [(moves.DEMove(), 0.6), (moves.DESnookerMove(), 0.1), (moves.StretchMove(), 0.3)]
    if proposal is not None:
        own = np.random.default_rng(int(random.integers(2**63)))

        def propose(at: Array, _: Any) -> tuple[Array, Array]:
            to = proposal.draw(len(at), own)
            return to, proposal.log_density(at) - proposal.log_density(to)

        chosen = [(move, (1 - WHOLE) * share) for move, share in chosen]
        chosen.append((moves.MHMove(propose), WHOLE))
    sampler = emcee().EnsembleSampler(*start.shape, density, moves=chosen, vectorize=True)
    legacy = np.random.RandomState(int(random.integers(2**31)))
    sampler.random_state = legacy.get_state()
    return sampler


def _gathered(state: Any, random: np.random.Generator) -> Array:
    """Where the walkers are, those that are lost far below set between the others; only before draws are kept."""
    height, coords = np.array(state.log_prob), state.coords.copy()
    lost = ~(height > height.max() - LOST - coords.shape[1])
    good = state.coords[~lost]
    for k in np.flatnonzero(lost) if len(good) > 2 else ():
        one, two, three = good[random.choice(len(good), 3, replace=False)]
        coords[k] = one + 0.3 * random.standard_normal() * (two - three)
    return np.asarray(coords)


def _looked_at(samplers: list[Any], taken: int, walkers: int) -> Chains:
    """The later three quarters of what was kept, and what they are worth."""
    x = np.concatenate([sampler.get_chain().swapaxes(0, 1) for sampler in samplers])
    height = np.concatenate([sampler.get_log_prob().T for sampler in samplers])
    first = x.shape[1] // 4
    x, height = x[:, first:], height[:, first:]
    columns = [x[:, :, k] for k in range(x.shape[2])]
    accepted = float(np.mean([sampler.acceptance_fraction.mean() for sampler in samplers]))
    return Chains(
        x,
        height,
        np.array([rhat(column) for column in columns]),
        np.array([bulk_size(column) for column in columns]),
        np.array([tail_size(column) for column in columns]),
        len(samplers),
        taken * walkers,
        taken,
        accepted,
    )
