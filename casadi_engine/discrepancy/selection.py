"""How many independent samples a residual is worth, and how often halves of the data choose the same effect."""

from __future__ import annotations

from typing import Any

import numpy as np

from casadi_engine.discrepancy.compression import Compressed
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.score import score

_HALVES = 50


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


def numbers_of(e: Array) -> float:
    """How many independent numbers the size of a residual (N,) is told by: N over the sum of its squared correlations
    over all lags, to both sides, which is as large for a swing that does not die out as for one that is slow."""
    e, count = e - e.mean(), len(e)
    power = float(e @ e)
    if count < 3 or power <= 0:
        return float(count)
    rho = np.fft.irfft(np.abs(np.fft.rfft(e, 2 * count)) ** 2)[:count] / power
    return float(count / (2 * float(rho @ rho) - 1))


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
