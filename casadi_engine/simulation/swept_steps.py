"""Many steps of the explicit scheme in one CasADi call.

Where samples lie closer than the error asks for, or only a few times further apart, the length of the steps is known
before they are taken: each piece between two knots in so many equal parts. All of them run without Python, and are
looked at afterwards; from the first one that does not meet the tolerance, or within which a switch may be passed, the
integration goes on step by step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.adaptive_steps import dormand_prince
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.switched_field import Mode, SwitchedField

# Steps of one call, fewest first; it becomes longer where all were good, and begins anew where less than half were.
_ROOMS = 16, 32, 64, 128, 256
# Most parts of a piece; with fewer knots steps are taken one by one, as a sweep has to be made first.
_PARTS, FEWEST = 16, 64


@dataclass(frozen=True, eq=False)
class Swept:
    """Steps of one sweep, a row each.

    parts : steps to a piece; lengths (K,); ends : states (K, size), with their errors of order ``fifth`` and ``third``;
    share, first_share : (K, m) of the sliding modes at the ends and at the beginnings; late_g, late_rate, g, rate :
    (K, switches) switching functions and their rates there, with the errors ``passing5`` and ``passing3``
    """

    parts: int
    lengths: Array
    ends: Array
    fifth: Array
    third: Array
    share: Array
    passing5: Array
    passing3: Array
    rate: Array
    late_rate: Array
    g: Array
    late_g: Array
    first_share: Array

    def undisturbed(
        self, side: Array, mode: Mode, near: Array, jumped: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """(K,) True of steps within which no switch is passed, and none would be decided anew at the beginning.

        side : (switches,) on which the state is, 0 where that is not known; near : (K, switches) below which a
        switching function may be at 0; jumped : (K,) where the channels jump at the beginning
        """
        free = np.ones(len(side), dtype=bool)
        free[list(mode)] = False
        if (free & (side == 0)).any():
            return np.zeros(len(self.lengths), dtype=bool)
        reach = 0.5 * self.lengths[:, None] * np.maximum(np.abs(self.rate), np.abs(self.late_rate))
        far = (np.minimum(side * self.g, side * self.late_g) > reach)[:, free].all(axis=1)
        held, begun = (
            (np.minimum(share, 1 - share) > 0).all(axis=1) for share in (self.share, self.first_share)
        )
        clear = (np.abs(self.g) > near)[:, free].all(axis=1) & begun
        return np.asarray(far & held & (clear | ~jumped))


class Sweeps:
    """Sweeps over the pieces of one integration. cut : whether not all steps of the last one were good"""

    def __init__(self, field: SwitchedField) -> None:
        self.field, self._room, self.cut = field, 0, False

    def of(
        self,
        x: Array,
        time: Array,
        low: Array,
        high: Array,
        h: float,
        z: Array,
        held: tuple[Mode, Array, Array],
    ) -> Swept | None:
        """Step by step from x (size,) at the first knot of ``time`` (N,). None where a piece asks for too many steps.

        low, high : (nu, N-1) channels at the ends of each piece; h : length of a step that is thought to be good;
        held : the sliding mode, and the values (nb,) of the jumps, b and c of the field
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
        mode, b, c = held
        made = self.field.stepper(mode, dormand_prince, room)
        found = made(x, at, step, segments.ravel(), np.tile(b, room), np.tile(c, room))
        return Swept(parts, own, *(each.reshape(room, -1)[:taken] for each in found))

    def went(self, good: int, of: int) -> None:
        """Tell how many of the last sweep's steps were good."""
        self.cut = good < of
        longer = min(self._room + 1, len(_ROOMS) - 1)
        self._room = longer if good == of else 0 if good < of // 2 else self._room
