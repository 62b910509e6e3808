"""The integration steps between the samples of a record, laid out for all shooting intervals side by side.

Each cell of the grid, from one sample to the next, is cut into a number of steps of its own. Intervals with fewer steps
than the longest are filled up with steps of length 0, which change nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array


@dataclass(frozen=True)
class StepLayout:
    """S steps of M intervals.

    time, length : (S, M) where a step begins and how long it is [s]; low, high : (nu, S, M) the channels at its ends
    at : (L+1, M) number of the step that begins at each sample of the intervals (S where there is none)
    cell : (S, M) number of the grid's cell that a step lies in, -1 for the fillers
    """

    time: Array
    length: Array
    low: Array
    high: Array
    at: NDArray[np.intp]
    cell: NDArray[np.intp]

    @property
    def steps(self) -> int:
        """S."""
        return len(self.time)


def lay_steps(grid: Grid, plan: Intervals, counts: NDArray[np.intp]) -> StepLayout:
    """The steps of a record; counts : (N-1,) steps of each of the grid's cells, 1 or more."""
    m, length, cells = plan.m, plan.length, grid.samples - 1
    padded = np.zeros(m * length, np.intp)
    padded[:cells] = counts
    before = np.concatenate([[0], np.cumsum(padded)])
    starts = before[:-1].reshape(m, length)
    at = np.concatenate([starts, before[length::length, None]], axis=1) - starts[:, :1]
    size = max(int(at[:, -1].max()), 1)
    cell = np.repeat(np.arange(m * length), padded)
    interval = cell // length
    row = np.arange(len(cell)) - before[interval * length]
    part = np.arange(len(cell)) - before[cell]
    whole = np.maximum(padded, 1)[cell]
    times = grid.time
    duration = np.diff(times)
    # Fillers stand at the end of their interval, where the model can be evaluated.
    last = np.minimum(length * np.arange(1, m + 1), cells)
    time, step = np.tile(times[last], (size, 1)), np.zeros((size, m))
    time[row, interval] = times[cell] + duration[cell] * (part / whole)
    step[row, interval] = duration[cell] / whole
    where = np.full((size, m), -1, np.intp)
    where[row, interval] = cell
    low = np.tile(grid.channels[:, None, last], (1, size, 1))
    high = low.copy()
    first = np.array([[hold == "first"] for hold in grid.holds]).reshape(len(grid.channels), 1)
    begin = grid.channels[:, cell]
    rise = np.where(first, grid.channels[:, np.minimum(cell + 1, cells)] - begin, 0.0)
    low[:, row, interval] = begin + rise * (part / whole)
    high[:, row, interval] = begin + rise * ((part + 1) / whole)
    return StepLayout(time, step, low, high, np.ascontiguousarray(at.T), where)
