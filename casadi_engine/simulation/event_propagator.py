"""Propagation of a model that jumps with its states: through its events, with their derivatives.

The state after an event depends on the parameters also by the instant of the event; the sensitivities are carried
through by saltation matrices. Dry friction, a relay or an end stop is fitted as it is written.
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from casadi_engine.model import Model
from casadi_engine.simulation.adaptive import TOO_MANY, Adaptive
from casadi_engine.simulation.drives import Drives
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.sample_rows import to_rows
from casadi_engine.simulation.shown_outputs import ShownOutputs
from casadi_engine.simulation.switched_field import SwitchedField

# Tolerance of the steps at first, what a finer run has of it, and the least.
_TOLERANCE, _FINER, _LEAST = 1e-8, 1e-2, 1e-13
# Events of a trial point, in multiples of the most that a point has had so far; but one to a sample is not too many.
# A point that asks for more chatters, and the search shortens its step.
_RUNAWAY = 4

# Fields are long to build, and a fit makes several propagators of one model: (z, physical, sensitivities, field).
_Made = list[tuple[ca.SX, ca.SX, bool, SwitchedField]]
_made: WeakKeyDictionary[Model, _Made] = WeakKeyDictionary()


def _field(model: Model, z: ca.SX, physical: ca.SX, sensitivities: bool) -> SwitchedField:
    known = _made.setdefault(model, [])
    for own, made, kind, field in known:
        same = own.shape == z.shape and made.shape == physical.shape and kind == sensitivities
        if same and all(ca.is_equal(a, b, 20) for a, b in ((own, z), (made, physical))):
            return field
    field = SwitchedField(model, z, physical, sensitivities=sensitivities)
    known.append((z, physical, sensitivities, field))
    return field


class _Bounded(Adaptive):
    """An integration that meets ``most`` events at most, or as many as there may be for 0."""

    most = 0

    def _count(self) -> None:
        super()._count()
        if self.most and self.events > self.most:
            raise FloatingPointError(TOO_MANY)


@dataclass
class EventTrajectory:
    """x : (L+1, n, M) states at the samples; s : (L+1, M, n, n+nz) their sensitivities to (start, z); outputs y
    (1+nz, R*ny, b, M) and their derivatives to the start ys (R*ny, b, M, n). All scaled. events : of all intervals"""

    x: Array
    s: Array
    y: Array
    ys: Array
    events: int

    @property
    def end(self) -> Array:
        """(n, M)."""
        return self.x[-1]

    @property
    def end_z(self) -> Array:
        """(nz, n, M)."""
        return np.ascontiguousarray(self.s[-1][:, :, self.x.shape[1] :].transpose(2, 1, 0))

    @property
    def end_s(self) -> Array:
        """(M, n, n)."""
        return self.s[-1][:, :, : self.x.shape[1]]


class EventPropagator:
    """A model that jumps with its states over one record; arguments as in ``LinearPropagator``.

    tolerance : of the steps, relative to the states and their sensitivities
    """

    # its steps follow the error, and not the samples
    substeps = -1

    def __init__(
        self,
        model: Model,
        grid: Grid,
        intervals: Intervals,
        z: ca.SX,
        physical: ca.SX,
        *,
        scale: Array,
        tolerance: float = _TOLERANCE,
    ) -> None:
        self.intervals, self.nz, self.n, self.ny = intervals, int(z.numel()), len(scale), len(model.outputs)
        self.grid, self.scale, self.tolerance = grid, scale, tolerance
        self._value = _field(model, z, physical, False)
        self._first = _field(model, z, physical, True)
        self.outputs = ShownOutputs(model, grid, intervals, z, physical, scale)
        self._drives = Drives(model, grid, z, physical)
        first = np.array([[hold == "first"] for hold in grid.holds]).reshape(len(grid.channels), 1)
        self._low = grid.channels[:, :-1]
        self._high = np.where(first, grid.channels[:, 1:], self._low)
        self.events = self._usual = 0

    def finer(self, factor: int) -> EventPropagator:
        """The same propagator with a smaller tolerance, by a hundred whatever the factor."""
        del factor
        other = object.__new__(EventPropagator)
        other.__dict__.update(self.__dict__)
        other.tolerance = max(self.tolerance * _FINER, _LEAST)
        return other

    @property
    def finest(self) -> bool:
        """True if no smaller tolerance is left."""
        return self.tolerance <= _LEAST

    def drives_at(self, z: Array) -> Array:
        """(m, N) drives of the model on the grid."""
        return self._drives.at(z).value

    # A trial point of the search may be far off: what overflows is found by its result.
    @np.errstate(all="ignore")
    def propagate(self, z: Array, nodes: Array, order: int = 1) -> EventTrajectory:
        """Advance all intervals from ``nodes`` (M, n), scaled states, at z : (nz,)."""
        z, plan, n, grid = np.asarray(z, dtype=float), self.intervals, self.n, self.grid
        field = self._first if order else self._value
        wide = n + self.nz
        states = np.empty((plan.length + 1, plan.m, field.size))
        times, events, most = grid.time, 0, 0
        for i, node in enumerate(np.asarray(nodes, dtype=float)):
            first = i * plan.length
            last = min(first + plan.length, grid.samples - 1)
            start = node * self.scale
            if order:
                start = np.concatenate([start, np.eye(n, wide).T.ravel()])
            machine = _Bounded(field, self.tolerance, z, self.scale)
            machine.most = self._usual
            cells = slice(first, last)
            run = machine.run(start, times[first : last + 1], self._low[:, cells], self._high[:, cells])
            states[: last - first + 1, i] = run.states
            states[last - first + 1 :, i] = run.states[-1]
            events, most = events + run.events, max(most, run.events)
        if not np.isfinite(states).all():
            raise FloatingPointError("the model's state is not finite here")
        self.events, self._usual = events, max(self._usual, _RUNAWAY * most, plan.length)
        x = np.ascontiguousarray((states[..., :n] / self.scale).transpose(0, 2, 1))
        if not order:
            none = np.zeros((0,) * 4)
            return EventTrajectory(x, none, to_rows(plan, self.outputs.values(x, z)[None]), none, events)
        s = states[..., n:].reshape(plan.length + 1, plan.m, wide, n).swapaxes(-1, -2) / self.scale[:, None]
        s = np.ascontiguousarray(s)
        s[..., :n] *= self.scale
        value, out = self.outputs.slopes(x, z)
        full = out[..., :n] @ s[: plan.length]
        full[..., n:] += out[..., n:]
        y = np.concatenate([value[None], full[..., n:].transpose(3, 2, 0, 1)])
        ys = to_rows(plan, full[..., :n].transpose(3, 2, 0, 1)).transpose(1, 2, 3, 0)
        return EventTrajectory(x, s, to_rows(plan, y), np.ascontiguousarray(ys), events)

    def contraction(
        self, z: Array, path: EventTrajectory, rho: Array, lam: Array
    ) -> tuple[Array, Array, Array]:
        """Nothing: the second derivatives are left out, and the search's Hessian is that of Gauss and Newton."""
        del z, path, rho, lam
        count, n, nz = self.intervals.m, self.n, self.nz
        return np.zeros((nz, nz)), np.zeros((nz, n, count)), np.zeros((count, n, n))
