"""An effect by one step along a model: of an event that several records may show, with a time in each of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.linearised import OneStep

Times = dict[str, dict[str, float]]


@dataclass(frozen=True)
class Promise:
    """What one step says of an effect: chi-squared with it, the number of the candidate that says most, the amplitude,
    and for an event in several records nuisance name -> record -> time, inf where it does not happen."""

    cost: float
    lead: int
    amplitude: float
    times: Times = field(default_factory=dict)


def by_one_step(candidates: Sequence[Candidate], step: OneStep, members: Sequence[int]) -> Promise:
    """The best of an effect's candidates; of an event the best time in every record, with one amplitude for all."""
    lead = min(members, key=lambda k: step.cost[k])
    single = Promise(float(step.cost[lead]), lead, float(step.amplitude[lead]))
    records = _records(candidates, members)
    if len(records) < 2:
        return single
    best = single
    for k in members:
        gains, times = zip(
            *(_in_record(step, own, float(step.amplitude[k])) for own in records.values()), strict=True
        )
        cost = step.none - float(sum(gains))
        if cost <= best.cost or not best.times:
            found: Times = {}
            for record, chosen in zip(records, times, strict=True):
                for name in candidates[k].nuisance:
                    value = math.inf if chosen is None else float(candidates[chosen].nuisance[name])
                    found.setdefault(name, {})[record] = value
            best = Promise(cost, k, float(step.amplitude[k]), found)
    return best


def place_of_event(step: OneStep, amplitude: float | None) -> tuple[int, float] | None:
    """The candidate of an event that explains most, and its amplitude, None for one that is not known; None where no
    candidate explains anything."""
    if amplitude is None:
        best = int(np.argmin(step.cost))
        return (best, float(step.amplitude[best])) if np.isfinite(step.error[best]) else None
    _, chosen = _in_record(step, range(len(step.cost)), amplitude)
    return None if chosen is None else (chosen, amplitude)


def _in_record(step: OneStep, own: Sequence[int], amplitude: float) -> tuple[float, int | None]:
    """How much an event of this amplitude takes from chi-squared at its best time; 0 and None where it only adds."""
    members = np.asarray(own)
    error: Array = step.error[members]
    acts = np.isfinite(error) & (error > 0)
    gain = np.full(len(members), -math.inf)
    # what takes anything off is finite, as both factors are two standard scores at most; where an amplitude is far too
    # large for a candidate, what it adds may be beyond all numbers
    with np.errstate(over="ignore"):
        gain[acts] = (amplitude / error[acts]) * (
            (2 * step.amplitude[members][acts] - amplitude) / error[acts]
        )
    best = int(np.argmax(gain))
    return (float(gain[best]), int(members[best])) if gain[best] > 0 else (0.0, None)


def _records(candidates: Sequence[Candidate], members: Sequence[int]) -> dict[str, list[int]]:
    """record -> the candidates of an event with a time there; empty for other effects."""
    found: dict[str, list[int]] = {}
    for k in members:
        one = candidates[k]
        grids = one.source.effect.nuisance.values()
        if not grids or not all(grid.over == "time" and not grid.whole for grid in grids):
            return {}
        if not isinstance(one.direction, dict) or len(one.direction) != 1:
            return {}
        found.setdefault(next(iter(one.direction)), []).append(k)
    return found
