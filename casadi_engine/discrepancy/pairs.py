"""Two effects in the place of one: what the rounds, which add one at a time, would not come by.

A law with a value of its own to adjust (friction that fades with speed) may do what two simpler ones do together (dry
friction and drag). So rivals that were excluded are tried with one more effect each, where one step says that the two
may be as probable as the one that was chosen, after the further effect is paid for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from casadi_engine.deadline import ask
from casadi_engine.discrepancy.events import by_one_step
from casadi_engine.discrepancy.families import BEYOND
from casadi_engine.discrepancy.linear_algebra import basis, without
from casadi_engine.discrepancy.linearised import OneStep, one_step
from casadi_engine.discrepancy.refit import Addition
from casadi_engine.discrepancy.refits import FACTOR, PART, Refits
from casadi_engine.discrepancy.screening import Screened
from casadi_engine.discrepancy.start import Start
from casadi_engine.discrepancy.station import Station
from casadi_engine.discrepancy.tried import Tried

# Rivals that are tried with one more effect, and effects that each is tried with, the best by one step.
_RIVALS, _SECONDS = 3, 2
# Part of a column that is left beside the parameters, or beside another column, below which it is that of rounding.
_SEEN = 1e-6

Families = Mapping[tuple[str, str], Sequence[int]]


def price_of(families: Families) -> float:
    """What a further effect has to gain in log probability: each is as probable beforehand as all others."""
    return math.log(max(len(families), 1))


def tried_in_two(
    refits: Refits,
    now: Tried,
    screened: Screened,
    families: Families,
    chosen: Callable[[OneStep, Sequence[int]], Addition],
    tell: Callable[[str], None],
    beside: Station | None = None,
) -> list[Tried]:
    """Structures with two effects in the place of one of ``now``, refitted; the pool holds them.

    chosen : the addition of a family that one step asks for; beside : the station of ``now``, if there is one
    """
    made: list[Tried] = []
    price = price_of(families)
    least = 2 * max(refits.levels.memory.values(), default=1.0) * price
    for member in now.effects:
        rest = now.key - {member.candidate.key}
        alike = [
            t for t in refits.pool.values()
            if len(t.key) == len(now.key) and rest < t.key and t.log <= now.log - math.log(FACTOR)
        ]  # fmt: skip
        for one in sorted(alike, key=lambda t: -t.log)[:_RIVALS]:
            others = {key: own for key, own in families.items() if key not in one.key | now.key}
            lifting = None if beside is None else lifted_by(beside.screened, one.key - rest, least)
            if lifting is not None:
                others = {key: own for key, own in others.items() if key in lifting}
            if not others:
                continue
            missing = now.log - math.log(FACTOR) + price - one.log
            place = f" in place of {member.label}"
            made += with_one_more(refits, one, screened, others, chosen, lambda s: tell(s + place), missing)  # noqa: B023
    return made


def lifted_by(
    beside: Screened, rival: Collection[tuple[str, str]], least: float
) -> set[tuple[str, str]] | None:
    """The effects that take more than ``least`` from chi-squared together with a rival, along the model with what was
    chosen; None where the rival has no column there.

    Where both explain the data, the two models take one course, and what one law does in the place of another is the
    sum of their columns along it: what does not help there as a third does not help as the second of two.
    """
    own = [k for k, one in enumerate(beside.candidates) if one.key in rival]
    if not own:
        return None
    reduced = beside.compressed.reduced()
    left = without(basis(reduced.rows[:, : reduced.parameters]), reduced.rows[:, reduced.parameters :])
    columns, residual = left[:, :-1], left[:, -1]
    size = np.linalg.norm(columns, axis=0)
    seen = size > _SEEN * np.maximum(reduced.size, np.finfo(float).tiny)
    columns = np.where(seen, columns / np.where(seen, size, 1.0), 0.0)
    alone, between = columns.T @ residual, columns[:, own].T @ columns
    rest = 1 - between**2
    joint = alone[own, None] ** 2 + alone**2 - 2 * between * alone[own, None] * alone
    with np.errstate(divide="ignore", invalid="ignore"):
        drop = np.where(rest > _SEEN, joint / rest, np.maximum(alone[own, None] ** 2, alone**2)).max(axis=0)
    return {one.key for one, gain in zip(beside.candidates, drop, strict=True) if not gain <= least}


def with_one_more(
    refits: Refits,
    one: Tried,
    screened: Screened,
    others: Families,
    chosen: Callable[[OneStep, Sequence[int]], Addition],
    tell: Callable[[str], None],
    missing: float,
) -> list[Tried]:
    """A structure with one more effect, refitted with each of those that explain most by one step; the pool holds them.

    others : effects that may be added; missing : what one has to gain in log probability, of which one step may leave
    a share to further ones
    """
    memory = max(refits.levels.memory.values(), default=1.0)
    made: list[Tried] = []
    ask()
    null, members = refits.null(one), sorted({k for own in others.values() for k in own})
    step = None if null is None else one_step(null, screened.candidates, refits.path.levels, members)
    if step is None:
        return made
    cost = {key: by_one_step(screened.candidates, step, list(own)).cost for key, own in others.items()}
    for key in sorted(cost, key=lambda k: cost[k])[:_SECONDS]:
        if step.none - cost[key] < (1 - PART) * 2 * memory * missing:
            break
        ask()
        second = chosen(step, others[key])
        tell(f"refit {one.label} with {second.label}")
        both, start = (*one.effects, second), Start(one.arrived.values, one.arrived.initial)
        # the optimum with one of them is near; short windows may lead away where few outputs are measured
        made += refits.tried(both, start, near=True) or refits.tried(both, start)
    return made


def together(best: Tried, tried: Sequence[Tried]) -> float:
    """The log evidence of the best structure and of its rivals together: that one of them is right is more probable
    than each alone."""
    rivals = [t.log for t in tried if t is not best and t.beyond > BEYOND and len(t.key) == len(best.key)]
    return float(np.logaddexp.reduce([best.log, *rivals]))
