"""The integration steps between the samples of a record, laid out for all shooting intervals side by side.

Each cell of the grid, from one sample to the next, is cut into a number of steps of its own, of any lengths. Row by
row stand the first steps of all intervals, then the second ones, and so on: a row holds the intervals that still have a
step, so that one interval which passes a corner costs its own steps and none of the others'.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array

Index = NDArray[np.intp]


@dataclass(frozen=True)
class StepLayout:
    """K steps of M intervals, or parts of steps that are cut at instants of their own; behind them M fillers of length
    0, which stand at the intervals' ends.

    rows : (S+1,) where each row of steps begins, K last
    time, length : (K+M,) where the whole step begins and how long it is [s]; low, high : (nu, K+M) the channels at its
    ends; part : (K+M,) number of the step's part; number : (K,) of the whole step in order of time
    at : (L+1, M) number of the step that begins at each sample of the intervals; K + m at the end of interval m
    after : (K,) number of what follows each step in its interval
    """

    rows: Index
    time: Array
    length: Array
    low: Array
    high: Array
    part: Index
    number: Index
    at: Index
    after: Index

    @property
    def steps(self) -> int:
        """K."""
        return len(self.number)

    @property
    def interval(self) -> Index:
        """(K,) number of the interval of each step."""
        found = np.empty(self.steps + self.intervals, np.intp)
        found[self.steps :] = np.arange(self.intervals)
        for own, after in reversed(self):
            found[own] = found[after]
        return found[: self.steps]

    @property
    def intervals(self) -> int:
        """M."""
        return self.at.shape[1]

    def __iter__(self) -> Iterator[tuple[slice, Index]]:
        """The rows one after the other: their steps, and the numbers of what follows these."""
        for low, high in zip(self.rows[:-1], self.rows[1:], strict=True):
            yield slice(int(low), int(high)), self.after[low:high]

    def __reversed__(self) -> Iterator[tuple[slice, Index]]:
        """The same, backward."""
        return reversed(list(self))


def lay_steps(
    grid: Grid, plan: Intervals, counts: Index, parts: int = 1, shares: Array | None = None
) -> StepLayout:
    """The steps of a record; counts : (N-1,) steps of each of the grid's cells, 1 or more; parts : of each step.

    shares : of their cells that steps take, in order of time; None for equal steps in each cell
    """
    m, length, cells = plan.m, plan.length, grid.samples - 1
    padded = np.zeros(m * length, np.intp)
    padded[:cells] = counts
    before = np.concatenate([[0], np.cumsum(padded)])
    starts = before[:-1].reshape(m, length)
    inside = np.concatenate([starts, before[length::length, None]], axis=1) - starts[:, :1]
    sizes = inside[:, -1]
    rank = np.empty(m, np.intp)
    rank[np.argsort(-sizes, kind="stable")] = np.arange(m)
    size = int(sizes.max(initial=0))
    active = m - np.cumsum(np.bincount(sizes, minlength=size + 1))[:size]
    rows = np.concatenate([[0], parts * np.cumsum(active)]).astype(np.intp)
    # steps in order of time, and the number that each has in the layout
    cell = np.repeat(np.arange(m * length), padded)
    interval, total = cell // length, parts * len(cell)
    row, share = np.arange(len(cell)) - before[interval * length], np.arange(len(cell)) - before[cell]
    place = rows[row] + rank[interval]
    last = row + 1 == sizes[interval]
    following = np.where(last, total + interval, rows[np.minimum(row + 1, size - 1)] + rank[interval])
    chosen, after, part = (np.empty(total, np.intp) for _ in range(3))
    for k in range(parts):
        own = place + k * active[row]
        chosen[own], part[own] = np.arange(len(cell)), k
        after[own] = own + active[row] if k < parts - 1 else following
    at = np.where(
        inside < sizes[:, None],
        rows[np.minimum(inside, size - 1)] + rank[:, None],
        total + np.arange(m)[:, None],
    )
    ends = np.minimum(length * np.arange(1, m + 1), cells)
    steps = _Steps.of(grid, cell, *_places(cell, share, padded, shares))
    return StepLayout(
        rows=np.concatenate([[0], np.cumsum(np.repeat(active, parts))]).astype(np.intp),
        time=np.concatenate([steps.time[chosen], grid.time[ends]]),
        length=np.concatenate([steps.length[chosen], np.zeros(m)]),
        low=np.concatenate([steps.low[:, chosen], grid.channels[:, ends]], axis=1),
        high=np.concatenate([steps.high[:, chosen], grid.channels[:, ends]], axis=1),
        part=np.concatenate([part, np.zeros(m, np.intp)]),
        number=chosen,
        at=np.ascontiguousarray(at.T),
        after=after,
    )


@dataclass(frozen=True)
class _Steps:
    """Steps in order of time: where they begin, their lengths, and the channels at their ends."""

    time: Array
    length: Array
    low: Array
    high: Array

    @staticmethod
    def of(grid: Grid, cell: Index, begins: Array, ends: Array) -> _Steps:
        """The steps between such shares of their cells."""
        times, first = grid.time, [[hold == "first"] for hold in grid.holds]
        duration = np.diff(times)[cell]
        begin = grid.channels[:, cell]
        linear = np.array(first).reshape(len(grid.channels), 1)
        rise = np.where(linear, grid.channels[:, cell + 1] - begin, 0.0)
        return _Steps(
            times[cell] + duration * begins,
            duration * (ends - begins),
            begin + rise * begins,
            begin + rise * ends,
        )


def _places(cell: Index, share: Index, counts: Index, shares: Array | None) -> tuple[Array, Array]:
    """Where in its cell each step begins and ends, 0 to 1; share : number of the step in its cell."""
    if shares is None:
        whole = counts[cell]
        return share / whole, (share + 1) / whole
    behind = np.cumsum(shares)
    begins = behind - shares
    first = np.arange(len(cell)) - share
    begins -= begins[first]
    ends = np.append(begins[1:], 1.0)
    ends[share + 1 == counts[cell]] = 1.0
    return begins, ends
