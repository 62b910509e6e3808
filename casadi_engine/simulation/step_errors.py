"""What single integration steps are off by, carried through the later ones: the error of a whole run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.step_layout import StepLayout


def carried_errors(
    layout: StepLayout,
    plan: Intervals,
    own: Array,
    ends: NDArray[np.intp],
    maps: Array,
    chained: Array,
) -> Array:
    """Errors of the states at the samples, (L, M, n), of a run through all intervals.

    own : (k, n) what steps are off by at their ``ends`` (k,), numbers in the layout; maps : (K, n, n) derivatives of
    the steps, chained : (K+M, n, n) of the states where they begin, by the intervals' starts
    """
    count, n = plan.m, own.shape[1]
    carried, arises = np.zeros((2, layout.steps + count, n))
    arises[ends] = own
    for steps, after in layout:
        carried[after] = (maps[steps] @ carried[steps][..., None])[..., 0] + arises[after]
    joined, last = np.zeros((count, n)), layout.steps + np.arange(count)
    for i in range(count - 1):
        joined[i + 1] = chained[last[i]] @ joined[i] + carried[last[i]]
    at = layout.at[: plan.length]
    return np.asarray(carried[at] + (chained[at] @ joined[None, :, :, None])[..., 0])


def errors_by_cell(layout: StepLayout, own: Array, begun: Array) -> Array:
    """What arises in each cell of the grid, relative to the largest state; begun : (n, K+M) states along the steps."""
    size = np.abs(begun).max(axis=1) + 1e-300
    sizes = np.nan_to_num(np.abs(own / size).max(axis=-1), nan=np.inf, posinf=np.inf)
    first = np.flatnonzero(layout.part[: layout.steps] == 0)
    return np.bincount(layout.cell[first], sizes).astype(np.float64)


def shares(errors: Array) -> Array:
    """Errors that arise in cells (N-1,), relative to their mean.

    Raises FloatingPointError where none is finite.
    """
    finite = np.isfinite(errors)
    if not finite.any():
        raise FloatingPointError("no step of the record can be compared with two of half its length")
    return np.asarray(np.where(finite, errors, np.inf) / max(float(errors[finite].mean()), 1e-300))
