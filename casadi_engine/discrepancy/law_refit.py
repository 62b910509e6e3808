"""An unknown law far from the model without it: a function of one signal at one port as a part of the equations.

Where a law is large, the model without it is far from the motion that was measured, and nothing that is linearised
along its simulation sees what is missing: the residual looks like coloured noise. Here the function stands in the
equations, its terms are parameters with a smooth prior, and the model is refitted from short windows, which follow the
measurement. Its evidence is held against that of the model without it, at the noise that the function leaves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from casadi_engine.deadline import TimeUp, lifted
from casadi_engine.discrepancy.elsewhere_families import unused_everywhere
from casadi_engine.discrepancy.evidence import (
    FACTOR,
    Digest,
    Levels,
    evidence,
    foretold,
)
from casadi_engine.discrepancy.law_on_fresh import by_all_data
from casadi_engine.discrepancy.law_race import Begun, Followed, Race, chance, followed, raced, tells
from casadi_engine.discrepancy.law_rival import TAKEN
from casadi_engine.discrepancy.law_setups import Setup
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.random_families import TIME, Course, Family, course_of, smooth_family
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.tried import Tried
from casadi_engine.discrepancy.unknown_law import UnknownLaw, near_of, not_told_from
from casadi_engine.experiment import Experiment

# Those go on to the whole record whose chi-squared over short windows is within such a factor of the least.
_NEAR = 2.0
# Powers of the usual factor by which a function may be less probable for fresh data to be asked of it too.
_WIDER = 3
# So many of these at most, the best over short windows.
_FOLLOWED = 4
# A simulation that is off by this share of what an output varies by has slopes that are off as much: a law that is
# found along it leaves a hundredth of the squares that one along the motion itself would take.
_FAR = 0.1


def refitted_law(
    refits: Refits,
    tried: Tried,
    further: float,
    *,
    others: Sequence[Family] = (),
    fresh: Sequence[Experiment] = (),
) -> UnknownLaw | None:
    """The most probable function in the place of a structure's effects, or of none, each refitted; None where none
    arrives.

    further : what a further effect has to gain in log probability; others : functions of what the signals of a port do
    not say, or of a parameter, that come first along the simulation; fresh : records that the search did not see, by
    which functions are told from each other
    """
    asked = _with_unused(refits, [one for one in others if not one.order])
    begun, count = raced(refits, asked, thorough=True)
    if not begun:
        return None
    most = _NEAR * begun[0].found.cost
    with suppress(TimeUp):
        most = min(most, chance(refits, tried, count))
    first = {(one.port, one.signal) for one in asked}
    wanted = [*_distinct(begun, most), *_distinct(begun, most, elsewhere=True)]
    wanted += [one for one in begun if one.at in first and one not in wanted]
    each: list[Followed | None] = []
    try:
        for one in wanted:
            each.append(followed(refits, one))
    except TimeUp:
        if not any(each):
            raise
    with lifted():  # what was refitted is an answer
        left = refits.path.residuals(tried.effects, tried.arrived)
        found = [one for one in each if one is not None and _takes_the_colour(left, one.null)]
        found = _open(found)
    of_all = by_all_data(refits, found, fresh)
    with lifted():
        best = _most_probable(found, refits.pool[frozenset()], tried, of_all or found) if found else None
    if best is None:
        return None
    price = (len(tried.effects) - 1) * max(further, 0.0)
    unheard = [one.setup.family for one, arrived in zip(wanted, each, strict=False) if arrived is None]
    timed = (
        best.course.family.signal == TIME
    )  # it follows whatever is slow, and says nothing of what else might
    return replace(
        best,
        log=best.log - math.log(count) + price,
        price=price,
        unheard=tuple(one for one in unheard if timed and one.signal != TIME),
    )


def _with_unused(refits: Refits, others: Sequence[Family]) -> list[Family]:
    """Functions, and beside one of time at some port those of the inputs that were recorded and act on nothing: one of
    time does what any of these did in this record, and nothing that it does in another one."""
    ports = [one.port for one in others if one.signal == TIME]
    names = refits.refitter.model.idle_inputs
    blank = np.array([0.0, 1.0])
    return [*others, *(smooth_family(port, name, blank) for port in ports for name in names)]


def leading(refits: Refits) -> list[tuple[str, str]]:
    """Ports and signals of the functions that follow the motion over short windows, where the model without effects is
    far from it, the best first. They are followed to the whole record until one arrives."""
    none = refits.pool[frozenset()]
    if not is_far(refits.path.residuals(none.effects, none.arrived)) or not tells(refits, none):
        return []
    begun, count = raced(refits, unused_everywhere(refits.refitter.model, refits.null_fit.free))
    if not begun:
        return []
    if not begun[0].follows:
        return []
    most = min(_NEAR * begun[0].found.cost, chance(refits, none, count))
    for one in (*_distinct(begun, most), *_distinct(begun, most, elsewhere=True)):
        found = followed(refits, one)
        if found is not None and not is_far(found.null):  # one that follows all of it is enough to go by
            break
    return [one.at for one in begun if one.follows and one.found.cost <= most]


def _distinct(begun: Sequence[Begun], most: float, *, elsewhere: bool = False) -> list[Begun]:
    """The best functions over short windows that their ports know, or do not, each once."""
    near: list[Begun] = []
    for one in begun:
        if one.elsewhere is elsewhere and one.found.cost <= most and not one.is_again(near):
            near.append(one)
    return near[:_FOLLOWED]


def is_far(null: NullModel) -> bool:
    """True if what the past of a residual foretells is so much of what an output varies by that slopes along the
    simulation are not those along the motion."""
    for record in null.records:
        for output, e in record.residual.items():
            off = math.sqrt(max(foretold(e), 0.0) / len(e))
            if off > _FAR * float(np.std(record.path.grid.measured[output].values)):
                return True
    return False


def follows_by_function(refits: Refits) -> bool:
    """True if the model follows the whole records with some function: then it is no other start that it lacks."""
    return any(one is not None and not is_far(one.null) for one in Race.of(refits).whole.values())


def _open(found: Sequence[Followed]) -> list[Followed]:
    """The functions that other data may yet make the most probable one."""
    if not found:
        return []
    levels = min(found, key=lambda one: one.left).levels
    odds = [one.log(levels)[0] for one in found]
    least = max(odds) - _WIDER * math.log(FACTOR)
    return [one for one, own in zip(found, odds, strict=True) if own >= least]


def _most_probable(
    followed: Sequence[Followed], none: Tried, tried: Tried, of_all: Sequence[Followed]
) -> UnknownLaw | None:
    """The most probable of some functions, all held against the noise that the one leaves which leaves least.

    of_all : the same by all data, which tell them from each other
    """
    levels = min(followed, key=lambda one: one.left).levels
    widest = min(of_all, key=lambda one: one.left).levels
    odds = [one.log(widest)[0] for one in of_all]
    one = followed[int(np.argmax(odds))]
    log, best = one.log(levels)
    if not math.isfinite(log):
        return None
    zero, named, law = (evidence(own, levels) for own in (none.digest, tried.digest, best))
    share = (zero.cost - named.cost) / (zero.cost - law.cost) if zero.cost > law.cost else 1.0
    course, alike = _course(best, one.null, one.setup, levels), len(tried.effects) > 1
    families = [own.setup.family for own in followed]
    rivals = not_told_from(one.setup.family, list(zip(families, odds, strict=True)))
    near = near_of(tried, one.setup.family.port, one.setup.family.signal)
    return UnknownLaw(course, log - named.log, share, alike, near, rivals=rivals)


def _takes_the_colour(before: NullModel, after: NullModel) -> bool:
    """True if a function takes most of what the model without it leaves beyond white noise: what it leaves would
    else be the sensors' own colour, which any smooth function takes a little of."""
    taken = beyond = 0.0
    for record, left in zip(before.records, after.records, strict=True):
        for output, e in left.residual.items():
            whole, rest = float(record.residual[output] @ record.residual[output]), float(e @ e)
            white = max(rest - foretold(e), 1e-300)
            taken += (whole - rest) / white
            beyond += (whole - white) / white
    return taken >= TAKEN * beyond


def _course(made: Digest, null: NullModel, setup: Setup, levels: Levels) -> Course:
    """The course of the function where its refit ended, with its band."""
    rows = np.concatenate([*(part * levels.weight(output) for output, part in made.parts), made.prior])
    mine = [null.parameters.index(name) for name in setup.terms]
    inverse = np.linalg.pinv(rows[:, :-1])[: made.turn.shape[1]]
    root = made.turn[mine] @ inverse
    course = course_of(setup.family, null.values[mine] + root @ rows[:, -1], root)
    # a line is what the model's own parameters took or left, and no likeness, but where one of them follows it
    alike = course.looks_like
    if setup.family.port.startswith("parameter_"):
        return course
    return replace(course, looks_like={} if max(alike, key=alike.__getitem__) == "linear" else alike)
