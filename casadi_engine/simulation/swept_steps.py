"""Many steps of the explicit scheme in one CasADi call, for fields without switches.

Where samples lie closer than the error asks for, or only a few times further apart, the length of the steps is known
before they are taken: each piece between two knots in so many equal parts. All of them run without Python, and are
looked at afterwards; from the first one that does not meet the tolerance the integration goes on step by step.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from casadi_engine.simulation.adaptive_steps import dormand_prince
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.switched_field import SwitchedField

# Steps of one call, fewest first; it becomes longer where all were good, shorter where none was.
_ROOMS = 32, 256
# Most parts of a piece; with fewer knots steps are taken one by one, as a sweep has to be made first.
_PARTS, FEWEST = 16, 64


class Sweeps:
    """Sweeps over the pieces of one integration."""

    def __init__(self, field: SwitchedField) -> None:
        self.field, self._room = field, 0

    def of(
        self, x: Array, time: Array, low: Array, high: Array, h: float, z: Array
    ) -> tuple[Array, Array, Array, Array, int] | None:
        """Step by step from x (size,) at the first knot of ``time`` (N,): lengths (K,), states at the ends, and their
        errors of order 5 and 3, each (K, size); and the parts of a piece. None where a piece asks for too many of them.

        low, high : (nu, N-1) channels at the ends of each piece; h : length of a step that is thought to be good
        """
        parts = 1 << max(int(np.ceil(np.log2((time[1] - time[0]) / h))), 0)
        if parts > _PARTS:
            return None
        room = _ROOMS[self._room]
        count = min(room // parts, len(time) - 1)
        lengths = np.diff(time[: count + 1])
        own = np.repeat(lengths / parts, parts)
        begin = (time[:count, None] + lengths[:, None] * (np.arange(parts) / parts)).ravel()
        rows = np.concatenate(
            [time[None, :count], low[:, :count], (high - low)[:, :count] / lengths, np.tile(z, (count, 1)).T]
        )
        taken = len(own)
        at, step = np.full(room, begin[-1]), np.zeros(room)  # steps of no length behind the last
        at[:taken], step[:taken] = begin, own
        segments = np.empty((room, len(rows)))
        segments[:taken], segments[taken:] = np.repeat(rows.T, parts, axis=0), rows[:, -1]
        end, fifth, third = (
            found.reshape(room, -1)[:taken]
            for found in self._function(room)(x, at, step, segments.ravel(), 0.0, 0.0)
        )
        return own, end, fifth, third, parts

    def went(self, good: int, of: int) -> None:
        """Tell how many of the last sweep's steps were good."""
        change = 1 if good == of else -1 if good < of // 2 else 0
        self._room = min(max(self._room + change, 0), len(_ROOMS) - 1)

    def _function(self, room: int) -> Callable[..., list[Array]]:
        return self.field.stepper((), _SWEPT[room])


def _swept(room: int) -> Callable[[ca.Function], ca.Function]:
    def made(field: ca.Function) -> ca.Function:
        step = dormand_prince(field)
        symbols = step.sx_in()
        found: list[ca.SX] = list(step(*symbols))[:3]
        return ca.Function("short", symbols, found).mapaccum(room)

    made.__name__ = f"swept_{room}"
    return made


_SWEPT = {room: _swept(room) for room in _ROOMS}
