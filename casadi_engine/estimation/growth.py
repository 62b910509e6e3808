"""How much a change of a record's initial state grows on its way: past some point no number can hold its effect."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EstimationError
from casadi_engine.estimation.record import RecordPoint, RecordTerm
from casadi_engine.simulation.carried_errors import UNFOLLOWED

Array = NDArray[np.float64]

# Information is made of squares of what grows, and these must stay within the range of floating point.
_LARGEST = 100 * np.log(10.0)
# Growth that makes a gap between two intervals, 1e-11 of the states as closely as it closes, one of 1e-3.
ROUNDING = np.log(UNFOLLOWED)
# Share of its logarithm that is left to pieces which are to be followed: a growth of 1e6.
_FOLLOWED = 0.75


def log_growth(end_s: Array, intervals: int) -> float:
    """The logarithm of the largest growth of a state over ``intervals``, of their transition matrices.

    end_s : (1, n, n) if all intervals share it, else (m, n, n) with m >= intervals
    """
    if len(end_s) == 1:
        radius = float(np.abs(np.linalg.eigvals(end_s[0])).max(initial=0.0))
        return intervals * float(np.log(max(radius, 1e-300)))
    product, log, largest = np.eye(end_s.shape[1]), 0.0, 0.0
    for matrix in end_s[:intervals]:
        product = matrix @ product
        size = float(np.linalg.norm(product))
        if size == 0.0:
            break
        product, log = product / size, log + float(np.log(size))
        largest = max(largest, log)
    return largest


def in_their_sizes(point: RecordPoint) -> Array:
    """The transition matrices (1 or m, n, n) of a record between states in units of the largest that they take: what is
    a growth does not depend on units."""
    ends = point.path.end_s
    size = np.abs(point.path.end).max(axis=1)
    size = np.where(np.isfinite(size) & (size > 0), size, 1.0)
    return np.asarray(ends * (size / size[:, None]))


def length_for(record: RecordTerm, point: RecordPoint) -> float | None:
    """The length [s] of a record over which a change of its start grows no more than can be followed; None for one that
    is as short."""
    intervals = record.plan.m - 1
    if not record.n or intervals < 1 or not np.isfinite(point.path.end_s).all():
        return None
    log = log_growth(in_their_sizes(point), intervals)
    if log <= ROUNDING:
        return None
    return float(_FOLLOWED * ROUNDING / log * intervals * record.plan.length * record.grid.step)


def check_growth(records: Iterable[RecordTerm], points: Iterable[RecordPoint]) -> None:
    """Raise EstimationError if a record's model or predictor is too unstable at a point for its errors to be had."""
    for record, point in zip(records, points, strict=True):
        if not record.n or record.plan.m < 2 or not np.isfinite(point.path.end_s).all():
            continue
        log = log_growth(in_their_sizes(point), record.plan.m - 1)
        if log > _LARGEST:
            stated = record.gain is not None
            raise EstimationError(
                ("the predictor" if stated else "the model") + " is unstable over the length of the record",
                seen=f"{record.experiment.name}: a change of its start grows 1e{log / np.log(10):.0f} times",
                allowed="at most 1e100 times",
                cure="take another gain; between 0 and 1 for a measured state" if stated
                else "take shorter records, or start from values for which the motion stays finite",
            )  # fmt: skip
