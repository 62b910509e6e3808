"""Forward selection of missing effects: score, refit the best, score again, drop what is no longer needed, stop."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from scipy.special import gammaln

from casadi_engine.discrepancy.compression import Compressed
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.score import score
from casadi_engine.distributions import chi2_isf

State = TypeVar("State")

_CLUSTERS, _EFFECTS, _HALVES = 4, 4, 50
_GAMMA = 0.5


@dataclass(frozen=True, eq=False)
class Refit(Generic[State]):
    """A fit with effects added: their names, chi-squared with priors, how many numbers were estimated, and whatever the
    caller needs of it (None where it did not converge: ``converged`` False)."""

    effects: tuple[str, ...]
    cost: float
    freedom: int
    converged: bool = True
    state: State | None = None


@dataclass(frozen=True)
class Proposal:
    """An effect worth a refit: its name, the p-value pooled over the library, and the predicted drop of chi-squared."""

    name: str
    pooled: float
    drop: float


@dataclass(frozen=True, eq=False)
class Step(Generic[State]):
    """One round: what was proposed, the refits tried, and the one kept (None where the round ended the search)."""

    proposals: tuple[Proposal, ...]
    tried: tuple[Refit[State], ...]
    kept: Refit[State] | None
    dropped: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Selection(Generic[State]):
    """effects in the order in which they were found; final : the fit with them; steps : how they were found."""

    effects: tuple[str, ...]
    final: Refit[State]
    steps: tuple[Step[State], ...] = field(default_factory=tuple)


def extended_bic(cost: float, freedom: int, effects: int, *, samples: float, library: int) -> float:
    """chi^2 + k log n_eff + 2 gamma log C(K, j): Chen & Chen (2008), for j effects chosen from K.

    samples : effective number, see ``effective_samples``
    """
    choose = float(gammaln(library + 1) - gammaln(effects + 1) - gammaln(library - effects + 1))
    return cost + freedom * math.log(max(samples, 2.0)) + 2 * _GAMMA * choose


def effective_samples(residual: Array, *, lags: int | None = None) -> float:
    """How many independent samples a residual (N,) is worth: N / (1 + 2 sum rho_l), the sum up to its first change
    of sign (Geyer 1992)."""
    e = residual - residual.mean()
    count = len(e)
    power = float(e @ e)
    if count < 3 or power <= 0:
        return float(count)
    spectrum = np.abs(np.fft.rfft(e, 2 * count)) ** 2
    rho = np.fft.irfft(spectrum)[:count] / power
    most = count // 4 if lags is None else lags
    negative = np.flatnonzero(rho[1 : most + 1] <= 0)
    stop = int(negative[0]) if len(negative) else most
    return float(np.clip(count / (1 + 2 * rho[1 : stop + 1].sum()), 1.0, count))


def select(
    null: Refit[State],
    propose: Callable[[Refit[State]], Sequence[Proposal]],
    refit: Callable[[Refit[State], tuple[str, ...]], Refit[State]],
    *,
    alpha: float,
    samples: float,
    library: int,
    clusters: int = _CLUSTERS,
    most: int = _EFFECTS,
) -> Selection[State]:
    """Add effects one by one until none is significant.

    propose : the fit so far -> proposals, the best of each cluster, best first
    refit : the fit so far, names -> the fit with these effects
    alpha : false-alarm rate of the library; samples, library : for the extended BIC; clusters : refits a round

    An effect is kept if the pooled p-value is at most alpha, its refit converged and the extended BIC falls. After each
    addition an older effect is dropped if chi-squared then rises by less than the level at which one more number is
    worth keeping.
    """
    here, steps = null, []
    worth = float(chi2_isf(alpha, 1))

    def criterion(fit: Refit[State]) -> float:
        return extended_bic(fit.cost, fit.freedom, len(fit.effects), samples=samples, library=library)

    while len(here.effects) < most:
        proposals = tuple(propose(here))
        worthy = [p for p in proposals if p.pooled <= alpha and p.name not in here.effects][:clusters]
        tried = tuple(refit(here, (*here.effects, p.name)) for p in worthy)
        good = [fit for fit in tried if fit.converged and criterion(fit) < criterion(here)]
        if not good:
            steps.append(Step(proposals, tried, None))
            break
        here = min(good, key=criterion)
        here, dropped = _backward(here, refit, worth)
        steps.append(Step(proposals, tried, here, dropped))
        if dropped and dropped[-1] == here.effects[-1:]:
            break
    return Selection(here.effects, here, tuple(steps))


def _backward(
    fit: Refit[State], refit: Callable[[Refit[State], tuple[str, ...]], Refit[State]], worth: float
) -> tuple[Refit[State], tuple[str, ...]]:
    """Drop effects, but for the newest, without which chi-squared rises by less than ``worth``."""
    dropped: list[str] = []
    for name in fit.effects[:-1]:
        without = refit(fit, tuple(e for e in fit.effects if e != name))
        if without.converged and without.cost - fit.cost < worth:
            fit = without
            dropped.append(name)
    return fit, tuple(dropped)


def selection_frequency(
    compressed: Compressed, *, halves: int = _HALVES, seed: int = 0
) -> dict[tuple[str, str], float]:
    """How often each effect at each port has the largest statistic in half-samples of the cycles.

    Halves come in complementary pairs (Shah & Samworth 2013). Returns (effect, port) -> share of the half-samples, only
    of those that won at least once; empty for fewer than four cycles, which cannot be halved.
    """
    cycles = list(compressed.cycles)
    if len(cycles) < 4:
        return {}
    rng = np.random.default_rng(seed)
    wins: dict[tuple[str, str], int] = {}
    total = 0
    for _ in range(halves // 2):
        order = rng.permutation(len(cycles))
        middle = len(cycles) // 2
        for part in (order[:middle], order[middle:]):
            found: Any = score(compressed, [cycles[k] for k in part])
            total += 1
            if found.testable.any():
                key = compressed.candidates[int(np.argmax(found.statistic))].key
                wins[key] = wins.get(key, 0) + 1
    return {key: count / total for key, count in sorted(wins.items(), key=lambda pair: -pair[1])}
