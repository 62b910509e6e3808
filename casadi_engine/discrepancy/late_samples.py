"""The samples of late sensors that show what was before a record, which no equation knows.

Structures are held against the same samples. So those that one of them cannot tell of count as noise like that of the
samples next to them: their residuals are these mirrored, and their slopes are those at the record's end.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.experiment import Experiment
from casadi_engine.simulation.grid import Grid, Measured


def with_all_samples(grid: Grid, record: Experiment) -> Grid:
    """A grid whose late outputs have all of their valid samples, at the times when these were taken; those beyond the
    grid are at the nearest of its points."""
    late = {name: seen for name, seen in grid.measured.items() if len(seen.beyond)}
    if not late:
        return grid
    found = dict(grid.measured)
    for name, seen in late.items():
        index = np.sort(np.concatenate([seen.beyond, seen.index]))
        channel = record[name]
        own = np.clip(np.searchsorted(seen.index, index), 0, len(seen.index) - 1)
        position = seen.position[own]
        found[name] = Measured(channel.time[index], channel.values[index], position, index, seen.beyond)
    return replace(grid, measured=found)


def completed(seen: Measured, rows: Array, *, mirror: bool) -> Array:
    """Rows (N, ...) of the samples that a grid holds, with those beyond it: mirror images, or 0."""
    before = int((seen.beyond < seen.index[0]).sum())
    after = len(seen.beyond) - before
    if not before + after:
        return rows
    blocks = [_image(rows, before)[::-1], rows, _image(rows[::-1], after)]
    if not mirror:
        blocks = [np.zeros_like(blocks[0]), rows, np.zeros_like(blocks[2])]
    return np.concatenate(blocks)


def _image(rows: Array, count: int) -> Array:
    """So many rows from the first on, back and forth where there are fewer."""
    at = np.arange(count) % (2 * len(rows))
    return rows[np.minimum(at, 2 * len(rows) - 1 - at)]
