"""The samples of late sensors that show what was before a record, which no equation knows.

Structures are held against the same samples. So those that one of them cannot tell of count as noise like that of the
samples next to them: their residuals are these mirrored, and their slopes are those at the record's end.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.experiment import Experiment
from casadi_engine.simulation.grid import Grid, Measured

if TYPE_CHECKING:
    from casadi_engine.discrepancy.null_model import NullModel, RecordNull

Samples = Mapping[tuple[str, str], NDArray[np.intp]]


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


def beyond(null: NullModel) -> Samples:
    """(record, output) -> numbers of the samples that a model with late sensors cannot tell of."""
    found = {}
    for record in null.records:
        for output in record.residual:
            own = record.path.grid.measured[output].beyond
            if len(own):
                found[record.name, output] = own
    return found


def leaving_out(null: NullModel, samples: Samples, *, free: bool = False) -> NullModel:
    """The model as if it could not tell of these samples either: the noise next to them stands in for what it leaves
    there. What is wrong with a record's beginning is else explained by whatever does not look at it.

    free : True for first states that may move to where the other samples have them, to first order
    """
    return replace(null, records=tuple(_leaving_out(record, samples, free) for record in null.records))


def _leaving_out(record: RecordNull, samples: Samples, free: bool) -> RecordNull:
    lost = {out: np.isin(record.index[out], samples.get((record.name, out), ())) for out in record.residual}
    if not any(own.any() and not own.all() for own in lost.values()):
        return record
    slopes = {out: np.where(lost[out][:, None], 0.0, rows) for out, rows in record.slopes.items()}
    residual = {out: np.where(lost[out], 0.0, e) for out, e in record.residual.items()}
    if free and record.starts:
        first = np.concatenate([slopes[out][:, -len(record.starts) :] for out in residual])
        step = np.linalg.lstsq(first, np.concatenate(list(residual.values())), rcond=None)[0]
        residual = {out: e - slopes[out][:, -len(step) :] @ step for out, e in residual.items()}
    return replace(record, slopes=slopes, residual={o: _stood_in(e, lost[o]) for o, e in residual.items()})


def _stood_in(e: Array, lost: NDArray[np.bool_]) -> Array:
    """A residual whose lost samples at both ends are the mirror images of those next to them."""
    kept = np.flatnonzero(~lost)
    if not len(kept):
        return e
    low, high = int(kept[0]), int(kept[-1]) + 1
    rows = e[low:high]
    return np.concatenate([_image(rows, low)[::-1], rows, _image(rows[::-1], len(e) - high)])
