"""Propagation of any model, dx/dt = f(x, u, t, p): Runge-Kutta steps with exact derivatives of the discrete map.

The states of all shooting intervals advance together, sample by sample. Derivatives of the step are then evaluated
on all samples of the record at once, and chained by batched products; the same holds for the second order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_engine.model import Model
from casadi_engine.simulation.grid import Drives, Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.sample_rows import from_rows, to_rows
from casadi_engine.simulation.tape import ArrayFunction

# |lambda| h of one Runge-Kutta step: its error is then below 1e-5 of the fastest mode per radian.
_STEP = 0.25
_MOST_SUBSTEPS = 40
# From this number of intervals on, array operations step all of them faster than CasADi's machine does.
_WIDE = 40
# Samples of one sweep.
_LONGEST = 256


@dataclass
class GeneralTrajectory:
    """States of all samples and their sensitivities; shapes as in ``LinearTrajectory``, but no interval shares one.

    x : (L+1, n, M) states; s : (L+1, M, n, n+nz) sensitivities to (start, z); ys : (R*ny, b, M, n)
    """

    x: Array
    s: Array
    a: Array  # (L, M, n, n) step Jacobians in the state
    y: Array
    ys: Array

    @property
    def end(self) -> Array:
        """(n, M)."""
        return self.x[-1]

    @property
    def end_z(self) -> Array:
        """(nz, n, M)."""
        n = self.x.shape[1]
        return np.ascontiguousarray(self.s[-1][:, :, n:].transpose(2, 1, 0))

    @property
    def end_s(self) -> Array:
        """(M, n, n)."""
        return self.s[-1][:, :, : self.x.shape[1]]


class GeneralPropagator:
    """Any model over one record; arguments as in ``LinearPropagator``.

    substeps : Runge-Kutta steps to a sample; None for as many as the fastest mode asks for
    """

    def __init__(
        self,
        model: Model,
        grid: Grid,
        intervals: Intervals,
        z: ca.SX,
        physical: ca.SX,
        *,
        scale: Array,
        substeps: int | None = None,
    ) -> None:
        self._made_of = (model, grid, intervals, z, physical, scale)
        self.intervals, self.nz, self.n = intervals, int(z.numel()), len(scale)
        self.ny = len(model.outputs)
        x = ca.SX.sym("x", self.n)
        u0, u1 = ca.SX.sym("u0", model.u.numel()), ca.SX.sym("u1", model.u.numel())
        t0 = ca.SX.sym("t0")
        s = ca.DM(scale)
        ode = ca.Function("ode", [model.x, model.u, model.t, model.p], [model.closed_ode])
        out = ca.Function("out", [model.x, model.u, model.t, model.p], [model.closed_outputs])
        first = ca.DM([1.0 if hold == "first" else 0.0 for hold in grid.holds])

        def slope(state: ca.SX, share: float) -> ca.SX:
            held = u0 + share * first * (u1 - u0) if u0.numel() else u0
            return ode(state * s, held, t0 + share * grid.step, physical) / s

        substeps = self._substeps(model, z, physical, grid.step, scale) if substeps is None else substeps
        self.substeps = substeps
        state, h = x, grid.step / substeps
        for k in range(substeps):
            k1 = slope(state, k / substeps)
            k2 = slope(state + h / 2 * k1, (k + 0.5) / substeps)
            k3 = slope(state + h / 2 * k2, (k + 0.5) / substeps)
            k4 = slope(state + h * k3, (k + 1) / substeps)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        y = out(x * s, u0, t0, physical)
        both = ca.vertcat(x, z)
        mu, rho = ca.SX.sym("mu", self.n), ca.SX.sym("rho", self.ny)
        # What hangs on the channels alone (crank kinematics, gas torque) is worked out once for the whole record.
        channels = ca.vertcat(u0, u1, t0)
        rest, symbols, known = ca.extract_parametric(ca.vertcat(state, y), channels, {})
        state, y = rest[: self.n], rest[self.n :]
        inputs = [x, ca.vertcat(channels, *symbols), z]
        self._lay_steps(inputs, state)
        self._first = ArrayFunction(inputs, [ca.jacobian(state, both), y, ca.jacobian(y, both)])
        self._value = ArrayFunction(inputs, [y])
        self._symbols = (inputs, both, state, y, mu, rho)
        self._second: ArrayFunction | None = None
        self._known = self._on_samples(grid, ArrayFunction([u0, u1, t0], [ca.vertcat(channels, *known)]))
        self._drives = Drives(model, grid, z, physical)

    def refined(self, substeps: int) -> GeneralPropagator:
        """The same propagator with another number of steps to a sample."""
        model, grid, intervals, z, physical, scale = self._made_of
        return GeneralPropagator(model, grid, intervals, z, physical, scale=scale, substeps=substeps)

    def drives_at(self, z: Array) -> Array:
        """(m, N) drives of the model on the grid."""
        return self._drives.at(z).value

    def _substeps(self, model: Model, z: ca.SX, physical: ca.SX, step: float, scale: Array) -> int:
        """Runge-Kutta steps of one sample, from the fastest eigenvalue at unit states and the magnitudes of z.

        An entry of z is about 1 where it is a scaled value, and about 0 where it is a logarithm.
        """
        slope = ca.jacobian(model.closed_ode, model.x)
        rate = ca.Function("rate", [model.x, model.u, model.t, model.p], [slope])
        values = ca.Function("physical", [z], [physical])
        bent = ca.which_depends(physical, z, 2, False) if self.nz and physical.numel() else [False] * self.nz
        fastest = 0.0
        for point in (np.ones(self.nz), np.where(np.array(bent, dtype=bool), 0.0, 1.0)):
            matrix = rate(scale, np.zeros(model.u.numel()), 0.0, values(point)).full()
            if np.isfinite(matrix).all():
                fastest = max(fastest, float(np.abs(np.linalg.eigvals(matrix)).max()))
        return min(max(1, math.ceil(fastest * step / _STEP)), _MOST_SUBSTEPS)

    def _on_samples(self, grid: Grid, function: ArrayFunction) -> Array:
        """A function of (u0, u1, t0) on the record, (rows, points*M): point of the interval, then interval."""
        plan = self.intervals
        tail = np.repeat(grid.channels[:, -1:], plan.padded + 1 - grid.samples, axis=1)
        u = np.concatenate([grid.channels, tail], axis=1)
        at = (np.arange(plan.points)[:, None] + plan.length * np.arange(plan.m)).ravel()
        time = np.asarray(grid.start + grid.step * at, dtype=np.float64)
        return function(u[:, at], u[:, np.minimum(at + 1, plan.padded)], time[None])[0]

    def _columns(self, x: Array, z: Array) -> list[Array]:
        """Arguments of the array functions, all samples side by side: states (n, points*M), known terms, z."""
        return [np.ascontiguousarray(x.transpose(1, 0, 2)).reshape(self.n, -1), self._known, z]

    # A trial point of the search may be far off: what overflows is found by its result.
    @np.errstate(over="ignore", invalid="ignore")
    def propagate(self, z: Array, nodes: Array, order: int = 1) -> GeneralTrajectory:
        """Advance all intervals from ``nodes`` (M, n), scaled states, at z : (nz,)."""
        plan, n, nz = self.intervals, self.n, self.nz
        length, points = plan.length, plan.points
        x = self._states(np.asarray(z, dtype=float), nodes)
        if not np.isfinite(x).all():
            raise FloatingPointError("the model's state is not finite here")
        columns = self._columns(x[:points], z)
        if order == 0:
            y = self._value(*columns)[0].reshape(1, self.ny, points, plan.m)
            none = np.zeros((0, 0, 0, 0))
            return GeneralTrajectory(x, none, none, to_rows(plan, y), none)
        jacobian, value, slope = self._first(*columns)
        step = jacobian.reshape(n + nz, n, points, plan.m).transpose(2, 3, 1, 0)
        out = slope.reshape(n + nz, self.ny, points, plan.m).transpose(2, 3, 1, 0)
        s = np.zeros((length + 1, plan.m, n, n + nz))
        s[0, :, :, :n] = np.eye(n)
        a = np.ascontiguousarray(step[..., :n])
        for k in range(length):
            np.matmul(a[k], s[k], out=s[k + 1])
            s[k + 1, :, :, n:] += step[k, :, :, n:]
        full = out[..., :n] @ s[:points]
        full[..., n:] += out[..., n:]
        y = np.concatenate(
            [value.reshape(1, self.ny, points, plan.m), full[..., n:].transpose(3, 2, 0, 1)], axis=0
        )
        ys = to_rows(plan, full[..., :n].transpose(3, 2, 0, 1)).transpose(1, 2, 3, 0)
        return GeneralTrajectory(x, s, a, to_rows(plan, y), np.ascontiguousarray(ys))

    def _lay_steps(self, inputs: list[ca.SX], state: ca.SX) -> None:
        """The step of all intervals: an array function where they are many, else parts of the record in one call."""
        plan = self.intervals
        self._wide = ArrayFunction(inputs, [state]) if plan.m >= _WIDE else None
        # The graph of a long sweep takes long to build: a part of it is called several times.
        self._part = max(k for k in range(1, min(plan.length, _LONGEST) + 1) if plan.length % k == 0)
        if self._wide is None:
            part = ca.Function("step", inputs, [state]).mapaccum(self._part)
            self._sweep = part.map(plan.m) if plan.m > 1 else part

    def _states(self, z: Array, nodes: Array) -> Array:
        """(L+1, n, M) states from ``nodes`` (M, n)."""
        plan, n, length, part = self.intervals, self.n, self.intervals.length, self._part
        x = np.empty((length + 1, n, plan.m))
        x[0] = nodes.T
        known = self._known[:, : length * plan.m].reshape(-1, length, plan.m)
        if self._wide is not None:
            for k in range(length):
                x[k + 1] = self._wide(x[k], known[:, k], z)[0]
            return x
        many = np.repeat(z[:, None], plan.m * part, axis=1)
        for k in range(0, length, part):
            given = known[:, k : k + part].transpose(0, 2, 1).reshape(len(known), -1)
            swept = np.asarray(self._sweep(x[k], given, many), dtype=float)
            x[k + 1 : k + 1 + part] = swept.reshape(n, plan.m, part).transpose(2, 0, 1)
        return x

    def _second_function(self) -> ArrayFunction:
        if self._second is None:
            inputs, both, state, y, mu, rho = self._symbols
            lagrangian = ca.dot(mu, state) + ca.dot(rho, y)
            hessian = ca.hessian(lagrangian, both)[0]
            slope = ca.gradient(ca.dot(rho, y), inputs[0])
            self._second = ArrayFunction([*inputs, mu, rho], [hessian])
            self._pull = ArrayFunction([*inputs, rho], [slope])
        return self._second

    @np.errstate(over="ignore", invalid="ignore")
    def contraction(
        self, z: Array, path: GeneralTrajectory, rho: Array, lam: Array
    ) -> tuple[Array, Array, Array]:
        """Second derivatives of sum(rho * y) + sum(lam * end): (z, z), (z, start) and (start, start)."""
        plan, n, nz = self.intervals, self.n, self.nz
        length, points = plan.length, plan.points
        second = self._second_function()
        spread = from_rows(plan, rho, self.ny)
        weights = np.ascontiguousarray(spread.transpose(1, 0, 2)).reshape(self.ny, -1)
        columns = self._columns(path.x[:points], z)
        pull = self._pull(*columns, weights)[0].reshape(n, points, plan.m).transpose(1, 2, 0)
        mu = np.zeros((length + 1, plan.m, n))
        mu[:points] = pull
        mu[-1] += lam.T
        for k in range(length - 1, -1, -1):
            mu[k] += (mu[k + 1][:, None, :] @ path.a[k])[:, 0]
        multipliers = np.zeros((n, points, plan.m))
        multipliers[:, :length] = mu[1:].transpose(2, 0, 1)
        hessian = second(*columns, multipliers.reshape(n, -1), weights)[0].reshape(
            n + nz, n + nz, points, plan.m
        )
        inner = hessian.transpose(2, 3, 0, 1)
        basis = np.zeros((points, plan.m, n + nz, n + nz))
        basis[:, :, :n] = path.s[:points]
        basis[:, :, n:, n:] = np.eye(nz)
        total = (basis.swapaxes(-1, -2) @ inner @ basis).sum(axis=0)
        return (
            total[:, n:, n:].sum(axis=0),
            np.ascontiguousarray(total[:, n:, :n].transpose(1, 2, 0)),
            total[:, :n, :n],
        )
