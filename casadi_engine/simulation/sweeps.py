"""All integration steps of a record, one after the other, and their derivatives, all at once.

Steps of many intervals advance together by NumPy arrays, implicit ones by Newton's method for all intervals; steps of
few intervals, or of one long simulation, by CasADi's virtual machine, which needs no Python for a step.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import ask
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.newton_machine import ITERATIONS, ROUNDING, SMALL, newton_steps
from casadi_engine.simulation.stage_slope import StageSlope
from casadi_engine.simulation.step_layout import StepLayout
from casadi_engine.simulation.tableau import Tableau, newton_step
from casadi_engine.simulation.tape import ArrayFunction

# From this number of intervals on, array operations step all of them faster than CasADi's machine does.
_WIDE = 40
# Steps that are made at once where none waits for another: beyond, what waits for an end is asked in between.
_MANY = 65536
# Steps of one sweep of the virtual machine.
_SWEEP = 256
# The same for implicit steps, and those of one sweep: a step at which the machine does not arrive ends it.
_WIDE_IMPLICIT, _SWEEP_IMPLICIT = 20, 32


class Sweeps:
    """The steps of a layout by one scheme. known : (rows, K+M) for each stage."""

    def __init__(self, slope: StageSlope, scheme: Tableau, layout: StepLayout) -> None:
        self.slope, self.scheme, self.layout = slope, scheme, layout
        given = layout.low, layout.high, layout.time, layout.length
        made = {c: slope.known(*given, c, layout.part) for c in dict.fromkeys(scheme.c.tolist())}
        self.known = [made[c] for c in scheme.c.tolist()]
        self._given = np.concatenate(list(made.values()))

    # ---- values

    def run(self, z: Array, nodes: Array) -> tuple[Array | None, Array | None]:
        """States (n, K+M) at the steps' starts and the intervals' ends from ``nodes`` (M, n); stage values
        (stages, n, K) of implicit steps. No states where Newton's method does not arrive."""
        layout = self.layout
        begun = np.empty((self.slope.n, layout.steps + layout.intervals))
        begun[:, layout.at[0]] = nodes.T
        if self.scheme.implicit:
            few = layout.intervals < _WIDE_IMPLICIT
            return self._in_turn(z, begun) if few else self._newton(z, begun)
        if layout.intervals < _WIDE:
            self._by_machine(z, begun)
            return begun, None
        step = _array_step(self.slope, self.scheme).bound(z)
        for own, after in layout:
            ask(len(after))
            begun[:, after] = step(begun[:, own], self._given[:, own])[0]
        return begun, None

    def _by_machine(self, z: Array, begun: Array) -> None:
        """The states of few intervals, side by side, the shorter ones filled up with steps of length 0."""
        layout, count = self.layout, self.layout.intervals
        steps = max(len(layout.rows) - 1, 1)
        place = np.tile(layout.steps + np.arange(count), (steps + 1, 1))
        place[0] = layout.at[0]
        for k in range(steps):
            real = place[k] < layout.steps
            place[k + 1, real] = layout.after[place[k, real]]
        size = min(_SWEEP, steps)
        sweep = _machine_step(self.slope, self.scheme).mapaccum(size)
        if count > 1:
            sweep = sweep.map(count)
        many = np.repeat(z[:, None], count * size, axis=1)
        for k in range(0, steps, size):
            # The last sweep steps back over what is done rather than being of another length.
            first = min(k, steps - size)
            own = place[first : first + size].T.ravel()
            ask(len(own))
            swept = np.asarray(sweep(begun[:, place[first]], self._given[:, own], many), dtype=float)
            begun[:, place[first + 1 : first + 1 + size].T.ravel()] = swept

    def _newton(self, z: Array, begun: Array) -> tuple[Array | None, Array | None]:
        n, layout, size = self.slope.n, self.layout, self.scheme.stages
        stages = np.empty((size, n, layout.steps))
        function = self.slope.newton.bound(z)
        for own, after in layout:
            x = begun[:, own]
            given = np.concatenate([known[:, own] for known in self.known], axis=-1)
            found = solve_stages(self.scheme, function, x, np.repeat(x[None], size, axis=0), given)
            if found is None:
                return None, None
            stages[:, :, own] = found
            begun[:, after] = found[-1]
        return begun, stages

    def _in_turn(self, z: Array, begun: Array) -> tuple[Array | None, Array | None]:
        """The same for few intervals, one after the other."""
        layout, after = self.layout, self.layout.after.tolist()
        stages = np.empty((self.scheme.stages, self.slope.n, layout.steps))
        for first in layout.at[0].tolist():
            own = [first]
            while own[-1] < layout.steps:
                own.append(after[own[-1]])
            if not self._along(z, begun, stages, np.array(own)):
                return None, None
        return begun, stages

    def _along(self, z: Array, begun: Array, stages: Array, own: NDArray[np.intp]) -> bool:
        """The steps of one interval, with what stands at its end behind them; False where Newton's method fails."""
        size, n, last = self.scheme.stages, self.slope.n, len(own) - 1
        sweep = newton_steps(self.slope, self.scheme, _SWEEP_IMPLICIT)
        function, many = self.slope.newton.bound(z), np.repeat(z[:, None], _SWEEP_IMPLICIT, axis=1)
        own = np.concatenate([own, np.repeat(own[-1:], _SWEEP_IMPLICIT)])  # filled up with steps of length 0
        k = 0
        while k < last:
            some = own[k : k + _SWEEP_IMPLICIT]
            ask(len(some))
            try:
                made = sweep(begun[:, some[0]], self._given[:, some], many)
            except RuntimeError:  # of a singular matrix somewhere in the sweep
                count = 0
            else:
                end, found, arrived = (np.asarray(one) for one in made)
                count = min(int(np.append(arrived.ravel() > 0, False).argmin()), last - k)
                begun[:, own[k + 1 : k + 1 + count]] = end[:, :count]
                stages[:, :, some[:count]] = found[:, :count].reshape(size, n, count)
            k += count
            if count == len(some) or k == last:
                continue
            x, given = begun[:, own[k : k + 1]], [known[:, own[k : k + 1]] for known in self.known]
            guess = np.repeat(x[None], size, axis=0)
            step = solve_stages(self.scheme, function, x, guess, np.concatenate(given, axis=-1))
            if step is None:
                return False
            stages[:, :, own[k]], begun[:, own[k + 1]] = step[..., 0], step[-1, :, 0]
            k += 1
        return True

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


def solve_stages(scheme: Tableau, function: object, x: Array, guess: Array, given: Array) -> Array | None:
    """Stage values (stages, n, K) of implicit steps from x (n, K), or None where Newton's method does not arrive.

    function : (stage values (n, stages*K), known (rows, stages*K)) -> slopes and their derivatives, z put in
    """
    size, n, count = guess.shape
    stages, before = guess, np.full(guess.shape, np.inf)
    for _ in range(ITERATIONS):
        ask(size * count)
        columns = np.ascontiguousarray(stages.transpose(1, 0, 2)).reshape(n, -1)
        value, slope = function(columns, given)  # type: ignore[operator]
        value = value.reshape(n, size, count).transpose(1, 0, 2)
        residual = stages - x - np.einsum("ij,jnk->ink", scheme.a, value)
        by_x = slope.reshape(n, n, size, count).transpose(2, 3, 1, 0)
        if not (np.isfinite(residual).all() and np.isfinite(by_x).all()):
            return None
        try:
            change = newton_step(scheme, by_x, residual.transpose(0, 2, 1)).transpose(0, 2, 1)
        except np.linalg.LinAlgError:
            return None
        stages = stages + change
        own, moved = np.abs(stages).max(axis=0) + np.abs(x), np.abs(change)
        # What has decayed is known to the rounding of the states that it follows from: there it moves to and fro.
        rests = (moved >= 0.5 * before) & (moved <= ROUNDING * own.max(axis=0))
        if (rests | (moved <= SMALL * own + 1e-30)).all():
            return stages
        before = moved
    return None


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
            guess = np.repeat(x[None], scheme.stages, axis=0)
            found = solve_stages(scheme, lambda s, g: slope.newton(s, g, z), x, guess, given)
            x = np.full_like(x, np.nan) if found is None else found[-1]
        else:
            x = _array_step(slope, scheme)(x, np.concatenate(list(made.values())), z)[0]
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


def _array_step(slope: StageSlope, scheme: Tableau) -> ArrayFunction:
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
