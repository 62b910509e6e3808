"""One record's share of the estimation problem: weighted residuals and their derivatives."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
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
from casadi_engine.simulation.observed import ObservedPropagator
from casadi_engine.simulation.propagator import (
    after_missing,
    bends_between_samples,
    fineness_of,
    make_propagator,
    starts_afresh,
)
from casadi_engine.simulation.runge_kutta import Fineness, RungeKuttaPropagator
from casadi_engine.simulation.shared_core import Cores

Array = NDArray[np.float64]


# A record with more outputs and slopes than this is long: it is evaluated in parts of about so many, which stay in the
# processor's cache and are not kept, so that its slopes take no memory.
_LONG, _PART = 2_000_000, 200_000
# Samples of an interval of a head: more of these go side by side.
_SHORT = 16


@dataclass(frozen=True)
class Blocks:
    """Hessian blocks of a record: zz (nz, nz), zs (nz, n, M), ss (M, n, n)."""

    zz: Array
    zs: Array
    ss: Array

    def __add__(self, other: Blocks) -> Blocks:
        return Blocks(self.zz + other.zz, self.zs + other.zs, self.ss + other.ss)


@dataclass(frozen=True)
class Part:
    """The blocks ``at`` of all intervals of a record, evaluated at one point, in K' of its rows.

    r : (K', M) weighted residual (y_hat - y)/sigma, 0 where nothing was measured; jz : (nz, K', M) weighted;
    js : (K', n) unweighted if all intervals share it, else (K', M, n); weight : (K', M), ``common`` if it is one number
    """

    at: slice
    path: Any
    r: Array
    jz: Array
    js: Array
    weight: Array
    common: float | None

    def gradient(self, slope: Array) -> tuple[Array, Array]:
        """Gradient in the parameters (nz,) and the starts (M, n) of a loss with this slope (K', M)."""
        in_z = self.jz.reshape(len(self.jz), slope.size) @ slope.ravel()
        weighted = slope * self.weight
        if self.js.ndim == 2:
            return in_z, weighted.T @ self.js
        return in_z, np.einsum("km,kma->ma", weighted, self.js)

    def gauss_newton(self, curvature: Array | None) -> Blocks:
        """Gauss-Newton blocks of a loss with this curvature (K', M) (None: 1 throughout)."""
        jz = self.jz if curvature is None else self.jz * curvature
        nz, k, m = jz.shape
        zz = jz.reshape(nz, k * m) @ self.jz.reshape(nz, k * m).T
        weight = self.weight if curvature is None else self.weight * curvature
        js, n = self.js, self.js.shape[-1]
        if js.ndim == 2 and self.common is not None and curvature is None:
            zs = np.matmul(jz.transpose(0, 2, 1), js * self.common).transpose(0, 2, 1)
            ss = np.broadcast_to(js.T @ js * self.common**2, (m, n, n))
        elif js.ndim == 2:
            zs = np.matmul((jz * self.weight).transpose(0, 2, 1), js).transpose(0, 2, 1)
            outer = (js[:, :, None] * js[:, None, :]).reshape(k, -1)
            ss = ((weight * self.weight).T @ outer).reshape(m, n, n)
        else:
            zs = np.einsum("zkm,kma->zam", jz * self.weight, js, optimize=True)
            ss = np.einsum("km,kma,kmb->mab", weight * self.weight, js, js, optimize=True)
        return Blocks(zz, zs, ss)


@dataclass(frozen=True)
class Ends:
    """What a long record's path leaves: states at the intervals' ends (n, M) and their slopes."""

    end: Array
    end_z: Array
    end_s: Array


@dataclass(frozen=True)
class _Again:
    """The parts of a long record, evaluated anew each time that they are gone through."""

    record: RecordTerm
    v: Array
    nodes: Array
    order: int

    def __iter__(self) -> Iterator[Part]:
        return self.record.parts_at(self.v, self.nodes, self.order)


@dataclass
class RecordPoint:
    """A record evaluated at one point: residuals, and the states at the intervals' ends (in ``path``).

    r : (K, M) weighted residual; parts : the residuals' slopes, part by part; sums : of a long record, gradients of
    half the summed squares in the parameters and starts, and the Gauss-Newton blocks
    """

    path: Any
    r: Array
    parts: list[Part] | _Again
    sums: tuple[Array, Array, Blocks] | None = None

    @property
    def jz(self) -> Array:
        """(nz, K, M) weighted slopes of the whole record."""
        return _joined([(part.jz, part.at) for part in self.parts], 1)

    @property
    def js(self) -> Array:
        """Slopes in the starts of the whole record, (K, n) or (K, M, n), as those of a part."""
        return _joined([(part.js, part.at) for part in self.parts], 0)


def _joined(found: list[tuple[Array, slice]], axis: int) -> Array:
    """The rows (along ``axis``) of all parts as those of the whole record: row of a block, then block."""
    if len(found) == 1:
        return found[0][0]
    own = [a.reshape(*a.shape[:axis], -1, at.stop - at.start, *a.shape[axis + 1 :]) for a, at in found]
    whole = np.concatenate(own, axis=axis + 1)
    shape = whole.shape
    return whole.reshape(*shape[:axis], shape[axis] * shape[axis + 1], *shape[axis + 2 :])


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
        self.long, self.part = _LONG, _PART

    @property
    def linear(self) -> bool:
        """True if the state at an interval's end is affine in that at its start."""
        return isinstance(self.propagator, LinearPropagator)

    def step_in_places(self, *, anyway: bool = False) -> bool:
        """Integrate by steps that may differ from sample to sample, in place of those of the linear core; False where
        there are none of these, or the answer may be another one, which ``anyway`` does not ask."""
        core = isinstance(self.propagator, (ExponentialPropagator, ObservedPropagator))
        if not core or (bends_between_samples(self.model) and not anyway):
            return False
        self.propagator = RungeKuttaPropagator(
            self.model, self.grid, self.plan, self._local, self.symbols[1], scale=self.scale
        )
        return True

    @property
    def stiff(self) -> bool:
        """True if a point was refused because its laws are too stiff for the steps of the linear core."""
        return bool(getattr(getattr(self.propagator, "states", self.propagator), "stiff", False))

    def as_fine_as(self, known: Any) -> None:
        """Integrate as finely as a propagator of this record did elsewhere (`fineness_of`), where both are alike."""
        propagator: Any = self.propagator
        if isinstance(known, Fineness):
            alike = (
                isinstance(propagator, RungeKuttaPropagator) and len(known.counts) == self.grid.samples - 1
            )
        else:
            alike = known is not None and isinstance(known, type(fineness_of(propagator)))
            alike = alike and hasattr(propagator, "refined")  # events take steps as they come
        if alike:
            self.propagator = propagator.refined(known)

    def single(self) -> RecordTerm:
        """The same record as one interval, for simulation; made once for one fineness of the integration."""
        steps = fineness_of(self.propagator)
        if self._single is None or self._single[0] != steps or self._single[1].limited != self.limited:
            self._single = (steps, self.again(gain=self.gain))
        return self._single[1]

    def again(self, *, gain: Array | GainPlan | None, length: int | None = None) -> RecordTerm:
        """The same record in intervals of another length (None: one), predicted with another gain or simulated."""
        return self._like(self.grid, fineness_of(self.propagator), length=length, gain=gain)

    def head(self, samples: int, sigma: Array) -> RecordTerm:
        """The first samples of the record, weighted by the standard deviations (ny,) of the outputs; the record itself
        if it is as short, or if another output begins later."""
        begins = [own.position[0] for own in self.grid.measured.values() if len(own.position)]
        if self.grid.samples <= samples or self.grid.whole is not None or max(begins, default=0) >= samples:
            return self
        steps = fineness_of(self.propagator)
        steps = steps.head(samples) if isinstance(steps, Fineness) else steps
        length = min(self.plan.length, _SHORT)
        other = self._like(self.grid.head(samples), steps, length=length, gain=None)
        other.set_sigma(sigma)
        return other

    def _like(
        self,
        grid: Grid,
        steps: int | float | Fineness | None,
        *,
        length: int | None,
        gain: Array | GainPlan | None,
    ) -> RecordTerm:
        other = RecordTerm(
            self.model, self.experiment, *self.symbols,
            length=length, gain=gain, method=self.method, grid=grid, scale=self.scale, steps=steps,
        )  # fmt: skip
        if isinstance(self.propagator, RungeKuttaPropagator) and other.step_in_places(anyway=True):
            other.as_fine_as(steps)
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
        if isinstance(inner := self._inner, ExponentialPropagator):
            inner.most = most

    def begin(self) -> None:
        """What comes is the first point of a search: it may ask for many more integration steps than others before."""
        if isinstance(inner := self._inner, ExponentialPropagator):
            inner.begin()

    @property
    def _inner(self) -> Any:
        """What propagates the states."""
        return getattr(self.propagator, "states", self.propagator)

    @property
    def count(self) -> int:
        """Number of samples that count."""
        return int(self.observation.valid.sum())

    def set_sigma(self, sigma: Array) -> None:
        """Weight the residuals by the standard deviations (ny,) of the outputs."""
        self.weight = self.observation.valid / sigma[self.observation.column]
        first = float(self.weight.flat[0])
        self._common = first if (self.weight == first).all() else None
        if self._common is not None:
            self.weight = np.broadcast_to(first, self.weight.shape)  # one number in memory

    def evaluate(self, v: Array, nodes: Array, *, order: int = 1) -> RecordPoint:
        """Residuals at the global vector and the interval starts (M, n), scaled states."""
        parts = _Again(self, v, nodes, order)
        if len(self._cuts()) == 1:
            (part,) = parts
            return RecordPoint(part.path, part.r, [part])
        r, sums = np.empty(self.observation.shape), None
        for part in parts:
            self._rows(r, part.at)[:] = self.observation.adjoint(part.r)
            if order:
                own = (*part.gradient(part.r), part.gauss_newton(None))
                sums = own if sums is None else (sums[0] + own[0], sums[1] + own[1], sums[2] + own[2])
        path = part.path  # the last one's ends are those of the intervals
        return RecordPoint(Ends(path.end.copy(), path.end_z.copy(), path.end_s.copy()), r, parts, sums)

    def parts_at(self, v: Array, nodes: Array, order: int) -> Iterator[Part]:
        """The record's parts one after the other; see `evaluate`."""
        # steps of a fit, and what it is compared with near by, do not need the transition's last digit
        for at, path in self._paths(v, nodes, order, lasting=False):
            weight = self.observation.part(self.weight, at)
            factor = weight if self._common is None else self._common
            y = self.observation.observe(path.y)
            r = (y[0] - self.observation.part(self.observation.measured, at)) * factor
            js = self.observation.observe_starts(path.ys)
            yield Part(at, path, r, y[1:] * factor, js, weight, self._common)

    def outputs_at(self, v: Array, nodes: Array) -> tuple[Array, Any]:
        """Outputs (K, M) and the path with the states at the intervals' ends, without slopes in the parameters."""
        y = np.empty(self.observation.shape)
        for at, path in self._paths(v, nodes, 0):
            self._rows(y, at)[:] = path.y[0]
        return y, path

    def drives_at(self, v: Array) -> Array:
        """(1 + m, N) times of the grid and the drives of the model there."""
        z, grid, propagator = v[self.active], self.grid, self.propagator
        found = np.empty((1 + len(self.model.drives), grid.samples))
        if not isinstance(propagator, LinearPropagator):
            found[0], found[1:] = grid.time, propagator.drives_at(z)
            return found
        propagator.forget()  # the search is over, and what it keeps of the drives takes as much memory
        for begin in range(0, grid.samples, _PART):
            points = np.arange(begin, min(begin + _PART, grid.samples))
            found[0, points], found[1:, points] = grid.time_at(points), propagator.drives_at(z, points)
        return found

    def _cuts(self) -> list[slice]:
        """The blocks of every interval in the parts that are evaluated one after the other."""
        each = len(self.outputs) * (1 + len(self.active))
        if isinstance(self.propagator, LinearPropagator) and self.plan.padded * each > self.long:
            return self.propagator.parts(self.part // each)
        return [slice(0, self.plan.b)]

    def _paths(
        self, v: Array, nodes: Array, order: int, *, lasting: bool = True
    ) -> Iterator[tuple[slice, Any]]:
        z, cuts = v[self.active], self._cuts()
        if isinstance(self.propagator, LinearPropagator):
            yield from zip(cuts, self.propagator.run(z, nodes, order, cuts, lasting=lasting), strict=True)
        else:
            yield cuts[0], self.propagator.propagate(z, nodes, order)

    def _rows(self, values: Array, at: slice) -> Array:
        """The rows of (K, M) values that belong to some blocks, as a view (R*ny, L, M)."""
        return self.observation.adjoint(values)[:, at]

    def gradient(self, point: RecordPoint, loss: Loss) -> tuple[Array, Array]:
        """Gradient of the summed loss in the active parameters (nz,) and the starts (M, n)."""
        if point.sums is not None and not loss.robust:
            return point.sums[:2]
        found = [part.gradient(loss.slope(part.r)) for part in point.parts]
        return sum((own[0] for own in found[1:]), found[0][0]), sum(
            (own[1] for own in found[1:]), found[0][1]
        )

    def gauss_newton(self, point: RecordPoint, curvature: Array | None = None) -> Blocks:
        """Gauss-Newton Hessian blocks of the summed loss with this curvature (K, M) (None: 1 throughout)."""
        if point.sums is not None and curvature is None:
            return point.sums[2]
        bend = None if curvature is None else partial(self.observation.part, curvature)
        found = [part.gauss_newton(None if bend is None else bend(part.at)) for part in point.parts]
        return sum(found[1:], found[0])

    def curvature(self, v: Array, point: RecordPoint, loss: Loss, factor: float, lam: Array) -> Blocks:
        """Second-order part of the Lagrangian's Hessian: factor * loss + lam * ends; lam : (n, M)."""
        z, cuts, ends, propagator = v[self.active], self._cuts(), [lam], self.propagator

        def rho(at: slice) -> Array:
            slope = loss.slope(self.observation.part(point.r, at))
            weighted = factor * slope * self.observation.part(self.weight, at)
            return self.observation.adjoint(weighted)

        if isinstance(point.parts, list) or not isinstance(propagator, LinearPropagator):
            return Blocks(*propagator.contraction(z, point.path, rho(cuts[0]), lam))
        for at in cuts[:0:-1]:  # a part's end is the start of the next
            ends.append(propagator.pulled_back(z, rho(at), ends[-1]))
        found = [
            Blocks(*propagator.contraction(z, path, rho(path.at), end))
            for path, end in zip(
                propagator.run(z, point.parts.nodes, 2, cuts, outputs=False), reversed(ends), strict=True
            )
        ]
        return sum(found[1:], found[0])
