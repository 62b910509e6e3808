"""Importance weights with a smoothed tail, and how heavy it is (Vehtari, Simpson, Gelman, Yao and Gabry, JMLR 2024)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Draws of the tail below which nothing is fitted; strength of the prior of the shape, towards 0.5.
_FEWEST, _PRIOR = 5, 10.0


def pareto_smoothed(log_weights: Array) -> tuple[Array, float]:
    """Log weights (n,) with the largest ones replaced by the quantiles of a generalised Pareto distribution, and its
    shape k-hat: below 0.7 the weighted means can be trusted; infinite where there are too few weights.

    >>> random = np.random.default_rng(0)
    >>> round(pareto_smoothed(random.exponential(0.5, 20000))[1], 1)  # weights whose tail has the shape 0.5
    0.5
    """
    count = len(log_weights)
    top = float(log_weights.max(initial=-np.inf))
    tail = int(np.ceil(min(0.2 * count, 3 * np.sqrt(count))))
    if not np.isfinite(top) or tail < _FEWEST:
        return log_weights, np.inf
    found = log_weights - top
    order = np.argsort(found)
    largest = order[-tail:]
    cutoff = float(np.exp(max(found[order[-tail - 1]], -700.0)))
    excess = np.exp(found[largest]) - cutoff
    if not excess[-1] > 0 or np.count_nonzero(excess > 0) < _FEWEST:
        return log_weights, (-np.inf if np.isfinite(found).all() else np.inf)
    k, sigma = _pareto(np.maximum(excess, 1e-300))
    share = (np.arange(tail) + 0.5) / tail
    with np.errstate(over="ignore"):  # of a tail that is far too heavy
        inverse = sigma * (np.expm1(-k * np.log1p(-share)) / k if abs(k) > 1e-12 else -np.log1p(-share))
    found[largest] = np.minimum(np.log(inverse + cutoff), 0.0)
    return found + top, float(k)


def _pareto(x: Array) -> tuple[float, float]:
    """Shape and scale of a generalised Pareto distribution from rising excesses (Zhang & Stephens 2009)."""
    n = len(x)
    m = 30 + int(np.sqrt(n))
    quarter = x[int(n / 4 + 0.5) - 1]
    b = 1 / x[-1] + (1 - np.sqrt(m / (np.arange(1, m + 1) - 0.5))) / (3 * quarter)
    shape = np.log1p(-b[:, None] * x).mean(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        profile = n * (np.log(-b / shape) - shape - 1)
    profile = np.where(np.isfinite(profile), profile, -np.inf)
    weight = np.exp(profile - profile.max())
    theta = float(b @ weight / weight.sum())
    k = float(np.log1p(-theta * x).mean())
    sigma = -k / theta
    return (k * n + 0.5 * _PRIOR) / (n + _PRIOR), sigma


def log_mean(log_weights: Array) -> float:
    """The logarithm of the mean of weights given by their logarithms."""
    top = float(log_weights.max(initial=-np.inf))
    if not np.isfinite(top):
        return top
    return top + float(np.log(np.mean(np.exp(log_weights - top))))


def normalised(log_weights: Array) -> Array:
    """Weights (n,) that sum to one."""
    weight = np.exp(log_weights - log_weights.max())
    return np.asarray(weight / weight.sum())


def kish(weight: Array) -> float:
    """Independent draws that weighted ones are worth."""
    most = float(weight.max(initial=0.0))
    return float(np.sum(weight / most) ** 2 / np.square(weight / most).sum()) if most > 0 else 0.0
