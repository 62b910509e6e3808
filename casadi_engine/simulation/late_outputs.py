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

    What a late sensor shows before it shows the first instant goes on backwards as the first samples do, to second
    order and within what is shown later.
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
    """Rows (..., N) at times earlier by a lag; beyond the grid by the parabola through the three samples next to it."""
    time = grid.time
    at, steps = time - lag, lag / grid.step
    if grid.uniform and abs(steps - round(steps)) < _WHOLE:
        found = rows[..., np.clip(np.arange(grid.samples) - round(steps), 0, grid.samples - 1)]
    else:
        from scipy.interpolate import CubicSpline

        found = CubicSpline(time, rows, axis=-1)(np.clip(at, time[0], time[-1]))
    near = _WHOLE * grid.step
    for beyond, own in ((at < time[0] - near, slice(0, 3)), (at > time[-1] + near, slice(-3, None))):
        if beyond.any() and grid.samples > 2:
            low, high = rows.min(axis=-1, keepdims=True), rows.max(axis=-1, keepdims=True)
            found[..., beyond] = np.clip(_parabola(time[own], rows[..., own], at[beyond]), low, high)
    return found


def _parabola(t: Array, y: Array, at: Array) -> Array:
    """Through three points t (3,), y (..., 3), by Lagrange."""
    a, b, c = t
    weights = np.array(
        [
            (at - b) * (at - c) / ((a - b) * (a - c)),
            (at - a) * (at - c) / ((b - a) * (b - c)),
            (at - a) * (at - b) / ((c - a) * (c - b)),
        ]
    )
    found: Array = y @ weights
    return found
