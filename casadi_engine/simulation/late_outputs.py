"""What late sensors show: outputs at earlier times."""

from __future__ import annotations

import numpy as np

from casadi_engine.model import Model
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.jets import Array

# A lag is of whole steps of a grid within this share of one.
_WHOLE = 1e-3


def as_shown(model: Model, grid: Grid, outputs: Array) -> Array:
    """Outputs (..., ny, N) at the points of a grid, as the sensors show them that are late by the model's lags.

    Before a late sensor shows the first instant it shows what is there then.
    """
    lags = {name: lag for name, lag in model.lags if lag}
    if not lags:
        return outputs
    shown = np.array(outputs, dtype=float)
    for row, out in enumerate(model.outputs):
        if out.name in lags:
            shown[..., row, :] = _earlier(grid, outputs[..., row, :], lags[out.name])
    return shown


def _earlier(grid: Grid, rows: Array, lag: float) -> Array:
    """Rows (..., N) at times earlier by a lag, within the grid."""
    steps = lag / grid.step
    if grid.uniform and abs(steps - round(steps)) < _WHOLE:
        return rows[..., np.clip(np.arange(grid.samples) - round(steps), 0, grid.samples - 1)]
    from scipy.interpolate import CubicSpline

    time = grid.time
    found: Array = CubicSpline(time, rows, axis=-1)(np.clip(time - lag, time[0], time[-1]))
    return found
