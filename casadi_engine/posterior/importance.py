"""Draws by adaptive importance sampling: where modes are few and smooth, and their weights say so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from casadi_engine.posterior.mixture import Mixture
from casadi_engine.posterior.psis import kish, log_mean, normalised, pareto_smoothed

Array = NDArray[np.float64]
LogDensity = Callable[[Array], Array]

# Rounds in which the proposal learns, and draws of each for a dimension. The last draws are as many as promise to be
# worth so many independent ones for each thousand that is wanted, between two and six rounds of them; a second trial,
# where these are not to be trusted, has twelve.
ROUNDS, EACH, WORTH, LAST = 6, 100, 1200.0, (2, 6, 12)
# Share of the draws from where the proposal started, if that has several parts: one that no draw happened to meet is
# lost in what is learnt, and no weight tells of it.
_KEPT = 0.15
# Share of its draws that a proposal is worth when it has learnt enough.
ENOUGH = 0.55
# What weights have to be for their means to be trusted: the tail's shape, and the draws they are worth, those of the
# outer shares of the probability too.
LARGEST_SHAPE, FEWEST, TAIL = 0.7, 400.0, 0.05


@dataclass(frozen=True)
class Weighted:
    """Independent draws x (n, d) of ``proposal`` with their weights (n,), which sum to one.

    density : (n,) log densities; log_evidence, error : of the integral of the density, and its standard error
    shape : k-hat; size : draws that they are worth, tail : (d,) for the ends of a coordinate
    """

    x: Array
    density: Array
    weight: Array
    proposal: Mixture
    log_evidence: float
    error: float
    shape: float
    size: float
    tail: Array

    @property
    def trusted(self) -> bool:
        """True if means of these draws can be trusted."""
        return self.shape <= LARGEST_SHAPE and min(self.size, self.tail.min()) >= FEWEST

    @property
    def words(self) -> str:
        """How good they are."""
        size = min(self.size, float(self.tail.min()))
        return f"importance sampling: Pareto k-hat {self.shape:.2g}, worth {size:.0f} independent draws"

    def resampled(self, count: int, random: np.random.Generator) -> NDArray[np.intp]:
        """Numbers of ``count`` draws that weigh alike, in random order."""
        places = (np.arange(count) + random.random()) / count
        chosen = np.minimum(np.searchsorted(np.cumsum(self.weight), places), len(self.weight) - 1)
        return np.asarray(random.permutation(chosen))


def sample(density: LogDensity, start: Mixture, random: np.random.Generator, wanted: int = 1000) -> Weighted:
    """Draws from a mixture that starts from the modes and learns from all its draws.

    wanted : draws that are to be taken from them
    The proposal of the last ones does not depend on them, so that their evidence has no bias.
    """
    d = start.centre.shape[1]
    each, learnt, proposal = EACH * max(d, 3), _Learnt(), start
    for _ in range(ROUNDS):
        wide = _beside(start, proposal)
        x = wide.draw(each, random)
        share, shape = learnt.add(x, density(x), wide)
        if shape <= 0.5 and share > ENOUGH:
            break
        proposal = learnt.refitted(proposal)
    more = max(wanted / 1000, 1.0)
    first = int(more * np.clip(WORTH / max(share, 1e-9), LAST[0] * each, LAST[1] * each))
    for count in (first, int(more * LAST[2] * each)):
        wide = _beside(start, proposal)
        x = wide.draw(count, random)
        found = _weigh(x, density(x), wide)
        if found.trusted or found.size < FEWEST / 4:
            break
        learnt.add(x, found.density, wide)
        proposal = learnt.refitted(proposal)
    return found


def _beside(start: Mixture, proposal: Mixture) -> Mixture:
    """What draws come from: the proposal, guarded, and where it started."""
    return proposal.guarded().beside(start, _KEPT) if len(start.share) > 1 else proposal.guarded()


class _Learnt:
    """All draws so far, weighed by the mixture of all proposals that they came from (Cornuet et al. 2012)."""

    def __init__(self) -> None:
        self._x: list[Array] = []
        self._density: list[Array] = []
        self._proposals: list[Mixture] = []

    def add(self, x: Array, density: Array, proposal: Mixture) -> tuple[float, float]:
        """Take draws in; the share of them that they are worth by themselves, and k-hat."""
        self._x.append(x)
        self._density.append(density)
        self._proposals.append(proposal)
        smooth, shape = pareto_smoothed(density - proposal.log_density(x))
        return (kish(normalised(smooth)) / len(x) if np.isfinite(smooth.max()) else 0.0), shape

    def refitted(self, proposal: Mixture) -> Mixture:
        """The proposal moved towards all draws."""
        x, count = np.concatenate(self._x), np.array([len(own) for own in self._x], dtype=float)
        parts = [np.log(n) + own.log_density(x) for n, own in zip(count, self._proposals, strict=True)]
        smooth, _ = pareto_smoothed(np.concatenate(self._density) - logsumexp(parts, axis=0))
        return proposal.fitted(x, normalised(smooth), rounds=3) if np.isfinite(smooth.max()) else proposal


def _weigh(x: Array, density: Array, proposal: Mixture) -> Weighted:
    smooth, shape = pareto_smoothed(density - proposal.log_density(x))
    if not np.isfinite(smooth.max()):
        nothing = np.full(len(x), 1 / len(x))
        return Weighted(x, density, nothing, proposal, -np.inf, np.inf, np.inf, 0.0, np.zeros(x.shape[1]))
    weight = normalised(smooth)
    size = kish(weight)
    error = float(np.sqrt(max(1 / size - 1 / len(x), 1e-300)))
    return Weighted(x, density, weight, proposal, log_mean(smooth), error, shape, size, _tails(x, weight))


def _tails(x: Array, weight: Array) -> Array:
    """(d,) draws that weighted ones (n, d) are worth for the share of probability at either end, the smaller one."""
    found = np.empty(x.shape[1])
    for k, column in enumerate(x.T):
        order = np.argsort(column)
        below = np.cumsum(weight[order])
        ends = (weight[order[below <= TAIL]], weight[order[below >= 1 - TAIL]])
        found[k] = min(kish(end) / TAIL if end.sum() > 0 else 0.0 for end in ends)
    return found
