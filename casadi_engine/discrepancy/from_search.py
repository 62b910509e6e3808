"""The null model of a shooting problem's point: its residuals and chained slopes, without another simulation."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.null_model import (
    NullModel,
    RecordNull,
    cycle_numbers,
    free_directions,
    prior_rows,
    unit_of,
)
from casadi_engine.estimation.chained import chained_slopes
from casadi_engine.estimation.search import Search


def null_of_search(search: Search, x: Array) -> NullModel:
    """The model linearised at a point (size,) whose gaps are closed; without the paths that candidates act along."""
    problem, pmap = search.problem, search.pmap
    v = x[: problem.nv]
    z = search.coordinates.values(v)
    turn = free_directions(search.model, pmap, z, ())
    by_z = turn / search.coordinates.slope(v)[:, None]
    point = problem.at(x)
    records = tuple(
        _record(search, record, own, by_z)
        for record, own in zip(search.records, point.records, strict=True)
    )
    units = tuple(unit_of(search.parameters, name) for name in pmap.free)
    return NullModel(search.model, pmap.free, units, z, turn, prior_rows(pmap, z, turn), records)


def _record(search: Search, record: Any, point: Any, by_z: Array) -> RecordNull:
    model, grid = search.model, record.grid
    nz, flat = len(record.active), record.weight.ravel()
    weight = np.where(flat > 0, flat, 1.0)
    slopes = chained_slopes(record, point).reshape(nz + record.n, -1) / weight
    states = np.array([state.scale for state in model.states]) / record.scale
    both = np.concatenate([by_z[record.active].T @ slopes[:nz], slopes[nz:] * states[:, None]]).T
    left = -point.r.ravel() / weight
    where = record.observation.where
    measured = grid.measured
    return RecordNull(
        name=record.experiment.name,
        path=SimpleNamespace(grid=grid),  # type: ignore[arg-type]
        residual={name: left[rows] for name, rows in where.items()},
        time={name: measured[name].time for name in where},
        index={name: measured[name].index for name in where},
        length={name: len(record.experiment[name].time) for name in where},
        cycle={name: cycle_numbers(model, grid, measured[name].time) for name in where},
        slopes={name: both[rows] for name, rows in where.items()},
        starts=tuple(state.name for state in model.states),
    )
