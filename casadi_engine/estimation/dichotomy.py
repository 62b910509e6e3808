"""The errors of a record along which changes of its start grow: its states taken out first, by orthogonal steps.

An unstable model's initial states are told exponentially well by where the record ends, and its parameters by little
more than any other record tells. Chained through the intervals, the slopes of all of them grow alike until no number
tells them apart. Taken backwards from the record's end the states are eliminated one interval after the other: what is
left tells the parameters as if no state were known, however much changes grow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.growth import in_their_sizes, log_growth
from casadi_engine.estimation.record import RecordPoint, RecordTerm

Array = NDArray[np.float64]

# Growth from which the states are taken out: squares of it are still told apart by eight digits.
_GROWN = float(np.log(1e4))
# A state whose standard error is larger than this, in its scale, is no state to express others by.
_LOST = 1e8


def grows(record: RecordTerm, point: RecordPoint, most: float = _GROWN) -> bool:
    """True if changes of a record's start grow too much for its slopes to be chained, or more than ``most``, the
    logarithm of a factor."""
    ends = point.path.end_s
    if not record.n or record.plan.m < 2 or not np.isfinite(ends).all():
        return False
    return log_growth(in_their_sizes(point), record.plan.m - 1) > most


@dataclass(frozen=True)
class Eliminated:
    """Information (nz + n, nz + n) of a record's active parameters and of coordinates in place of its initial states,
    the gradient (nz + n,) of its loss in these, and the matrix (nz + n, nz + n) that leads from these coordinates to
    the states."""

    information: Array
    gradient: Array
    turn: Array


def eliminated(
    record: RecordTerm, point: RecordPoint, kept: NDArray[np.bool_], slope: Array
) -> Eliminated | None:
    """A record whose states are taken out; None where a state is not told.

    kept : (n,) initial states that stay coordinates, as they have a bound or are fixed; slope : (K, M) of the loss
    """
    n, nz = record.n, len(record.active)
    rows = _swept(record, point, slope)
    order = np.concatenate([np.flatnonzero(~kept), np.flatnonzero(kept), n + np.arange(nz)])
    r = np.asarray(np.linalg.qr(rows[:, np.append(order, n + nz)], mode="r"))
    r, off = r[: len(order), :-1], r[: len(order), -1]
    count = int((~kept).sum())
    if (
        len(r) < len(order)
        or not np.isfinite(r).all()
        or not np.abs(np.diag(r)[:count]).min(initial=1.0) > 1 / _LOST
    ):
        return None
    back = np.linalg.inv(r[:count, :count])
    # positions of [parameters; states] among the columns of r
    place = np.argsort(np.concatenate([nz + np.arange(n)[~kept], nz + np.arange(n)[kept], np.arange(nz)]))
    information, turn = np.eye(len(order)), np.eye(len(order))
    information[count:, count:] = r[count:, count:].T @ r[count:, count:]
    turn[:count, :count], turn[:count, count:] = back, -back @ r[:count, count:]
    gradient = np.concatenate([off[:count], r[count:, count:].T @ off[count:]])
    return Eliminated(information[np.ix_(place, place)], gradient[place], turn[np.ix_(place, place)])


def _swept(record: RecordTerm, point: RecordPoint, slope: Array) -> Array:
    """Rows over [first state; parameters] that have the products of all residuals' slopes, and beside them the residual
    that has their products with ``slope`` (K, M). What is left of gaps between the intervals is none of it: it grows
    as changes do, and a search closes them."""
    n, nz, m = record.n, len(record.active), record.plan.m
    end_z, end_s, weight = point.path.end_z, point.path.end_s, record.weight
    jz, js = point.jz, point.js
    found: Array = np.zeros((0, n + nz + 1))
    for i in range(m - 1, -1, -1):
        ahead = np.eye(n + nz + 1)
        ahead[:n, :n] = end_s[i if len(end_s) > 1 else 0]
        ahead[:n, n:-1] = end_z[:, :, i].T
        own = (js if js.ndim == 2 else js[:, i]) * weight[:, i, None]
        # the large rows first: steps by Householder's reflections then keep the small ones
        mine = np.concatenate([own, jz[:, :, i].T, slope[:, i, None]], axis=1)
        rows = np.concatenate([found @ ahead, mine])
        found = np.asarray(np.linalg.qr(rows, mode="r"))
    return found
