"""Other effects in the place of those of a structure: members exchanged and left out, special cases of their laws.

Adding one effect at a time goes past a structure whose members only together are right; and what was added first may
have done what a later one does better.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from casadi_engine.deadline import ask, late
from casadi_engine.discrepancy.coloured_errors import coloured_errors
from casadi_engine.discrepancy.exchanged_units import BEHIND, LAG, LATE
from casadi_engine.discrepancy.families import BEYOND, every_family, families_of
from casadi_engine.discrepancy.in_place import instead, may_go, start_without
from casadi_engine.discrepancy.no_noise import leaves_no_noise
from casadi_engine.discrepancy.noise_choice import too_large
from casadi_engine.discrepancy.noise_model import estimated_noise
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.refit import Addition, addition, parts_of
from casadi_engine.discrepancy.refits import FACTOR, Refits
from casadi_engine.discrepancy.screening import Screened
from casadi_engine.discrepancy.tried import Key, Tried, key_of
from casadi_engine.discrepancy.unknown_law import moving

Tell = Callable[[str], None]
# Log evidence by which a law's special case may be less probable than its chi-squared beside the law's makes it.
_TIE = 1.0
# Ratio of a parameter's values beyond which two refits are far from one another.
_MOVED = 10.0
# Structures that lead alike, of which twins are tried at most.
_LED = 4
# Share of chi-squared up to which two structures have come to one and the same.
_SAME = 1e-4


def special_cases(refits: Refits, best: Key, screened: Screened, tell: Tell) -> None:
    """Refit the most probable structures with a law's special case in its place, where that was not tried beside
    the other effects, as what the law has more may be what one of these does, or where its refit had not arrived or is
    less probable."""
    now, families = refits.pool[best], families_of(screened)
    least = now.log - math.log(FACTOR)
    for one in [t for t in refits.pool.values() if len(t.key) == len(now.key) > 0 and t.log > least]:
        for member in one.effects:
            limit = (member.candidate.source.effect.limit, member.candidate.port)
            if limit in one.key or limit not in families:
                continue
            known = refits.pool.get(one.key - {member.candidate.key} | {limit})
            if known is not None and (len(one.key) > 1 or _at_its_best(known, one)):
                continue
            ask()
            tell(f"{limit[0]} in place of {member.label}, in {one.label}")
            candidate = screened.candidates[families[limit][0]]
            size = next(v for n, v in one.arrived.values.items() if n.partition("@")[0] == member.amplitude)
            rest = (other for other in one.effects if other is not member)
            start = start_without(one.arrived, member)
            refits.tried((*rest, addition(candidate, size)), start)


def in_its_parts(refits: Refits, best: Tried, screened: Screened, price: float, tell: Tell) -> Tried:
    """A structure, or the one with the effects that a member is made of in the place of it where that is more probable:
    a number of the member has gone to its bound, and its parts by themselves have none there."""
    families, made = every_family(screened), list[Tried]()
    for member in best.effects:
        nuisance, port = member.candidate.source.effect.nuisance, member.candidate.port
        bound = [name for name in nuisance if f"{member.key}.{name}" in best.arrived.held]
        parts = parts_of(member, best.arrived.values) if bound and not late() else {}
        keys = {name: (name, port) for name in parts}
        if not parts or not all(key in families and key not in best.key for key in keys.values()):
            continue
        ask()
        tell(f"{' and '.join(parts)} in place of {member.label}, in {best.label}")
        rest = (one for one in best.effects if one is not member)
        two = (addition(screened.candidates[families[keys[name]][0]], size) for name, size in parts.items())
        made += refits.tried((*rest, *two), start_without(best.arrived, member))
    refits.weigh()
    ready = [one for one in made if one.beyond > BEYOND and one.log - price > best.log]
    return max(ready, key=lambda one: one.log, default=best)


def is_far(refits: Refits, best: Tried) -> bool:
    """True if a parameter of a structure's refit is many times what it is without effects, or a small part of it: from
    there another effect may have looked like a parameter, so that it was not testable, or its refit found no way back.
    """
    before, after = refits.null_fit.values, best.arrived.values
    ratios = (abs(after[name] / before[name]) for name in before if before[name] and after.get(name))
    return any(not 1 / _MOVED < ratio < _MOVED for ratio in ratios)


def known_twins(refits: Refits, best: Key, screened: Screened, tell: Tell) -> None:
    """Refit a structure, and those that the data do not tell from it, with what is known to do the same as one of the
    effects in its place.

    A wrong conductance, power and gain of the input come to one chi-squared where a capacity is free; the slopes along
    a structure with one of them do not say so of the others, which are far from it. Nor is there a slope along a
    structure without what has states of its own: any channel may be what is late.
    """
    least, seen = refits.pool[best].log - math.log(FACTOR), set[Key]()
    while len(best) > 1 and len(seen) < _LED:
        # that of two which lead alike has no twins tried makes a class without them
        near = [t for t in refits.pool.values() if len(t.key) == len(best) and t.log > least]
        left = [t for t in near if t.key not in seen]
        if not left:
            return
        now = max(left, key=lambda t: (t.key == best, t.log))
        seen.add(now.key)
        for member in now.effects:
            late_too = _late_as_well(member, screened) if now.key == best else {}
            for key, other in (late_too | _did_the_same(refits, member)).items():
                target = now.key - {member.candidate.key} | {key}
                if key in now.key or target in refits.pool or len(target) < len(best):
                    continue
                ask()
                tell(f"{other.label} in place of {member.label}, in {now.label}")
                rest = (one for one in now.effects if one is not member)
                refits.tried((*rest, other), start_without(now.arrived, member))
        refits.weigh()


def late_otherwise(refits: Refits, best: Tried, screened: Screened, tell: Tell) -> Tried:
    """A structure, or the one with a lag in the place of a delay of the same channel, or the other way round, where
    that is more probable: by a step beside one of them the other lies far off, and what the wrong one of the two leaves
    is no missing effect."""
    made: list[Tried] = []
    for member in best.effects:
        for key, other in _late_as_well(member, screened).items():
            target = best.key - {member.candidate.key} | {key}
            if key[1] != member.candidate.key[1] or key in best.key or target in refits.pool or late():
                continue
            ask()
            tell(f"{other.label} in place of {member.label}, in {best.label}")
            rest = (one for one in best.effects if one is not member)
            made += refits.tried((*rest, other), start_without(best.arrived, member))
    if made:
        refits.weigh()
    ready = [one for one in made if one.beyond > BEYOND and one.log > best.log]
    return max(ready, key=lambda one: one.log, default=best)


def _late_as_well(member: Addition, screened: Screened) -> dict[tuple[str, str], Addition]:
    """What else may be late where one effect of a structure is."""
    if member.candidate.key[0] not in LATE:
        return {}
    found = {}
    for key, own in every_family(screened).items():
        if key[0] in LATE and key != member.candidate.key:
            candidate = screened.candidates[own[len(own) // 2]]
            found[key] = addition(
                candidate, 1.0 if candidate.effect in BEHIND or candidate.effect == LAG else 0.0
            )
    return found


def _did_the_same(refits: Refits, member: Addition) -> dict[tuple[str, str], Addition]:
    """Effects that came to the same chi-squared as one of a structure in its place, beside the same others."""
    found: dict[tuple[str, str], Addition] = {}
    own = member.candidate.key
    for key, one in refits.pool.items():
        for other_key, other in refits.pool.items() if own in key else ():
            more = other_key - key
            if len(other_key) != len(key) or len(more) != 1 or own in other_key:
                continue
            if abs(one.arrived.cost - other.arrived.cost) <= _SAME * one.arrived.cost:
                added = next(effect for effect in other.effects if effect.candidate.key in more)
                size = next(
                    v for n, v in other.arrived.values.items() if n.partition("@")[0] == added.amplitude
                )
                found[added.candidate.key] = addition(added.candidate, size)
    return found


def _at_its_best(case: Tried, law: Tried) -> bool:
    """True if the refit of a law's special case has arrived where that is as probable as it can be.

    It has fewer numbers, so that nothing but its chi-squared makes it less probable than the law, if the two ended at
    one place of whatever valley there is along which the data tell nothing.
    """
    worse = 0.5 * max(case.evidence.cost - law.evidence.cost, 0.0)
    return case.arrived.settled and case.log > law.log - worse - _TIE


def exchanged(refits: Refits, best: Tried, here: Tried, screened: Screened, tell: Tell) -> Tried:
    """The structure after its members were exchanged one by one, and each was left out, until none is better.

    here : the structure before the last effect was added; screened : along the model without effects

    An only effect has rivals that were refitted from where it began, so that there is nothing to exchange it for,
    unless its parameters ended far from there.
    """
    while not late():
        far = is_far(refits, best)
        if len(best.effects) < (1 if far else 2):
            return best
        families = every_family(screened) if far else families_of(screened)
        made: list[Tried] = []
        for member in best.effects:
            rest = tuple(one for one in best.effects if one is not member)
            others = {k: v for k, v in families.items() if k not in key_of(rest)}
            start = start_without(best.arrived, member)
            for one in instead(refits, best, member, screened, others):
                ask()
                tell(f"exchange {member.label} for {one.label}")
                made += refits.tried((*rest, one), start)
            if rest and may_go(refits, best, member, screened, others):
                made += refits.tried(rest, start)
        refits.weigh()
        ready = [one for one in made if one.beyond > BEYOND or not one.effects]
        top = max(ready, key=lambda one: one.log, default=None)
        # one more effect has to be worth it; one in place of another has to be more probable
        price = 0.0 if top is None else math.log(FACTOR) * (len(top.effects) - len(best.effects))
        if top is None or top.log - price <= best.log or top.key == here.key:
            return best
        best = top
    return best


def leaves_more(refits: Refits, best: Tried) -> bool:
    """True if a structure leaves more than the noise that was stated, whatever its colour."""
    if not refits.known:
        return False
    try:
        with np.errstate(all="ignore"):
            null = refits.path.residuals(best.effects, best.arrived)
            slopes = {record.name: dict(record.slopes) for record in null.records}
            return bool(too_large(null, estimated_noise(null, explained=slopes, colour=True), refits.known))
    except FAILURES:
        return False


def _told_by_innovations(refits: Refits, best: Tried, one: Addition) -> bool:
    """True if the likelihood of the innovations, of structures that leave noise of their own colour each, tells an
    effect from none: least squares, whose errors the colour widens, see less of what is faster than it."""
    without = refits.pool.get(best.key - {one.candidate.key})
    if without is None or best.own is None or without.own is None or best.arrived.cost > without.arrived.cost:
        return False
    return best.own - without.own > 0.5 * BEYOND**2


def is_rounding(refits: Refits, here: Tried, one: Tried) -> bool:
    """True if what a structure has more only sharpens a corner: a law of the same signal at the port of one whose
    corners are still rounded, that gains no more than sharper ones may, or whose shape is at its bound."""
    felt = refits.rounding_felt(here.effects)
    if felt == 0 or not here.key < one.key:
        return False
    last = one.newest(here)
    corner = [own for own in here.effects if refits.path.cornered([own])]
    same = [own for own in corner if own.candidate.port == last.candidate.port]
    if not any(moving(own.candidate) == moving(last.candidate) for own in same):
        return False
    shapes = {f"{last.key}.{name}" for name in last.candidate.source.effect.nuisance}
    return here.arrived.cost - one.arrived.cost <= felt or not shapes.isdisjoint(one.arrived.held)


def weak_beside_colour(refits: Refits, best: Tried) -> bool:
    """True if an amplitude is no finding beside coloured noise, whose slow part may do as much; what is larger than was
    stated, or so smooth that its own past foretells it, is no noise."""
    if not refits.levels.memory:
        return False
    try:
        with np.errstate(all="ignore"):
            null = refits.path.residuals(best.effects, best.arrived)
            slopes = {record.name: dict(record.slopes) for record in null.records}
            noise = estimated_noise(null, explained=slopes, colour=True)
            if too_large(null, noise, refits.known) or leaves_no_noise(null, noise):
                return False
            error = coloured_errors(null, best.arrived.levels, noise)
    except FAILURES:
        return False  # its whole fit has the last word
    values = best.arrived.values
    for one in best.effects:
        own = [n for n in values if n.partition("@")[0] == one.amplitude]
        # as certain as it is in white noise, by as much less as its error is larger
        if _told_by_innovations(refits, best, one):
            continue
        plain, white = best.certainty(one), best.evidence.error
        size = max((abs(values[n]) / white.get(n, math.inf) for n in own), default=0.0)
        found = max((abs(values[n]) / error.get(n, math.inf) for n in own), default=0.0)
        if size > 0 and found * plain < BEYOND * size:
            return True
    return False
