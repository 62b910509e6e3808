"""A delay of an input in the place of its lag, where that is shorter than any delay that is searched: over a sample or
less one does what the other does, and a controller that computes for half a sample is late by a delay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from casadi_engine.discrepancy.refit import Addition, Refitter, addition, merit
from casadi_engine.discrepancy.repaired import FoundEffect, Member
from casadi_engine.discrepancy.screening import Screened
from casadi_engine.discrepancy.station import Station
from casadi_engine.estimation.search import is_near

_LAG, _DELAY = "input_lag", "input_delay"
# Share of the probability below which a member of a class is excluded.
_LEAST = 0.05


def with_short_delays(
    found: Sequence[FoundEffect], last: Station, refitter: Refitter, screened: Screened
) -> tuple[FoundEffect, ...]:
    """The effects found, a short lag of an input with the delay that does the same as a member of its class."""
    return tuple(_with_delay(one, last, refitter, screened) for one in found)


def _with_delay(one: FoundEffect, last: Station, refitter: Refitter, screened: Screened) -> FoundEffect:
    known = {member.name for member in one.members}
    candidate = next((c for c in screened.candidates if c.key == (_DELAY, one.at)), None)
    time = last.fit.values.get(f"{one.key}.time", math.inf)
    if one.name != _LAG or _DELAY in known or candidate is None:
        return one
    late = addition(candidate, 1.0)
    if not time < late.nuisance["time"].start:
        return one
    effects: list[Addition] = [late if own.key == one.key else own for own in last.effects]
    fit = refitter.with_all(effects, late, time, last.fit)
    if fit is None or not is_near(fit):
        return one
    share = 1 / (1 + math.exp(min(max(0.5 * (merit(fit) - merit(last.fit)), -50.0), 50.0)))
    if share < _LEAST:
        return one
    members = [replace(own, probability=(1 - share) * own.probability) for own in one.members]
    return replace(one, members=(*members, Member(_DELAY, one.at, 1.0, share)))
