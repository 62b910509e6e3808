"""Candidates by effect and port, and what one step says of each: where a refit of the most promising one begins."""

from __future__ import annotations

import math
from collections.abc import Sequence

from casadi_engine.discrepancy.events import by_one_step
from casadi_engine.discrepancy.linearised import OneStep
from casadi_engine.discrepancy.refit import Addition, addition
from casadi_engine.discrepancy.screening import Screened

# An amplitude is a finding beyond so many of its standard errors.
BEYOND = 3.0


def families_of(screened: Screened) -> dict[tuple[str, str], list[int]]:
    """(effect, port) -> its testable candidates."""
    found: dict[tuple[str, str], list[int]] = {}
    for k in screened.order:
        found.setdefault(screened.candidates[k].key, []).append(k)
    return found


def costs_of(
    screened: Screened, step: OneStep, families: dict[tuple[str, str], list[int]]
) -> dict[tuple[str, str], float]:
    """Chi-squared with each effect by one step."""
    return {key: by_one_step(screened.candidates, step, own).cost for key, own in families.items()}


def chosen_of(screened: Screened, step: OneStep, members: Sequence[int]) -> Addition:
    """The candidate of the least chi-squared, started at its one-step amplitude: small where that has a wrong sign."""
    found = by_one_step(screened.candidates, step, members)
    candidate, size = screened.candidates[found.lead], found.amplitude
    if size * candidate.side < 0 or size == 0 or not math.isfinite(size):
        size = BEYOND * float(screened.scores.error[found.lead]) * (candidate.side or 1)
    whole = any(grid.whole for grid in candidate.source.effect.nuisance.values())
    return addition(candidate, size, len(members) if whole else 1, found.times)
