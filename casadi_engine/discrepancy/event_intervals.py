"""Times of events that the data do not tell from a swing earlier or later: an interval in place of an error.

What an event excites swings, and so does chi-squared over its time. The error by the curvature at the lowest of these
optima says nothing of the others, so that chi-squared is looked at over all times around it, by one step each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.checked_errors import with_errors_of
from casadi_engine.discrepancy.event_times import finer_candidates
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.linearised import OneStep, without_effect
from casadi_engine.discrepancy.refit import Addition
from casadi_engine.discrepancy.refits import Refits, Tried
from casadi_engine.discrepancy.repaired import Repair
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
    null = refits.null(tried) if one.moves and list(one.nuisance) == ["time"] else None
    if null is None:
        return
    values, data = tried.arrived.values, refits.refitter.data
    count = sum(len(e) for record in null.records for e in record.residual.values())
    unit = max(1.0, tried.arrived.cost / count) * max(refits.levels.memory.values(), default=1.0)
    for record in data:
        name = f"{one.key}.time" if f"{one.key}.time" in values else f"{one.key}.time@{record.name}"
        size = values.get(f"{one.amplitude}@{record.name}", values.get(one.amplitude))
        # what it does in the other records stays: what their residuals would be without it is no word on this time
        gone = without_effect(null, one, len(refits.null_fit.model.states), only=record.name)
        if name not in values or not size or gone is None:
            continue
        only = record.name if len(data) > 1 else None
        with np.errstate(all="ignore"):
            made, step = finer_candidates(one.candidate, gone, data, refits.path.levels, values[name], only)
        if step is None:
            continue
        shared = size if one.amplitude in values and len(data) > 1 else None
        times, cost = _over_time(made, step, record.name, size, shared)
        yield name, times[cost < cost.min(initial=np.inf) + _WITHIN * unit]


def _over_time(
    made: list[Candidate], step: OneStep, record: str, size: float, shared: float | None
) -> tuple[Array, Array]:
    """Times (K,) of an event in a record, and chi-squared there but for a constant, by one step.

    size : its amplitude, of which other times have the sign; shared : the same where all records have it, else None
    """
    own = [
        k
        for k, one in enumerate(made)
        if isinstance(one.direction, dict)
        and record in one.direction
        and np.isfinite(step.error[k])
        and step.amplitude[k] * size > 0
    ]
    best = step.amplitude[own]
    used = best if shared is None else np.full(len(own), shared)
    gain = used * (2 * best - used) / step.error[own] ** 2
    return np.array([made[k].nuisance["time"] for k in own]), -gain


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
