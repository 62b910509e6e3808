"""A fit in two stages: the search on records of a lower rate, its last iterations on the whole data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import TimeUp, best_wanted, lifted
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.final_check import response
from casadi_engine.estimation.ipopt import Solution
from casadi_engine.estimation.lower_rate import LowerRate
from casadi_engine.estimation.search import Attempt, Search

Array = NDArray[np.float64]

# Optima of the first stage whose chi-squared lies so far above the best are not followed: the whole data move their
# difference by less.
_FAR = 30.0
# Share of an output's motion by which the simulation of the thinned record may differ from the thinned simulation.
_BENT = 0.03
# Optima of the first stage are one when their costs and their coordinates agree to these shares.
_SAME_COST, _SAME_PLACE = 1e-4, 1e-3


@dataclass(frozen=True)
class _Found:
    """Where the first stage ended, as a search starts warm from a fit."""

    values: Mapping[str, float]
    initial: Mapping[str, Mapping[str, float]]
    noise: Mapping[str, tuple[float, bool]]
    converged: bool


def lower_search(search: Search, arguments: Mapping[str, Any], lower: LowerRate, progress: Any) -> Search:
    """The search of the first stage; arguments : those of ``search``."""
    changed = {"data": lower.data, "noise": lower.noise}
    return Search(**{**arguments, **changed}, progress=progress, interrupts=search._interrupts)


def bent_by_thinning(search: Search, first: Search) -> str:
    """Why what was thinned is another system, at the start of the search; empty if it is the same.

    A linear model passes a filter on from its inputs to its outputs, any other one as far as it is slow beside the
    filter. A model that takes the square of a fast input is not.
    """
    v, x = search.first_point()[: search.problem.nv], search.first_point()
    low = first.coordinates.of(search.coordinates.values(v))
    for record, lay, other in zip(search.records, search.problem.layouts, first.records, strict=True):
        start = lay.take(x)[0]
        made = other.experiment.decimation
        assert made is not None
        try:
            y, seen = response(record, v, start)
            z, thin = response(other, low, start * record.scale / other.scale)
        except (FloatingPointError, np.linalg.LinAlgError):
            return "the start cannot be simulated"
        for name, sample in other.grid.measured.items():
            whole = made.sampled(seen.series(y, name), other.grid.samples, late=False, sharp=False)
            expected = whole[sample.position]
            error = thin.series(z, name) - expected
            size = float(np.std(expected))
            if not np.sqrt(np.mean(error**2)) <= _BENT * size:
                return f"{name} depends on what a filter would take from the inputs"
    return ""


def searched_on(search: Search, best: Attempt, lower: LowerRate | str) -> str:
    """What a fit was searched on, in words."""
    if isinstance(lower, LowerRate):
        return lower.words
    linear = all(record.linear for record in search.records)
    return best.searched if linear else f"all samples: {lower}"


def on_whole_data(search: Search, first: Search, attempts: list[Attempt]) -> list[Attempt]:
    """What the attempts of the first stage become on the whole data.

    Of attempts that ended at one place one alone is followed; places far above the best keep what they are.
    """
    best = min((a.merit for a in attempts if np.isfinite(a.merit)), default=np.inf)
    known: list[tuple[Attempt, Attempt]] = []
    found, warm = [], search.warm
    try:
        for attempt in attempts:
            same = next((after for before, after in known if _same(before, attempt)), None)
            if same is None:
                near = attempt.merit <= best + _FAR and attempt.solution.status != "interrupted"
                same = _followed(search, first, attempt, search=near)
                known.append((attempt, same))
            iterations = attempt.iterations + same.iterations
            found.append(replace(same, start=attempt.start, iterations=iterations))
    finally:
        search.warm = warm
    return found


def _same(one: Attempt, other: Attempt) -> bool:
    if one.solution.status != other.solution.status:
        return False
    apart = float(np.abs(one.v - other.v).max(initial=0.0))
    return abs(one.cost - other.cost) <= _SAME_COST * abs(one.cost) and apart <= _SAME_PLACE


def _followed(whole: Search, first: Search, attempt: Attempt, *, search: bool) -> Attempt:
    """The attempt from the first stage's end, searched or as it stands."""
    z = first.coordinates.values(attempt.v)
    whole.warm = _end_of(first, attempt)
    z = np.clip(z, whole.pmap.lower, whole.pmap.upper)
    try:
        if search:
            return _run(whole, attempt, z)
    except TimeUp:
        if not best_wanted():
            raise
    with lifted():
        x = whole._start(z, first=True)
        x[: whole.problem.nv] = whole.coordinates.of(z)
        none = np.zeros(whole.problem.rows), np.zeros(whole.problem.size)
        status = "interrupted" if search else attempt.solution.status
        return whole._outcome(Solution(x, *none, status, 0, attempt.solution.words), 0, z)


def _run(whole: Search, attempt: Attempt, z: Array) -> Attempt:
    """The search on all samples from where the first stage ended."""
    try:
        return whole.finished(whole.run(z, first=True))
    except EstimationError:  # there the whole data cannot be simulated
        whole.warm = None
        return whole.finished(whole.run(attempt.start, first=False))


def _end_of(first: Search, attempt: Attempt) -> _Found:
    problem, x = first.problem, attempt.solution.x
    states = [state.name for state in first.model.states]
    initial = {
        record.experiment.name: dict(zip(states, (lay.take(x)[0] * record.scale).tolist(), strict=True))
        for record, lay in zip(first.records, problem.layouts, strict=True)
    }
    z = first.coordinates.values(attempt.v)
    made = first.data[0].decimation
    share = 1.0 if made is None else made.deviation
    noise = {
        name: (level / share, estimated)
        for name, (level, estimated) in first.levels.by_name(attempt.sigma).items()
    }
    values = dict(zip(first.pmap.free, z.tolist(), strict=True))
    return _Found(values, initial, noise, attempt.solution.status == "converged")
