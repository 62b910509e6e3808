"""Events that do not happen in the fresh data: what acts there all the time, or never, confirms none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from casadi_engine.discrepancy.refit import Addition
    from casadi_engine.discrepancy.repaired import Repair


def held_to_seen_events(repair: Repair, effects: Sequence[Addition]) -> Repair:
    """The repair, confirmed by no fresh data in which an event that it names is nowhere between a record's ends.

    effects : those of the answer
    """
    after = None if repair.gaps is None else repair.gaps.validation_after
    if not repair.confirmed or after is None or not after.fits:
        return repair
    unseen = [
        f"{one.candidate.effect} at {one.candidate.port}"
        for one in effects
        if one.placed and not _happens(repair, one)
    ]
    if not unseen:
        return repair
    words = (
        f"in the fresh data {' and '.join(unseen)} acts all the time or never: they may confirm something constant "
        "there, and not that it begins or ends"
    )
    return replace(repair, confirmed=None, messages=(words, *repair.messages))


def _happens(repair: Repair, one: Addition) -> bool:
    """True if the event is within a fresh record."""
    assert repair.gaps is not None
    assert repair.gaps.validation_after is not None
    for fit in repair.gaps.validation_after.fits:
        for record in fit.data:
            first, last = record.span
            key = f"{one.key}.time"
            at = fit.values.get(f"{key}@{record.name}", fit.values.get(key))
            if at is None or first < at < last:
                return True
    return False
