"""What is added to a structure, added to its rivals too.

Effects are added one at a time to what was chosen before; where another effect explained as much, the choice was none,
and only the next one tells: beside a heater whose gain was wrong, a late heater and a late sensor left the same, and
what made up for the wrong one of them was a storage that was not there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from casadi_engine.deadline import TimeUp, ask
from casadi_engine.discrepancy.in_place import start_without
from casadi_engine.discrepancy.refits import FACTOR, Refits
from casadi_engine.discrepancy.tried import Tried

# Effects that are tried beside each of the rivals, the best rival first.
_ADDED = (3, 3, 1, 1, 1)
# Part of what the best of these takes away by which the chi-squared of rivals may differ.
_ALIKE = 0.1


def beside_rivals(
    refits: Refits, here: Tried, tried: list[Tried], tell: Callable[[str], None]
) -> list[Tried]:
    """Structures with one of the effects that were just added, the best first, to a rival of the one before.

    here : the structure before; tried : those with one effect more. What explained more counts also where it was no
    answer: a lag had a share of more than all, as long as a gain lacked.
    """
    more = sorted((t for t in tried if here.key < t.key), key=lambda t: t.arrived.cost)
    if not more:
        return []
    # what differs by a small part of what the further effects take away tells nothing of what is below them
    alike = here.arrived.cost + _ALIKE * max(here.arrived.cost - more[0].arrived.cost, 0.0)
    rivals = [
        one
        for one in (*refits.pool.values(), *refits.filters.values())
        if len(one.key) == len(here.key) and len(one.key - here.key) == 1
        and (one.arrived.cost <= alike or (one.log >= here.log - math.log(FACTOR) and not one.failed))
    ]  # fmt: skip
    made: list[Tried] = []
    with suppress(TimeUp):  # what was made so far is of use
        for rival, most in zip(sorted(rivals, key=lambda t: t.arrived.cost), _ADDED, strict=False):
            made += _given(refits, here, rival, more[:most], tell)
    return made


def _given(
    refits: Refits, here: Tried, rival: Tried, more: list[Tried], tell: Callable[[str], None]
) -> list[Tried]:
    """A rival of a structure with each of the effects that were added to that."""
    gone = next(one for one in here.effects if one.candidate.key not in rival.key)
    own = next(one for one in rival.effects if one.candidate.key not in here.key)
    known = {n: v for n, v in rival.arrived.values.items() if n.startswith(f"{own.key}.")}
    made: list[Tried] = []
    for one in more:
        last = one.newest(here)
        if last.candidate.key in rival.key or rival.key | {last.candidate.key} in refits.pool:
            continue
        ask()
        tell(f"refit {rival.label} with {last.label}")
        start = start_without(one.arrived, gone)
        made += refits.tried((*rival.effects, last), replace(start, values={**start.values, **known}))
    return made
