"""The steps of the exponential integrator: how many in each cell of the grid, and what channels and drives give them.

A corner of a law is passed in a few cells only: these are cut into many steps, and the others into few or none.
Intervals advance row by row as in ``StepLayout``; steps of the same length share their matrices, and are one group.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.laws import Laws
from casadi_engine.simulation.step_layout import lay_steps

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Substeps:
    """(N-1,) steps of each cell of a grid."""

    counts: Index

    @property
    def most(self) -> int:
        """Most steps of a cell."""
        return int(self.counts.max(initial=1))

    @property
    def mean(self) -> float:
        """Steps to a cell on average."""
        return float(self.counts.mean()) if len(self.counts) else 1.0


class LocalSteps:
    """K steps of M intervals; the cells behind the record have one each, with the last value of every channel.

    levels : the different numbers of steps to a cell; level : (K,) which of them each step belongs to
    groups : their steps; number : (K,) of the step in its cell; given : (3, rows, K) what the laws take from channels
    at the start, middle and end of each step
    """

    def __init__(self, grid: Grid, plan: Intervals, laws: Laws, counts: Index) -> None:
        tail = plan.padded - grid.samples + 1
        self.grid, self.plan, self.counts = (
            _padded(grid, plan),
            plan,
            np.append(counts, np.ones(tail, np.intp)),
        )
        self.laws, self.layout = laws, lay_steps(self.grid, plan, self.counts)
        layout = self.layout
        self.levels, self.level = np.unique(self.counts[layout.cell], return_inverse=True)
        one = len(self.levels) == 1
        self.groups: list[slice | Index] = (
            [slice(0, layout.steps)]
            if one
            else [np.flatnonzero(self.level == k) for k in range(len(self.levels))]
        )
        self.given = laws.given(layout, (0.0, 0.5, 1.0))

    @cached_property
    def rows(self) -> list[tuple[slice, Index, int | Index]]:
        """The rows one after the other: their steps, what follows these, and their level, one or each its own."""
        found: list[tuple[slice, Index, int | Index]] = []
        for own, after in self.layout:
            level = self.level[own]
            same = len(self.levels) == 1 or level.min() == level.max()
            found.append((own, after, int(level[0]) if same else level))
        return found

    @cached_property
    def order(self) -> Index:
        """(K,) numbers of the steps in order of time, one interval after the other."""
        return np.argsort(self.layout.time[: self.layout.steps], kind="stable")

    @property
    def steps(self) -> int:
        """K."""
        return self.layout.steps

    @property
    def most(self) -> int:
        """Most steps of a cell."""
        return int(self.levels[-1])

    @property
    def width(self) -> float:
        """Intervals that advance together on average."""
        return self.steps / max(len(self.layout.rows) - 1, 1)

    def parts(self, size: int) -> list[tuple[int, slice | Index]]:
        """Runs of at most ``size`` steps of one level each: its number, and their numbers."""
        found: list[tuple[int, slice | Index]] = []
        for level, group in enumerate(self.groups):
            if isinstance(group, slice):
                found += [(level, slice(k, min(k + size, group.stop))) for k in range(0, group.stop, size)]
            else:
                found += [(level, group[k : k + size]) for k in range(0, len(group), size)]
        return found

    def columns(self, v: Array, first: NDArray[np.bool_]) -> Array:
        """Merged drives (..., m, N) at the start and end of each step, (..., 2 m, K); first : (m,) straight lines."""
        padded = self.at_points(v)
        cell, whole = self.layout.cell, self.counts[self.layout.cell]
        low = padded[..., cell]
        rise = np.where(first[:, None], padded[..., cell + 1] - low, 0.0)
        share = self._number / whole
        return np.concatenate([low + share * rise, low + (share + 1 / whole) * rise], axis=-2)

    def at_points(self, v: Array) -> Array:
        """(..., N) of the record with the last value behind it."""
        tail = np.repeat(v[..., -1:], self.grid.samples - v.shape[-1], axis=-1)
        return np.concatenate([v, tail], axis=-1)

    def at_samples(self, columns: Array) -> Array:
        """Drive columns (2m, K) at the intervals' samples, (m, L, M)."""
        return columns[: len(columns) // 2, self.layout.at[: self.plan.length]]

    @cached_property
    def _number(self) -> Array:
        """(K,) number of each step in its cell."""
        number, begins = np.empty(self.steps), np.cumsum(self.counts) - self.counts
        number[self.order] = np.arange(self.steps) - begins[self.layout.cell[self.order]]
        return number

    def by_cell(self, values: Array) -> Array:
        """The largest of (K,) values in each cell of the record, (N-1,)."""
        begins = np.cumsum(self.counts) - self.counts
        return np.maximum.reduceat(values[self.order], begins)


def _padded(grid: Grid, plan: Intervals) -> Grid:
    """The grid with a point behind each cell of every interval."""
    more = plan.padded + 1 - grid.samples
    rows = tuple(np.append(row, np.full(more, row[-1])) for row in grid.rows)
    return replace(grid, rows=rows, samples=plan.padded + 1)
