"""Candidates by effect and port, and what one step says of each: where a refit of the most promising one begins."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from casadi_engine.discrepancy.events import by_one_step
from casadi_engine.discrepancy.linearised import OneStep
from casadi_engine.discrepancy.refit import Addition, addition
from casadi_engine.discrepancy.screening import Screened

# An amplitude is a finding beyond so many of its standard errors.
BEYOND = 3.0
# Difference of chi-squared within which two secants of one law are the same.
_SAME = 0.1


def families_of(screened: Screened) -> dict[tuple[str, str], list[int]]:
    """(effect, port) -> its testable candidates; of effects that are the same in the equations the first one."""
    return _families(screened, screened.order)


def every_family(screened: Screened) -> dict[tuple[str, str], list[int]]:
    """The same of all candidates, whether they are testable or not along the model without effects."""
    return _families(screened, range(len(screened.candidates)))


def _families(screened: Screened, members: Iterable[int]) -> dict[tuple[str, str], list[int]]:
    found: dict[tuple[str, str], list[int]] = {}
    for k in members:
        found.setdefault(screened.candidates[k].key, []).append(k)
    again = {key for own in screened.second_names.values() for key in own}
    return {key: own for key, own in found.items() if key not in again}


def costs_of(
    screened: Screened, step: OneStep, families: dict[tuple[str, str], list[int]]
) -> dict[tuple[str, str], float]:
    """Chi-squared with each effect by one step; of one with a value that is looked for on a grid the least that it may
    come to between two of them."""
    found = {key: by_one_step(screened.candidates, step, own).cost for key, own in families.items()}
    if step.between is None:
        return found
    return {key: min(found[key], float(step.between[own].min())) for key, own in families.items()}


def _of_its_size(screened: Screened, step: OneStep, members: Sequence[int], lead: int) -> int:
    """Of the secants of a law without a slope at 0, which explain the same, the one whose size the data ask for."""
    alike = [k for k in members if step.cost[k] <= step.cost[lead] + _SAME]

    def off(k: int) -> float:
        ratio = float(step.amplitude[k]) / float(screened.candidates[k].size or 1.0)
        return abs(math.log(ratio)) if ratio > 0 else math.inf

    return min(alike, key=off, default=lead)


def chosen_of(screened: Screened, step: OneStep, members: Sequence[int]) -> Addition:
    """The candidate of the least chi-squared, started at its one-step amplitude: small where that has a wrong sign."""
    found = by_one_step(screened.candidates, step, members)
    candidate, size = screened.candidates[found.lead], found.amplitude
    if candidate.source.is_flat:
        candidate = screened.candidates[_of_its_size(screened, step, members, found.lead)]
    if size * candidate.side < 0 or size == 0 or not math.isfinite(size):
        error = min(float(screened.scores.error[found.lead]), float(step.error[found.lead]))
        size = BEYOND * error * (candidate.side or 1) if math.isfinite(error) else 0.0
    whole = any(grid.whole for grid in candidate.source.effect.nuisance.values())
    return addition(candidate, size, len(members) if whole else 1, found.times)
