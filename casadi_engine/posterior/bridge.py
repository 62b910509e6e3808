"""The evidence from draws of a posterior and of a proposal: bridge sampling (Meng & Wong 1996)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from casadi_engine.posterior.mixture import around

Array = NDArray[np.float64]

_ROUNDS, _SETTLED, _COMPONENTS = 200, 1e-8, 8


def bridge(
    density: Callable[[Array], Array],
    chains: Array,
    heights: Array,
    size: float,
    random: np.random.Generator,
    count: int = 2000,
) -> tuple[float, float]:
    """Log of the integral of the density and its standard error, from walkers' draws (m, t, d).

    heights : (m, t) their log densities; size : independent draws that they are worth
    The proposal is fitted to the first half of every chain and compared with the other one.
    """
    half = chains.shape[1] // 2
    d = chains.shape[2]
    first, second = chains[:, :half].reshape(-1, d), chains[:, half:].reshape(-1, d)
    thin = random.choice(len(first), min(len(first), 8000), replace=False)
    proposal = around(first[thin], _COMPONENTS, random)
    thin = random.choice(len(second), min(len(second), 8000), replace=False)
    mine = heights[:, half:].reshape(-1)[thin] - proposal.log_density(second[thin])
    x = proposal.draw(count, random)
    other = density(x) - proposal.log_density(x)
    return meng_wong(mine, other, max(size / 2, 2.0))


def meng_wong(mine: Array, other: Array, size: float) -> tuple[float, float]:
    """Log ratio of normalising constants and its error, from log(posterior / proposal) at draws of the posterior (n,)
    and of the proposal (k,); size : independent draws that the first are worth."""
    share = size / (size + len(other))
    tilt, found = np.log(share / (1 - share)), float(np.median(mine))
    for _ in range(_ROUNDS):
        # 1 / (s1 l + s2 r), with s1 l / (s1 l + s2 r) = expit(log l - log r + tilt)
        above = expit(other - found + tilt) / share
        below = expit(found - mine - tilt) / (1 - share)
        change = float(np.log(above.mean()) - np.log(below.mean()))
        found += change
        if abs(change) < _SETTLED:
            break
    above = expit(other - found + tilt)
    below = expit(found - mine - tilt)
    error = above.var() / above.mean() ** 2 / len(other) + below.var() / below.mean() ** 2 / size
    return found, float(np.sqrt(error))
