"""Errors of integration, carried from one shooting interval to the next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Growth of an error along a record from which no run is followed to its end, and over which it is carried then: the
# nodes of a fit go along the measurement, and what an error has made of the motion by then they take.
UNFOLLOWED, _CARRIED = 1e8, 1e4


def carried_on(ends: Array, own: Array) -> Array:
    """(M, n) errors at the starts of intervals, from those that arise within each (M, n) and what it makes of its start
    (M, n, n)."""
    count, n = own.shape
    found, growth = np.zeros((count, n)), np.eye(n)
    afresh = unstable(ends[: count - 1])
    for k in range(count - 1):
        found[k + 1] = ends[k] @ found[k] + own[k]
        if afresh:
            growth = ends[k] @ growth
            if np.linalg.norm(growth) > _CARRIED:
                found[k + 1], growth = 0.0, np.eye(n)
    return found


def unstable(ends: Array) -> bool:
    """True if a change grows beyond what can be followed over intervals (M, n, n)."""
    growth, log = np.eye(ends.shape[-1]), 0.0
    for one in ends:
        growth = one @ growth
        size = float(np.linalg.norm(growth))
        if not 0 < size < np.inf:
            return False
        growth, log = growth / size, log + float(np.log(size))
        if log > np.log(UNFOLLOWED):
            return True
    return False
