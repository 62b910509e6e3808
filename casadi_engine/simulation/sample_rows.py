"""Between samples in time order and the batch's layout: row of a block, block of an interval, interval."""

from __future__ import annotations

import numpy as np

from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array


def to_rows(plan: Intervals, y: Array) -> Array:
    """(., ny, L, M) to (., R*ny, b, M)."""
    rows = y[:, :, plan.samples[:, None] + plan.q * np.arange(plan.b)]
    return np.ascontiguousarray(rows.transpose(0, 2, 1, 3, 4)).reshape(len(y), -1, plan.b, plan.m)


def from_rows(plan: Intervals, rho: Array, ny: int) -> Array:
    """The transpose of ``to_rows``: (R*ny, b, M) to (L, ny, M)."""
    spread = np.zeros((plan.length, ny, plan.m))
    for sample, row in zip(plan.samples, rho.reshape(-1, ny, plan.b, plan.m), strict=True):
        spread[sample :: plan.q] = row.transpose(1, 0, 2)
    return spread
