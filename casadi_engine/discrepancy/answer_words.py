"""What an answer says of the search: what it points at, what it did not come to, where events do not happen."""

from __future__ import annotations

import math
from collections.abc import Sequence

from casadi_engine.discrepancy.choice import TIME_UP, Choice
from casadi_engine.discrepancy.exchange import leaves_more
from casadi_engine.discrepancy.families import BEYOND
from casadi_engine.discrepancy.fresh_misfit import SEEN
from casadi_engine.discrepancy.repaired import MORE_THAN_NOISE, SO_FAR, UNTOLD
from casadi_engine.discrepancy.station import Station
from casadi_engine.discrepancy.tried import Tried
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.standard_errors import UNDETERMINED
from casadi_engine.model import Model


def so_far(search: Choice) -> list[str]:
    """What the refits point at, where the time was up before the best of them was fitted to its end."""
    top, now = _top_so_far(search), search.pool[search.best]
    if top is None:
        return []
    gone = f"chi-squared falls by {100 * (1 - top.evidence.cost / max(now.evidence.cost, 1e-300)):.0f} %"
    return [f"{SO_FAR} {top.name} ({gone}), which was not fitted to its end"]


def ahead(search: Choice) -> float:
    """The log odds of that beside the structure that was fitted to its end; -inf without one, or where it closes no
    part of the gap that a person would see."""
    top, now = _top_so_far(search), search.pool[search.best]
    if top is None or top.evidence.cost > (1 - SEEN) ** 2 * now.evidence.cost:
        return -math.inf
    return top.counted - now.log


def odds_over_none(search: Choice) -> float:
    """The log odds of the structure that the search chose, over none, what its names cost taken off."""
    now, none = search.pool[search.best], search.pool[frozenset()]
    return now.log - none.log - search.price * len(now.effects) if now.effects else -math.inf


def _top_so_far(search: Choice) -> Tried | None:
    """The most probable structure, where the time was up before its whole fit."""
    if TIME_UP not in search.failed.values():
        return None
    now = search.pool[search.best]
    ready = [
        one for one in search.pool.values()
        if one.beyond > BEYOND and one.counted > now.log + search.price
        and (not one.failed or search.failed.get(one.label) == TIME_UP)
    ]  # fmt: skip
    top = max(ready, key=lambda one: one.counted, default=now)
    return None if top is now else top


def untold(search: Choice) -> str:
    """What is known where the time was up before anything was found: that more is left than noise, if it is more than
    was stated, or if the test of an effect by itself says so."""
    if leaves_more(search.refits, search.pool[search.best]):
        return MORE_THAN_NOISE
    screened = search.null.screened
    if not screened.significant:
        return UNTOLD
    k = screened.significant[0]
    first, z = screened.candidates[k], abs(float(screened.scores.statistic[k]))
    return (
        f"of the tests of single effects that of {first.effect} at {first.port} has |z| = {z:.3g}, beyond "
        f"{screened.threshold:.3g}; the time was up before effects were compared"
    )


def without_answer(search: Choice) -> list[str]:
    """What to say of effects that were looked for in vain: nothing excludes them."""
    chosen = {f"{one.candidate.effect} at {one.candidate.port}" for one in search.pool[search.best].effects}
    failed = {name: why for name, why in search.failed.items() if name not in chosen and why != TIME_UP}
    found = []
    for why in dict.fromkeys(failed.values()):
        names = [name for name, own in failed.items() if own == why]
        found.append(f"no answer for {', '.join(names)}: {why}; nothing excludes what was not tried")
    return found


def elsewhere(last: Station) -> list[str]:
    """In which records an event that others show does not happen: its time is not known from their ends."""
    found = []
    for one in (e for e in last.effects if e.times):
        for record in last.fit.data:
            times = [last.fit.estimates.get(f"{one.key}.{name}@{record.name}") for name in one.times]
            if any(t is not None and t.value >= record.span[1] for t in times):
                found.append(f"record {record.name} shows no {one.candidate.effect} at {one.candidate.port}")
    return found


def undetermined(fit: Fit) -> list[str]:
    """That the values of some parameters are not the data's, where these do not determine them."""
    names = [name for name, one in fit.estimates.items() if one.why == UNDETERMINED and not one.fixed]
    if not names:
        return []
    return [
        f"the data do not determine {', '.join(names)}: fix one or give it a prior; print(repair.fit) says more"
    ]


def at_bounds(names: Sequence[str], least: Sequence[str]) -> list[str]:
    """What to say of estimates at a bound that the fit without effects did not have.

    least : amplitudes among them that refits hold as small as the data are content with
    """
    others = [name for name in names if name not in least]
    said = [f"{name} is known from below alone: larger ones explain these data as well" for name in least]
    return said + ([f"in the repaired model {', '.join(others)} is at a bound"] if others else [])


def open_units(model: Model, ports: Sequence[str]) -> list[str]:
    """Of the ports that have a part in the answer and whose unit the equations leave open, why, and what to do."""
    cures = [model.ports[name].unit_cure for name in ports if name in model.ports.names]
    return [words for words in dict.fromkeys(cures) if words]
