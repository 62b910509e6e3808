"""Slopes of a whole record from those of its shooting intervals, whose starts follow one another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.record import RecordPoint, RecordTerm

Array = NDArray[np.float64]


def chained_slopes(record: RecordTerm, point: RecordPoint, intervals: int | None = None) -> Array:
    """(nz + n, K, m) weighted slopes of the residuals in the record's active parameters and in its first states.

    intervals : the first so many (default: all). A record advanced in one piece takes one step after the other; its
    intervals are taken side by side, and the chain rule joins them.
    """
    count = record.plan.m if intervals is None else intervals
    jz, js = point.jz, point.js
    n, nz = record.n, len(jz)
    found = np.zeros((nz + n, len(point.r), count))
    found[:nz] = jz[:, :, :count]
    turn = _starts(record, point, count)
    weight = record.weight[:, :count]
    if js.ndim == 3:
        found += np.matmul(js[:, :count].transpose(1, 0, 2), turn).transpose(2, 1, 0) * weight
    else:
        found += np.matmul(js, turn).transpose(2, 1, 0) * weight
    return found


def _starts(record: RecordTerm, point: RecordPoint, count: int) -> Array:
    """(count, n, nz + n) slopes of the intervals' starts."""
    path, n, nz = point.path, record.n, len(record.active)
    turn = np.zeros((count, n, nz + n))
    turn[0, :, nz:] = np.eye(n)
    if count == 1:
        return turn
    ends, pushes = path.end_s, path.end_z
    for k in range(count - 1):
        np.matmul(ends[0] if len(ends) == 1 else ends[k], turn[k], out=turn[k + 1])
        turn[k + 1, :, :nz] += pushes[:, :, k].T
    return turn
