"""One record's share of the estimation problem: weighted residuals and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.loss import Loss
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.simulation.discretisation import Method
from casadi_engine.simulation.exponential_runge_kutta import ExponentialPropagator
from casadi_engine.simulation.gain import GainPlan
from casadi_engine.simulation.grid import Grid, lay_grid
from casadi_engine.simulation.intervals import Intervals, Observation, cut
from casadi_engine.simulation.linear import LinearPropagator
from casadi_engine.simulation.propagator import after_missing, fineness_of, make_propagator, starts_afresh
from casadi_engine.simulation.runge_kutta import Fineness, RungeKuttaPropagator
from casadi_engine.simulation.shared_core import Cores

Array = NDArray[np.float64]


@dataclass
class RecordPoint:
    """A record evaluated at one point: residuals (K, M), Jacobians, and the states at the intervals' ends.

    r : weighted residual (y_hat - y)/sigma, 0 where nothing was measured; jz : (nz, K, M) weighted;
    js : (K, n) unweighted if all intervals share it, else (K, M, n)
    """

    path: Any
    r: Array
    jz: Array
    js: Array


@dataclass(frozen=True)
class Blocks:
    """Hessian blocks of a record: zz (nz, nz), zs (nz, n, M), ss (M, n, n)."""

    zz: Array
    zs: Array
    ss: Array


class RecordTerm:
    """Residuals of one record over its shooting intervals.

    active : entries of the global vector that this record depends on; n : states; scale : (n,) of the states, those
    of the model unless given
    """

    def __init__(
        self,
        model: Model,
        experiment: Experiment,
        v: ca.SX,
        physical: ca.SX,
        *,
        length: int | None,
        gain: Array | GainPlan | None,
        method: Method,
        grid: Grid | None = None,
        cores: Cores | None = None,
        steps: int | float | Fineness | None = None,
        scale: Array | None = None,
    ) -> None:
        self.experiment, self.model = experiment, model
        self.symbols, self.gain, self.method = (v, physical), gain, method
        self.outputs = tuple(out.name for out in model.outputs)
        self.grid = grid or lay_grid(model, experiment)
        self.plan: Intervals = cut(self.grid, length)
        self.observation = Observation(self.grid, self.plan, self.outputs)
        self.scale = np.array([state.scale for state in model.states]) if scale is None else scale
        plan = gain if isinstance(gain, GainPlan) else None
        needed = physical if plan is None else ca.vertcat(physical, plan.expression)
        depends = ca.which_depends(needed, v, 1, False) if v.numel() and needed.numel() else []
        self.active = np.flatnonzero(depends) if len(depends) else np.zeros(0, np.intp)
        local = ca.vertcat(*[v[int(i)] for i in self.active]) if len(self.active) else ca.SX(0, 1)
        self.propagator = make_propagator(
            model, self.grid, self.plan, local, physical, scale=self.scale, method=method,
            gain=gain.build(gain.expression, local) if isinstance(gain, GainPlan) else gain,
            used=None if plan is None else plan.used, cores=cores, steps=steps,
        )  # fmt: skip
        self._local = local
        self.n = len(self.scale)
        if isinstance(gain, np.ndarray) and starts_afresh(model, gain, self.scale):
            self.observation.leave_out(after_missing(self.grid))
        self.weight = self.observation.valid.astype(float)
        self._most: int | None = None
        self.last_error: Any = None  # the integration error that was estimated last, and where
        self._single: tuple[Any, RecordTerm] | None = None
        self._common: float | None = None  # the weight, where all samples count and count alike

    @property
    def linear(self) -> bool:
        """True if the state at an interval's end is affine in that at its start."""
        return isinstance(self.propagator, LinearPropagator)

    def step_in_places(self) -> None:
        """Integrate by steps that may differ from sample to sample, in place of those of the linear core."""
        self.propagator = RungeKuttaPropagator(
            self.model, self.grid, self.plan, self._local, self.symbols[1], scale=self.scale
        )

    def single(self) -> RecordTerm:
        """The same record as one interval, for simulation; made once for one fineness of the integration."""
        steps = fineness_of(self.propagator)
        if self._single is None or self._single[0] != steps or self._single[1].limited != self.limited:
            self._single = (steps, self.again(gain=self.gain))
        return self._single[1]

    def again(self, *, gain: Array | GainPlan | None, length: int | None = None) -> RecordTerm:
        """The same record in intervals of another length (None: one), predicted with another gain or simulated."""
        other = RecordTerm(
            self.model, self.experiment, *self.symbols,
            length=length, gain=gain, method=self.method, grid=self.grid, scale=self.scale,
            steps=fineness_of(self.propagator),
        )  # fmt: skip
        if self._most is not None:
            other.limit_steps(self._most)
        return other

    @property
    def limited(self) -> bool:
        """True if points that ask for too many integration steps are refused."""
        return self._most is not None

    def limit_steps(self, most: int) -> None:
        """Refuse points at which nonlinear laws ask for more than ``most`` integration steps to a sample."""
        self._most = most
        inner = getattr(self.propagator, "states", self.propagator)
        if isinstance(inner, ExponentialPropagator):
            inner.most = most

    @property
    def count(self) -> int:
        """Number of samples that count."""
        return int(self.observation.valid.sum())

    def set_sigma(self, sigma: Array) -> None:
        """Weight the residuals by the standard deviations (ny,) of the outputs."""
        self.weight = self.observation.valid / sigma[self.observation.column]
        first = float(self.weight.flat[0])
        self._common = first if (self.weight == first).all() else None

    def evaluate(self, v: Array, nodes: Array, *, order: int = 1) -> RecordPoint:
        """Residuals at the global vector and the interval starts (M, n), scaled states."""
        path = self.propagator.propagate(v[self.active], nodes, order)
        y = self.observation.observe(path.y)
        weight = self.weight if self._common is None else self._common
        r = (y[0] - self.observation.measured) * weight
        jz = y[1:] * weight
        return RecordPoint(path, r, jz, self.observation.observe_starts(path.ys))

    def gradient(self, point: RecordPoint, loss: Loss) -> tuple[Array, Array]:
        """Gradient of the summed loss in the active parameters (nz,) and the starts (M, n)."""
        slope = loss.slope(point.r)
        in_z = point.jz.reshape(len(point.jz), slope.size) @ slope.ravel()
        weighted = slope * self.weight
        if point.js.ndim == 2:
            return in_z, weighted.T @ point.js
        return in_z, np.einsum("km,kma->ma", weighted, point.js)

    def gauss_newton(self, point: RecordPoint, curvature: Array | None = None) -> Blocks:
        """Gauss-Newton Hessian blocks of the summed loss with this curvature (K, M) (None: 1 throughout)."""
        jz = point.jz if curvature is None else point.jz * curvature
        nz, k, m = jz.shape
        zz = jz.reshape(nz, k * m) @ point.jz.reshape(nz, k * m).T
        weight = self.weight if curvature is None else self.weight * curvature
        js, n = point.js, self.n
        if js.ndim == 2 and self._common is not None and curvature is None:
            zs = np.matmul(jz.transpose(0, 2, 1), js * self._common).transpose(0, 2, 1)
            ss = np.broadcast_to(js.T @ js * self._common**2, (m, n, n))
        elif js.ndim == 2:
            zs = np.matmul((jz * self.weight).transpose(0, 2, 1), js).transpose(0, 2, 1)
            outer = (js[:, :, None] * js[:, None, :]).reshape(k, -1)
            ss = ((weight * self.weight).T @ outer).reshape(m, n, n)
        else:
            zs = np.einsum("zkm,kma->zam", jz * self.weight, js, optimize=True)
            ss = np.einsum("km,kma,kmb->mab", weight * self.weight, js, js, optimize=True)
        return Blocks(zz, zs, ss)

    def curvature(self, v: Array, point: RecordPoint, loss: Loss, factor: float, lam: Array) -> Blocks:
        """Second-order part of the Lagrangian's Hessian: factor * loss + lam * ends; lam : (n, M)."""
        rho = self.observation.adjoint(factor * loss.slope(point.r) * self.weight)
        zz, zs, ss = self.propagator.contraction(v[self.active], point.path, rho, lam)
        return Blocks(zz, zs, ss)
