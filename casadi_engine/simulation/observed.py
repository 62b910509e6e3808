"""Outputs of any form over the exponential integrator: a delayed sensor that shows a law's torque at once.

States do not hang on outputs. So the split model is propagated with all its states as outputs, and the outputs
y = h(x, u, t; z) are evaluated at the samples; their derivatives follow by the chain rule. A sensor then changes
nothing of how its model is integrated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casadi_engine.model import Model
from casadi_engine.simulation.exponential_runge_kutta import ExponentialPropagator, ExponentialTrajectory
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.tape import ArrayFunction


@dataclass
class ObservedTrajectory:
    """Outputs and sensitivities; shapes as in ``ExponentialTrajectory``. states : the trajectory of the states"""

    states: ExponentialTrajectory
    y: Array
    ys: Array

    @property
    def x(self) -> Array:
        """(L+1, n, M) states at the samples."""
        return self.states.x

    @property
    def end(self) -> Array:
        """(n, M)."""
        return self.states.end

    @property
    def end_z(self) -> Array:
        """(nz, n, M)."""
        return self.states.end_z

    @property
    def end_s(self) -> Array:
        """(M, n, n)."""
        return self.states.end_s


def with_states_shown(model: Model) -> Model:
    """The model with its states as outputs."""
    return replace(model, outputs=model.states, output_expressions=model.x)


class ObservedPropagator:
    """A model over one record, by the propagator of ``with_states_shown(model)``; z, physical as it got them."""

    def __init__(
        self, model: Model, states: ExponentialPropagator, grid: Grid, z: ca.SX, physical: ca.SX
    ) -> None:
        self.states, self.intervals = states, states.intervals
        self.n, self.nz, self.ny = states.n, states.nz, len(model.outputs)
        x, known = model.x, [model.u, model.t]
        shown = model.closed_outputs
        if model.p.numel():
            shown = ca.substitute(shown, model.p, physical)
        # what hangs on the channels alone (crank kinematics) is worked out once for the whole record
        rest, symbols, terms = ca.extract_parametric(shown, ca.vertcat(*known), {})
        given = ca.vertcat(*known, *symbols)
        self._given = self._on_samples(grid, ArrayFunction(known, [ca.vertcat(*known, *terms)]))
        both, rho = ca.vertcat(x, z), ca.SX.sym("rho", self.ny)
        self._value = ArrayFunction([x, given, z], [rest])
        self._first = ArrayFunction([x, given, z], [rest, ca.jacobian(rest, both)])
        weighted = ca.dot(rho, rest)
        self._second = ArrayFunction(
            [x, given, z, rho], [ca.gradient(weighted, x), ca.hessian(weighted, both)[0]]
        )

    @property
    def substeps(self) -> int:
        """Integration steps to a sample."""
        return self.states.substeps

    def refined(self, substeps: int) -> ObservedPropagator:
        """The same propagator with another number of steps to a sample."""
        other = object.__new__(ObservedPropagator)
        other.__dict__.update(self.__dict__)
        other.states = self.states.refined(substeps)
        return other

    def finer(self, factor: int) -> ObservedPropagator:
        """The same propagator with every step cut into ``factor`` steps."""
        return self.refined(self.substeps * factor)

    def drives_at(self, z: Array) -> Array:
        """(m, N) drives of the model on the grid."""
        return self.states.drives_at(z)

    def _on_samples(self, grid: Grid, function: ArrayFunction) -> Array:
        """A function of (u, t) at the batch's samples: (rows, R*b*M)."""
        plan = self.intervals
        inside = plan.samples[:, None] + plan.q * np.arange(plan.b)
        at = (inside[:, :, None] + plan.length * np.arange(plan.m)).ravel()
        u = grid.channels[:, np.minimum(at, grid.samples - 1)]
        return function(u, np.asarray(grid.start + grid.step * at, dtype=np.float64)[None])[0]

    def _by_point(self, rows: Array) -> Array:
        """(., R*k, b, M, ...) of k outputs each to (., k, R*b*M, ...)."""
        plan, k = self.intervals, rows.shape[1] // len(self.intervals.samples)
        tail = rows.shape[4:]
        split = rows.reshape(len(rows), -1, k, plan.b, plan.m, *tail)
        return np.ascontiguousarray(np.moveaxis(split, 2, 1)).reshape(len(rows), k, -1, *tail)

    def _by_rows(self, points: Array) -> Array:
        """The reverse of ``_by_point``."""
        plan, k, tail = self.intervals, points.shape[1], points.shape[3:]
        split = points.reshape(len(points), k, -1, plan.b, plan.m, *tail)
        return np.ascontiguousarray(np.moveaxis(split, 1, 2)).reshape(len(points), -1, plan.b, plan.m, *tail)

    # A trial point of the search may be far off: what overflows is found by its result.
    @np.errstate(all="ignore")
    def propagate(self, z: Array, nodes: Array, order: int = 1) -> ObservedTrajectory:
        """Advance all intervals from ``nodes`` (M, n), scaled states, at z : (nz,)."""
        z = np.asarray(z, dtype=float)
        path = self.states.propagate(z, nodes, order)
        shown = self._by_point(path.y)
        if order == 0:
            value = self._value(shown[0], self._given, z)[0]
            return ObservedTrajectory(path, self._finite(self._by_rows(value[None])), path.ys)
        value, slope = self._first(shown[0], self._given, z)
        slope = slope.reshape(self.n + self.nz, self.ny, -1)
        along = np.einsum("iyp,zip->zyp", slope[: self.n], shown[1:]) + slope[self.n :]
        starts = self._by_point(path.ys[None])[0]
        y = np.concatenate([value[None], along])
        ys = np.einsum("iyp,ipn->ypn", slope[: self.n], starts)
        return ObservedTrajectory(path, self._finite(self._by_rows(y)), self._by_rows(ys[None])[0])

    @staticmethod
    def _finite(y: Array) -> Array:
        if not np.isfinite(y[0]).all():
            raise FloatingPointError("the model's output is not finite here")
        return y

    @np.errstate(all="ignore")
    def contraction(
        self, z: Array, path: ObservedTrajectory, rho: Array, lam: Array
    ) -> tuple[Array, Array, Array]:
        """Second derivatives of sum(rho * y) + sum(lam * end): (z, z), (z, start) and (start, start)."""
        z, n, count = np.asarray(z, dtype=float), self.n, self.intervals.m
        shown = self._by_point(path.states.y)
        pull, bend = self._second(shown[0], self._given, z, self._by_point(rho[None])[0])
        zz, zs, ss = self.states.contraction(z, path.states, self._by_rows(pull[None])[0], lam)
        wide = n + self.nz
        basis = np.zeros((shown.shape[2], wide, wide))
        basis[:, :n, :n] = self._by_point(path.states.ys[None])[0].transpose(1, 0, 2)
        basis[:, :n, n:] = shown[1:].transpose(2, 1, 0)
        basis[:, n:, n:] = np.eye(self.nz)
        inner = bend.reshape(wide, wide, -1).transpose(2, 0, 1)
        total = (basis.swapaxes(-1, -2) @ inner @ basis).reshape(-1, count, wide, wide).sum(axis=0)
        zs = zs + total[:, n:, :n].transpose(1, 2, 0)
        return zz + total[:, n:, n:].sum(axis=0), np.ascontiguousarray(zs), ss + total[:, :n, :n]
