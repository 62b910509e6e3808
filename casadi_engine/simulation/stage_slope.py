"""The slope φ = h f at a stage of an integration step, as a function of the state, of what is known, and of z.

What depends on channels and time alone is worked out once for the record. Where the equations jump at instants of
their own (a load that is switched on, forcing by a square wave), a step is cut at these instants: its parts have
lengths that depend on the parameters, each is integrated with the jump held on one side, and so the instant has a
slope.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.model import Model
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.tape import ArrayFunction
from casadi_engine.simulation.time_events import TimeEvents, time_events


class StageSlope:
    """The symbols (x, known, z) and the expression of φ (n, 1); x scaled.

    parts : into how many a step is cut, 1 where nothing jumps in time
    """

    def __init__(self, model: Model, z: ca.SX, physical: ca.SX, scale: Array) -> None:
        self.n = len(scale)
        self.x, self.z = ca.SX.sym("x", self.n), z
        s = ca.DM(scale)
        ode = ca.substitute(model.closed_ode, model.x, self.x * s) / s
        if model.p.numel():
            ode = ca.substitute(ode, model.p, physical)
        self.events: TimeEvents | None = time_events(ode, model.u, model.t, self.x)
        if self.events is None:
            self._plain(ode, model)
        else:
            self._cut(self.events, model)
        symbols = [self.x, self.known_symbols, z]
        self.value = ArrayFunction(symbols, [self.expression])
        by_x = ca.densify(ca.jacobian(self.expression, self.x))
        self.newton = ArrayFunction(symbols, [self.expression, by_x])
        by_z = ca.densify(ca.jacobian(self.expression, z))
        self.first = ArrayFunction(symbols, [self.expression, by_x, by_z])
        self._second: ArrayFunction | None = None
        # functions made of the slope, by whoever needs them
        self.made: dict[tuple[str | int, ...], Any] = {}

    @property
    def parts(self) -> int:
        """Number of parts of a step."""
        return 1 if self.events is None else self.events.parts

    def _plain(self, ode: ca.SX, model: Model) -> None:
        channels, h = ca.vertcat(model.u, model.t), ca.SX.sym("h")
        rest, held, terms = ca.extract_parametric(ode, channels, {})
        bare = [i for i in range(channels.numel()) if ca.depends_on(rest, channels[i])]
        known = ca.vertcat(*[channels[i] for i in bare], *terms)
        self._given = ArrayFunction([model.u, model.t], [known])
        self.known_symbols = ca.vertcat(*[channels[i] for i in bare], *held, h)
        self.expression = ca.densify(h * rest)

    def _cut(self, events: TimeEvents, model: Model) -> None:
        low, high = ca.SX.sym("low", model.u.numel()), ca.SX.sym("high", model.u.numel())
        begin, length, node = ca.SX.sym("begin"), ca.SX.sym("length"), ca.SX.sym("node")
        part = ca.SX.sym("part", events.parts)
        self.known_symbols = ca.vertcat(low, high, begin, length, node, part)
        self.expression = ca.densify(events.slope(low, high, begin, length, node, part))

    def known(
        self, low: Array, high: Array, time: Array, length: Array, node: float, part: NDArray[Any]
    ) -> Array:
        """(rows, K) of what φ takes besides x and z at the node of K steps; part : (K,) number of the step's part."""
        if self.events is None:
            given = self._given(low + node * (high - low), (time + node * length)[None])[0]
            return np.concatenate([given, length[None]])
        chosen = (np.arange(self.parts)[:, None] == part[None]).astype(float)
        nodes = np.full((1, len(time)), node)
        return np.concatenate([low, high, time[None], length[None], nodes, chosen])

    def second(self, x: Array, known: Array, z: Array, weights: Array) -> Array:
        """(n + nz, n + nz, K) Hessian to (x, z) of sum(weights * φ); weights : (n, K)."""
        if self._second is None:
            weight = ca.SX.sym("weight", self.n)
            both = ca.vertcat(self.x, self.z)
            hessian = ca.densify(ca.hessian(ca.dot(weight, self.expression), both)[0])
            self._second = ArrayFunction([self.x, self.known_symbols, self.z, weight], [hessian])
        wide = self.n + int(self.z.numel())
        return self._second(x, known, z, weights)[0].reshape(wide, wide, -1)
