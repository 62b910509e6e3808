"""The time grid of one record: channels on it, and where the outputs were measured.

Where inputs and outputs were sampled together, or at rates that divide each other, the grid is that of the fastest
input, cut finer by a whole number where an output is faster than the inputs. Any other record has a grid of the times
at which anything was sampled: the outputs are evaluated where they were measured, an input has its corners where it
was sampled, and the grid grows with the samples and not with the time between them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ExperimentError, SimulationError
from casadi_engine.experiment import Channel, Experiment
from casadi_engine.experiment.channel import sampling_rate
from casadi_engine.experiment.decimation import Decimation
from casadi_engine.model import Model
from casadi_engine.model.arrival import arriving
from casadi_engine.model.late_inputs import between, finer
from casadi_engine.simulation.jets import Array

# Samples that lie closer to a grid point than this share of a step count as on it: files round their times, to
# microseconds for instance.
_ON_GRID = 1e-2
# The fourth power of a residual this large is a finite number still: squares of squares occur in step lengths.
_LARGEST = 1e70
# An output is faster than the inputs by more than this share.
_FASTER = 0.1
# An equally spaced grid has at most so many points for each that something was sampled at; else it holds gaps.
_SPARSE = 4
# Samples of two channels closer to each other than this share of the steps there are at one time.
_SAME = 1e-6


@dataclass(frozen=True)
class Measured:
    """One output's valid samples: time (N,), values (N,), and ``position`` (N,), the numbers of their grid points.

    index : of the samples in the channel; beyond : of those that a late sensor shows of the time before the record
    """

    time: Array
    values: Array
    position: NDArray[np.intp]
    index: NDArray[np.intp]
    beyond: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))


@dataclass(frozen=True)
class Grid:
    """start [s], step [s], samples N; channels on the grid, (N,) each; their holds; outputs by name.

    times : (N,) of a grid that is not equally spaced, whose ``step`` is the typical one; else None
    whole : of a record of a lower rate that of the record which it was made of, and how; else None
    parts : of each step of the record that its own steps are, for an input that acts late
    """

    start: float
    step: float
    samples: int
    rows: Sequence[Array]
    holds: tuple[str, ...]
    measured: dict[str, Measured]
    times: Array | None = None
    whole: tuple[Grid, Decimation] | None = None
    parts: int = 1

    @property
    def uniform(self) -> bool:
        """True if the points are equally spaced."""
        return self.times is None

    @cached_property
    def channels(self) -> Array:
        """(nu, N) side by side: a copy, unlike ``rows``, which a long record may share with its experiment."""
        return np.asarray(self.rows, dtype=np.float64).reshape(len(self.rows), self.samples)

    @property
    def time(self) -> Array:
        """(N,) s."""
        return self.time_at(np.arange(self.samples)) if self.times is None else self.times

    def time_at(self, points: NDArray[np.intp]) -> Array:
        """(k,) s of the points with these numbers."""
        if self.times is not None:
            return self.times[points]
        return np.asarray(self.start + self.step * points, dtype=np.float64)

    @property
    def span(self) -> float:
        """From the first to the last point [s]."""
        return float(self.time[-1] - self.time[0])

    def head(self, samples: int) -> Grid:
        """The first points of this one, of a record that is no other one's of a lower rate."""
        measured = {}
        for name, own in self.measured.items():
            keep = own.position < samples
            measured[name] = Measured(own.time[keep], own.values[keep], own.position[keep], own.index[keep])
        times = None if self.times is None else self.times[:samples]
        rows = [row[:samples] for row in self.rows]
        return Grid(self.start, self.step, samples, rows, self.holds, measured, times)


def lay_grid(model: Model, experiment: Experiment, *, outputs: tuple[str, ...] | None = None) -> Grid:
    """The grid of a record for a model; outputs not in ``outputs`` (default: all of the model's) are left out.

    Raises ExperimentError if channels are missing, have gaps in an input, or do not cover the outputs;
    SimulationError if there is nothing to take times from, or less than two samples.
    """
    wanted = tuple(v.name for v in model.outputs) if outputs is None else outputs
    experiment = arriving(model, experiment)
    units = {v.name: v.unit for v in model.outputs}
    experiment.require(
        inputs={v.name: v.unit for v in model.inputs}, outputs={name: units[name] for name in wanted}
    )
    inputs = [experiment[v.name] for v in model.inputs]
    observed = [experiment[name] for name in wanted]
    if not inputs and not observed:
        raise SimulationError(
            "the model takes no input and the record holds no output: there is no time grid",
            seen=f"{experiment.place}: {', '.join(experiment.names)}",
            allowed=f"a record with {', '.join(v.name for v in model.outputs)}",
            cure="give the record a channel for an output, with the times wanted",
        )
    for channel in (*inputs, *observed):
        _check_size(channel, experiment.place)
    first, last = _span(observed) if observed else _common_span(inputs, experiment.place)
    if experiment.begin is not None:
        first = min(first, max([experiment.begin, *(channel.span[0] for channel in inputs)]))
    if model.lags and observed:
        observed, last = _read_late(observed, dict(model.lags), first, last, experiment.place)
    found = _equally_spaced(
        inputs, observed, first, last, experiment.place, lags=[lag for _, lag in model.late]
    )
    if found is None:
        found = _of_all_times(inputs, observed, first, last)
    rows, holds = _with_rates(model, found)
    for name, late in model.late:
        channel, lag = experiment[name], between(late, found.step) * found.step
        at, before = (_shifted(channel, found.time, shift) for shift in (lag, lag + found.step))
        slope = (before - at) / found.step
        rows, holds = [*rows, at - lag * slope, slope], (*holds, *[channel.hold] * 2)
    found = replace(found, rows=rows, holds=holds, measured=_with_beyond(model, experiment, found))
    return found if experiment.decimation is None else _thinned(model, found, experiment.decimation)


def _thinned(model: Model, grid: Grid, made: Decimation) -> Grid:
    """The grid of a record of a lower rate, with that of its whole record; outputs count where the filter fits."""
    same = abs(grid.start - made.start) < _ON_GRID * made.step and grid.samples <= made.count
    if not same or abs(grid.step - made.factor * made.step) > _SAME * grid.step:
        raise SimulationError(
            "a record of a lower rate was cut or resampled after it was made",
            seen=f"{grid.samples} samples from {grid.start:.9g} s",
            allowed=f"up to {made.count} from {made.start:.9g} s: its inputs are taken from the whole record",
            cure="cut the whole record, and make the lower rate of that",
        )
    there = made.whole_filter(grid.samples)
    measured = {}
    for name, own in grid.measured.items():
        keep = there[own.position]
        measured[name] = Measured(
            own.time[keep], own.values[keep], own.position[keep], own.index[keep], own.beyond
        )
    whole = (lay_grid(model, made.whole, outputs=()), made) if model.inputs else None
    return replace(grid, measured=measured, whole=whole)


def _read_late(
    observed: list[Channel], lags: Mapping[str, float], first: float, last: float, place: str
) -> tuple[list[Channel], float]:
    """The outputs at the times whose values their sensors show, from ``first`` on, and the last of these times."""
    found = []
    for channel in observed:
        lag = lags.get(channel.name, 0.0)
        if lag:
            near = _ON_GRID * float(np.median(np.diff(channel.time)))
            time = channel.time - lag
            inside = (time >= first - near) & (time <= last + near)
            there = channel.mask & inside
            if there.sum() < 2:
                raise _too_short(place, int(there.sum()), last - first - abs(lag), near / _ON_GRID)
            channel = replace(channel, time=time, mask=there)
        found.append(channel)
    return found, _span(found)[1]


def _with_beyond(model: Model, experiment: Experiment, grid: Grid) -> dict[str, Measured]:
    """The outputs of a grid; late ones know which of their valid samples it does not hold."""
    found = dict(grid.measured)
    for name, lag in model.lags:
        if lag and name in found:
            gone = np.setdiff1d(np.flatnonzero(experiment[name].mask), found[name].index)
            found[name] = replace(found[name], beyond=gone)
    return found


def _equally_spaced(
    inputs: list[Channel],
    observed: list[Channel],
    first: float,
    last: float,
    place: str,
    *,
    lags: Sequence[float] = (),
) -> Grid | None:
    """The grid of the fastest input or output, if all samples lie on it and it is not mostly empty; of parts of its
    steps where inputs are late by no whole number of them."""
    leader = _leader(inputs or observed)
    rate = sampling_rate(leader.time, _ON_GRID)
    step = 1 / rate if rate else float(np.median(np.diff(leader.time)))
    step /= _refinement(step, observed)
    origin = leader.time[0] if rate else first
    start = origin + step * math.floor((first - origin) / step + _ON_GRID)
    points = (last - start) / step
    parts = max((finer(lag, step) for lag in lags), default=1)
    if points > _SPARSE * sum(len(c.time) for c in (*inputs, *observed)):
        return None
    points, step = points * parts, step / parts
    samples = math.ceil(points - _ON_GRID) + 1
    if samples < 2:
        raise _too_short(place, samples, last - first, step)
    time = np.asarray(start + step * np.arange(samples), dtype=np.float64)
    measured = {}
    for channel in observed:
        index, own, values = _valid(channel)
        at = _on_own_points(own, start, step)
        if at is None:
            return None
        at = index if np.array_equal(at, index) else at
        measured[channel.name] = Measured(own, values, at, index)
    if not all(_on_points(own, start, step, samples) for own in _distinct(inputs)):
        return None
    found = {id(own): _own_part(own, time, step) for own in _distinct(inputs)}
    rows = [
        channel.values[part] if (part := found[id(channel.time)]) else _sampled(channel, time, step)
        for channel in inputs
    ]
    return Grid(start, step, samples, rows, tuple(c.hold for c in inputs), measured, parts=parts)


def _valid(channel: Channel) -> tuple[NDArray[np.intp], Array, Array]:
    """Numbers of a channel's valid samples, their times and values; its own arrays where none is missing."""
    index = np.flatnonzero(channel.mask)
    if len(index) == len(channel.mask):
        return index, channel.time, channel.values
    return index, channel.time[index], channel.values[index]


def _with_rates(model: Model, grid: Grid) -> tuple[Sequence[Array], tuple[str, ...]]:
    """Channels of a grid with the rates that a model needs of them behind, and the holds of all.

    The rate of a channel is what it has behind a sample, where a late output is looked for (``model.lags``): the slope
    of the line that begins there, none of a stair.
    """
    if not model.rates:
        return grid.rows, grid.holds
    names, step, rates = [variable.name for variable in model.inputs], np.diff(grid.time), []
    for name in model.rates:
        row, hold = grid.rows[names.index(name)], grid.holds[names.index(name)]
        lines = hold == "first" and len(step) > 0
        ahead = np.diff(row) / step if lines else np.zeros(max(len(row) - 1, 0))
        rates.append(np.append(ahead, ahead[-1:] if len(ahead) else 0.0))
    return [*grid.rows, *rates], (*grid.holds, *["first"] * len(rates))


def _of_all_times(inputs: list[Channel], observed: list[Channel], first: float, last: float) -> Grid:
    """The grid of all times at which anything was sampled."""
    own = [c.time[c.mask] for c in observed] + [c.time[(c.time > first) & (c.time < last)] for c in inputs]
    times = _joined([np.array([first, last]), *own])
    step = float(np.median(np.diff(times)))
    rows = [_held(channel, times) for channel in inputs]
    measured = {}
    for channel in observed:
        index, at, values = _valid(channel)
        near = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
        near -= at - times[near - 1] < times[near] - at
        measured[channel.name] = Measured(at, values, near, index)
    holds = tuple(c.hold for c in inputs)
    return Grid(float(times[0]), step, len(times), rows, holds, measured, times)


def _joined(groups: list[Array]) -> Array:
    """The times of all groups in order, each time once; rounding apart, times of different groups may be one."""
    gaps = [np.diff(group) for group in groups if len(group)]
    spaces = [np.minimum(np.r_[np.inf, gap], np.r_[gap, np.inf]) for gap in gaps]
    time, space = np.concatenate([g for g in groups if len(g)]), np.concatenate(spaces)
    order = np.argsort(time, kind="stable")
    time, space = time[order], space[order]
    near = _SAME * np.minimum(space[1:], space[:-1])
    return time[np.concatenate([[True], np.diff(time) > np.where(np.isfinite(near), near, 0.0)])]


def _held(channel: Channel, times: Array) -> Array:
    """The channel at any times, by its hold."""
    if channel.hold == "first":
        return np.asarray(np.interp(times, channel.time, channel.values), dtype=np.float64)
    space = np.diff(channel.time)
    slack = _SAME * np.minimum(np.r_[space[0], space], np.r_[space, space[-1]])
    held = np.searchsorted(channel.time - slack, times, side="right") - 1
    return channel.values[np.clip(held, 0, len(channel.time) - 1)]


def _shifted(channel: Channel, times: Array, shift: float) -> Array:
    """The channel that much earlier than these times; one that is held on average over the step behind each of them, in
    which it may jump."""
    if channel.hold == "first" or len(times) < 2 or len(channel.time) < 2:
        return _held(channel, times - shift)
    steps = np.diff(channel.time)
    area = np.concatenate([[0.0], np.cumsum(channel.values[:-1] * steps)])
    ends = np.append(times, 2 * times[-1] - times[-2]) - shift
    before, behind = np.minimum(ends - channel.time[0], 0.0), np.maximum(ends - channel.time[-1], 0.0)
    whole = np.interp(ends, channel.time, area) + before * channel.values[0] + behind * channel.values[-1]
    return np.asarray(np.diff(whole) / np.diff(ends), dtype=np.float64)


def _distinct(channels: list[Channel]) -> list[Array]:
    """The channels' times; those that several share are one."""
    return list({id(c.time): c.time for c in channels}.values())


def _on_points(own: Array, start: float, step: float, samples: int) -> bool:
    """True if the samples (N,) of a channel within the grid lie on its points."""
    position = (own - start) / step
    inside = position[(position > 0) & (position < samples - 1)]
    return not inside.size or bool(np.abs(inside - np.rint(inside)).max() < _ON_GRID)


def _too_short(place: str, samples: int, span: float, step: float) -> SimulationError:
    return SimulationError(
        "the record is too short: there are fewer than two points of its time grid",
        seen=f"{place}: {samples} in {span:.6g} s, step {step:.6g} s",
        allowed="two or more",
        cure="take a longer record",
    )


def _span(channels: list[Channel]) -> tuple[float, float]:
    valid = [c.time[c.mask] for c in channels]
    return min(float(t[0]) for t in valid), max(float(t[-1]) for t in valid)


def _check_size(channel: Channel, place: str) -> None:
    """Raise for a value so large that sums of its square with others are not finite."""
    if channel.values.max(initial=0.0) <= _LARGEST and channel.values.min(initial=0.0) >= -_LARGEST:
        return  # none is, and none is NaN
    values = np.abs(np.where(channel.mask, channel.values, 0.0))
    if values.max(initial=0.0) > _LARGEST:
        index = int(values.argmax())
        raise ExperimentError(
            f"{place}, column {channel.name!r}: a value is too large to calculate with",
            seen=f"{float(channel.values[index]):g} {channel.unit} at {channel.time[index]:.9g} s",
            allowed=f"sizes up to {_LARGEST:g}",
            cure="correct the value, or mark the sample as missing if it is one of an output",
        )


def _common_span(inputs: list[Channel], place: str) -> tuple[float, float]:
    """Where all inputs are there, for a simulation without measured outputs."""
    first, last = max(c.span[0] for c in inputs), min(c.span[1] for c in inputs)
    if last <= first:
        raise SimulationError(
            "the inputs do not overlap in time",
            seen=f"{place}: "
            + ", ".join(f"{c.name} from {c.span[0]:.9g} to {c.span[1]:.9g} s" for c in inputs),
            allowed="a span of time that all inputs cover",
            cure="take records of the same run, or correct the times",
        )
    return first, last


def _refinement(step: float, outputs: list[Channel]) -> int:
    """Into how many parts to cut the inputs' step, so that the fastest output has a grid point for each sample."""
    rates = [(len(c.time) - 1) / (c.span[1] - c.span[0]) for c in outputs]
    return max([1, *(math.ceil(step * rate - _FASTER) for rate in rates)])


def _leader(channels: list[Channel]) -> Channel:
    """The channel that sets the grid: the uniform one with the highest rate, else the densest."""
    equal = {id(time) for time in _distinct(channels) if sampling_rate(time, _ON_GRID)}
    uniform = [c for c in channels if id(c.time) in equal]
    return max(uniform or channels, key=lambda c: (len(c.time) - 1) / (c.span[1] - c.span[0]))


def _own_part(own: Array, time: Array, step: float) -> slice | None:
    """The part of a channel's times (N,) that is the grid; None if there is no such part."""
    at = int(np.searchsorted(own, time[0] - 0.5 * step))
    part = slice(at, at + len(time))
    there = len(own[part]) == len(time) and np.abs(own[part] - time).max() < _ON_GRID * step
    return part if there else None


def _sampled(channel: Channel, time: Array, step: float) -> Array:
    """The channel's values at the grid times, by its hold."""
    if channel.hold == "first":
        return np.interp(time, channel.time, channel.values)
    held = np.searchsorted(channel.time, time + _ON_GRID * step, side="right") - 1
    return channel.values[np.clip(held, 0, len(channel.time) - 1)]


def _on_own_points(time: Array, start: float, step: float) -> NDArray[np.intp] | None:
    """Numbers of the grid's points at the times, or None if one has none of its own."""
    position = (time - start) / step
    nearest = np.rint(position)
    there = np.abs(position - nearest).max() < _ON_GRID and (np.diff(nearest) > 0).all()
    return nearest.astype(np.intp) if there else None
