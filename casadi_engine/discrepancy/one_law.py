"""Effects at one port that are together one function of what moves there, and of which the data tell no number."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from casadi_engine.discrepancy.repaired import Unknown

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import FoundEffect, Repair


def told_as_one_law(repair: Repair) -> Repair:
    """The repair with a law that the library lacks in the place of effects at a port that have no numbers of their own.

    Two or three laws of one signal, or one with a shape of its own, bend to many a smooth curve. Where the data tell
    none of their numbers, neither by an error nor by an interval, they tell the curve alone: the leak through an
    orifice comes out as a proportional one and one that fades.
    """
    ports: dict[str, list[FoundEffect]] = {}
    for one in repair.effects:
        ports.setdefault(one.at, []).append(one)
    said = tuple(_said(at, own) for at, own in ports.items() if _is_curve(own))
    if not said:
        return repair
    unknown = repair.unknown or Unknown(
        said[0], {}, next(at for at, own in ports.items() if _is_curve(own)), odds=1.0
    )
    verdict = "class" if repair.verdict == "named" else repair.verdict  # a law of no name is a member too
    return replace(repair, verdict=verdict, unknown=unknown, messages=(*said, *repair.messages))


def _is_curve(own: list[FoundEffect]) -> bool:
    """True for two numbers or more, none of which is known."""
    numbers = [value for one in own for value in one.parameters.values()]
    return len(numbers) > 1 and all(one.stderr is None and one.interval is None for one in numbers)


def _said(at: str, own: list[FoundEffect]) -> str:
    verb, whose = ("are", "their") if len(own) > 1 else ("is", "its")
    return (
        f"{' and '.join(one.name for one in own)} at {at} {verb} identified as one curve alone, none of {whose} "
        "parameters by itself: a law that the library lacks may be the true one there"
    )
