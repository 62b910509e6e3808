"""Holes: places where rows are missing in a channel.

A step is a hole if it is more than five times as long as the third longest of the twenty steps around it. So a hole
takes at least five missing rows in a row of equal steps; tooth events that change slowly, jitter, and a profile of a
few points have none; two holes close to each other do not hide one another. Times with fewer than 21 steps say too
little of how densely they are meant to be. Where samples hold until the next one (hold "zero") unequal steps are what
is expected of them, and a hole is one only between steps that are equal otherwise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ExperimentError

from .channel import Channel
from .units import FloatArray

if TYPE_CHECKING:
    from .experiment import Experiment

# Steps looked at on either side, how many of them may be holes themselves, and how much longer a hole is.
AROUND = 10
OTHERS = 2
LONGER = 5.0
# Steps are equal within this share.
EQUAL = 0.1


def holes(channel: Channel) -> NDArray[np.intp]:
    """(H,) index of the sample before each hole in the channel's times; none in a channel that was bridged."""
    return np.zeros(0, np.intp) if channel.bridge else holes_in(channel.time, channel.hold)


def holes_in(time: FloatArray, hold: str) -> NDArray[np.intp]:
    """(H,) index of the sample before each hole in (N,) times [s]."""
    step = np.diff(time)
    if step.size <= 2 * AROUND or step.max() <= LONGER * step.min():
        return np.zeros(0, np.intp)
    least = np.pad(step, AROUND, mode="edge")
    for shift in (1, 2, 4, 8, 2 * AROUND - 15):  # the least of 2, 4, 8, 16, and at last of all steps around
        least = np.minimum(least[shift:], least[:-shift])
    near = np.flatnonzero(step > LONGER * least)
    if not near.size:
        return near
    first = np.clip(near - AROUND, 0, step.size - 2 * AROUND - 1)
    around = first[:, None] + np.arange(2 * AROUND + 1)
    others = np.where(around == near[:, None], -1.0, step[around])
    others.sort(axis=1)  # the step itself comes first
    longest = others[:, -1 - OTHERS]
    found = step[near] > LONGER * longest
    if hold == "zero":
        found &= longest <= (1 + EQUAL) * others[:, 1 + OTHERS]
    return near[found]


def refuse_holes(experiment: Experiment, channel: Channel, why: str, cure: str | None = None) -> None:
    """Raise :class:`ExperimentError` with the place of the first hole in a channel."""
    found = holes(channel)
    if not found.size:
        return
    name, at = channel.name, int(found[0])
    before, after = float(channel.time[at]), float(channel.time[at + 1])
    usual = float(np.median(np.diff(channel.time[max(at - AROUND, 0) : at + AROUND + 2])))
    where = f"after row {channel.rows[at]}" if channel.rows.size else f"after sample {at}"
    more = f"; {found.size} holes in all" if found.size > 1 else ""
    raise ExperimentError(
        f"{experiment.place}, column {name!r}, {where}: rows are missing, and {why}",
        seen=f"nothing from {before:.9g} to {after:.9g} s, {after - before:.3g} s where {usual:.3g} s is usual{more}",
        allowed=f"steps up to {LONGER:g} times as long as those around them",
        cure=cure
        or f'split the record there by split_at_holes(), or say what the channel does: bridged({name}="join") for a '
        f'straight line, bridged({name}="hold") for the last value',
    )
