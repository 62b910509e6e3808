"""A grid with more points: parts of its cells, and around the instants at which equations jump in time."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.model import Model
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.tape import ArrayFunction
from casadi_engine.simulation.time_events import time_events

# Halvings of a cell in which a switch lies: its instant is then known to the last digit.
_HALVINGS = 60
# Points on both sides of an instant, this share of the shorter part of its cell away from it.
_BESIDE = 1e-7


def with_parts(grid: Grid, counts: NDArray[np.intp]) -> Grid:
    """The grid with each of its cells cut into as many equal parts; counts : (N-1,), 1 or more."""
    if (counts == 1).all():
        return grid
    cell = np.repeat(np.arange(len(counts)), counts)
    first = np.cumsum(counts) - counts
    share = (np.arange(len(cell)) - first[cell]) / counts[cell]
    at = np.append(cell + share, len(counts))
    return _at(grid, at, equal=grid.uniform and bool((counts == counts[0]).all()))


def around_instants(model: Model, grid: Grid, p: Array) -> Grid:
    """The grid with a point close before and one close behind each instant at which the equations jump in time.

    p : (np,) parameters. A switch that passes zero and comes back within a cell is not seen.
    """
    events = time_events(model.closed_ode, model.u, model.t, model.x)
    if events is None:
        return grid
    switches = ca.substitute(ca.vertcat(*events.switches), model.p, ca.SX(ca.DM(p)))
    function = ArrayFunction([model.u, model.t], [ca.densify(switches)])

    def value(places: Array) -> Array:
        low = np.minimum(places.astype(int), grid.samples - 2)
        return np.asarray(function(*_signals(grid, low, places - low))[0])

    steps = np.arange(grid.samples - 1, dtype=float)
    ends = np.stack([value(steps), value(np.append(steps[1:], steps[-1] + 1 - 1e-12))])
    rows, cells = np.nonzero((ends[0] > 0) != (ends[1] > 0))
    if not len(rows):
        return grid
    low, high, begun = steps[cells], steps[cells] + 1, ends[0][rows, cells] > 0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        before = (value(middle)[rows, np.arange(len(rows))] > 0) == begun
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    inside = low - cells
    away = _BESIDE * np.maximum(np.minimum(inside, 1 - inside), _BESIDE)
    places = np.clip(np.concatenate([low - away, low + away]), 0, grid.samples - 1)
    return _at(grid, np.unique(np.concatenate([np.arange(grid.samples), places])), equal=False)


def _signals(grid: Grid, low: NDArray[np.intp], share: Array) -> tuple[Array, Array]:
    """Channels (nu, T) by their holds and time (1, T) at ``share`` of the cells that begin at the points ``low``."""
    first = np.array([hold == "first" for hold in grid.holds]).reshape(-1, 1)
    begin = grid.channels[:, low]
    end = grid.channels[:, low + 1]
    # a held channel has the next value at the next point alone
    moved = np.where(first, share * (end - begin), np.where(share >= 1, end - begin, 0.0))
    time = grid.time
    return begin + moved, (time[low] + share * (time[low + 1] - time[low]))[None]


def _at(grid: Grid, places: Array, *, equal: bool) -> Grid:
    """The grid at places (T,) in points of the old one, all of whose points are among them."""
    low = np.minimum(places.astype(int), grid.samples - 2)
    channels, time = _signals(grid, low, places - low)
    old = np.searchsorted(places, np.arange(grid.samples))
    measured = {
        name: replace(one, position=old[one.position.astype(int)].astype(one.position.dtype))
        for name, one in grid.measured.items()
    }
    times = time[0]
    step = grid.step * (grid.samples - 1) / (len(places) - 1) if equal else float(np.median(np.diff(times)))
    return replace(
        grid,
        step=step,
        samples=len(places),
        rows=tuple(channels),
        measured=measured,
        times=None if equal else times,
    )
