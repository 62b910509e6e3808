"""Reducing a long signal to what a figure can show, without losing its peaks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Bins across a figure: more than its pixels show, few enough for a small file.
BINS = 900


def ascending(x: Array) -> bool:
    """Whether a signal goes from left to right, as a time does."""
    return bool(np.all(x[1:] >= x[:-1]))


def envelope(time: Array, values: Array, *, bins: int = BINS) -> tuple[Array, Array]:
    """Return (time, values) with two points a bin, the smallest and the largest in their order of time.

    time : (N,) s.  values : (N,) any unit; NaN is missing, and a bin without any value stays NaN
    Signals of up to 2·bins samples are returned as they are. The largest and the smallest value are kept.

    >>> import numpy as np
    >>> t, y = envelope(np.arange(8.0), np.array([0, 5, 1, 1, 1, 1, -3, 2.0]), bins=2)
    >>> t, y
    (array([0., 1., 6., 7.]), array([ 0.,  5., -3.,  2.]))
    """
    n = values.size
    if n <= 2 * bins:
        return time, values
    width = -(-n // bins)
    rows = -(-n // width)
    padded = np.full(rows * width, np.nan)
    padded[:n] = values
    grid = padded.reshape(rows, width)
    missing = np.isnan(grid)
    low = np.argmin(np.where(missing, np.inf, grid), axis=1)
    high = np.argmax(np.where(missing, -np.inf, grid), axis=1)
    base = np.arange(rows) * width
    picked = np.sort(np.stack([base + low, base + high], axis=1), axis=1).ravel()
    return time[picked], padded[picked]
