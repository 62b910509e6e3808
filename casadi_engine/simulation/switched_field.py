"""A model's field f(x, u, t) with its jumps held, for integration through events and along sliding modes.

Between two events every jump keeps its side, so that the field is smooth. Where the fields on both sides of a switch
g = 0 point at it, the state stays on it (Filippov, Differential Equations with Discontinuous Righthand Sides, 1988):
the jump's value lies between both sides such that dg/dt = 0: the field is a mean of those on both sides. This is how
dry friction holds a body at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casadi_engine.model import Model
from casadi_engine.model.jumps import with_held_jumps
from casadi_engine.simulation.jets import Array

# A sliding mode: the numbers of the switches on which the state stays.
Mode = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Segment:
    """Channels on a straight line from ``begin`` [s] on, u = low + (t - begin) * rise; and the estimated vector z."""

    begin: float
    low: Array
    rise: Array
    z: Array

    @property
    def row(self) -> Array:
        """(1 + 2 nu + nz,)."""
        return np.concatenate([[self.begin], self.low, self.rise, self.z])


class SwitchedField:
    """The equations of a model at parameters ``physical`` (np,), expressions of z.

    f(x, t, segment, b, c) with the held jumps' values b; in a mode the mean of the fields at b and b + c, weighted by
    1 - α and α such that the state stays on the mode's switches
    inputs_switch : whether switching functions or what jumps at them depend on the channels
    switches : number of switching functions; ``owner`` : (nb,) the switch at which each held value changes
    sensitivities : carry the derivatives of the states to (start, z) along
    """

    def __init__(self, model: Model, z: ca.SX, physical: ca.SX, *, sensitivities: bool = False) -> None:
        ode, outer = model.closed_ode, ca.vertcat(model.x, model.u, model.t)
        if model.p.numel():
            ode = ca.substitute(ode, model.p, physical)
        self.n, nu, self.nz = int(model.x.numel()), int(model.u.numel()), int(z.numel())
        self.sensitivities = sensitivities
        self.size = self.n * (1 + self.n + self.nz) if sensitivities else self.n
        held = with_held_jumps(ode, of=outer)
        # A corner is no event: the error control sees it, and a law need not be defined beyond it.
        wanted = [s.kind != "kink" for s in held.switches]
        back = [k for k, at in enumerate(held.at) if not wanted[at]]
        kept = [k for k, at in enumerate(held.at) if wanted[at]]
        g = [switch.function for switch, keep in zip(held.switches, wanted, strict=True) if keep]
        field, functions = held.expression, ca.vertcat(ca.SX(0, 1), *g)
        if back:
            corners = _rows(held.symbols, back), _rows(held.values, back)
            field, functions = ca.substitute([field, functions], [corners[0]], [corners[1]])
        numbers = {old: new for new, old in enumerate(i for i, keep in enumerate(wanted) if keep)}
        self.owner = np.array([numbers[held.at[k]] for k in kept], dtype=np.intp)
        self.x, self.t = model.x, model.t
        self._segment = ca.SX.sym("segment", 1 + 2 * nu + self.nz)
        moving = self._segment[1 : 1 + nu] + (model.t - self._segment[0]) * self._segment[1 + nu : 1 + 2 * nu]
        self._z = self._segment[1 + 2 * nu :] if self.nz else ca.SX(0, 1)
        self._given = (ca.vertcat(model.u, z), ca.vertcat(moving, self._z))
        self._b = _rows(held.symbols, kept)
        self._field = self._along(ca.densify(field))
        self.switches = len(g)
        self._g = self._along(functions)
        nodes = self._along(_rows(held.values, kept))
        place = [self.x, self.t, self._segment]
        slope = ca.densify(ca.jacobian(self._g, ca.vertcat(self.x, self.t, self._z)))
        # whether where channels jump, a switch or what jumps there may do so too
        self.inputs_switch = bool(ca.depends_on(ca.vertcat(self._g, nodes), self._segment[: 1 + 2 * nu]))
        self._nodes = _fast(ca.Function("nodes", place, [nodes]))
        self._g_of = _fast(ca.Function("g", [*place, self._b], [self._g]))
        self._slope = _fast(ca.Function("slope", [*place, self._b], [slope]))
        self._made: dict[tuple[str, Mode], Callable[..., list[Array]]] = {}
        self._steps: dict[tuple[str, Mode], ca.Function] = {}

    def _along(self, expression: ca.SX) -> ca.SX:
        """An expression with the channels on the segment's line."""
        return ca.substitute(expression, *self._given) if self._given[0].numel() else expression

    def _sliding(self, mode: Mode) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Symbols b and c, the field in a mode, and the shares α (len(mode), 1)."""
        b, c = ca.SX.sym("b", len(self.owner)), ca.SX.sym("c", len(self.owner))
        if not mode:
            return (
                b,
                c,
                ca.substitute(self._field, self._b, b) if self._b.numel() else self._field,
                ca.SX(0, 1),
            )
        base = ca.substitute(self._field, self._b, b)
        rise = []
        for i in mode:
            own = ca.DM((self.owner == i).astype(float))
            rise.append(ca.substitute(self._field, self._b, b + c * own) - base)
        g = ca.substitute(ca.vertcat(*[self._g[i] for i in mode]), self._b, b)
        slope = ca.jacobian(g, self.x)
        rest = slope @ base + ca.jacobian(g, self.t)
        found = -ca.solve(slope @ ca.horzcat(*rise), rest)
        return b, c, base + ca.horzcat(*rise) @ found, found

    def nodes(self, x: Array, t: float, segment: Array) -> Array:
        """(nb,) values of the jumps at a point."""
        return self._nodes(x[: self.n], t, segment)[0]

    def g(self, x: Array, t: float, segment: Array, b: Array) -> Array:
        """(switches,) switching functions at a point; one may depend on the values b of other jumps."""
        return self._g_of(x[: self.n], t, segment, b)[0]

    def field_function(self, mode: Mode) -> ca.Function:
        """(x, t, segment, b, c) -> (dx/dt, α, dg/dt, g); with sensitivities x is [x; vec S], S : (n, n + nz)."""
        b, c, field, share = self._sliding(mode)
        g = ca.substitute(self._g, self._b, b) if self._b.numel() else self._g
        passing = ca.jacobian(g, self.x) @ field + ca.jacobian(g, self.t)
        x = self.x
        if self.sensitivities:
            s = ca.SX.sym("s", self.n, self.n + self.nz)
            rate = ca.jacobian(field, self.x) @ s
            rate += ca.horzcat(ca.SX.zeros(self.n, self.n), ca.jacobian(field, self._z))
            x, field = ca.vertcat(self.x, ca.vec(s)), ca.vertcat(field, ca.vec(rate))
        found = [ca.densify(part) for part in (field, share, passing, g)]
        return ca.Function("field", [x, self.t, self._segment, b, c], found)

    def field(self, mode: Mode) -> Callable[..., list[Array]]:
        """The same, on arrays."""
        key = ("field", mode)
        if key not in self._made:
            self._made[key] = _fast(self.field_function(mode))
        return self._made[key]

    def stepper(
        self, mode: Mode, make: Callable[[ca.Function], ca.Function], room: int = 1
    ) -> Callable[..., list[Array]]:
        """A step function made of the field of a mode, once; of so many steps in a row."""
        key = (make.__name__, mode)
        if key not in self._steps:
            self._steps[key] = make(self.field_function(mode))
        long = (f"{make.__name__} {room}", mode)
        if long not in self._made:
            step = self._steps[key]
            self._made[long] = _fast(step if room == 1 else step.mapaccum(room))
        return self._made[long]

    def jacobian(self, x: Array, t: float, segment: Array, b: Array, c: Array, mode: Mode) -> Array:
        """(n, n) df/dx."""
        key = ("jacobian", mode)
        if key not in self._made:
            bs, cs, field, _ = self._sliding(mode)
            slope = ca.densify(ca.jacobian(field, self.x))
            self._made[key] = _fast(ca.Function("slope", [self.x, self.t, self._segment, bs, cs], [slope]))
        return self._made[key](x[: self.n], t, segment, b, c)[0].reshape(self.n, self.n).T

    def slopes(self, x: Array, t: float, segment: Array, b: Array) -> Array:
        """(switches, n + 1 + nz) derivatives of the switching functions to (x, t, z)."""
        return self._slope(x[: self.n], t, segment, b)[0].reshape(-1, self.switches).T

    def sides(
        self, x: Array, t: float, segment: Array, b: Array, i: int, sizes: Array
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Held values (nb,) and switching functions on the sides g_i < 0 and g_i > 0 of a point on the switch i.

        sizes : (n,) of the states, by which a point to either side is chosen
        """
        slope, x = self.slopes(x, t, segment, b)[i], x[: self.n]
        scaled = slope[: self.n] * sizes
        norm = float(scaled @ scaled)
        if norm > 0:
            move = 1e-7 * sizes * scaled / np.sqrt(norm)
            return self._there(x - move, t, segment), self._there(x + move, t, segment)
        late = 1e-9 * max(abs(t), 1e-3) * (1 if slope[self.n] >= 0 else -1)
        return self._there(x, t - late, segment), self._there(x, t + late, segment)

    def _there(self, x: Array, t: float, segment: Array) -> tuple[Array, Array]:
        values = self.nodes(x, t, segment)
        return values, self.g(x, t, segment, values)


def _rows(column: ca.SX, rows: list[int]) -> ca.SX:
    return ca.vertcat(ca.SX(0, 1), *[column[row] for row in rows])


def _fast(function: ca.Function) -> Callable[..., list[Array]]:
    """A CasADi function called on arrays without conversions."""
    made: Any = function.buffer()
    buffer, call = made
    inputs: list[Any] = [np.zeros(function.numel_in(k)) for k in range(function.n_in())]
    outputs: list[Any] = [np.zeros(function.numel_out(k)) for k in range(function.n_out())]
    for k, place in enumerate(inputs):
        buffer.set_arg(k, memoryview(place))
    for k, place in enumerate(outputs):
        buffer.set_res(k, memoryview(place))

    def run(*arguments: Array | float) -> list[Array]:
        for place, argument in zip(inputs, arguments, strict=True):
            place[...] = argument
        call()
        return [place.copy() for place in outputs]

    run.keep = (function, buffer)  # type: ignore[attr-defined]
    return run
