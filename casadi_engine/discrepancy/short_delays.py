"""Delays of inputs in the place of what does the same, where they are shorter than any that is searched.

Over a sample or less a lag does what a delay does, and a sensor that is late does what an input does that alone moves
it. A controller that computes for half a sample is late by a delay.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from casadi_engine.discrepancy.refit import Addition, Refitter, addition, merit
from casadi_engine.discrepancy.repaired import FoundEffect, Member
from casadi_engine.discrepancy.screening import Screened
from casadi_engine.discrepancy.station import Station
from casadi_engine.estimation.search import is_near

_LAG, _DELAY, _SENSOR = "input_lag", "input_delay", "sensor_delay"
# Share of the probability below which a member of a class is excluded.
_LEAST = 0.05


def with_short_delays(
    found: Sequence[FoundEffect], last: Station, refitter: Refitter, screened: Screened
) -> tuple[FoundEffect, ...]:
    """The effects found, a short lag of an input and a short delay of a sensor with the delays of inputs that do the
    same as members of their class."""
    return tuple(_with_delays(one, last, refitter, screened) for one in found)


def _with_delays(one: FoundEffect, last: Station, refitter: Refitter, screened: Screened) -> FoundEffect:
    if one.name not in (_LAG, _SENSOR):
        return one
    time = last.fit.values.get(f"{one.key}.time", one.amplitude.value)
    known = {(member.name, member.at) for member in one.members}
    late = {
        candidate.port: addition(candidate, 1.0)
        for candidate in screened.candidates
        if candidate.effect == _DELAY and (candidate.port == one.at or one.name == _SENSOR)
    }
    odds = {}
    for port, other in late.items():
        if (_DELAY, port) in known or not 0 < time < other.nuisance["time"].start:
            continue
        effects: list[Addition] = [other if own.key == one.key else own for own in last.effects]
        fit = refitter.with_all(effects, other, time, last.fit)
        if fit is not None and is_near(fit):
            odds[port] = math.exp(min(0.5 * (merit(last.fit) - merit(fit)), 50.0))
    total = 1 + sum(odds.values())
    more = [Member(_DELAY, port, 1.0, own / total) for port, own in odds.items() if own > _LEAST * total]
    if not more:
        return one
    rest = 1 - sum(member.probability for member in more)
    return replace(one, members=(*(replace(m, probability=rest * m.probability) for m in one.members), *more))
