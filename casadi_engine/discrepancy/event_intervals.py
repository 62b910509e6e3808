"""Times of events that the data do not tell from a swing earlier or later: an interval in place of an error.

What an event excites swings, and so does chi-squared over its time. The error by the curvature at the lowest of these
optima says nothing of the others, so that chi-squared is looked at over all times around it, by one step each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from casadi_engine.discrepancy.checked_errors import with_errors_of
from casadi_engine.discrepancy.event_times import in_each_record
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.refit import Addition
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.repaired import Repair
from casadi_engine.discrepancy.tried import Tried
from casadi_engine.estimation import Estimate

# Rise of chi-squared within which 95 % of the true times are, and standard errors within which they are as well where
# there is one optimum.
_WITHIN, _ALONE = 3.84, 3.0
# Standard errors to both sides of the first and the last of several optima.
_SIDES = 2.0
_WHY = "another swing of what it excites explains the data as well"


def with_intervals_of_times(repair: Repair, refits: Refits) -> Repair:
    """The same with intervals for the times of events that other swings explain as well, and a message of it."""
    tried = refits.pool.get(frozenset((one.name, one.at) for one in repair.effects))
    if tried is None or not any(one.moves for one in tried.effects):
        return repair
    found: dict[str, Estimate] = {}
    for one in tried.effects:
        for name, times in _as_good(refits, tried, one):
            own = repair.fit.estimates.get(name)
            wider = None if own is None else _with_interval(own, times, repair, name)
            if wider is not None:
                found[name] = wider
    if not found:
        return repair
    fit = replace(repair.fit, estimates={**repair.fit.estimates, **found})
    effects = tuple(with_errors_of(one, fit) for one in repair.effects)
    said = [
        f"{name} may be a swing earlier or later: chi-squared comes as low between {low:.5g} and {high:.5g} "
        f"{one.unit}; all other errors are those at this one"
        for name, one in found.items()
        for low, high in [one.interval or (one.value, one.value)]
    ]
    return replace(repair, fit=fit, effects=effects, messages=(*repair.messages, *said))


def _as_good(refits: Refits, tried: Tried, one: Addition) -> Iterator[tuple[str, Array]]:
    """The time of an event in each record, by its parameter's name, with all times (K,) that explain as much."""
    null = refits.null(tried) if one.moves else None
    if null is None:
        return
    count = sum(len(e) for record in null.records for e in record.residual.values())
    unit = max(1.0, tried.arrived.cost / count) * max(refits.levels.memory.values(), default=1.0)
    for _, name, times, cost in in_each_record(refits, tried, one):
        yield name, times[cost < cost.min(initial=np.inf) + _WITHIN * unit]


def _with_interval(own: Estimate, times: Array, repair: Repair, name: str) -> Estimate | None:
    """An estimate with the interval that holds all of these times; None where its error says as much."""
    error = own.stderr or own.quadratic
    if error is None or not len(times):
        return None
    low, high = float(min(times.min(), own.value)), float(max(times.max(), own.value))
    if max(own.value - low, high - own.value) <= _ALONE * error:
        return None
    bounds = repair.fit.parameters[name.partition("@")[0]]
    interval = max(low - _SIDES * error, bounds.min), min(high + _SIDES * error, bounds.max)
    return replace(own, stderr=None, quadratic=error, interval=interval, why=_WHY)
