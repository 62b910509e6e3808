"""Several effects at one port that are together one function of what moves there, and none of them by itself."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import FoundEffect, Repair


def told_as_one_law(repair: Repair) -> Repair:
    """The repair with a message where effects at a port have no size of their own.

    Two or three laws of one signal add up to many a smooth curve. Where the data tell none of their amplitudes, neither
    by an error nor by an interval, they tell the curve alone: the leak through an orifice comes out as a proportional
    one and one that fades.
    """
    ports: dict[str, list[FoundEffect]] = {}
    for one in repair.effects:
        if one.amplitude.stderr is None and one.amplitude.interval is None:
            ports.setdefault(one.at, []).append(one)
    said = tuple(
        f"{' and '.join(one.name for one in own)} at {at} are told as one curve, none of them by its own size: a law "
        "that the library lacks may be the true one there"
        for at, own in ports.items()
        if len(own) > 1
    )
    return replace(repair, messages=(*said, *repair.messages)) if said else repair
