"""Sensitivities of an amplitude that runs piecewise linearly over time: one column for each knot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.candidate_sensitivities import Direction, Sweep
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.null_path import NullPath, Points


class _Hats:
    """The columns of one direction times the hat function of every knot."""

    def __init__(self, columns: object, knots: Array) -> None:
        self._columns, self._knots = columns, knots

    def at(self, points: Points, xi: Array) -> Array:
        """(T, rows, K)."""
        one = self._columns.at(points, xi)[:, :, 0]  # type: ignore[attr-defined]
        place, share = hat_weights(points.t[0], self._knots)
        out = np.zeros((*one.shape, len(self._knots)))
        row = np.arange(len(one))
        out[row, :, place] = one * (1 - share)[:, None]
        out[row, :, place + 1] = one * share[:, None]
        return out


def hat_weights(time: Array, knots: Array) -> tuple[NDArray[np.intp], Array]:
    """Number of the knot before each time, and the share (0..1) of the way to the next; constant outside."""
    place = np.clip(np.searchsorted(knots, time, side="right") - 1, 0, len(knots) - 2)
    share = (time - knots[place]) / (knots[place + 1] - knots[place])
    return place, np.clip(share, 0.0, 1.0)


def knot_sensitivities(
    path: NullPath, direction: Direction, knots: Array, *, every: int = 1, substeps: int | None = None
) -> Array:
    """dy/d(amplitude at each knot), (K, ny, rows), averaged over every ``every`` samples of the grid.

    knots : (K,) s, rising, two or more; rows : the whole multiples of ``every`` in N samples
    """
    sweep = Sweep(path, [direction], substeps=substeps)
    sweep.shape = (sweep.shape[0], len(knots))
    sweep._ode, sweep._out = _Hats(sweep._ode, knots), _Hats(sweep._out, knots)  # type: ignore[assignment]
    rows = path.grid.samples // every
    total = np.zeros((rows + 1, sweep.shape[0] * len(knots)))
    for shown, part in sweep:
        group = np.minimum(np.arange(shown.start, shown.stop) // every, rows)
        first = np.flatnonzero(np.diff(group, prepend=-1))
        total[group[first]] += np.add.reduceat(part.reshape(len(part), -1), first, axis=0)
    mean = total[:rows].reshape(rows, *sweep.shape) / every
    return np.ascontiguousarray(mean.transpose(2, 1, 0))
