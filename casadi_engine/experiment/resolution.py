"""The step in which a sensor reads."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Values that differ by less than this share of the largest gap between two are one; gaps are multiples of a step within
# this share of it; so many values have to be there.
_SAME, _NEAR, _FEWEST = 1e-3, 0.02, 3


def step_of(measured: NDArray[np.float64]) -> float | None:
    """The step of which all measured values (N,) are multiples, but for one offset; None where there is none."""
    values = np.unique(measured)
    if len(values) < _FEWEST:
        return None
    gaps = np.diff(values)
    gaps = gaps[gaps > _SAME * gaps.max()]
    step = float(gaps.min())
    turns = gaps / step
    return step if np.abs(turns - np.round(turns)).max() < _NEAR else None
