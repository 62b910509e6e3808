"""What might stand in the place of an effect of a structure, by one step along the structure without it."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from casadi_engine.discrepancy.arrived import Arrived
from casadi_engine.discrepancy.event_times import in_each_record, located
from casadi_engine.discrepancy.families import chosen_of, costs_of
from casadi_engine.discrepancy.linearised import OneStep, one_step, without_effect
from casadi_engine.discrepancy.refit import Addition, addition
from casadi_engine.discrepancy.refits import FACTOR, PART, Refits
from casadi_engine.discrepancy.screening import Screened
from casadi_engine.discrepancy.start import Start
from casadi_engine.discrepancy.tried import Tried

# Candidates that are refitted in the place of a member, the best by one step.
_EXCHANGED = 6
# Chi-squared by which an event has to be better at another time, by one step, to be refitted there.
_ELSEWHEN = 1.0

Family = tuple[str, str]


def instead(
    refits: Refits, tried: Tried, member: Addition, screened: Screened, families: Mapping[Family, list[int]]
) -> list[Addition]:
    """The candidates that might do as well in the place of a member, the best by one step first; an event also where it
    does clearly better itself, at another time."""
    step = step_in_place(refits, tried, member, screened, families)
    if step is None:
        return []
    others = {key: own for key, own in families.items() if key != member.candidate.key}
    cost = costs_of(screened, step, others)
    most = rival(refits, tried.arrived.cost, step.none, screened)
    order = [key for key in sorted(cost, key=lambda key: cost[key]) if cost[key] < most]
    found = at_another_time(refits, tried, member, screened, families)
    found += [chosen_of(screened, step, families[key]) for key in order[:_EXCHANGED]]
    return [form for one in found for form in one.forms]


def at_another_time(
    refits: Refits,
    tried: Tried,
    member: Addition,
    screened: Screened,
    families: Mapping[Family, list[int]],
) -> list[Addition]:
    """An event of a structure at a time at which it does better by one step, if there is one: near where it is, or near
    the best time of its grid, as a refit moves it by less than half a swing of what it excites."""
    own = families.get(member.candidate.key)
    step = (
        None if own is None or not member.moves else step_in_place(refits, tried, member, screened, families)
    )
    null = None if step is None else refits.null(tried)
    gone = None if null is None else without_effect(null, member)
    if own is None or step is None or gone is None:
        return []
    alone = _in_one_record(refits, tried, member)
    if alone is not None:
        return [alone]
    time = tried.arrived.values.get(f"{member.key}.time")
    with np.errstate(all="ignore"):
        ends = [located(refits, member, gone, time), located(refits, chosen_of(screened, step, own), gone)]
    best = min((one for one in ends if one is not None), key=lambda one: one[1], default=None)
    return [] if best is None or best[1] > tried.arrived.cost - _ELSEWHEN else [best[0]]


def _in_one_record(refits: Refits, tried: Tried, member: Addition) -> Addition | None:
    """An event with the time at which it does clearly better in one record or more, of several; None without one."""
    if len(refits.refitter.data) < 2:
        return None
    values, times, moved = tried.arrived.values, {}, False
    for record, name, at, cost in in_each_record(refits, tried, member):
        times[record] = values[name]
        if not len(at):
            continue
        here, best = int(np.argmin(np.abs(at - values[name]))), int(np.argmin(cost))
        if cost[best] < cost[here] - _ELSEWHEN:
            times[record], moved = float(at[best]), True
    size = next((v for n, v in values.items() if n.partition("@")[0] == member.amplitude), 0.0)
    if not moved or len(times) < len(refits.refitter.data) or not size:
        return None
    return addition(member.candidate, size, 1, {"time": times})


def may_go(
    refits: Refits, tried: Tried, member: Addition, screened: Screened, families: Mapping[Family, list[int]]
) -> bool:
    """True if a structure may well do without a member: one step without it does not clearly tell that it is worse."""
    step = step_in_place(refits, tried, member, screened, families)
    return step is None or step.none < rival(refits, tried.arrived.cost, step.none, screened)


def step_in_place(
    refits: Refits, tried: Tried, member: Addition, screened: Screened, families: Mapping[Family, list[int]]
) -> OneStep | None:
    """One step of the candidates of some families in the place of a member; None where that fails."""
    asked = (member.candidate.key, tuple(families), id(screened), tuple(refits.path.levels.items()))
    known = refits.steps.get(tried)
    if known is None or known[0] != asked:
        null = refits.null(tried)
        gone = None if null is None else without_effect(null, member)
        members = sorted(k for own in families.values() for k in own)
        step = None if gone is None else one_step(gone, screened.candidates, refits.path.levels, members)
        refits.steps[tried] = known = (asked, step)
    return known[1]


def rival(refits: Refits, least: float, none: float, screened: Screened) -> float:
    """Chi-squared by one step up to which an effect may well be a rival of one with chi-squared ``least``: that takes
    away all but ``PART`` of what this one takes of its logarithm, as the level of the noise is estimated."""
    return float(least * max(none / max(least, 1e-300), 1.0) ** PART + chance(refits, screened))


def chance(refits: Refits, screened: Screened) -> float:
    """Chi-squared by which the least of all candidates may lie below the others by chance, at a factor of odds."""
    memory = max(refits.levels.memory.values(), default=1.0)
    return 2 * math.log(FACTOR * len(screened.candidates)) * memory


def start_without(arrived: Arrived, member: Addition) -> Start:
    """Where a structure's refit ended, but for the parameters of a member."""
    values = {n: v for n, v in arrived.values.items() if not n.startswith(f"{member.key}.")}
    return Start(values, arrived.initial)
