"""Jumps in time: where equations switch at an instant that only time, recorded channels and parameters decide.

Within a step each switch has at most one instant. It is found by Newton's method from the secant, written as an
expression, so that its derivative by the parameters is that of the implicit function: the state after a switch moves
with the instant as it does in the true system.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca

from casadi_engine.errors import SimulationError
from casadi_engine.model.jumps import with_held_jumps

# Newton's method squares its error each time: from a secant's it is at the last digit after four, and after six where
# a switch bends as much as t**3 from 0 on.
_NEWTON = 6
# More switches than these would make the expressions of a step long; all their orders in time are possible.
_MOST = 6

# (expressions of channels and time, an instant) -> the expressions there
Place = Callable[[ca.SX, ca.SX], ca.SX]


@dataclass(frozen=True, eq=False)
class TimeEvents:
    """Equations with jumps in time.

    held : (n, 1) SX, the equations with the jumps replaced by ``symbols``; nodes : (nb, 1) the jumps' values
    switches : functions of (u, t) whose zeros are the instants
    """

    held: ca.SX
    symbols: ca.SX
    nodes: ca.SX
    switches: tuple[ca.SX, ...]
    u: ca.SX
    t: ca.SX

    @property
    def parts(self) -> int:
        """Into how many parts a step is cut."""
        return len(self.switches) + 1

    def slope(self, low: ca.SX, high: ca.SX, begin: ca.SX, length: ca.SX, node: ca.SX, part: ca.SX) -> ca.SX:
        """The slope h f at a node of a part of the step from ``begin`` on; part : (parts, 1), 1 for the part meant."""
        safe = ca.fmax(length, 1e-300)

        def at(expressions: ca.SX, time: ca.SX) -> ca.SX:
            channels = low + (time - begin) / safe * (high - low)
            return ca.substitute(expressions, ca.vertcat(self.u, self.t), ca.vertcat(channels, time))

        marks = [begin, *self._instants(at, begin, begin + length), begin + length]
        starts, ends = ca.vertcat(*marks[:-1]), ca.vertcat(*marks[1:])
        start, size = ca.dot(part, starts), ca.dot(part, ends - starts)
        values = at(self.nodes, start + 0.5 * size)
        fields = at(self.held, start + node * size)
        return size * ca.substitute(fields, self.symbols, values)

    def _instants(self, at: Place, begin: ca.SX, end: ca.SX) -> list[ca.SX]:
        """The switches' instants in order of time, those that lie outside the step at its end."""
        found: list[ca.SX] = []
        for switch in self.switches:
            rate = _rate(switch, at)
            first, last = at(switch, begin), at(switch, end)
            inside = ca.logic_or(ca.logic_and(first <= 0, last > 0), ca.logic_and(first >= 0, last < 0))
            time = begin - first * (end - begin) / ca.if_else(inside, last - first, 1.0)
            for _ in range(_NEWTON):
                slope = rate(time)
                time = time - at(switch, time) / ca.if_else(ca.fabs(slope) > 0, slope, 1.0)
                # at a limit itself the slope is the root's: fmin and fmax would take half of it
                time = ca.if_else(time < begin, begin, ca.if_else(time > end, end, time))
            found.append(ca.if_else(inside, time, end))
        for last_place in range(len(found) - 1, 0, -1):
            for k in range(last_place):
                found[k], found[k + 1] = ca.fmin(found[k], found[k + 1]), ca.fmax(found[k], found[k + 1])
        return found


def _rate(switch: ca.SX, at: Place) -> Callable[[ca.SX], ca.SX]:
    """The derivative by time of a switch along a step, its channels moving on a straight line."""
    moving = ca.SX.sym("moving")
    slope = ca.jacobian(at(switch, moving), moving)
    return lambda time: ca.substitute(slope, moving, time)


def time_events(equations: ca.SX, u: ca.SX, t: ca.SX, inside: ca.SX) -> TimeEvents | None:
    """The jumps of equations at instants that do not depend on ``inside`` (the states); None where there are none.

    Raises SimulationError for more than six switches.
    """
    outer = ca.vertcat(u, t)
    found = with_held_jumps(equations, of=outer)
    plain = [ca.substitute(switch.function, found.symbols, found.values) for switch in found.switches]
    # A corner of a recorded channel is left to the error control: a channel's own samples are corners too.
    timed = [
        not ca.depends_on(g, inside) and (switch.kind != "kink" or ca.depends_on(g, t))
        for g, switch in zip(plain, found.switches, strict=True)
    ]
    if not any(timed):
        return None
    # A jump may sit on a corner (the sign of max(u - 1, 0)): then the corner says when.
    under = ca.vertcat(*[switch.g for switch, cut in zip(found.switches, timed, strict=True) if cut])
    deciding = {found.at[b] for b in range(found.symbols.numel()) if ca.depends_on(under, found.symbols[b])}
    timed = [cut or (k in deciding and not ca.depends_on(plain[k], inside)) for k, cut in enumerate(timed)]
    back = [b for b, at in enumerate(found.at) if not timed[at]]
    held = found.expression
    if back:
        held = ca.substitute(held, _entries(found.symbols, back), _entries(found.values, back))
    kept = [b for b, at in enumerate(found.at) if timed[at]]
    switches = tuple(g for g, wanted in zip(plain, timed, strict=True) if wanted)
    if len(switches) > _MOST:
        raise SimulationError(
            "the equations switch in time in more ways than can be integrated at their instants",
            seen=f"{len(switches)} different conditions",
            allowed=f"up to {_MOST}",
            cure="put the switches into one input channel, or smooth some of them",
        )
    return TimeEvents(held, _entries(found.symbols, kept), _entries(found.values, kept), switches, u, t)


def _entries(column: ca.SX, rows: list[int]) -> ca.SX:
    return ca.vertcat(*[column[row] for row in rows])
