"""When an event happened, where the model swings several times from one time of its grid to the next.

A refit moves an event by less than half a swing of what it excites: beyond that lies another optimum. The grid of times
serves to tell that something happened; when it did is looked for on a finer one.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.events import by_one_step
from casadi_engine.discrepancy.library_candidates import library_candidates
from casadi_engine.discrepancy.linearised import OneStep, one_step
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.refit import Addition, addition
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.experiment import Experiment

# How many times finer that grid is, over how many steps of the other to both sides of where the event is, and how many
# times are tried at most.
_FINER, _ASIDE, _MOST = 16, 4, 200


def located(
    refits: Refits, one: Addition, null: NullModel, at: float | None = None
) -> tuple[Addition, float] | None:
    """An event at its best time on a finer grid by one step along a model without it, and chi-squared there; None where
    that cannot be told. at : near where [s], None for where its candidate is"""
    data = refits.refitter.data
    made, step = finer_candidates(one.candidate, null, data, refits.path.levels, at)
    if step is None:
        return None
    found = by_one_step(made, step, range(len(made)))
    if not np.isfinite(step.error[found.lead]) or found.amplitude * made[found.lead].side < 0:
        return None
    return addition(made[found.lead], found.amplitude, 1, found.times), found.cost


def finer_candidates(
    one: Candidate, null: NullModel, data: Sequence[Experiment], levels: Any, at: float | None
) -> tuple[list[Candidate], OneStep | None]:
    """The candidates of an event on a finer grid of times, and one step of them; of one record about where it is."""
    if not _timed(one):
        return [], None
    effect, (begin, length) = one.source.effect, (data[0].span[0], data[0].duration)
    grid = effect.nuisance["time"]
    if len(data) == 1:
        step = (grid.stop - grid.start) / (grid.steps - 1)
        middle = ((one.nuisance["time"] if at is None else at) - begin) / length
        low, high = max(middle - _ASIDE * step, grid.start), min(middle + _ASIDE * step, grid.stop)
        if low >= high:
            return [], None
        grid = replace(grid, start=low, stop=high, steps=2 * _ASIDE + 1)
    steps = min((grid.steps - 1) * _FINER, _MOST // len(data)) + 1
    dense = copy.copy(effect)
    object.__setattr__(dense, "nuisance", {"time": replace(grid, steps=steps)})
    every = library_candidates(null, data, (dense,), again=True)
    made = [replace(own, source=replace(own.source, effect=effect)) for own in every if own.key == one.key]
    return made, one_step(null, made, levels) if made else None


def _timed(one: Candidate) -> bool:
    """True for a candidate with a time, and no other nuisance."""
    grids = one.source.effect.nuisance
    return list(grids) == ["time"] and grids["time"].over == "time"
