"""The drives of a model over the grid of a record, as functions of the estimated vector."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.model import Model
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.tape import ArrayFunction

# Drives of a record of so many samples at most are kept, where they are the same for every z.
_SHORT = 32768


@dataclass(frozen=True)
class DriveSamples:
    """Drives on the grid at one z: value (m, N), first (a, m, N) and second (pairs of a, m, N) derivatives in the
    ``active`` entries of z (none for drives made of channels and known geometry alone)."""

    value: Array
    active: NDArray[np.intp]
    first: Array
    second: Array


class Drives:
    """The drives of a model over a grid, as functions of the estimated vector."""

    def __init__(self, model: Model, grid: Grid, z: ca.SX, physical: ca.SX) -> None:
        self.names = tuple(v.name for v in model.drives)
        count = len(self.names)
        expression = model.shared_drives
        self._decimation = None if grid.whole is None else grid.whole[1]
        whole = grid if grid.whole is None else grid.whole[0]
        late = np.array(
            [
                any(
                    h == "zero" and ca.depends_on(expression[j], model.u[i])
                    for i, h in enumerate(whole.holds)
                )
                for j in range(count)
            ],
            dtype=bool,
        )
        # drives of a lower rate are straight lines, whatever they were made of
        self._late = late
        self.holds = tuple("zero" if own and self._decimation is None else "first" for own in late)
        if model.p.numel() and ca.depends_on(expression, model.p):
            expression = ca.substitute(expression, model.p, physical)
        parts = [ca.densify(expression)]
        self.active = np.zeros(0, np.intp)
        if z.numel() and ca.depends_on(expression, z):
            mask = ca.which_depends(expression, z, 1, False)
            self.active = np.flatnonzero(mask)
            chosen = ca.vertcat(*[z[int(i)] for i in self.active])
            first = ca.jacobian(expression, chosen)
            second = ca.jacobian(ca.vec(first), chosen)
            parts += [ca.vec(ca.densify(first)), ca.vec(ca.densify(second))]
        self._function = ArrayFunction([model.u, model.t, z], parts)
        self._count, self._samples = count, grid.samples
        self._grid = whole
        self._constant: DriveSamples | None = None

    def at(self, z: Array) -> DriveSamples:
        """Samples at z : (nz,), kept where they are the same for every z."""
        if self._constant is not None:
            return self._constant
        found = self.part(z)
        if not len(self.active):
            self._constant = found
        return found

    def part(self, z: Array, points: NDArray[np.intp] | None = None) -> DriveSamples:
        """Samples at z : (nz,) at the grid points with these numbers (k,), all by default; of a long record nothing is
        kept."""
        kept = not len(self.active) and self._samples <= _SHORT
        if (kept or self._decimation is not None) and points is not None:
            found = self.at(z)
            return DriveSamples(
                found.value[:, points], self.active, found.first[..., points], found.second[..., points]
            )
        grid, m, a = self._grid, self._count, len(self.active)
        if m == 0:
            none = np.zeros((0, 0, self._samples if points is None else len(points)))
            return DriveSamples(np.zeros(none.shape[1:]), self.active, none, none)
        u = grid.rows if points is None else [row[points] for row in grid.rows]
        time = grid.time if points is None else grid.time_at(points)
        values = self._function(u, [time], np.asarray(z, dtype=float))
        value = self._thinned(values[0])
        if a == 0:
            none = np.zeros((0, *value.shape))
            return DriveSamples(value, self.active, none, none)
        i, j = np.triu_indices(a)
        second = values[2].reshape(a, a, m, len(time))[j, i]
        first = values[1].reshape(a, m, len(time))
        return DriveSamples(value, self.active, self._thinned(first), self._thinned(second))

    def _thinned(self, values: Array) -> Array:
        """(..., m, N) drives of the whole record at the grid's own samples."""
        if self._decimation is None:
            return values
        found = np.empty((*values.shape[:-1], self._samples))
        for late in (False, True):
            rows = self._late == late
            if rows.any():
                found[..., rows, :] = self._decimation.sampled(
                    values[..., rows, :], self._samples, late=late, sharp=True
                )
        return found
