"""Going on from a lower optimum that the profile of a parameter came below: a search that ended in a higher one is not
left there, where the better place is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from casadi_engine.estimation.fit import Fit

# Chi-squared by which an optimum has to be lower to take the place of another, and what is no optimum; and how often.
_LOWER, _FAR, _AGAIN = 0.1, 4.0, 4


@dataclass(frozen=True)
class Place:
    """Where a search is to begin: parameters, record -> state -> its first value, noise levels as a fit has them."""

    values: Mapping[str, float]
    initial: Mapping[str, Mapping[str, float]]
    noise: Mapping[str, tuple[float, bool]]


def from_lower_places(fit: Fit, again: Callable[[dict[str, Any]], Fit]) -> Fit:
    """The fit, or the lowest one that searches from lower places lead to.

    again(changes) : makes a fit with changed arguments
    """
    for _ in range(_AGAIN):
        if fit.lower is None or not fit.converged:
            return fit
        found = again({"warm": fit.lower})
        # where a far better place is known, this is no optimum, whether or not the search from there ends in one
        if not merit(found) < merit(fit) - (_LOWER if found.converged else _FAR):
            return fit
        fit = found
    return fit


def merit(fit: Fit) -> float:
    """Twice the negative log likelihood, but for a constant: where noise levels are estimated chi-squared is about the
    number of samples everywhere, and so where innovations have the size that the noise covariances foretell."""
    total, levels = fit.cost, fit.noise
    if fit.innovations is not None and fit.innovations.kind == "process":
        levels = {name: (sigma, True) for name, sigma in fit.innovations.sigma.items()}
    for name, (sigma, estimated) in levels.items():
        count = sum(int(np.count_nonzero(own[name].mask)) for own in fit.traces.values() if name in own)
        total += 2 * count * math.log(sigma) if estimated and sigma > 0 else 0.0
    return total
