"""When an event happened, where the model swings several times from one time of its grid to the next.

A refit moves an event by less than half a swing of what it excites: beyond that lies another optimum. The grid of times
serves to tell that something happened; when it did is looked for on a finer one.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.events import by_one_step
from casadi_engine.discrepancy.library_candidates import library_candidates
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.linearised import OneStep, one_step, without_effect
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.refit import Addition, addition
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.tried import Tried
from casadi_engine.effects import Grid
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


def in_each_record(refits: Refits, tried: Tried, one: Addition) -> Iterator[tuple[str, str, Array, Array]]:
    """The record, the name of the time's parameter, and times (K,) of an event there with chi-squared at each (K,) but
    for a constant, by one step along a structure that has the event in all other records as it is.

    What it does in the others stays: what their residuals would be without it is no word on this time.
    """
    null = refits.null(tried) if one.moves and list(one.nuisance) == ["time"] else None
    if null is None:
        return
    values, data = tried.arrived.values, refits.refitter.data
    for record in data:
        name = f"{one.key}.time" if f"{one.key}.time" in values else f"{one.key}.time@{record.name}"
        size = values.get(f"{one.amplitude}@{record.name}", values.get(one.amplitude))
        gone = without_effect(null, one, only=record.name)
        if name not in values or not size or gone is None:
            continue
        only = record.name if len(data) > 1 else None
        with np.errstate(all="ignore"):
            made, step = finer_candidates(one.candidate, gone, data, refits.path.levels, values[name], only)
        if step is None:
            continue
        shared = size if one.amplitude in values and len(data) > 1 else None
        yield record.name, name, *_over_time(made, step, record.name, size, shared)


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


def finer_candidates(
    one: Candidate,
    null: NullModel,
    data: Sequence[Experiment],
    levels: Any,
    at: float | None,
    only: str | None = None,
) -> tuple[list[Candidate], OneStep | None]:
    """The candidates of an event on a finer grid of times, in all records or in one of them, and one step of them;
    where there is one record about where it is."""
    if not _timed(one):
        return [], None
    effect, own = one.source.effect, next((r for r in data if r.name == only), data[0])
    begin, length = own.span[0], own.duration
    grid = effect.nuisance["time"]
    if len(data) == 1:
        step = (grid.stop - grid.start) / (grid.steps - 1)
        middle = ((one.nuisance["time"] if at is None else at) - begin) / length
        low, high = max(middle - _ASIDE * step, grid.start), min(middle + _ASIDE * step, grid.stop)
        if low >= high:
            return [], None
        grid = replace(grid, start=low, stop=high, steps=2 * _ASIDE + 1)
    steps = min((grid.steps - 1) * _FINER, _MOST // (len(data) if only is None else 1)) + 1
    grid = replace(grid, steps=steps)
    if at is not None:  # which is one of the times then: the others are held against it
        grid = _through(grid, (at - begin) / length)
    dense = copy.copy(effect)
    object.__setattr__(dense, "nuisance", {"time": grid})
    every = library_candidates(null, data, (dense,), again=True, at=one.port)
    made = [
        replace(found, source=replace(found.source, effect=effect))
        for found in every
        if found.key == one.key and (only is None or only in found.direction)  # type: ignore[operator]
    ]
    return made, one_step(null, made, levels) if made else None


def _through(grid: Grid, value: float) -> Grid:
    """The same grid moved by less than a step, so that a value inside it is one of its own."""
    step = (grid.stop - grid.start) / (grid.steps - 1)
    before = math.floor((value - grid.start) / step + 1e-9)
    after = math.floor((grid.stop - value) / step + 1e-9)
    if before < 0 or after < 0 or before + after < 1:
        return grid
    return replace(grid, start=value - before * step, stop=value + after * step, steps=before + after + 1)


def _timed(one: Candidate) -> bool:
    """True for a candidate with a time, and no other nuisance."""
    grids = one.source.effect.nuisance
    return list(grids) == ["time"] and grids["time"].over == "time"
