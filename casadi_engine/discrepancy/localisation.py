"""Where in the data the gap sits: record, time, cycle, crank-angle window and engine order.

The whitened residual r is summed over short blocks; a block's sum squared over its length is chi-squared with one
degree of freedom if nothing is missing, and large where the model errs for longer than a sample. Windows are found by
scanning runs of blocks of any length for the largest standardised excess.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import FOUR_STROKE, Index, NullModel, RecordNull
from casadi_engine.distributions import chi2_sf, normal_isf

_BLOCKS = 48  # of an engine cycle: 15 degrees of the crank
_LEVEL = 0.01
_HIGHEST_ORDER = 16
# Numerical dust of a record without any gap.
_LEAST = 1e-12


@dataclass(frozen=True)
class Where:
    """Where the gap is; a part is None where the data do not single one out.

    record; time : (from, to) s; cycles : numbers as in `Experiment.cycles`, 1 from theta = 0 on, also in a record that
    was cut; None without a crank angle; crank_angle : (from, to) rad in
    0..4 pi, from > to where the window goes over 0; order : per revolution; excess : share of chi-squared above noise
    that each record holds
    """

    record: str
    time: tuple[float, float]
    cycles: tuple[int, ...] | None
    crank_angle: tuple[float, float] | None
    order: float | None
    excess: Mapping[str, float]


def where_in_data(null: NullModel, noise: NoiseModel) -> Where | None:
    """Locate the gap of the null residuals; None if no block statistic is above chance at 1 %."""
    blocks = {record.name: _blocks(record, noise) for record in null.records}
    excess = {name: float((b.statistic - 1).sum()) for name, b in blocks.items()}
    strength = {name: excess[name] / math.sqrt(2 * max(len(b.statistic), 1)) for name, b in blocks.items()}
    record = max(null.records, key=lambda one: strength[one.name])
    own = blocks[record.name]
    order = _order(record, noise)
    window = _angle_window(own)
    count = len(own.statistic)
    chance = chi2_sf(float(own.statistic.sum()), count) * len(null.records)
    if chance > _LEVEL and order is None and window is None:
        return None
    first, last = _scan(own.statistic - 1)
    total = sum(max(value, 0.0) for value in excess.values())
    shares = {name: max(value, 0.0) / max(total, _LEAST) for name, value in excess.items()}
    time = (float(own.start[first]), float(own.stop[last]))
    return Where(record.name, time, _cycles(own), window, order, shares)


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Blocks of one record in time order: statistic, start and stop [s], cycle; mean of r and its weight, and the
    crank angle's bin (-1 without a crank angle)."""

    statistic: Array
    start: Array
    stop: Array
    cycle: Index
    total: Array
    samples: Array
    bin: Index


def crank_angle(record: RecordNull, time: Array) -> Array | None:
    """(N,) crank angle [rad] at the times, or None for a model without the channel theta."""
    names = [v.name for v in record.path.model.inputs]
    if "theta" not in names:
        return None
    grid = record.path.grid
    return np.interp(time, grid.time, grid.channels[names.index("theta")])


def _blocks(record: RecordNull, noise: NoiseModel) -> _Blocks:
    parts = []
    for name, e in record.residual.items():
        r = _whitened(record, noise, name, e)
        time, cycle = record.time[name], record.cycle[name]
        theta = crank_angle(record, time)
        if theta is None:
            number = np.floor((time - time[0]) / max(time[-1] - time[0], _LEAST) * _BLOCKS * 10).astype(int)
            place = np.full(len(time), -1)
        else:
            number = np.floor(theta / FOUR_STROKE * _BLOCKS).astype(int)
            place = np.mod(number, _BLOCKS)
        edge = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
        total = np.add.reduceat(r, edge)
        samples = np.diff(np.append(edge, len(r))).astype(float)
        stop = np.append(edge[1:] - 1, len(r) - 1)
        parts.append((total, samples, time[edge], time[stop], cycle[edge], place[edge]))
    total, samples, start, stop, cycle, place = (np.concatenate(p) for p in zip(*parts, strict=True))
    order = np.argsort(start, kind="stable")
    return _Blocks(
        (total**2 / samples)[order],
        start[order],
        stop[order],
        cycle[order],
        total[order],
        samples[order],
        place[order],
    )


def _whitened(record: RecordNull, noise: NoiseModel, name: str, e: Array) -> Array:
    """The whitened residual at the valid samples."""
    white = noise.whiten(record, name, e[:, None])[:, 0]
    return white if len(white) == len(e) else np.asarray(white[record.index[name]])


def _scan(excess: Array) -> tuple[int, int]:
    """First and last block of the run with the largest excess over the square root of its length."""
    count = len(excess)
    sums = np.concatenate([[0.0], np.cumsum(excess)])
    best, found = -math.inf, (0, count - 1)
    lengths = np.unique(np.round(np.geomspace(1, count, 60)).astype(int))
    for length in lengths:
        run = (sums[length:] - sums[:-length]) / math.sqrt(2 * length)
        k = int(np.argmax(run))
        if run[k] > best:
            best, found = float(run[k]), (k, k + int(length) - 1)
    return found


def _cycles(blocks: _Blocks) -> tuple[int, ...] | None:
    """The cycles that stand out from the others; None if none or all do, or without a crank angle."""
    if (blocks.bin < 0).any():
        return None
    numbers = np.unique(blocks.cycle)
    if len(numbers) < 3:
        return None
    inside = [blocks.cycle == number for number in numbers]
    value = np.array([float(blocks.statistic[i].mean()) for i in inside])
    middle = float(np.median(value))
    spread = np.array([math.sqrt(2 * max(middle, 1.0) ** 2 / i.sum()) for i in inside])
    limit = normal_isf(_LEVEL / len(numbers))
    out = numbers[value - middle > limit * spread]
    return tuple(int(number) + 1 for number in out) if 0 < len(out) < len(numbers) else None


def _angle_window(blocks: _Blocks) -> tuple[float, float] | None:
    """The crank-angle window in which the residual keeps its sign from cycle to cycle; None if there is none."""
    if (blocks.bin < 0).any() or len(np.unique(blocks.cycle)) < 2:
        return None
    total = np.bincount(blocks.bin, blocks.total, _BLOCKS)
    samples = np.bincount(blocks.bin, blocks.samples, _BLOCKS)
    statistic = total**2 / np.maximum(samples, 1.0)
    if chi2_sf(float(statistic.sum()), _BLOCKS) > _LEVEL:
        return None
    doubled = np.concatenate([statistic, statistic])[:-1] - 1
    sums = np.concatenate([[0.0], np.cumsum(doubled)])
    best, found = -math.inf, (0, 1)
    for length in range(1, _BLOCKS + 1):
        run = (sums[length : length + _BLOCKS] - sums[:_BLOCKS]) / math.sqrt(2 * length)
        k = int(np.argmax(run))
        if run[k] > best:
            best, found = float(run[k]), (k, length)
    width = FOUR_STROKE / _BLOCKS
    if found[1] == _BLOCKS:
        return (0.0, FOUR_STROKE)
    return found[0] * width, ((found[0] + found[1]) * width) % FOUR_STROKE or FOUR_STROKE


def order_powers(record: RecordNull, noise: NoiseModel) -> tuple[Array, Array] | None:
    """Engine orders (K,) [per revolution] in halves, and their power (K,), chi-squared with two degrees of freedom
    where nothing is missing; None without a crank angle."""
    orders = np.asarray(0.5 * np.arange(1, 2 * _HIGHEST_ORDER + 1), dtype=np.float64)
    power = np.zeros(len(orders))
    for name, e in record.residual.items():
        theta = crank_angle(record, record.time[name])
        if theta is None:
            return None
        r = _whitened(record, noise, name, e)
        for k, order in enumerate(orders):
            wave = np.exp(1j * order * theta)
            power[k] += abs(r @ wave) ** 2 / (0.5 * len(r))
    return orders, power / len(record.residual)


def _order(record: RecordNull, noise: NoiseModel) -> float | None:
    found = order_powers(record, noise)
    if found is None:
        return None
    orders, power = found
    k = int(np.argmax(power))
    outputs = len(record.residual)
    chance = chi2_sf(power[k] * outputs, 2 * outputs) * len(orders)
    return float(orders[k]) if chance < _LEVEL else None
