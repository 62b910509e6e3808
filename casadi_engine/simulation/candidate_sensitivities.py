"""Sensitivities of effects that are not in the model: dy/dpsi at psi = 0 for many candidate laws in one sweep.

A candidate adds psi g(x, u, t) to the state's derivative and psi m(x, u, t) to the outputs. At psi = 0 its sensitivity
obeys ds/dt = A(t) s + g(t), y_psi = C(t) s + m(t) along the null trajectory; all candidates are columns of one linear
equation (see ``variational``), and a parameter of the model or an initial state is a column like any other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import casadi as ca
import numpy as np

from casadi_engine.deadline import ask
from casadi_engine.model import Model
from casadi_engine.simulation.grouped_scan import Pushed, constant_scan, varying_scan
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.null_path import NullPath, Points
from casadi_engine.simulation.sensitivity_columns import Columns, OwnStates
from casadi_engine.simulation.variational import Steps, balance, scan, step_matrices

# Samples worked on at a time: the arrays of a part then stay near the cache.
_PART = 2048
# States of a part, for all columns, that do not stay in the cache together (16 MB): then columns go by groups.
_WIDE = 2_000_000
# Of what a state's row of A makes in a step, what its change within the step may leave unsolved.
_UNSOLVED = 1e-3
# |A| h at which a step is exact enough, whatever A does in it.
_STEP = 0.5
_MOST_SUBSTEPS = 64
# Steps at which A's change is looked at.
_LOOKED_AT = 1024


@dataclass(frozen=True, eq=False)
class Direction:
    """A term with one amplitude psi that a model may lack, linearised at psi = 0.

    name : what it is called in results
    ode : (n, 1) SX, d(dx/dt)/dpsi; output : (ny, 1) SX, dy/dpsi beside the states' share; both in the model's
    (x, u, d, w, t, p) and in ``states``
    states, rates, start : symbols of the term's own states, their time derivatives at psi = 0 and first values; several
    terms may share them
    inputs, series : symbols of further known signals and their values (ns, N) at the grid's samples, linear between
    initial : (n,) derivative of the first state, or None for zero
    """

    name: str
    ode: ca.SX
    output: ca.SX
    states: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    rates: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    start: tuple[float, ...] = ()
    inputs: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    series: Array | None = None
    initial: Array | None = None


def _with_states(directions: Sequence[Direction]) -> list[Direction]:
    """Directions with states of their own; of those that share them the first."""
    found: dict[tuple[int, ...], Direction] = {}
    for one in directions:
        key = tuple(one.states[k].element_hash() for k in range(one.states.numel()))
        if key:
            found.setdefault(key, one)
    return list(found.values())


def torque_direction(model: Model, port: str, torque: ca.SX, *, name: str) -> Direction:
    """A torque psi * ``torque`` [N m] in the slot of a port; torque : scalar SX in (x, u, d, t, p).

    Laws that divide by slots' torques (a variable inertia) see it too. Raises ModelError for an unknown port.
    """
    slots = [p.name for p in model.ports.with_slot]
    at = slots.index(model.ports[port].name)
    unit = ca.SX.zeros(model.w.numel(), 1)
    unit[at] = torque
    return slot_direction(model, unit, name=name)


def slot_direction(
    model: Model,
    slots: ca.SX,
    *,
    name: str,
    drives: ca.SX | None = None,
    outputs: ca.SX | None = None,
) -> Direction:
    """A direction from what is added to slots (nw, 1), drives (m, 1) and outputs (ny, 1) per unit of psi.

    All in (x, u, d, t, p); laws that depend on drives or other slots respond.
    """
    by_slot, shown_by_slot, law_by_drive, ode_by_drive, output_by_drive = _responses(model)
    ode = ca.SX.zeros(model.x.numel(), 1)
    out = ca.SX.zeros(len(model.outputs), 1) if outputs is None else outputs
    total = ca.sparsify(slots)
    drives = ca.SX(model.d.numel(), 1) if drives is None else ca.sparsify(drives)
    if drives.nnz():
        total = total + ca.mtimes(law_by_drive, drives)
        ode = ode + ca.mtimes(ode_by_drive, drives)
        out = out + ca.mtimes(output_by_drive, drives)
    ode, out = ode + ca.mtimes(by_slot, total), out + ca.mtimes(shown_by_slot, total)
    return Direction(name, ca.densify(ode), ca.densify(out))


@lru_cache(maxsize=16)
def _responses(model: Model) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
    """What the ode (n, nw) and outputs (ny, nw) make of the slots, other laws' answers included, and of the drives:
    laws (nw, m), ode (n, m) and outputs (ny, m)."""
    inside, every = ca.jacobian(model.laws, model.w), ca.SX.eye(model.w.numel())
    part = every
    for _ in range(model.w.numel()):
        part = ca.sparsify(ca.mtimes(inside, part))
        if not part.nnz():
            break
        every = every + part
    moved = (model.laws, model.ode, model.output_expressions)
    by_drive = (ca.jacobian(one, model.d) for one in moved)
    by_slot = (ca.mtimes(ca.jacobian(one, model.w), every) for one in (model.ode, model.output_expressions))
    return (*by_slot, *by_drive)


def parameter_direction(model: Model, slope: Array, *, name: str) -> Direction:
    """The direction of a free parameter: d(model parameters)/d(free one) = ``slope`` : (np,)."""
    turn = ca.SX(ca.DM(np.asarray(slope, dtype=float)))
    moved = slot_direction(
        model,
        ca.jtimes(model.laws, model.p, turn),
        name=name,
        drives=ca.jtimes(model.drive_expressions, model.p, turn),
        outputs=ca.jtimes(model.output_expressions, model.p, turn),
    )
    return replace(moved, ode=moved.ode + ca.jtimes(model.ode, model.p, turn))


def initial_direction(model: Model, state: int, size: float, *, name: str) -> Direction:
    """The direction of an initial state, per ``size`` units of it."""
    first = np.zeros(model.x.numel())
    first[state] = size
    zero = (ca.SX.zeros(model.x.numel(), 1), ca.SX.zeros(len(model.outputs), 1))
    return Direction(name, *zero, initial=first)


class Sweep:
    """The sensitivities of many directions along one null path, part by part.

    substeps : steps of the variational equation in one sample; None chooses them by the fastest rate of A
    """

    def __init__(
        self, path: NullPath, directions: Sequence[Direction], *, substeps: int | None = None
    ) -> None:
        self.path, self.directions = path, tuple(directions)
        model = path.model
        n, width = path.states, len(self.directions)
        self.shape = (len(model.outputs), width)
        stated = _with_states(self.directions)
        own = ca.vertcat(ca.SX(0, 1), *[d.states for d in stated])
        inputs = ca.vertcat(ca.SX(0, 1), *[d.inputs for d in self.directions])
        self._series = np.concatenate(
            [np.zeros((0, path.grid.samples)), *[d.series for d in self.directions if d.series is not None]]
        )
        xi = ca.vertcat(own, inputs)
        self.constant = model.linear is not None and not model.has_slot_laws and path.grid.uniform
        jacobian = [ca.jacobian(one, model.x) for one in (model.ode, model.output_expressions)]
        if model.w.numel():
            laws = ca.jacobian(model.slot_laws, model.x)
            by_slot = (ca.jacobian(one, model.w) for one in (model.ode, model.output_expressions))
            jacobian = [own + ca.mtimes(part, laws) for own, part in zip(jacobian, by_slot, strict=True)]
        self._jacobian = path.function(jacobian)
        first, last = self._some()
        self.scale = balance(first)
        self.substeps = self._fewest(first, last) if substeps is None else substeps
        self._ode = Columns(path, [d.ode for d in self.directions], xi, n)
        self._out = Columns(path, [d.output for d in self.directions], xi, self.shape[0])
        self._own = self._own_states(own, stated) if own.numel() else None
        self._constant: tuple[Array, Steps] | None = None

    def _some(self) -> tuple[Array, Array]:
        """A (T, n, n) at the starts and the ends of some steps; (1, n, n) for a linear model."""
        points = self.path.at_samples()
        if self.constant:
            only = self._slopes(points.part(slice(0, 1)))[0]
            return only, only
        every = max(1, (self.path.grid.samples - 1) // _LOOKED_AT)
        parts = (slice(0, -1, every), slice(1, None, every))
        first, last = (self._slopes(points.part(part))[0] for part in parts)
        return first, last

    def _fewest(self, first: Array, last: Array) -> int:
        """The fewest substeps that follow the change of A within a sample: a constant A is solved in any step."""
        # a slope that is infinite, as that of a root at 0, is followed by no step: what it enters has no numbers
        known = np.isfinite(first) & np.isfinite(last)
        first, last = (np.where(known, one, 0.0) for one in (first, last))
        largest = np.maximum(np.abs(first), np.abs(last))
        h = float(self.path.lengths.max())
        moved, size = (h * np.abs(self._scaled(one)).sum(axis=2) for one in (last - first, largest))
        most = min(max(1, math.ceil(size.max(initial=0.0) / _STEP)), _MOST_SUBSTEPS)
        share = np.divide(moved, size, out=np.zeros_like(size), where=size > 0)
        for wanted in range(1, most):
            acts = np.minimum(1.0, size / wanted) ** 3
            if (acts * share).max(initial=0.0) / wanted <= _UNSOLVED:
                return wanted
        return most

    def _own_states(self, own: ca.SX, stated: Sequence[Direction]) -> OwnStates:
        start = np.array([v for d in stated for v in d.start], dtype=float)
        rates = ca.vertcat(*[d.rates for d in stated])
        return OwnStates(self.path, start, rates, own, self.substeps)

    def _slopes(self, points: Points) -> tuple[Array, Array]:
        """A (T, n, n) and C (T, ny, n)."""
        n, ny = self.path.states, len(self.path.model.outputs)
        found = self._jacobian(*points.arguments)[0]
        found = np.broadcast_to(found, (len(found), points.t.shape[1])).T
        a = found[:, : n * n].reshape(-1, n, n).swapaxes(1, 2)
        return a, found[:, n * n :].reshape(-1, n, ny).swapaxes(1, 2)

    def _scaled(self, a: Array) -> Array:
        return np.ascontiguousarray(a / self.scale[:, None] * self.scale)

    def __iter__(self) -> Iterator[tuple[slice, Array]]:
        """Parts of the grid's samples with dy/dpsi (T, ny, K)."""
        samples = self.path.grid.samples
        state = np.zeros((self.path.states, self.shape[1]))
        for k, direction in enumerate(self.directions):
            if direction.initial is not None:
                state[:, k] = direction.initial / self.scale
        halves = self._halves()
        grouped = self.constant or min(samples, _PART) * state.size > _WIDE
        for here in self._parts():
            shown = slice(here.start, here.stop + 1 if here.stop == samples - 1 else here.stop)
            count = shown.stop - shown.start
            if grouped and isinstance(self._ode, Columns):
                seen, state = self._scanned(here, halves, self._ode, state)
                yield shown, seen[:count] + self._shown(shown, halves)
                continue
            f, push = self._advance(here, halves)
            states = scan(f, np.broadcast_to(push, (here.stop - here.start, *push.shape[1:])), state)
            state = states[-1]
            yield shown, self.outputs(shown, states[:count], halves)

    def _parts(self) -> Iterator[slice]:
        """The steps from sample to sample, part by part."""
        steps = self.path.grid.samples - 1
        for first in range(0, steps, _PART):
            ask()
            yield slice(first, min(first + _PART, steps))

    def steps(self) -> Iterator[tuple[slice, Array, Array, list[tuple[Points, Array]]]]:
        """Parts of the steps from sample to sample: transition (T, n, n), or (1, n, n) for all, push (T, n, K), and the
        points and signals of all halves of substeps, for the outputs."""
        halves = self._halves()
        for here in self._parts():
            f, push = self._advance(here, halves)
            yield here, f, np.broadcast_to(push, (here.stop - here.start, *push.shape[1:])), halves

    def _halves(self) -> list[tuple[Points, Array]]:
        """Every half of a substep from a sample to the next, both included: points and further signals, N - 1 each."""
        count = 2 * self.substeps
        points = [self.path.between(k / count) for k in range(count + 1)]
        low, rise = self._series[:, :-1], np.diff(self._series, axis=1)
        signals = [low + (k / count) * rise for k in range(count + 1)]
        if self._own is not None:
            signals = [np.concatenate(pair) for pair in zip(self._own.run(), signals, strict=True)]
        return list(zip(points, signals, strict=True))

    def _advance(self, here: slice, halves: list[tuple[Points, Array]]) -> tuple[Array, Array]:
        """Transition (T, n, n) and push (T, n, K) over the samples of a part."""
        matrices, forces = [], []
        for points, xi in halves if self.path.held else halves[1:-1]:
            matrices.append(self._matrix(points.part(here)))
            forces.append(self._ode.at(points.part(here), xi[:, here]) / self.scale[:, None])
        if not self.path.held:  # the end of a step is the start of the next
            points = self.path.at_samples().part(slice(here.start, here.stop + 1))
            last = halves[-1][1][:, here.stop - 1 : here.stop]
            force = self._ode.at(points, np.concatenate([halves[0][1][:, here], last], axis=1))
            force /= self.scale[:, None]
            matrix = self._matrix(points)
            low, high = (matrix, matrix) if self.constant else (matrix[:-1], matrix[1:])
            matrices, forces = [low, *matrices, high], [force[:-1], *forces, force[1:]]
        total, push = None, None
        for k in range(0, len(halves) - 1, 2):
            steps = self._steps(here, *matrices[k : k + 3])
            own = steps.start @ forces[k] + steps.middle @ forces[k + 1] + steps.end @ forces[k + 2]
            push = own if push is None else steps.f @ push + own
            total = steps.f if total is None else steps.f @ total
        return np.asarray(total), np.asarray(push)

    def _scanned(
        self, here: slice, halves: list[tuple[Points, Array]], columns: Columns, state: Array
    ) -> tuple[Array, Array]:
        """Outputs by the states (T+1, ny, K) at a part's samples, and the states at its end: a column is pushed by the
        few rows that it acts in, from all halves of substeps at once, and columns that act alike advance together."""
        total, weights = self._weights(here, halves)
        count = here.stop - here.start
        inner = halves if self.path.held else halves[1:-1]
        values = [columns.values(points.part(here), xi[:, here]) for points, xi in inner]
        if not self.path.held:  # the end of a step is the start of the next
            points = self.path.at_samples().part(slice(here.start, here.stop + 1))
            last = halves[-1][1][:, here.stop - 1 : here.stop]
            ends = columns.values(points, np.concatenate([halves[0][1][:, here], last], axis=1))
            values = [ends[:, :-1], *values, ends[:, 1:]]
        pushed = (
            Pushed(
                own,
                weights[..., list(rows)].transpose(1, 2, 3, 0).reshape(len(total), self.path.states, -1),
                np.array([[value[at] for value in values] for at in entries]).reshape(-1, len(own), count),
            )
            for rows, own, entries in columns.alike
        )
        if self.constant:
            return constant_scan(total[0], self.seen(slice(0, 1))[0], pushed, state, count)
        seen = self.seen(slice(here.start, here.stop + 1))
        return varying_scan(total, seen, pushed, state)

    def _weights(self, here: slice, halves: list[tuple[Points, Array]]) -> tuple[Array, Array]:
        """Transition (T, n, n) over the samples of a part, and what a force in each half of a substep makes of the
        state at the end (halves, T, n, n); T is 1 where A is constant."""
        matrices = [self._matrix(points.part(here)) for points, _ in halves]
        if not self.path.held and not self.constant:
            edge = self._matrix(self.path.at_samples().part(slice(here.start, here.stop + 1)))
            matrices[0], matrices[-1] = edge[:-1], edge[1:]
        total = np.eye(self.path.states)[None]
        weights = np.zeros((len(halves), *np.broadcast_shapes(*[m.shape for m in matrices])))
        for k in range(len(halves) - 3, -1, -2):  # from the last substep back
            around = (matrices[0],) * 3 if self.constant else matrices[k : k + 3]
            steps = self._steps(here, *around)
            weights[k] += total @ steps.start
            weights[k + 1] += total @ steps.middle
            weights[k + 2] += total @ steps.end
            total = total @ steps.f
        return total, weights / self.scale

    def _matrix(self, points: Points) -> Array:
        """A of the scaled states (T, n, n), or (1, n, n) for a linear model."""
        if self.constant:
            points = points.part(slice(0, 1))
        a = self._slopes(points)[0]
        return np.ascontiguousarray(a / self.scale[:, None] * self.scale)

    def _steps(self, here: slice, start: Array, middle: Array, end: Array) -> Steps:
        if not self.constant:
            lengths = self.path.lengths
            own = lengths[here] if len(lengths) > 1 else lengths
            return step_matrices(start, middle, end, own[:, None, None] / self.substeps)
        if self._constant is None:
            step = self.path.lengths[:, None, None] / self.substeps
            self._constant = (start, step_matrices(start, start, start, step))
        return self._constant[1]

    def seen(self, shown: slice) -> Array:
        """C of the scaled states at samples (T, ny, n), or (1, ny, n) for all."""
        points = self.path.at_samples().part(shown)
        return np.asarray(self._slopes(points.part(slice(0, 1)) if self.constant else points)[1] * self.scale)

    def outputs(self, shown: slice, states: Array, halves: list[tuple[Points, Array]]) -> Array:
        """dy/dpsi (T, ny, K) at samples from the states there (T, n, K)."""
        return np.asarray(self.seen(shown) @ states + self._shown(shown, halves))

    def _shown(self, shown: slice, halves: list[tuple[Points, Array]]) -> Array:
        """What the directions add to the outputs beside the states (T, ny, K)."""
        xi = halves[0][1][:, shown]
        if shown.stop == self.path.grid.samples:
            xi = np.concatenate([xi, halves[-1][1][:, -1:]], axis=1)
        return self._out.at(self.path.at_samples().part(shown), xi)


def grid_sensitivities(
    path: NullPath, directions: Sequence[Direction], *, substeps: int | None = None
) -> Array:
    """dy/dpsi of K directions at the grid's samples, (K, ny, N)."""
    sweep = Sweep(path, directions, substeps=substeps)
    out = np.empty((path.grid.samples, *sweep.shape))
    for shown, part in sweep:
        out[shown] = part
    return np.ascontiguousarray(out.transpose(2, 1, 0))


def at_measurements(path: NullPath, values: Array) -> dict[str, Array]:
    """(K, ny, N) values at the grid's samples as (K, samples) at the measured times of each output."""
    grid, outputs = path.grid, tuple(out.name for out in path.model.outputs)
    measured = {name: grid.measured[name] for name in outputs if name in grid.measured}
    return {name: values[:, outputs.index(name), m.position] for name, m in measured.items()}
