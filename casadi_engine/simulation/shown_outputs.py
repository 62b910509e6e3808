"""What the outputs of any model show at the samples: y = g(x, u, t; z) with its derivatives, on whole arrays."""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_engine.model import Model
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.tape import ArrayFunction


class ShownOutputs:
    """Outputs at the samples 0 .. L-1 of all intervals, from scaled states (L+1, n, M)."""

    def __init__(
        self, model: Model, grid: Grid, plan: Intervals, z: ca.SX, physical: ca.SX, scale: Array
    ) -> None:
        self.plan, self.n, self.ny, self.nz = plan, len(scale), len(model.outputs), int(z.numel())
        x = ca.SX.sym("x", self.n)
        shown = ca.substitute(model.closed_outputs, model.x, x * ca.DM(scale))
        if model.p.numel():
            shown = ca.substitute(shown, model.p, physical)
        # What hangs on the channels alone (crank kinematics) is worked out once for the whole record.
        channels = ca.vertcat(model.u, model.t)
        rest, symbols, terms = ca.extract_parametric(shown, channels, {})
        given, both = ca.vertcat(channels, *symbols), ca.vertcat(x, z)
        rho = ca.SX.sym("rho", self.ny)
        self._value = ArrayFunction([x, given, z], [rest])
        self._first = ArrayFunction([x, given, z], [rest, ca.densify(ca.jacobian(rest, both))])
        weighted = ca.dot(rho, rest)
        self._second = (
            None
            if not ca.depends_on(ca.gradient(weighted, both), both)
            else ArrayFunction([x, given, z, rho], [ca.densify(ca.hessian(weighted, both)[0])])
        )
        at = (np.arange(plan.length)[:, None] + plan.length * np.arange(plan.m)).ravel()
        at = np.minimum(at, grid.samples - 1)
        self._given = ArrayFunction([model.u, model.t], [ca.vertcat(channels, *terms)])(
            grid.channels[:, at], grid.time[at][None]
        )[0]

    def _columns(self, x: Array) -> Array:
        return np.ascontiguousarray(x[: self.plan.length].transpose(1, 0, 2)).reshape(self.n, -1)

    def values(self, x: Array, z: Array) -> Array:
        """(ny, L, M)."""
        found = self._value(self._columns(x), self._given, z)[0]
        return found.reshape(self.ny, self.plan.length, self.plan.m)

    def side_by_side(self, x: Array, z: Array) -> Array:
        """(P, ny, L, 1) of states (L + 1, n, P) of one interval at points z (nz, P)."""
        samples, points = self.plan.length, x.shape[2]
        columns = np.ascontiguousarray(x[:samples].transpose(1, 0, 2)).reshape(self.n, -1)
        found = self._value(columns, np.repeat(self._given, points, axis=1), np.tile(z, samples))[0]
        return np.ascontiguousarray(found.reshape(self.ny, samples, points).transpose(2, 0, 1))[..., None]

    def slopes(self, x: Array, z: Array) -> tuple[Array, Array]:
        """Values (ny, L, M) and derivatives to (x, z), (L, M, ny, n + nz)."""
        value, slope = self._first(self._columns(x), self._given, z)
        shape = (self.plan.length, self.plan.m)
        by = slope.reshape(self.n + self.nz, self.ny, *shape).transpose(2, 3, 1, 0)
        return value.reshape(self.ny, *shape), np.ascontiguousarray(by)

    def contracted(self, x: Array, z: Array, weights: Array, s: Array) -> Array:
        """(M, n + nz, n + nz) second derivatives to (start, z) of sum(weights * y) at given states.

        weights : (L, ny, M); s : (L, M, n, n + nz) sensitivities of the states
        """
        n, nz, plan = self.n, self.nz, self.plan
        if self._second is None:
            return np.zeros((plan.m, n + nz, n + nz))
        rho = np.ascontiguousarray(weights.transpose(1, 0, 2)).reshape(self.ny, -1)
        bend = self._second(self._columns(x), self._given, z, rho)[0]
        inner = bend.reshape(n + nz, n + nz, plan.length, plan.m).transpose(2, 3, 0, 1)
        basis = np.zeros((plan.length, plan.m, n + nz, n + nz))
        basis[:, :, :n] = s
        basis[:, :, n:, n:] = np.eye(nz)
        found: Array = (basis.swapaxes(-1, -2) @ inner @ basis).sum(axis=0)
        return found
