"""Searching on records of a lower rate: how low a rate may be is computed from what it would lose.

Most of a record's samples are far faster than anything that the parameters can move. A search on records that are
filtered and thinned (see ``experiment.decimation``) takes as many times fewer integration steps; its last iterations,
and everything that is reported, are of the whole data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.chained import chained_slopes
from casadi_engine.estimation.record import RecordPoint, RecordTerm
from casadi_engine.estimation.search import Search
from casadi_engine.experiment import Experiment
from casadi_engine.experiment.decimation import REACH, decimated, rows_at_lower_rate
from casadi_engine.model import Model
from casadi_engine.problem.noise import Noise
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.propagator import switches_with_states

Array = NDArray[np.float64]

# Share of the Fisher information of any combination of parameters that a rate half as low again may lose: at the rate
# itself it is less by an order, and the search ends within a tenth of a standard error of where the whole data lead.
LOST = 1e-2
# Factors that are tried, and samples that a record of a lower rate has at least.
_FACTORS = (32, 24, 16, 12, 8, 6, 4)
_LEAST = 1000
# The filter passes frequencies to a fifth of the rate; straight lines between samples carry those to a tenth well.
_MARGIN = 2
# Samples of a record from which the information is computed: as much of a longer one as this.
_LOOKED_AT = 30_000
# Singular values below this share of the largest belong to what the data do not determine.
_FLAT = 1e-8


# Why a single search runs on the whole data.
ONE_SEARCH = "one search is as fast on them"


@dataclass(frozen=True)
class LowerRate:
    """What a search runs on: records (thinned by ``factor``), their noise, and the share of information ``lost``."""

    data: tuple[Experiment, ...]
    noise: Noise
    factor: int
    lost: float

    @property
    def words(self) -> str:
        """What was searched on."""
        lost = f"{100 * max(self.lost, 0.0):.2g} % of the information left out"
        return f"records of a rate {self.factor} times lower ({lost}), and then the whole data"


def lower_rate(search: Search) -> LowerRate | str:
    """Records of a lower rate for a search that is set up, or why it runs on the whole data."""
    why = _unsuitable(search)
    if why:
        return why
    factor, lost = lost_at_lower_rate(search)
    if factor == 1:
        return "no lower rate keeps the information"
    model = search.model
    data = tuple(thinned(model, record, factor) for record in search.data)
    return LowerRate(data, thinned_noise(search.noise, model, data[0]), factor, lost)


def thinned(model: Model, record: Experiment, factor: int) -> Experiment:
    """The record at a rate ``factor`` times lower, for this model."""
    outputs = tuple(out.name for out in model.outputs if out.name in record)
    return decimated(record, tuple(v.name for v in model.inputs), outputs, factor)


def thinned_noise(noise: Noise, model: Model, record: Experiment) -> Noise:
    """The noise of the samples of a lower rate."""
    share = record.decimation.deviation if record.decimation is not None else 1.0
    levels: dict[str, Any] = {}
    for out in model.outputs:
        level = noise.level(out.name)
        levels[out.name] = level if isinstance(level, str) else level * share
    return Noise(**levels)


def _unsuitable(search: Search) -> str:
    """Why a search does not run on thinned records; empty if it does."""
    if search.noise.predicts:
        return "a predictor corrects the states"
    if search.loss.robust:
        return "the loss is robust"
    if search.cut not in ("auto", "single"):
        return "a shooting interval was given"
    if getattr(search.warm, "converged", False):
        return "it starts at an optimum"
    if all(record.linear for record in search.records):
        return "a linear model is as fast"
    found = (unsuitable_record(r.model, r.grid, r.experiment) for r in search.records)
    return next((why for why in found if why), "")


def unsuitable_record(model: Model, grid: Grid, experiment: Experiment) -> str:
    """Why a record cannot be thinned; empty if it can."""
    if experiment.decimation is not None:
        return "the records are of a lower rate"
    if switches_with_states(model):
        return "the equations jump with their states"
    times = [experiment[name].time for name in (*(v.name for v in model.inputs), *grid.measured)]
    alike = all(own is times[0] or np.array_equal(own, times[0]) for own in times)
    if not grid.uniform or not alike or grid.samples != len(times[0]):
        return "the channels were not sampled together at equal steps"
    if any(len(own.position) != grid.samples for own in grid.measured.values()):
        return "samples are missing"
    if grid.samples < _FACTORS[-1] * _LEAST:
        return "the records are short"
    return ""


def lost_at_lower_rate(
    search: Search, others: Sequence[Experiment] = (), held: Sequence[str] = ()
) -> tuple[int, float]:
    """The largest factor that loses little, and the share of information that it loses; 1 where there is none.

    The slopes are those at the search's start. others : records that are to be thinned alike; held : parameters that
    do not move, at a bound for instance
    """
    problem = search.problem
    try:
        point = problem.at(search.first_point())
    except (FloatingPointError, np.linalg.LinAlgError):
        return 1, 0.0
    slopes = [
        whole_slopes(record, found, lay.m)
        for record, found, lay in zip(search.records, point.records, problem.layouts, strict=True)
    ]
    lengths = [len(record[record.names[0]].time) for record in others]
    shortest = min([record.grid.samples for record in search.records] + lengths)
    free = np.array([name not in held for name in search.pmap.free], dtype=bool)
    for factor in _FACTORS:
        if shortest < factor * _LEAST:
            continue
        if lost_information(search, slopes, _MARGIN * factor, free) <= LOST:
            return factor, lost_information(search, slopes, factor, free)
    return 1, 0.0


def whole_slopes(record: RecordTerm, point: RecordPoint, count: int) -> Mapping[str, Array]:
    """Output -> (nz + n, N) weighted slopes in the record's active parameters and its first states, in time order.

    The intervals' starts are taken to follow one another; of a long record the first part alone is looked at.
    """
    use = min(count, max(1, _LOOKED_AT // max(record.plan.length, 1)))
    whole = np.zeros((len(record.active) + record.n, *point.r.shape))
    whole[:, :, :use] = chained_slopes(record, point, use)
    samples = min(record.grid.samples, use * record.plan.length)
    return {
        name: np.array([record.observation.series(row, name)[:samples] for row in whole])
        for name in record.observation.where
    }


def lost_information(
    search: Search, slopes: list[Mapping[str, Array]], factor: int, free: NDArray[np.bool_] | None = None
) -> float:
    """The largest share of the Fisher information of any combination of parameters that a lower rate loses.

    Initial states are projected out; the ends of the records, where the filter does not fit, are left to the last
    iterations on the whole data. free : (nv,) False for parameters that do not move
    """
    nv = search.problem.nv
    moving = np.ones(nv, dtype=bool) if free is None else free
    if not moving.any():
        return 0.0
    before, after = np.zeros((nv, nv)), np.zeros((nv, nv))
    for record, own in zip(search.records, slopes, strict=True):
        full, thin = [], []
        for rows in own.values():
            pair = _thinned_rows(rows, factor)
            if pair is None:
                return 1.0
            full.append(pair[0])
            thin.append(pair[1])
        nz = len(record.active)
        at = np.ix_(record.active, record.active)
        before[at] += _information(np.concatenate(full, axis=1), nz)
        after[at] += _information(np.concatenate(thin, axis=1), nz)
    before, after = before[np.ix_(moving, moving)], after[np.ix_(moving, moving)]
    size = np.sqrt(np.diag(before))
    size[size == 0] = 1.0
    values, vectors = np.linalg.eigh(before / np.outer(size, size))
    told = values > _FLAT * values[-1]
    turn = vectors[:, told] / np.sqrt(values[told])
    kept = turn.T @ (after / np.outer(size, size)) @ turn
    return float(1 - np.linalg.eigvalsh(kept)[0]) if told.any() else 0.0


def _thinned_rows(rows: Array, factor: int) -> tuple[Array, Array] | None:
    """Rows (w, N) where the filter fits, and their thinned and filtered (w, n), both for noise of one unit."""
    count = (rows.shape[1] - 1) // factor + 1
    there = np.arange(REACH, count - REACH)
    if len(there) < 2 * REACH:
        return None
    begin, end = there[0] * factor - factor // 2, (there[-1] + 1) * factor - factor // 2
    return rows[:, begin:end], rows_at_lower_rate(rows, factor, count)[:, there]


def _information(rows: Array, nz: int) -> Array:
    """(nz, nz) information of the first ``nz`` rows with the others projected out."""
    own, starts = rows[:nz], rows[nz:]
    size = np.sqrt((starts**2).sum(axis=1))
    starts = starts[size > 0] / size[size > 0, None]
    if len(starts):
        values, vectors = np.linalg.eigh(starts @ starts.T)
        keep = values > _FLAT * values[-1]
        basis = (vectors[:, keep] / np.sqrt(values[keep])).T @ starts
        own = own - (own @ basis.T) @ basis
    return np.asarray(own @ own.T, dtype=np.float64)
