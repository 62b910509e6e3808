"""Do chains of draws agree, and how many independent draws are they worth?

Rank-normalised split R-hat, bulk and tail effective sample size (Vehtari, Gelman, Simpson, Carpenter and Buerkner,
Bayesian Analysis 16, 2021).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

Array = NDArray[np.float64]

_TAIL = 0.05


def split(chains: Array) -> Array:
    """Chains (m, t) cut in halves, (2 m, t // 2): a chain that drifts disagrees with itself."""
    half = chains.shape[1] // 2
    return np.concatenate([chains[:, :half], chains[:, chains.shape[1] - half :]])


def ranked(chains: Array) -> Array:
    """The draws' normal scores, by their ranks among all of them; ties share one."""
    flat = chains.ravel()
    _, inverse, counts = np.unique(flat, return_inverse=True, return_counts=True)
    upto = np.cumsum(counts)
    ranks = (upto - 0.5 * (counts - 1))[inverse]
    return np.asarray(ndtri((ranks - 0.375) / (flat.size + 0.25)).reshape(chains.shape))


def _plain_rhat(chains: Array) -> float:
    t = chains.shape[1]
    within = float(chains.var(axis=1, ddof=1).mean())
    between = float(t * chains.mean(axis=1).var(ddof=1))
    if within <= 0:
        return 1.0 if between <= 0 else np.inf
    return float(np.sqrt((t - 1) / t + between / within / t))


def rhat(chains: Array) -> float:
    """Rank-normalised split R-hat of one quantity in chains (m, t): the larger of location and spread; 1 is agreement.

    >>> draws = np.random.default_rng(0).standard_normal((8, 500))
    >>> round(rhat(draws), 2), round(rhat(draws + np.arange(8)[:, None]), 1)
    (1.0, 2.3)
    """
    halves = split(chains)
    folded = np.abs(halves - np.median(halves))
    return max(_plain_rhat(ranked(halves)), _plain_rhat(ranked(folded)))


def effective_size(chains: Array) -> float:
    """Independent draws that chains (m, t) are worth, by Geyer's initial monotone sequence."""
    halves = split(chains)
    m, t = halves.shape
    centred = halves - halves.mean(axis=1, keepdims=True)
    size = 1 << (2 * t - 1).bit_length()
    spectrum = np.fft.rfft(centred, size, axis=1)
    covariance = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=1)[:, :t].mean(axis=0) / t
    within = covariance[0] * t / (t - 1)
    total = within * (t - 1) / t + (halves.mean(axis=1).var(ddof=1) if m > 1 else 0.0)
    if total <= 0:
        return float(m * t)
    rho = 1.0 - (within - covariance * t / (t - 1)) / total
    rho[0] = 1.0
    pairs = rho[: t - t % 2].reshape(-1, 2).sum(axis=1)
    fallen = np.flatnonzero(pairs <= 0)
    pairs = np.minimum.accumulate(pairs[: fallen[0]] if len(fallen) else pairs)
    tau = max(-1.0 + 2.0 * float(pairs.sum()), 1.0 / np.log10(max(m * t, 10)))
    return float(m * t / tau)


def bulk_size(chains: Array) -> float:
    """Effective sample size for the middle of the distribution."""
    return effective_size(ranked(chains))


def tail_size(chains: Array) -> float:
    """Effective sample size for the 5 % and 95 % quantiles, the smaller one."""
    low, high = np.quantile(chains, [_TAIL, 1 - _TAIL])
    return min(effective_size((chains <= low).astype(float)), effective_size((chains <= high).astype(float)))
