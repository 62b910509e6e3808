"""The null trajectory: states, channels and their values between samples along one simulated record."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casadi_engine.model import Model
from casadi_engine.model.linearity import is_affine
from casadi_engine.simulation.adaptive import Adaptive
from casadi_engine.simulation.drives import Drives
from casadi_engine.simulation.exponential_runge_kutta import MOST_SUBSTEPS, TooStiff
from casadi_engine.simulation.finer_grid import around_instants, with_parts
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import cut
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.propagator import make_propagator, switches_in_time
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator
from casadi_engine.simulation.split import timed_drives
from casadi_engine.simulation.switched_field import SwitchedField
from casadi_engine.simulation.tape import ArrayFunction

# Of the steps that follow the error.
_TOLERANCE = 1e-9
# Of the largest value of a state, what the cubic in the middle between two points may be off by.
_CUBIC = 1e-4
# Of a state's standard deviation, what steps of half the length may change it by.
_OTHER = 1e-3
# Parts that a cell is cut into where it is more, and points of a path for each of the record's at most.
_PARTS, _MOST = 4, 8
# Numbers of states that are kept at most, 2 MB.
_LARGE = 250_000
# Cells longer than this many means are holes in a record: laws move there too.
_HOLE = 4.0


@dataclass(frozen=True)
class Points:
    """Arguments of the model's functions at T points: states x (n, T), channels u (nu, T), drives d (m, T) (none
    where functions make them of the channels) and time t (1, T) s."""

    x: Array
    u: Array
    d: Array
    t: Array

    def part(self, chosen: slice) -> Points:
        """A run of the points."""
        return Points(self.x[:, chosen], self.u[:, chosen], self.d[:, chosen], self.t[:, chosen])

    @property
    def arguments(self) -> tuple[Array, Array, Array, Array]:
        """x, u, d, t."""
        return self.x, self.u, self.d, self.t


@dataclass(frozen=True)
class NullPath:
    """One record simulated with known parameters and start.

    grid : of the path; it may have more points than that of the record, where the integrator took more steps
    x : (n, N) states at the grid's samples, in their units; slope : (n, N) their time derivative; before : (n, N-1)
    that at the end of each step, where a held channel has not yet jumped
    d : (m, N) drives at the samples and drive_holds (m,) their holds, for a model with a linear core, whose propagators
    interpolate the drives themselves; (0, N) for any other, which interpolates the channels
    p : (np,) parameters of the model
    """

    model: Model
    grid: Grid
    x: Array
    slope: Array
    before: Array
    d: Array
    drive_holds: tuple[str, ...]
    p: Array

    @property
    def states(self) -> int:
        """Number of states n."""
        return len(self.x)

    @property
    def lengths(self) -> Array:
        """(N-1,) s from each sample to the next; (1,) where all are equal."""
        return np.array([self.grid.step]) if self.grid.uniform else np.diff(self.grid.time)

    def at_samples(self) -> Points:
        """The grid's samples."""
        return Points(self.x, self.grid.channels, self.d, self.grid.time[None])

    def between(self, share: float) -> Points:
        """The points at ``share`` (0 to 1) of each of the N - 1 steps: states by the cubic through both ends.

        A channel with the zero-order hold keeps the value of the step's start, also at its end.
        """
        h, s = self.lengths, share
        x0, x1, d0, d1 = self.x[:, :-1], self.x[:, 1:], self.slope[:, :-1], self.before
        low, rise = (1 + 2 * s) * (1 - s) ** 2, s * s * (3 - 2 * s)
        x = low * x0 + rise * x1 + h * s * (1 - s) * ((1 - s) * d0 - s * d1)
        u = _between(self.grid.channels, self.grid.holds, share)
        return Points(x, u, _between(self.d, self.drive_holds, share), self.grid.time[None, :-1] + s * h)

    @property
    def held(self) -> bool:
        """True if a channel jumps at samples, so that a step's end differs from the next one's start."""
        return any(hold != "first" for hold in self.grid.holds)

    def function(self, expressions: list[ca.SX], *extra: ca.SX) -> ArrayFunction:
        """An array function of (x, u, d, t, *extra) with the parameters put in, and w where it occurs."""
        model = self.model
        drives = model.d if len(self.d) else ca.SX(0, 1)
        inputs = [model.x, model.u, drives, model.t, *extra]
        stacked = ca.vertcat(*[ca.vec(ca.densify(e)) for e in expressions])
        if model.w.numel():
            stacked = ca.substitute(stacked, model.w, model.slot_laws)
        if model.d.numel() and not len(self.d):
            stacked = ca.substitute(stacked, model.d, model.drive_expressions)
        if model.p.numel():
            stacked = ca.substitute(stacked, model.p, ca.SX(ca.DM(self.p)))
        return ArrayFunction(inputs, [ca.cse(stacked)])


# The last paths, the newest first: what one structure is asked about asks for the same path several times over.
_KEPT: deque[tuple[Model, Grid, Array, Array, int | None, NullPath]] = deque(maxlen=4)


def null_path(model: Model, grid: Grid, p: Array, start: Array, *, steps: int | None = None) -> NullPath:
    """As ``simulated_path``; one that was made a moment ago is not made again."""
    p, start = np.array(p, dtype=float), np.array(start, dtype=float)
    for of, laid, at, begun, by, path in _KEPT:
        same = of is model and by == steps and np.array_equal(at, p) and np.array_equal(begun, start)
        if same and (laid is grid or _are_alike(laid, grid)):
            return path
    found = simulated_path(model, grid, p, start, steps=steps)
    if found.x.size <= _LARGE:
        _KEPT.appendleft((model, grid, p, start, steps, found))
    return found


def _are_alike(one: Grid, other: Grid) -> bool:
    """True of two grids of one record that were laid at different times."""
    if (one.holds, one.parts) != (other.holds, other.parts) or one.measured.keys() != other.measured.keys():
        return False
    arrays = [(one.time, other.time), (one.channels, other.channels)]
    arrays += [(own.values, other.measured[name].values) for name, own in one.measured.items()]
    arrays += [(own.time, other.measured[name].time) for name, own in one.measured.items()]
    return all(np.array_equal(a, b, equal_nan=True) for a, b in arrays)


def simulated_path(model: Model, grid: Grid, p: Array, start: Array, *, steps: int | None = None) -> NullPath:
    """Simulate a record at p : (np,) from the state ``start`` : (n,) at its first sample, by single shooting.

    steps : to a sample of an exponential integrator, as in the fit whose path this is; None for the fewest that are
    stable. Any model that is not integrated so, and any on unequal steps or with equations that depend on time itself
    and are affine in the channels, is simulated by steps that follow the error, and gets points between its samples
    where the states bend there; and so is one whose run is another one by steps of half the length.
    Raises FloatingPointError where the states are not finite.
    """
    # equations that bend in the channels are read as lines between samples by a fit with a linear core, and so here
    timed = timed_drives(model) and is_affine(model.closed_ode, model.u, ca.SX(0, 1))
    if not grid.uniform or timed or switches_in_time(model):
        return _adaptive_path(model, grid, p, start)
    try:
        x = _stepped(model, grid, p, start[None], None, steps)
        astray = x is None or _astray(model, grid, p, start, steps, x)
    except TooStiff:
        x, astray = None, True
    if x is None or astray:
        return _adaptive_path(model, grid, p, start)
    if not np.isfinite(x).all():
        raise FloatingPointError("the model's state is not finite here")
    return with_slope(model, grid, x, p)


def _astray(model: Model, grid: Grid, p: Array, start: Array, steps: int | None, x: Array) -> bool:
    """True if states (n, N) are not those of shorter steps: where a step that leaps across a corner to and fro lands,
    slopes are zero, and it looks stable."""
    if not model.has_slot_laws and model.linear is not None and not timed_drives(model):
        return False  # exact
    finer = _stepped(model, grid, p, start[None], None, min(2 * (steps or 1), MOST_SUBSTEPS))
    assert finer is not None  # as the others were made by the same integrator
    return bool((np.std(finer - x, axis=1) > _OTHER * np.std(x, axis=1)).any())


def pieces_path(model: Model, grid: Grid, p: Array, starts: Array, length: int) -> NullPath | None:
    """The same of a linear model piece by piece: every piece of ``length`` samples from a state (n,) of its own, of
    ``starts`` (M, n); None for a model that is no linear one."""
    x = _stepped(model, grid, p, starts, length, None)
    return None if x is None else with_slope(model, grid, x, p)


def _stepped(
    model: Model, grid: Grid, p: Array, starts: Array, length: int | None, steps: int | None
) -> Array | None:
    """(n, N) states on equal steps, from ``starts`` (M, n) of pieces of ``length`` samples; None where no exponential
    integrator makes them."""
    observed = replace(model, outputs=model.states, output_expressions=model.x)
    bare = replace(grid, measured={})
    plan = cut(bare, length)
    scale = np.array([state.scale for state in model.states])
    none, known = ca.SX(0, 1), ca.SX(ca.DM(p))
    propagator = make_propagator(observed, bare, plan, none, known, scale=scale, steps=steps)
    if isinstance(propagator, RungeKuttaPropagator):
        return None
    path = propagator.propagate(np.zeros(0), starts / scale, 0)
    rows = path.y[0].reshape(len(plan.samples), len(scale), plan.b, plan.m).transpose(1, 3, 2, 0)
    return np.ascontiguousarray(rows.reshape(len(scale), -1)[:, : grid.samples])


def _adaptive_path(model: Model, grid: Grid, p: Array, start: Array) -> NullPath:
    """The path by steps that follow the error, with points beside jumps in time and wherever cubics between the points
    would be off."""
    cells = np.diff(grid.time)
    grid = with_parts(grid, np.ceil(cells / (_HOLE * cells.mean())).astype(np.intp))
    grid = around_instants(model, grid, p)
    field, most = SwitchedField(model, ca.SX(0, 1), ca.SX(ca.DM(p))), _MOST * grid.samples
    while True:
        halves = with_parts(grid, np.full(grid.samples - 1, 2))
        x = _states(field, halves, start, np.array([state.scale for state in model.states]))
        path = with_slope(model, grid, np.ascontiguousarray(x[:, ::2]), p)
        off = np.abs(path.between(0.5).x - x[:, 1::2]) > _CUBIC * np.abs(x).max(axis=1, keepdims=True)
        bent = off.any(axis=0)
        if not bent.any() or grid.samples + _PARTS * bent.sum() > most:
            return path
        grid = with_parts(grid, np.where(bent, _PARTS, 1))


def _states(field: SwitchedField, grid: Grid, start: Array, scale: Array) -> Array:
    """(n, N) states on the grid."""
    first = np.array([[hold == "first"] for hold in grid.holds]).reshape(len(grid.channels), 1)
    low = grid.channels[:, :-1]
    high = np.where(first, grid.channels[:, 1:], low)
    with np.errstate(all="ignore"):
        x = Adaptive(field, _TOLERANCE, scale=scale).run(start, grid.time, low, high).states.T
    if not np.isfinite(x).all():
        raise FloatingPointError("the model's state is not finite here")
    return x


def with_slope(model: Model, grid: Grid, x: Array, p: Array) -> NullPath:
    """The null path of known states x : (n, N)."""
    drives: Array = np.zeros((0, grid.samples))
    holds: tuple[str, ...] = ()
    # What depends on time itself is no straight line between samples: it is made of the time.
    if model.linear is not None and model.d.numel() and not timed_drives(model):
        made = Drives(model, grid, ca.SX(0, 1), ca.SX(ca.DM(p)))
        drives, holds = made.at(np.zeros(0)).value, made.holds
    path = NullPath(model, grid, x, x, x[:, 1:], drives, holds, p)
    rates = path.function([model.ode])
    slope = np.broadcast_to(rates(*path.at_samples().arguments)[0], x.shape)
    before = slope[:, 1:]
    if path.held or any(hold != "first" for hold in holds):
        u, d = _between(grid.channels, grid.holds, 1.0), _between(drives, holds, 1.0)
        before = np.broadcast_to(rates(x[:, 1:], u, d, grid.time[None, 1:])[0], before.shape)
    return replace(path, slope=slope, before=before)


def _between(values: Array, holds: tuple[str, ...], share: float) -> Array:
    first = np.array([hold == "first" for hold in holds], dtype=float).reshape(-1, 1)
    return np.asarray(values[:, :-1] + share * first * (values[:, 1:] - values[:, :-1]))
