"""Confirmation on data not used: the gain of the repaired model, cycle by cycle, and the gap before and after."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.distributions import chi2_sf, normal_sf, t_sf

# The chance of a gain where there is none (two standard errors of many cycles); fewest cycles that tell.
CHANCE = 0.02275
_FEWEST = 3
# How rarely noise makes what is no noise; and how often it is as large as what is.
_SURE, _NOISE = 1e-4, 0.05
# Share of the chance that is for the ranks of the gains, and cycles from which their sum is taken to be normal.
_RANKS, _MANY = 0.1, 60


@dataclass(frozen=True)
class PairedGain:
    """Twice the gain of log likelihood per cycle of fresh data: mean, its standard error, number of cycles.

    confirmed : beyond chance (2.3 %); None where there are too few cycles to tell, and ``why`` says so
    ranks : signed-rank statistic of the cycles' gains (Wilcoxon 1945): one that is much larger than the others hides
        from Student's t that all are gains. Nine tenths of the chance are for t, the rest for the ranks
    """

    mean: float | None
    se: float | None
    cycles: int
    confirmed: bool | None
    why: str | None = None
    ranks: int | None = None

    @property
    def chance(self) -> float | None:
        """How often chance makes such a gain where there is none; None where there are too few cycles to tell."""
        return self._chance(1)

    @property
    def refused(self) -> bool:
        """True for a loss that is beyond chance as far as a gain has to be."""
        chance = self._chance(-1)
        return chance is not None and chance < CHANCE

    def _chance(self, sign: int) -> float | None:
        """How often chance makes a gain as large, or a loss (-1)."""
        if self.mean is None or self.se is None:
            return None
        by_t = float(t_sf(sign * self.mean / max(self.se, 1e-300), self.cycles - 1))
        if self.ranks is None:
            return by_t
        whole = self.cycles * (self.cycles + 1) // 2
        by_ranks = signed_rank_sf(self.ranks if sign > 0 else whole - self.ranks, self.cycles)
        return min(by_t / (1 - _RANKS), by_ranks / _RANKS, 1.0)


@dataclass(frozen=True)
class Gap:
    """How far simulation and data are apart: chi-squared per sample, RMSE [output unit] and fit % (2.32) by output."""

    chi2_per_sample: float
    rmse: Mapping[str, float]
    fit_percent: Mapping[str, float]
    samples: int


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of one output of one record: record, output, e (N,), measured (N,), cycle (N,) and its noise sigma."""

    record: str
    output: str
    e: Array
    measured: Array
    cycle: NDArray[np.intp]
    sigma: float


def gains(before: Sequence[Residuals], after: Sequence[Residuals]) -> Array:
    """(cycles,) twice the gain of log likelihood in each cycle, with the level of the noise that each model leaves
    there: one cycle in which the first model is lost does not outweigh all others."""
    squares: dict[tuple[str, str, int], tuple[float, float, int]] = {}
    for old, new in zip(before, after, strict=True):
        for number in np.unique(old.cycle):
            own = old.cycle == number
            key = (old.record, old.output, int(number))
            floor = np.finfo(float).eps * float(old.measured[own] @ old.measured[own]) + 1e-300
            squares[key] = (
                float(old.e[own] @ old.e[own]) + floor,
                float(new.e[own] @ new.e[own]) + floor,
                int(own.sum()),
            )
    found: dict[tuple[str, int], float] = {}
    for (record, _, number), (first, then, count) in squares.items():
        found[record, number] = found.get((record, number), 0.0) + count * math.log(first / then)
    return np.array(list(found.values()))


def paired_gain(before: Sequence[Residuals], after: Sequence[Residuals]) -> PairedGain:
    """The gain per cycle; the same records, outputs and samples before and after."""
    values = gains(before, after)
    if len(values) < _FEWEST:
        mean = float(values.mean()) if len(values) else None
        why = f"{len(values)} cycles of fresh data: at least {_FEWEST} are needed to tell a gain from chance"
        return PairedGain(mean, None, len(values), None, why)
    mean, se = float(values.mean()), float(values.std(ddof=1) / math.sqrt(len(values)))
    order = np.argsort(np.argsort(np.abs(values))) + 1
    found = PairedGain(mean, se, len(values), None, ranks=int(order[values > 0].sum()))
    return replace(found, confirmed=found.chance is not None and found.chance < CHANCE)


def is_foretold(before: Sequence[Residuals], after: Sequence[Residuals], found: int = 0) -> bool:
    """True if what one model leaves of fresh data is the noise of the search in every output, and the other leaves what
    lies between them beyond it: where few pieces hold most that an effect does, its gains scatter by that, and not by
    chance.

    For white noise: by chi-squared, with the levels that the search found, and by the normal distribution of the noise
    along the difference of both, which asks of an effect no more than it does.

    found : numbers that the other model has of the fresh data themselves, as the time of an event: they choose that
        difference, out of as many as there are samples, by the noise that is asked
    """
    left: dict[str, tuple[float, int]] = {}
    along = moved = 0.0
    for old, new in zip(before, after, strict=True):
        squares, count = left.get(new.output, (0.0, 0))
        left[new.output] = squares + float(new.e @ new.e) / new.sigma**2, count + len(new.e)
        between = (old.e - new.e) / new.sigma
        along += float(between @ old.e) / new.sigma
        moved += float(between @ between)
    noise = min((float(chi2_sf(*own)) for own in left.values()), default=0.0) > _NOISE / max(len(left), 1)
    if not (noise and moved > 0 and along > 0):
        return False
    size, samples = along / math.sqrt(moved), sum(count for _, count in left.values())
    chance = float(chi2_sf(size**2, 1 + found)) if found else float(normal_sf(size))
    return math.log(max(chance, 1e-300)) + found * math.log(samples) < math.log(_SURE)


def signed_rank_sf(ranks: int, count: int) -> float:
    """The chance that the ranks of ``count`` numbers, each taken with probability 1/2, add up to ``ranks`` or more.

    >>> signed_rank_sf(6, 3), signed_rank_sf(5, 3)
    (0.125, 0.25)
    """
    if count > _MANY:  # the sum of many is normal
        middle, spread = count * (count + 1) / 4, math.sqrt(count * (count + 1) * (2 * count + 1) / 24)
        return 0.5 * math.erfc((ranks - 0.5 - middle) / spread / math.sqrt(2))
    ways = np.ones(1)
    for rank in range(1, count + 1):
        ways = np.pad(ways, (0, rank)) / 2 + np.pad(ways, (rank, 0)) / 2
    return float(ways[max(ranks, 0) :].sum())


def gap(residuals: Sequence[Residuals]) -> Gap:
    """The gap of a set of residuals."""
    chi2 = sum(float(r.e @ r.e) / r.sigma**2 for r in residuals)
    count = sum(len(r.e) for r in residuals)
    rmse, percent = {}, {}
    for output in dict.fromkeys(r.output for r in residuals):
        own = [r for r in residuals if r.output == output]
        e = np.concatenate([r.e for r in own])
        spread = np.concatenate([r.measured - r.measured.mean() for r in own])
        rmse[output] = math.sqrt(float(e @ e) / len(e))
        size = float(np.linalg.norm(spread))
        percent[output] = 100 * (1 - float(np.linalg.norm(e)) / size) if size > 0 else -math.inf
    return Gap(chi2 / max(count, 1), rmse, percent, count)


def share_explained(before: Gap, after: Gap, *, floor: float = 1.0) -> float:
    """The share of the gap above the noise that the repair closed; floor : chi-squared per sample of pure noise."""
    return _share(before.chi2_per_sample, after.chi2_per_sample, floor)


def share_closed(before: Gap, after: Gap, sigma: Mapping[str, float], *, coloured: bool) -> float:
    """The share of the gap above the noise that is closed, as a person sees it: the noise is 1 of chi-squared per
    sample, or less where its level counts what is left unexplained. What is coloured counts as gap: whether it is the
    sensors' noise or more that is missing cannot be told.

    sigma : output -> standard deviation, of the innovations where the noise is coloured
    """
    if not coloured:
        return share_explained(before, after, floor=min(1.0, after.chi2_per_sample))
    old, new = (
        sum((gap.rmse[output] / level) ** 2 for output, level in sigma.items() if output in gap.rmse)
        / max(sum(output in gap.rmse for output in sigma), 1)
        for gap in (before, after)
    )
    return _share(old, new, min(1.0, new))


def _share(before: float, after: float, floor: float) -> float:
    excess = before - floor
    return float(np.clip((before - after) / excess, -1.0, 1.0)) if excess > 0 else 0.0


def hold_out(cycles: Sequence[int], *, share: float = 0.3) -> tuple[list[int], list[int]]:
    """Cycles to estimate from, and the last ``share`` of them, at least one of each, to confirm on.

    The held-out cycles are the last ones in one piece: neighbours of a cycle share its initial state. A single cycle is
    not split.
    """
    ordered = sorted(set(cycles))
    if len(ordered) < 2:
        return ordered, []
    kept = min(max(1, round(len(ordered) * (1 - share))), len(ordered) - 1)
    return ordered[:kept], ordered[kept:]
