"""The noise that a fit's residuals show, where it is not the one that its errors count with: white, of these levels.

A fit weighs all samples alike. With J the weighted slopes of the outputs and V the covariance of the weighted noise,
its estimates scatter by A^-1 B A^-1, A = J'J and B = J'VJ, priors in both; A^-1 is right for V = 1 alone. V is that of
an autoregression of the residual where neighbours go together, and the mean square of the residual where this is
larger than stated, or in one record larger than in the others. Estimates take part of the noise out of the residual,
the more the slower it is; what they took is known from their errors, so that both are found in turn. No error becomes
smaller than that of white noise of the fit's levels.

Source: White, Econometrica 48 (1980) 817; with autoregressions, den Haan & Levin (1997).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.distributions import chi2_sf, f_sf
from casadi_engine.estimation.all_pole import all_pole
from casadi_engine.estimation.autoregression import autoregression
from casadi_engine.estimation.dichotomy import grows
from casadi_engine.estimation.joint_noise import common_scatter
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.record import RecordPoint, RecordTerm
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.standard_errors import Uncertainty, efficiency
from casadi_engine.estimation.uncertainty import chained
from casadi_engine.estimation.varied_noise import (
    Varied,
    by_rounding,
    of_size,
    scattered,
    scattered_by_share,
    shared,
    together,
)

Array = NDArray[np.float64]

# Lag-one correlation, in its standard errors, from which a residual counts as coloured: once in 700 of white ones,
# whose errors are then larger by a tenth; least samples to say so, of a record by itself or of several, and of one of
# these.
_COLOUR, _FEW, _FEWEST = 3.0, 30, 5
# A sum of squares that chance makes so rarely is not of the stated noise level.
_IMPOSSIBLE = 1e-9
# A residual that is smaller than this share of the stated level is not of that noise; data without any are smaller yet.
_QUIET, _EXACT = 1 / 3, 1e-3
# So rarely chance makes the residual of a record that much larger than that of the others, whose level is one.
_UNEVEN = 1e-2
# Errors and colour are found in turn until no error moves by this share, or so often: of a residual that is one slow
# arc, as that of a model that is far off, each round adds as much again.
_SETTLED, _ROUNDS = 0.01, 5
# Share of its first value below which the noise's memory has died out.
_LITTLE = 1e-3
# Share of the information below which a direction is not seen.
_BLIND = 1e-12
# A record with more samples times estimates is so long that these take nothing of its noise that would be seen.
_LONG = 2_000_000
# Share of the samples beside which there is one before, from which on gaps leave an autoregression its long past.
_BESIDE = 0.9
# Samples to an estimate beyond which these take next to nothing of any sample's noise.
_MANY = 1000


@dataclass(frozen=True, eq=False)
class OwnNoise:
    """The residual of one output of a record, in its levels, where it is not white noise of the level 1.

    at : number of the record; residual : (n,) along its channel, 0 where not valid (n,); neighbours : their
    correlation, None where it is white; level : root mean square where the output is louder than stated, or where
    records differ, else None; others : root mean square in the other records, None where the level was stated
    """

    at: int
    output: str
    residual: Array
    valid: NDArray[np.bool_]
    neighbours: float | None
    level: float | None
    others: float | None = None


def own_noise(search: Search, best: Attempt) -> tuple[OwnNoise, ...]:
    """The outputs of all records whose residuals are coloured or larger than stated."""
    points = search.problem.at(best.solution.x).records
    louder, uneven, coloured = _louder(search, points), _uneven(search, points), _coloured(search, points)
    found = []
    for at, (record, point) in enumerate(zip(search.records, points, strict=True)):
        for name in record.observation.where:
            neighbours = coloured.get((at, name))
            level, others = uneven.get((at, name), (louder.get((at, name)), None))
            if neighbours is not None or level is not None:
                residual, valid = _along(record, point, name, search.loss)
                found.append(OwnNoise(at, name, residual, valid, neighbours, level, others))
    return tuple(found)


def _coloured(search: Search, points: Sequence[RecordPoint]) -> dict[tuple[int, str], float]:
    """Number of a record and output -> the correlation of neighbours in its residual, where this is coloured: by
    itself, or, where that cannot be told, with those of the other records."""
    found: dict[tuple[int, str], float] = {}
    for name in search.records[0].outputs:
        short: dict[tuple[int, str], tuple[float, float, int]] = {}
        for at, (record, point) in enumerate(zip(search.records, points, strict=True)):
            r = _counted(record, point.r, name) if name in record.observation.where else np.empty(0)
            if len(r) < _FEWEST or search.levels.rounding(name, r, search.sigma):
                continue
            own = float(r[1:] @ r[:-1]), float(r @ r), len(r)
            if own[0] > _COLOUR * own[1] / math.sqrt(own[2]) and own[2] >= _FEW:
                found[at, name] = own[0] / own[1]
            else:
                short[at, name] = own
        product, square, count = (sum(one[k] for one in short.values()) for k in range(3))
        if len(short) > 1 and count >= _FEW and product > _COLOUR * square / math.sqrt(count):
            found |= dict.fromkeys(short, product / square)
    return found


def _uneven(search: Search, points: Sequence[RecordPoint]) -> dict[tuple[int, str], tuple[float, float]]:
    """Number of a record and output -> the residual's size there and in the other records, in the one level that was
    estimated for all, where it is larger in one of them than chance makes it."""
    found: dict[tuple[int, str], tuple[float, float]] = {}
    for name, estimated in zip(search.records[0].outputs, search.levels.estimated, strict=True):
        rows = {
            at: _counted(record, point.r, name)
            for at, (record, point) in enumerate(zip(search.records, points, strict=True))
            if name in record.observation.where
        }
        count = sum(map(len, rows.values()))
        left = 1 - search.free_count / count if count else 0.0
        if not estimated or search.loss.robust or len(rows) < 2 or left <= 0:
            continue
        total = float(sum(r @ r for r in rows.values()))
        sizes = {}
        for at, r in rows.items():
            own, rest = left * len(r), left * (count - len(r))
            if own >= 1 and rest >= 1:
                sizes[at] = own, rest, float(r @ r) / own, (total - float(r @ r)) / rest
        least = _UNEVEN / len(rows)
        if any(
            below > 0 and f_sf(size / below, own, rest) < least for own, rest, size, below in sizes.values()
        ):
            found |= {(at, name): (math.sqrt(one[2]), math.sqrt(one[3])) for at, one in sizes.items()}
    return found


def _louder(search: Search, points: Sequence[RecordPoint]) -> dict[tuple[int, str], float]:
    """Number of a record and output -> its residual's size in the level that was stated for it, where this is larger
    than chance allows: in the records in which it is, or in all of them where it is so in none alone."""
    found: dict[tuple[int, str], float] = {}
    for name, estimated in zip(search.records[0].outputs, search.levels.estimated, strict=True):
        rows = {
            at: _counted(record, point.r, name)
            for at, (record, point) in enumerate(zip(search.records, points, strict=True))
            if name in record.observation.where
        }
        count = sum(map(len, rows.values()))
        left = 1 - search.free_count / count if count else 0.0
        if estimated or search.loss.robust or left * count < 1:
            continue
        own = {at: (float(r @ r), left * len(r)) for at, r in rows.items() if len(r)}
        loud = {at: math.sqrt(r / n) for at, (r, n) in own.items() if chi2_sf(r, n) < _IMPOSSIBLE}
        square = sum(r for r, _ in own.values())
        if not loud and chi2_sf(square, left * count) < _IMPOSSIBLE:
            loud = dict.fromkeys(own, math.sqrt(square / (left * count)))
        found |= {(at, name): size for at, size in loud.items()}
    return found


def quieter(search: Search, points: Sequence[RecordPoint]) -> dict[str, float]:
    """Output -> its residual's size in the level that was stated for it, where this is far smaller than any noise of
    that level; not of data that were simulated without noise."""
    found: dict[str, float] = {}
    for name, estimated in zip(search.records[0].outputs, search.levels.estimated, strict=True):
        rows = [
            _counted(record, point.r, name)
            for record, point in zip(search.records, points, strict=True)
            if name in record.observation.where
        ]
        count = sum(map(len, rows))
        left = count * (1 - search.free_count / count) if count else 0.0
        if estimated or search.loss.robust or left < 1:
            continue
        square = float(sum(r @ r for r in rows))
        size = math.sqrt(square / left)
        if _EXACT < size < _QUIET and 1 - chi2_sf(square, left) < _IMPOSSIBLE:
            found[name] = size
    return found


def taken_of(
    search: Search, points: Sequence[RecordPoint], errors: Uncertainty
) -> dict[tuple[int, str], Array]:
    """Number of a record and output -> (n,) share of each sample's variance that the estimates took, of records in
    which it may be more than next to nothing."""
    found: dict[tuple[int, str], Array] = {}
    if not errors.optimal or not np.isfinite(errors.covariance.matrix).all():
        return found
    for at, (record, point) in enumerate(zip(search.records, points, strict=True)):
        entries = _entries(search, at)
        own = errors.told[np.ix_(entries, entries)]
        for name in record.observation.where:
            index = record.grid.measured[name].index
            if len(index) > _MANY * len(entries) or grows(record, point):
                continue
            valid = np.zeros(len(record.experiment[name].time), dtype=bool)
            slopes = _slopes(search, record, point, OwnNoise(at, name, valid * 0.0, valid, None, None))[index]
            found[at, name] = np.einsum("nk,kl,nl->n", slopes, own, slopes, optimize=True)
    return found


def _counted(record: RecordTerm, r: Array, name: str) -> Array:
    """The residuals (K, M) of the samples of one output that count, in time order."""
    counts, rows = (record.observation.series(values, name) for values in (record.observation.valid, r))
    return rows if counts.all() else rows[counts]


def _along(record: RecordTerm, point: RecordPoint, name: str, loss: Loss) -> tuple[Array, NDArray[np.bool_]]:
    """The residual (n,) along the channel of an output, and which of its samples count; of a robust loss the clipped
    one, of unit size."""
    size, index = len(record.experiment[name].time), record.grid.measured[name].index
    residual, valid = np.zeros(size), np.zeros(size, dtype=bool)
    valid[index] = record.observation.series(record.observation.valid, name)
    residual[index] = record.observation.series(point.r, name)
    residual = np.where(valid, loss.slope(residual), 0.0)
    return residual / (np.sqrt(np.mean(residual[valid] ** 2)) if loss.robust else 1.0), valid


def with_own_noise(
    search: Search,
    best: Attempt,
    errors: Uncertainty,
    noises: Sequence[OwnNoise],
    varied: Sequence[Varied] = (),
) -> tuple[Uncertainty, Array, float]:
    """The errors that count with the noise as the residuals show it; by how much they are larger (N,) than before, of
    the parameters in the search's coordinates and the initial states; and how many independent samples the most
    coloured output is worth.

    varied : residuals that are white, and not of one size or not by themselves
    """
    white = errors.covariance.matrix
    ratio = np.ones(len(white))
    if not (noises or varied) or not errors.optimal or not np.isfinite(white).all():
        return errors, ratio, math.inf
    points, size = search.problem.at(best.solution.x).records, np.sqrt(np.maximum(np.diag(white), 0.0))
    # slopes along what grows beyond all numbers are lost on their way
    noises = [one for one in noises if not grows(search.records[one.at], points[one.at])]
    varied = [one for one in varied if not grows(search.records[one.at], points[one.at])]
    if not (noises or varied):
        return errors, ratio, math.inf
    slopes = [_slopes(search, search.records[one.at], points[one.at], one) for one in noises]
    places = [_entries(search, one.at) for one in noises]
    fixed, matrix = np.zeros_like(white), errors.told
    for _ in range(2 if varied else 0):  # what the estimates are off by, moves what rounding does
        fixed = np.zeros_like(white)
        for odd in varied:
            at = _entries(search, odd.at)
            own = (matrix if odd.step else errors.told)[np.ix_(at, at)]
            fixed[np.ix_(at, at)] += odd.chance * _of_varied(search, points[odd.at], odd, own)
        matrix = errors.told + errors.scattered(fixed)
    matrix, more, few = errors.told, fixed, math.inf
    for _ in range(_ROUNDS):
        before, more, few = matrix, fixed.copy(), math.inf
        uneven, even = np.zeros_like(white), np.zeros_like(white)
        joint = _add_common(more, _in_common(search, noises), noises, slopes, places, matrix)
        for k, (one, own, at) in enumerate(zip(noises, slopes, places, strict=True)):
            scatter, samples = _scatter(one, own, matrix[np.ix_(at, at)])
            few = min(few, samples)
            if k in joint:
                continue
            if one.others is None or one.neighbours is not None:
                more[np.ix_(at, at)] += _beyond(scatter, own.T @ own)
            else:  # of louder records and quieter ones together
                uneven[np.ix_(at, at)] += scatter
                even[np.ix_(at, at)] += own.T @ own
        more += _beyond(uneven, even)
        matrix = errors.told + errors.scattered(more)
        then, now = (np.sqrt(np.maximum(np.diag(a), 0.0)) for a in (before, matrix))
        if (np.abs(now - then) <= _SETTLED * size).all():
            break
    here = size > 0
    ratio[here] = np.sqrt(np.maximum(np.diag(matrix)[here], 0.0)) / size[here]
    return errors.widened(more), ratio, few


def _of_varied(search: Search, point: RecordPoint, one: Varied, errors: Array) -> Array:
    """What J'VJ has more than J'J where white noise is not of one size, or shared by two sensors."""
    record, slopes, residuals = search.records[one.at], [], []
    for name in one.outputs:
        residual, valid = _along(record, point, name, search.loss)
        index = record.grid.measured[name].index
        own = OwnNoise(one.at, name, residual, valid, None, None)
        slopes.append(_slopes(search, record, point, own)[index])
        residuals.append(residual[index])
    white = sum((own.T @ own for own in slopes), np.zeros_like(errors))
    if one.step:
        (name,), sigma = one.outputs, float(search.sigma[search.levels.outputs.index(one.outputs[0])])
        values = record.grid.measured[name].values / sigma
        return _beyond(by_rounding(values, residuals[0], slopes[0], errors, one.step / sigma), white)
    if len(slopes) == 1:
        (name,) = one.outputs
        seen, sigma = record.grid.measured[name], float(search.sigma[search.levels.outputs.index(name)])
        shown = seen.values + sigma * residuals[0]
        if one.of_share:
            return _beyond(scattered_by_share(residuals[0], slopes[0], errors, shown), white)
        course = of_size(shown) if one.grows else seen.time
        return _beyond(scattered(residuals[0], slopes[0], errors, course), white)
    both = [
        own[rows]
        for own, rows in zip(slopes, shared(*(record.grid.measured[n] for n in one.outputs)), strict=True)
    ]
    return _beyond(white + together(one.share, *both), white)


def _entries(search: Search, at: int) -> NDArray[np.intp]:
    """Where a record's active parameters and initial states are in [v; initial states]."""
    begin = search.problem.nv + sum(record.n for record in search.records[:at])
    record = search.records[at]
    return np.concatenate([record.active, np.arange(begin, begin + record.n)])


def _slopes(search: Search, record: RecordTerm, point: RecordPoint, one: OwnNoise) -> Array:
    """(n, nz + states) weighted slopes of an output along its channel, 0 where its samples do not count; of a robust
    loss, of what its clipped residuals see."""
    nz, chain, name = len(record.active), chained(record, point), one.output
    row, interval = np.divmod(record.observation.where[name], record.plan.m)
    weight = np.asarray(record.weight)[row, interval]
    js = point.js[row] if point.js.ndim == 2 else point.js[row, interval]
    index = record.grid.measured[name].index
    found = np.zeros((len(one.valid), nz + record.n))
    for column in range(nz + record.n):
        found[index, column] = np.einsum("kn,kn->k", js, chain[interval, :, column]) * weight
    if nz:
        found[index, :nz] += point.jz[:, row, interval].T
    return found * math.sqrt(efficiency(search.loss, point.r[record.observation.valid], search.lost))


def _scatter(one: OwnNoise, slopes: Array, errors: Array) -> tuple[Array, float]:
    """J'VJ of an output with these slopes (n, k), errors (k, k) of what they are slopes in; and how many independent
    samples tell as much of a mean."""
    if one.neighbours is None:
        return slopes.T @ slopes * (one.level or 1.0) ** 2, math.inf
    columns, valid = _with_taken(one, slopes, errors), one.valid
    if np.count_nonzero(valid[1:] & valid[:-1]) < _BESIDE * np.count_nonzero(valid):
        # few have a long past without gaps: the past of each is what was sampled before it
        columns, slopes, valid = columns[valid], slopes[valid], valid[valid]
    noise = autoregression(columns, valid)
    predictor = _lasting(noise.predictors[-1], len(slopes))
    answer = all_pole(predictor, np.eye(len(slopes), 1))[:, 0]
    count, power = int(valid.sum()), float((answer**2).sum())
    level = math.sqrt(float((columns**2).sum()) / count / power)
    # the noise was there before the record began
    before = int(np.flatnonzero(np.abs(answer) > _LITTLE).max(initial=0))
    backwards = np.concatenate([slopes[::-1], np.zeros((before, slopes.shape[1]))])
    passed = all_pole(predictor, backwards, level)
    return passed.T @ passed, count * power * float(predictor.sum()) ** 2


def _with_taken(one: OwnNoise, slopes: Array, errors: Array) -> Array:
    """(n, 1 + k) the residual of an output, and columns of what estimates with these errors took out of it."""
    if slopes.size > _LONG:
        return one.residual[:, None]
    values, vectors = np.linalg.eigh(errors)
    return np.concatenate(
        [one.residual[:, None], slopes @ (vectors * np.sqrt(np.maximum(values, 0.0)))], axis=1
    )


def _in_common(search: Search, noises: Sequence[OwnNoise]) -> list[list[int]]:
    """The numbers of coloured outputs of one record that were sampled together, two at least."""
    found: dict[tuple[int, bytes], list[int]] = {}
    for k, one in enumerate(noises):
        if one.neighbours is not None:
            time = search.records[one.at].experiment[one.output].time
            found.setdefault((one.at, time.tobytes()), []).append(k)
    return [own for own in found.values() if len(own) > 1]


def _add_common(
    more: Array,
    groups: Sequence[Sequence[int]],
    noises: Sequence[OwnNoise],
    slopes: Sequence[Array],
    places: Sequence[NDArray[np.intp]],
    matrix: Array,
) -> set[int]:
    """Add to ``more`` what outputs with a colour in common scatter beyond white noise; which outputs these are."""
    found = set[int]()
    for members in groups:
        at = places[members[0]]
        both = [(noises[k], slopes[k]) for k in members]
        scatter = _scatter_together(both, matrix[np.ix_(at, at)])
        if scatter is not None:
            more[np.ix_(at, at)] += _beyond(scatter, sum((own.T @ own for _, own in both), 0.0 * scatter))
            found |= set(members)
    return found


def _scatter_together(members: Sequence[tuple[OwnNoise, Array]], errors: Array) -> Array | None:
    """J'VJ of coloured outputs of a record, (noise, slopes) each, that may have their colour in common."""
    if members[0][1].size > _LONG:
        return None
    valid = np.logical_and.reduce([one.valid for one, _ in members])
    noises = [_with_taken(one, own, errors) * valid[:, None] for one, own in members]
    return common_scatter(noises, valid, [own for _, own in members])


def _lasting(predictor: Array, samples: int) -> Array:
    """The predictor with a memory of no more than the record: least squares may find one that grows."""
    largest = float(np.abs(np.roots(predictor)).max(initial=0.0))
    limit = 1 - 1 / samples
    return predictor if largest <= limit else predictor * (limit / largest) ** np.arange(len(predictor))


def _beyond(scatter: Array, white: Array) -> Array:
    """What J'VJ has more than J'J, in the directions in which it has."""
    size = np.sqrt(np.maximum(np.diag(white), 1e-300))
    values, vectors = np.linalg.eigh(white / np.outer(size, size))
    seen = values > _BLIND * values.max(initial=0.0)
    root = (vectors[:, seen] * np.sqrt(values[seen])).T * size
    back = (vectors[:, seen] / np.sqrt(values[seen])).T / size
    more, turn = np.linalg.eigh(back @ scatter @ back.T - np.eye(len(back)))
    own = (turn * np.sqrt(np.maximum(more, 0.0))).T @ root
    return np.asarray(own.T @ own)
