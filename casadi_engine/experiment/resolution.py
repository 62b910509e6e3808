"""The step in which a sensor reads."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Values that differ by less than this share of the largest are one but for their rounding, and so are those that differ
# by less than the other of the gap that is usual between two; gaps are multiples of a step within this share of it; so
# many values have to be there.
_ROUNDING, _SAME, _NEAR, _FEWEST = 1e-9, 1e-3, 0.02, 3


def step_of(measured: NDArray[np.float64]) -> float | None:
    """The step of which all measured values (N,) are multiples, but for one offset; None where there is none."""
    values = np.unique(measured)
    if len(values) < _FEWEST:
        return None
    gaps = np.diff(values)
    gaps = gaps[gaps > _ROUNDING * np.abs(values).max()]
    if not len(gaps):
        return None
    gaps = gaps[gaps > _SAME * np.median(gaps)]
    step = float(gaps.min())
    turns = gaps / step
    return step if np.abs(turns - np.round(turns)).max() < _NEAR else None
