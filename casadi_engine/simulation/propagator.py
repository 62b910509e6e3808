"""The right propagator for a model: exact blocks for a linear one, a Runge-Kutta map for any other."""

from __future__ import annotations

from typing import Protocol

import casadi as ca

from casadi_engine.errors import SimulationError
from casadi_engine.model import Model
from casadi_engine.simulation.discretisation import Method
from casadi_engine.simulation.general import GeneralPropagator
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.linear import LinearPropagator


class Trajectory(Protocol):
    """What a propagation gives; see ``LinearTrajectory`` for the shapes."""

    y: Array
    ys: Array

    @property
    def end(self) -> Array: ...
    @property
    def end_z(self) -> Array: ...
    @property
    def end_s(self) -> Array: ...


def make_propagator(
    model: Model,
    grid: Grid,
    intervals: Intervals,
    z: ca.SX,
    physical: ca.SX,
    *,
    scale: Array,
    method: Method = "exact",
    gain: Array | None = None,
) -> LinearPropagator | GeneralPropagator:
    """Propagator of a model over one record.

    method : "exact", or "euler" for a linear model; gain : (n, ny) correction gain per scaled state, or None
    Raises SimulationError where a method or a gain does not go with the model.
    """
    if method not in ("exact", "euler"):
        raise SimulationError("the method is not known", seen=repr(method), allowed='"exact" or "euler"')
    if model.linear is not None and not model.has_slot_laws:
        feedback = _feedback(model, grid) if gain is not None else None
        return LinearPropagator(
            model, grid, intervals, z, physical, scale=scale, method=method, gain=gain, feedback=feedback
        )
    if method != "exact" or gain is not None:
        raise SimulationError(
            "this model has nonlinear terms, and the option is for linear models",
            seen=f"method={method!r}" if method != "exact" else "a correction gain",
            allowed='method="exact" without a gain',
            cure="take the linear form of the model, or leave the option out",
        )
    return GeneralPropagator(model, grid, intervals, z, physical, scale=scale)


def _feedback(model: Model, grid: Grid) -> Array:
    """(ny, N) measured outputs on the grid, for the correction of the one-step predictor."""
    import numpy as np

    rows = []
    for output in model.outputs:
        measured = grid.measured.get(output.name)
        if measured is None or not measured.on_grid:
            raise SimulationError(
                "a predictor needs every output on the inputs' time grid",
                seen=f"{output.name} off the grid",
                cure="resample the inputs to the output's times, or take output error (no gain)",
            )
        row = np.full(grid.samples, np.nan)
        row[measured.position.astype(int)] = measured.values
        rows.append(row)
    return np.array(rows)
