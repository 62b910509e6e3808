"""The way to a structure of several effects: the models in between, one effect more each, fitted and scored; and the
order in which structures are put to the test of fresh data."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from casadi_engine.deadline import late
from casadi_engine.discrepancy.evidence import FACTOR
from casadi_engine.discrepancy.families import BEYOND
from casadi_engine.discrepancy.membership import class_of, ordered, reached
from casadi_engine.discrepancy.refit import Addition
from casadi_engine.discrepancy.start import Start
from casadi_engine.discrepancy.station import Station
from casadi_engine.discrepancy.tried import Key, Tried, key_of

if TYPE_CHECKING:
    from casadi_engine.discrepancy.choice import Choice

# Structures that leave less, where likelihoods do not agree, of which fresh data are asked.
_LESS = 3
_IDLE = "one of its effects does nothing of its own beside the others"


def ranked(search: Choice) -> Iterator[Key]:
    """The structures in the order in which fresh data are asked: the chosen one, its rivals, its parts, those that
    leave less where the two likelihoods beside coloured noise do not agree, none."""
    chosen = search.pool[search.best]
    yield search.best
    every = [t for t in search.pool.values() if t.effects and t.beyond > BEYOND and t.key != search.best]

    def gain(one: Tried, log: float) -> float:
        return log - search.price * (len(one.key) - len(search.best)) + math.log(FACTOR)

    near = [t for t in every if gain(t, t.log - chosen.log) > 0 or t.key < search.best]
    less = [
        t for t in every
        if search.refits.levels.memory and search.best and t not in near and math.isfinite(t.log)
        and gain(t, t.evidence.log - chosen.evidence.log) > 0
    ]  # fmt: skip
    yield from (one.key for one in sorted(near, key=lambda t: -t.log))
    yield from (one.key for one in sorted(less, key=lambda t: -t.evidence.log)[:_LESS])
    if search.best:
        yield frozenset()


def way(search: Choice, key: Key) -> list[Station] | None:
    """The stations on the way to a structure, effect by effect, the most telling first, or in another order where a fit
    on that way does not converge; None where there is no way, or an effect does nothing of its own beside the others
    (what differs by direction, once the motion has one direction alone)."""
    effects = ordered(search.pool[key].effects, search.pool)
    if not effects:
        search.as_chosen(key)
        return [search.null]
    shut = set[Key]()  # beginnings that lead nowhere
    for own in itertools.permutations(effects):
        if any(key_of(own[:count]) in shut for count in range(1, len(own) + 1)):
            continue
        found = _along(search, key, own, shut)
        if found is not None or late():
            return found
    return None


def _along(search: Choice, key: Key, effects: Sequence[Addition], shut: set[Key]) -> list[Station] | None:
    """The stations of a structure's effects in this order; None where there is one that cannot be reached: ``shut``
    takes those that have no fit, in any order."""
    found = [search.null]
    for count in range(1, len(effects) + 1):
        own = tuple(effects[:count])
        if _idle(found[-1], own[-1]):
            search.failed.setdefault(search.pool[key].label, _IDLE)
            return None
        if key_of(own) not in search.pool:
            there = search.pool[key].arrived
            search.refits.tried(own, Start(there.values, there.initial))
        part = search.pool.get(key_of(own))
        station = None if part is None else search.station_of(part)
        if station is None:
            shut.add(key_of(own))
            return None
        station = search.as_chosen(key) if count == len(effects) else station
        found.append(_reached(search, found[-1], station, key, own))
    return found


def way_so_far(search: Choice) -> list[Station]:
    """The stations on the way to the most probable structure to which all of them are there: no fit is made."""

    def log(key: Key) -> float:
        return search.pool[key].log - search.price * len(key)

    known = [key for key in search.stations if key in search.pool and search.pool[key].beyond > BEYOND]
    for key in sorted(known, key=log, reverse=True):
        effects = _order_so_far(search, search.pool[key].effects)
        found = [search.null]
        for count in range(1, len(effects or ()) + 1):
            assert effects is not None
            own = effects[:count]
            if _idle(found[-1], own[-1]):
                break
            found.append(_reached(search, found[-1], search.stations[key_of(own)], key, own))
        if effects is not None and len(found) == len(effects) + 1:
            return found
    return [search.null]


def _order_so_far(search: Choice, effects: tuple[Addition, ...]) -> tuple[Addition, ...] | None:
    """Effects in an order in which each beginning is fitted; None where there is none."""
    if not effects:
        return ()
    if key_of(effects) not in search.stations:
        return None
    for last in reversed(ordered(effects, search.pool)):
        first = _order_so_far(search, tuple(one for one in effects if one is not last))
        if first is not None:
            return (*first, last)
    return None


def _idle(before: Station, one: Addition) -> bool:
    """True for an effect that is no candidate beside the ones before."""
    return all(c.key != one.candidate.key for c in before.screened.candidates)


def _reached(
    search: Choice, before: Station, station: Station, key: Key, own: tuple[Addition, ...]
) -> Station:
    names = before.screened.second_names
    members = class_of(
        search.pool, key, own[-1], FACTOR, search.price, search.misfit, names, search.refits.blur
    )
    return reached(before, station, own, members)
