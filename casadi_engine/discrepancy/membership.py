"""The way to a structure, effect by effect, with the class of each: what the data do not exclude in its place."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from casadi_engine.discrepancy.refit import Addition, numbers, whitened_cost
from casadi_engine.discrepancy.repaired import Member
from casadi_engine.discrepancy.screening import Screened
from casadi_engine.discrepancy.selection import selection_frequency
from casadi_engine.discrepancy.station import Station

Key = frozenset[tuple[str, str]]
# Difference of log evidence that tells nothing: there the simpler one is named first.
_TIE = 1.0
# Kinds of ports at which something acts that comes from elsewhere.
_FAR = frozenset({"path", "cross"})
# Standard errors of an amplitude below which a refit has left nothing of an effect.
NOTHING = 0.01


def simpler(now: Any, alike: Sequence[Any], factor: float) -> Any:
    """The structure of fewer numbers, of those with as many effects, that the data do not tell from the one chosen:
    within a unit of log evidence of the most probable one. The chosen one itself where none is simpler.

    A structure with an effect beyond what the records reach gives way to the one with its special case in its place,
    where that is not excluded.
    """
    top = max([now.log, *(one.log for one in alike)])
    out = [e for e in now.effects if _beyond(e, now)]
    for one in out:
        key = now.key - {one.candidate.key} | {(one.candidate.source.effect.limit, one.candidate.port)}
        case = next((t for t in alike if t.key == key and t.log > top - math.log(factor)), None)
        if case is not None:
            return case
    own = numbers(now.effects), strange(now.effects)
    few = [t for t in alike if t.log > top - _TIE and (numbers(t.effects), strange(t.effects)) < own]
    return min(few, key=lambda t: (numbers(t.effects), strange(t.effects), -t.log), default=now)


def strange(effects: Sequence[Addition]) -> int:
    """How many effects are of another world than their port: what slides has dry friction, and heat has none; and what
    acts by a channel from elsewhere is farther off than what acts by itself."""
    sliding = [one.candidate for one in effects if getattr(one.candidate.source.effect, "slides", False)]
    may = [one for one in effects if _FAR & {*getattr(one.candidate.source.effect, "attaches", ())}]
    far = sum(one.kind in _FAR for one in may)
    return far + sum(not one.source.model.ports[one.port].is_mechanical for one in sliding)


def _beyond(one: Addition, tried: Any) -> bool:
    """True if an effect of a structure has ended out of what the records reach."""
    own = {
        name.rpartition(".")[2]: value
        for name, value in tried.arrived.values.items()
        if name.startswith(f"{one.key}.")
    }
    return bool(one.candidate.source.effect.limit) and bool(one.candidate.source.effect.beyond(own))


def ordered(effects: Sequence[Addition], pool: Mapping[Any, Any]) -> tuple[Addition, ...]:
    """Effects so that each beginning is the most probable one of its length."""
    left, done = list(effects), list[Addition]()
    while left:

        def log(one: Addition) -> float:
            found = pool.get(frozenset(e.candidate.key for e in (*done, one)))
            return -math.inf if found is None else float(found.log)

        best = max(left, key=log)
        done.append(best)
        left.remove(best)
    return tuple(done)


def reached(
    before: Station, station: Station, effects: tuple[Addition, ...], members: tuple[Member, ...]
) -> Station:
    """A station with how it was reached from the one before; effects : its own, in order."""
    screened, one = before.screened, effects[-1]
    lead = number_of(screened, one.candidate.key, one.label)
    choice = station.screened.choice
    drop = whitened_cost(before.fit, choice) - whitened_cost(station.fit, choice)
    rows = tuple(replace(m, rho=_rho(screened, lead, (m.name, m.at))) for m in members)
    return replace(
        station, effects=effects, lead=lead, members=rows, drop=drop, frequency=_frequency(screened, lead)
    )


def class_of(
    pool: Mapping[Any, Any],
    key: Key,
    one: Addition,
    factor: float,
    price: float,
    misfit: float = 1.0,
    second_names: Mapping[tuple[str, str], Sequence[tuple[str, str]]] = MappingProxyType({}),
    blur: float = 0.0,
) -> tuple[Member, ...]:
    """The effects that are not excluded in the place of one of a structure, with their probabilities, itself first.

    Two effects may stand in the place of it, and one in the place of it and another; price : of one effect more. An
    effect of which its refit has left nothing explains nothing in its place. misfit : chi-squared per sample of fresh
    data, in the noise's: where it is more than 1 no structure is right, and evidence counts by as much less.
    second_names : effects that are the same as one in the equations, which is why that one alone was refitted.
    One that neither the data of the search nor fresh data tell from it, with no more numbers, is named however
    improbable it was before them.
    blur : chi-squared by which structures may be off, as their corners are rounded
    """
    own = one.candidate.key
    rest = key - {own}
    # or what is paid for alone would make fewer effects the more probable ones; a set is found in any order
    paid, back = ((price - math.log(size)) / misfit for size in (len(key) + 1, len(key)))
    known = {
        other: float(found.log) / misfit for other, found in pool.items()
        if found.log > -math.inf and (other <= key or found.beyond > NOTHING)
    }  # fmt: skip
    logs = {
        (next(iter(other - rest)), ""): log
        for other, log in known.items()
        if len(other) == len(key) and rest < other
    }
    logs |= {(same, ""): log for (k, _), log in logs.items() for same in second_names.get(k, ())}
    least = max(logs.values(), default=0.0) - math.log(factor)
    for other, log in known.items():
        new = other - key
        if len(new) == 2 and rest | new == other:
            first, second = sorted(new, key=lambda k: -known.get(rest | {k}, -math.inf))
            if known.get(rest | {first}, -math.inf) <= least:  # by itself it is excluded
                logs[first, f" with {second[0]} at {second[1]}"] = log - paid
        elif len(new) == 1 and len(other) == len(key) - 1 and own not in other:
            (gone,) = rest - other
            logs[next(iter(new)), f" in place of it and {gone[0]} at {gone[1]}"] = log + back
    top = max(logs.values(), default=0.0)
    logs.setdefault((own, ""), top)
    untold = _untold(pool, key, rest, blur, misfit * math.log(factor))
    kept = {
        k: math.exp(log - top) for k, log in logs.items()
        if k[0] == own or log > top - math.log(factor) or (not k[1] and k[0] in untold)
    }  # fmt: skip
    total = sum(kept.values())
    order = _simple_first(sorted(kept, key=lambda k: (k[0] != own, -kept[k])), kept, pool, rest)
    return tuple(Member(name, at, 1.0, kept[(name, at), more] / total, more) for (name, at), more in order)


def _untold(pool: Mapping[Any, Any], key: Key, rest: Key, blur: float, most: float) -> set[tuple[str, str]]:
    """The effects that leave in the place of one of a structure what it does, with no more numbers: what makes them
    less probable is what was held of them before the data.

    most : log of how much less probable the fresh data may be by one of them
    """
    now = pool.get(key)
    if now is None:
        return set()
    return {
        next(iter(other - rest)) for other, found in pool.items()
        if len(other) == len(key) and rest < other and found.log > -math.inf and found.beyond > NOTHING
        and found.evidence.cost < now.evidence.cost + 2 * _TIE + blur
        and numbers(found.effects) <= numbers(now.effects) and found.fresh > now.fresh - most
    }  # fmt: skip


def _simple_first(
    order: list[tuple[tuple[str, str], str]],
    kept: Mapping[tuple[tuple[str, str], str], float],
    pool: Mapping[Any, Any],
    rest: Key,
) -> list[tuple[tuple[str, str], str]]:
    """Members in order of probability, itself first; of those that the data do not tell apart the simplest first."""
    done, left = order[:1], order[1:]

    def size(member: tuple[tuple[str, str], str]) -> int:
        found = None if member[1] else pool.get(rest | {member[0]})
        return 99 if found is None else numbers(found.effects)

    while left:
        alike = [m for m in left if kept[m] >= kept[left[0]] * math.exp(-_TIE)]
        first = min(alike, key=size)  # the most probable of these where sizes are equal
        done.append(first)
        left.remove(first)
    return done


def number_of(screened: Screened, key: tuple[str, str], label: str = "") -> int:
    """The number of an effect's candidate: the one of this label, else the one that scores best."""
    own = [k for k, c in enumerate(screened.candidates) if c.key == key]
    same = [k for k in own if screened.candidates[k].label == label]
    return (same or sorted(own, key=lambda k: -screened.scores.statistic[k]))[0]


def _rho(screened: Screened, lead: int, key: tuple[str, str]) -> float:
    if screened.candidates[lead].key == key:
        return 1.0
    own = [k for k, c in enumerate(screened.candidates) if c.key == key]
    return max((float(screened.scores.correlation[lead, k]) for k in own), key=abs, default=0.0)


def _frequency(screened: Screened, lead: int) -> float | None:
    """How often the lead's effect scores best in half-samples, against the best point of every other effect."""
    best: dict[tuple[str, str], int] = {}
    for k in screened.order:
        best.setdefault(screened.candidates[k].key, k)
    found = selection_frequency(screened.compressed.only(list(best.values())), seed=screened.seed)
    return found.get(screened.candidates[lead].key, 0.0) if found else None
