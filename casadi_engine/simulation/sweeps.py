"""All integration steps of a record, one after the other, and their derivatives, all at once.

Steps of many intervals advance together by NumPy arrays, implicit ones by Newton's method for all intervals; steps of
few intervals, or of one long simulation, by CasADi's virtual machine, which needs no Python for a step.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import ask
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.newton_machine import newton_steps
from casadi_engine.simulation.stage_newton import beyond, stages_of
from casadi_engine.simulation.stage_slope import StageSlope
from casadi_engine.simulation.step_layout import StepLayout
from casadi_engine.simulation.tableau import Tableau
from casadi_engine.simulation.tape import ArrayFunction

# From this number of intervals on, array operations step all of them faster than CasADi's machine does.
_WIDE = 40
# Steps that are made at once where none waits for another: beyond, what waits for an end is asked in between.
_MANY = 65536
# Up to this number of points that step side by side CasADi's machine is faster.
MACHINE = 512
# Steps of one sweep of the virtual machine.
_SWEEP = 256
# The same for implicit steps, and those of one sweep: a step at which the machine does not arrive ends it.
_WIDE_IMPLICIT, _SWEEP_IMPLICIT = 10, 32
# Numbers of a run that are kept for points near by.
_KEPT = 4_000_000
# Such steps that may be left to the arrays: so many, and one of so many steps; with more of them all are.
_LEFT, _LEFT_OF = 8, 16


class Sweeps:
    """The steps of a layout by one scheme. known : (rows, K+M) for each stage."""

    def __init__(self, slope: StageSlope, scheme: Tableau, layout: StepLayout) -> None:
        self.slope, self.scheme, self.layout = slope, scheme, layout
        given = layout.low, layout.high, layout.time, layout.length
        made = {c: slope.known(*given, c, layout.part) for c in dict.fromkeys(scheme.c.tolist())}
        self.known = [made[c] for c in scheme.c.tolist()]
        self.given = np.concatenate(list(made.values()))
        self._bent = False  # too often for the machine
        # steps at which Newton's method did not arrive at once in the last run
        self.hard = np.zeros(layout.steps, dtype=bool)
        # (z, begun, stage values, their derivatives to (x, z) (S, K, n, n+nz)) of a run: what a point near by begins at
        self._known_by: tuple[Array, Array, Array, Array] | None = None

    # ---- values

    def run(self, z: Array, nodes: Array) -> tuple[Array, Array | None]:
        """States (n, K+M) at the steps' starts and the intervals' ends from ``nodes`` (M, n); stage values
        (stages, n, K) of implicit steps. NaN from where Newton's method does not arrive."""
        layout = self.layout
        self.hard[:] = False
        begun = np.empty((self.slope.n, layout.steps + layout.intervals))
        begun[:, layout.at[0]] = nodes.T
        if self.scheme.implicit:
            few = layout.intervals < _WIDE_IMPLICIT and not self._bent
            return self._in_turn(z, begun) if few else self._newton(z, begun)
        if layout.intervals < _WIDE:
            self._by_machine(z, begun)
            return begun, None
        step = array_step(self.slope, self.scheme).bound(z)
        for own, after in layout:
            ask(len(after))
            begun[:, after] = step(begun[:, own], self.given[:, own])[0]
        return begun, None

    def _by_machine(self, z: Array, begun: Array) -> None:
        """The states of few intervals, side by side, the shorter ones filled up with steps of length 0."""
        place, count = self._side_by_side, self.layout.intervals
        steps = len(place) - 1
        size = min(_SWEEP, steps)
        sweep = _machine_sweep(self.slope, self.scheme, size, count)
        many = np.repeat(z[:, None], count * size, axis=1)
        for k in range(0, steps, size):
            # The last sweep steps back over what is done rather than being of another length.
            first = min(k, steps - size)
            own = place[first : first + size].T.ravel()
            ask(len(own))
            swept = np.asarray(sweep(begun[:, place[first]], self.given[:, own], many), dtype=float)
            begun[:, place[first + 1 : first + 1 + size].T.ravel()] = swept

    @cached_property
    def _side_by_side(self) -> NDArray[np.intp]:
        """(S + 1, M) numbers of the steps of each interval, and of what stands at its end from where it has no more."""
        layout, count = self.layout, self.layout.intervals
        place = np.tile(layout.steps + np.arange(count), (max(len(layout.rows) - 1, 1) + 1, 1))
        place[0] = layout.at[0]
        for k in range(len(place) - 1):
            real = place[k] < layout.steps
            place[k + 1, real] = layout.after[place[k, real]]
        return place

    def _newton(self, z: Array, begun: Array) -> tuple[Array, Array]:
        n, layout, size = self.slope.n, self.layout, self.scheme.stages
        stages, near = np.empty((size, n, layout.steps)), self._near(z)
        function = self.slope.newton.bound(z)
        for own, after in layout:
            x = begun[:, own]
            given = np.concatenate([known[:, own] for known in self.known], axis=-1)
            found = stages_of(self.scheme, function, x, given, None if near is None else near(x, own))
            stages[:, :, own] = found
            begun[:, after] = found[-1]
        return begun, stages

    def remember(self, z: Array, begun: Array, stages: Array, slopes: Array) -> None:
        """Keep a run as what points near by begin at; slopes : (S, K, n, n+nz) of the stage values to (x, z)."""
        self._known_by = (z.copy(), begun, stages, slopes) if slopes.size <= _KEPT else None

    def _near(self, z: Array) -> Callable[[Array, Any], Array] | None:
        """Where the stages (S, n, k) of some steps lead that begin at x (n, k), by the slopes of the run that was kept;
        NaN for those that begin further from there than they went."""
        if self._known_by is None:
            return None
        before, begun, stages, slopes = self._known_by
        n = self.slope.n
        moved = stages + (slopes[..., n:] @ (z - before)).transpose(0, 2, 1)

        def near(x: Array, own: Any) -> Array:
            at, off = begun[:, own], x - begun[:, own]
            there = moved[..., own] + np.einsum("skij,jk->sik", slopes[:, own, :, :n], off)
            went = stages[..., own]
            return np.where(beyond(there - went, went - at, went, at), np.nan, there)

        return near

    def _in_turn(self, z: Array, begun: Array) -> tuple[Array, Array]:
        """The same for few intervals, one after the other."""
        layout, after = self.layout, self.layout.after.tolist()
        stages = np.empty((self.scheme.stages, self.slope.n, layout.steps))
        done = left = 0
        for first in layout.at[0].tolist():
            own = [first]
            while own[-1] < layout.steps:
                own.append(after[own[-1]])
            path = np.array(own)
            k = self._by_sweeps(z, begun, stages, path, 0)
            while k < len(own) - 1:
                left += 1
                if left > _LEFT + (done + k) // _LEFT_OF:
                    self._bent = True
                    return self._newton(z, begun)
                if not self._by_itself(z, begun, stages, path[k : k + 2]):
                    begun[:, path[k + 1 :]] = np.nan
                    break
                k = self._by_sweeps(z, begun, stages, path, k + 1)
            done += k
        return begun, stages

    def _by_sweeps(self, z: Array, begun: Array, stages: Array, path: NDArray[np.intp], k: int) -> int:
        """The steps of one interval from its k-th on, as far as the machine arrives: the number of the one where it
        does not. path : numbers of the steps, and of what stands at the interval's end behind them."""
        last, n, size = len(path) - 1, self.slope.n, self.scheme.stages
        sweep, many = (
            newton_steps(self.slope, self.scheme, _SWEEP_IMPLICIT),
            np.repeat(z[:, None], _SWEEP_IMPLICIT, 1),
        )
        while k < last:
            # filled up with steps of length 0
            some = path[np.minimum(np.arange(k, k + _SWEEP_IMPLICIT), last)]
            ask(len(some))
            try:
                end, found, arrived = map(np.asarray, sweep(begun[:, some[0]], self.given[:, some], many))
            except RuntimeError:  # of a singular matrix somewhere in the sweep
                return k
            count = min(int(np.append(arrived.ravel() > 0, False).argmin()), last - k)
            begun[:, path[k + 1 : k + 1 + count]] = end[:, :count]
            stages[:, :, some[:count]] = found[:, :count].reshape(size, n, count)
            k += count
            if count < len(some):
                break
        return k

    def _by_itself(self, z: Array, begun: Array, stages: Array, ends: NDArray[np.intp]) -> bool:
        """One step by as many iterations as it takes; False where these do not arrive."""
        own, x = ends[:1], begun[:, ends[:1]]
        self.hard[own] = True
        given = np.concatenate([known[:, own] for known in self.known], axis=-1)
        found = stages_of(self.scheme, self.slope.newton.bound(z), x, given)
        stages[:, :, own], begun[:, ends[1:]] = found, found[-1]
        return bool(np.isfinite(found).all())

    # ---- derivatives

    def derivatives(self, z: Array, begun: Array, stages: Array | None) -> tuple[Array, Array, Array]:
        """Stage values (stages, n, K), slopes' derivatives by x (stages, K, n, n) and z (stages, K, n, nz)."""
        n, nz, steps = self.slope.n, int(self.slope.z.numel()), self.layout.steps
        start, at, by_x, by_z = begun[:, :steps], [], [], []
        slopes: list[Array] = []
        for i in range(self.scheme.stages):
            ask(steps)
            x = start if stages is None else stages[i]
            if stages is None:
                for weight, slope in zip(self.scheme.a[i], slopes, strict=False):
                    x = x + weight * slope if weight else x
            value, in_x, in_z = self.slope.first(x, self.known[i][:, :steps], z)
            slopes.append(value)
            at.append(x)
            # all steps side by side in memory, for `products`
            by_x.append(in_x.reshape(n, n, steps).transpose(2, 1, 0))
            by_z.append(in_z.reshape(nz, n, steps).transpose(2, 1, 0))
        return np.stack(at), _stacked(by_x), _stacked(by_z)


def _stacked(parts: list[Array]) -> Array:
    """Arrays (K, n, k) on top of each other, K last in memory as it is in theirs."""
    return np.stack([part.transpose(1, 2, 0) for part in parts]).transpose(0, 3, 1, 2)


def advance(
    slope: StageSlope,
    scheme: Tableau,
    z: Array,
    x: Array,
    low: Array,
    high: Array,
    time: Array,
    length: Array,
) -> Array:
    """Ends (n, K) of K single steps from x (n, K), each whole (with all its parts); NaN where there is none."""
    if x.shape[1] > _MANY:
        parts = [slice(k, k + _MANY) for k in range(0, x.shape[1], _MANY)]
        each = [(x[:, p], low[:, p], high[:, p], time[p], length[p]) for p in parts]
        return np.concatenate([advance(slope, scheme, z, *own) for own in each], axis=1)
    ask()
    nodes = dict.fromkeys(scheme.c.tolist())
    for part in range(slope.parts):
        which = np.full(len(time), part)
        made = {c: slope.known(low, high, time, length, c, which) for c in nodes}
        if scheme.implicit:
            given = np.concatenate([made[c] for c in scheme.c.tolist()], axis=-1)
            x = stages_of(scheme, lambda s, g: slope.newton(s, g, z), x, given)[-1]
        else:
            x = array_step(slope, scheme)(x, np.concatenate(list(made.values())), z)[0]
    return x


def _step_symbols(slope: StageSlope, scheme: Tableau) -> tuple[list[ca.SX], ca.SX]:
    """(x, known of the distinct nodes, z) and the end of an explicit step, as expressions."""
    key = ("step", scheme.name)
    if key not in slope.made:
        nodes = list(dict.fromkeys(scheme.c.tolist()))
        rows = int(slope.known_symbols.numel())
        known = ca.SX.sym("known", rows * len(nodes))
        phi = ca.Function("phi", [slope.x, slope.known_symbols, slope.z], [slope.expression])
        slopes: list[ca.SX] = []
        for i, c in enumerate(scheme.c.tolist()):
            x = slope.x
            for weight, made in zip(scheme.a[i], slopes, strict=False):
                if weight:
                    x = x + weight * made
            place = nodes.index(c) * rows
            slopes.append(phi(x, known[place : place + rows], slope.z))
        end = slope.x
        for weight, made in zip(scheme.b, slopes, strict=True):
            end = end + weight * made
        slope.made[key] = ([slope.x, known, slope.z], end)
    return slope.made[key]


def array_step(slope: StageSlope, scheme: Tableau) -> ArrayFunction:
    """An explicit step of many columns: (x, known of the distinct nodes, z) to x at its end."""
    key = ("array", scheme.name)
    if key not in slope.made:
        inputs, end = _step_symbols(slope, scheme)
        slope.made[key] = ArrayFunction(inputs, [end])
    return slope.made[key]


def _machine_step(slope: StageSlope, scheme: Tableau) -> ca.Function:
    key = ("machine", scheme.name)
    if key not in slope.made:
        inputs, end = _step_symbols(slope, scheme)
        slope.made[key] = ca.Function("step", inputs, [end])
    return slope.made[key]


def machine_ends(sweeps: Sweeps, z: Array, first: Array) -> tuple[NDArray[np.intp], Array]:
    """States (S + 1, n, P) along the explicit steps of one interval, at points z (nz, P) from ``first`` (n, P), and for
    each step, and what stands at the end, its number among these; for few points, which arrays would not fill."""
    place, (n, points) = sweeps._side_by_side[:, 0], first.shape
    steps = len(place) - 1
    size = min(_SWEEP, steps)
    sweep = _machine_points(sweeps.slope, sweeps.scheme, size, points)
    found = np.empty((steps + 1, n, points))
    found[0] = first
    for k in range(0, steps, size):
        begin = min(k, steps - size)
        ask(size * points)
        swept = sweep(found[begin], sweeps.given[:, place[begin : begin + size]], z)
        ends = np.asarray(swept, dtype=float).reshape(n, points, size)
        found[begin + 1 : begin + 1 + size] = ends.transpose(2, 0, 1)
    numbers = np.zeros(sweeps.layout.steps + sweeps.layout.intervals, dtype=np.intp)
    numbers[place] = np.arange(steps + 1)
    return numbers, found


def _machine_points(slope: StageSlope, scheme: Tableau, size: int, points: int) -> ca.Function:
    """So many steps at so many points, which share what is known."""
    one = ("point", scheme.name, size)
    if one not in slope.made:
        steps = _machine_step(slope, scheme).mapaccum(size)
        x, known = (ca.MX.sym(name, *steps.size_in(k)) for k, name in enumerate(("x", "known")))
        z = ca.MX.sym("z", int(slope.z.numel()))
        slope.made[one] = ca.Function("one", [x, known, z], [steps(x, known, ca.repmat(z, 1, size))])
    key = (*one, points)
    if key not in slope.made:
        slope.made[key] = slope.made[one].map("points", "serial", points, [1], [])
    return slope.made[key]


def _machine_sweep(slope: StageSlope, scheme: Tableau, size: int, count: int) -> ca.Function:
    """So many steps of so many intervals; made once, as an evaluation of few steps costs less than making it."""
    key = ("sweep", scheme.name, size, count)
    if key not in slope.made:
        sweep = _machine_step(slope, scheme).mapaccum(size)
        slope.made[key] = sweep.map(count) if count > 1 else sweep
    return slope.made[key]
