"""Pieces of an experiment: by time, and by engine cycle."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.errors import ExperimentError

from .channel import Channel
from .conditioning import changed, each, picked
from .header import name_list
from .units import FloatArray

if TYPE_CHECKING:
    from .experiment import Experiment

FOUR_STROKE = 4 * math.pi
# Records are often cut a few samples short of whole cycles; such a cycle still counts.
CYCLE_SLACK = 0.02
# Share of a length by which a last piece may be longer, as times are rounded.
_ROUNDED = 1e-9


def finite(value: Any, what: str) -> float:
    """A finite number as float; raises :class:`ExperimentError` otherwise."""
    number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not number or not abs(value) < math.inf or abs(value) > sys.float_info.max:
        raise ExperimentError(
            f"{what} is not a number", seen=repr(value), allowed="a finite number", cure="correct it"
        )
    return float(value)


def between(experiment: Experiment, start: float, stop: float, *, inputs: Iterable[str] | None) -> Experiment:
    """Samples with start <= time <= stop [s]."""
    start, stop = finite(start, "start"), finite(stop, "stop")
    names = _inputs(experiment, inputs)
    channels = _cut(experiment, start, stop, names, closed=True)
    arguments = {"start": start, "stop": stop, "inputs": list(names)}
    return changed(experiment, "between", arguments, channels)


def pieces(experiment: Experiment, length: float, *, inputs: Iterable[str] | None) -> tuple[Experiment, ...]:
    """Pieces of equal length, of up to ``length`` s each."""
    length, names = finite(length, "length"), _inputs(experiment, inputs)
    if not length > 0:
        raise ExperimentError(
            "pieces have no length", seen=f"length={length:g}", allowed="length > 0 s", cure="give seconds"
        )
    start, stop = experiment.span
    count = math.ceil((stop - start) / length * (1 - _ROUNDED))
    if count < 2:
        return (experiment,)
    edges = np.linspace(start, stop, count + 1)
    found = []
    for k in range(count):
        channels = _cut(experiment, edges[k], edges[k + 1], names, closed=k == count - 1)
        arguments = {"start": float(edges[k]), "stop": float(edges[k + 1]), "inputs": list(names)}
        found.append(
            changed(experiment, "between", arguments, channels).renamed(f"{experiment.name}/{k + 1}")
        )
    return tuple(found)


def _inputs(experiment: Experiment, inputs: Iterable[str] | None) -> tuple[str, ...]:
    if inputs is None:
        return experiment.inputs
    return tuple(experiment[name].name for name in name_list(inputs, "inputs"))


def _cut(
    experiment: Experiment, start: float, stop: float, inputs: tuple[str, ...], *, closed: bool
) -> dict[str, Channel]:
    if not start < stop:
        raise ExperimentError(
            "the piece has no length",
            seen=f"{start:g} to {stop:g} s",
            allowed="start < stop",
            cure="swap them",
        )

    def cut(channel: Channel) -> Channel:
        first = int(np.searchsorted(channel.time, start, side="left"))
        last = int(np.searchsorted(channel.time, stop, side="right" if closed else "left"))
        if channel.name in inputs:
            # An input must cover the outputs, so it keeps the samples next to both ends of the piece.
            first = max(int(np.searchsorted(channel.time, start, side="right")) - 1, 0)
            last = min(int(np.searchsorted(channel.time, stop, side="left")) + 1, len(channel))
        if last - first < 2:
            raise ExperimentError(
                f"the piece leaves fewer than two samples of channel {channel.name!r}",
                seen=f"{start:.9g} to {stop:.9g} s",
                allowed=f"a longer piece of {channel.span[0]:.9g} to {channel.span[1]:.9g} s",
                cure="move start and stop",
            )
        return picked(channel, slice(first, last))

    return each(experiment, cut)


def crank_angle(experiment: Experiment, theta: str) -> tuple[FloatArray, FloatArray]:
    """Times [s] and angles [rad] of the valid samples of the crank angle, both increasing."""
    channel = experiment[theta]
    if channel.unit != "rad":
        raise ExperimentError(
            f"channel {theta!r} is not an angle",
            seen=channel.unit,
            allowed="rad",
            cure="name the angle by theta=",
        )
    time, angle = channel.time[channel.mask], channel.values[channel.mask]
    if time.size < 2:
        raise ExperimentError(
            f"the crank angle {theta!r} has fewer than two valid samples", seen=f"{time.size}", allowed="two"
        )
    later = angle[1:] > angle[:-1]
    if not later.all():
        index = int(np.flatnonzero(~later)[0]) + 1
        raise ExperimentError(
            f"the crank angle {theta!r} does not increase at {time[index]:.9g} s",
            seen=f"{angle[index]:.9g} rad after {angle[index - 1]:.9g} rad",
            allowed="an unwrapped, increasing angle",
            cure="unwrap it, for example by numpy.unwrap; where the crank really turns back, cut the record by between",
        )
    return time, angle


def whole_cycles(angle: FloatArray, *, cycle_length: float, tdc: float) -> tuple[int, int]:
    """First and last engine cycle that a record holds; the last is smaller when it holds none."""
    first = math.ceil((angle[0] - tdc) / cycle_length - CYCLE_SLACK) + 1
    last = math.floor((angle[-1] - tdc) / cycle_length + CYCLE_SLACK)
    return first, last


def cycles(
    experiment: Experiment,
    first: int,
    last: int,
    *,
    cycle_length: float,
    theta: str,
    tdc: float,
    inputs: Iterable[str] | None,
) -> Experiment:
    """Engine cycles first..last, both included."""
    cycle_length, tdc = finite(cycle_length, "cycle_length"), finite(tdc, "tdc")
    if cycle_length <= 0:
        raise ExperimentError(
            "cycle_length is not positive",
            seen=f"{cycle_length:g}",
            allowed="4 pi (four-stroke), 2 pi (two-stroke)",
        )
    time, angle = crank_angle(experiment, theta)
    low, high = whole_cycles(angle, cycle_length=cycle_length, tdc=tdc)
    whole = all(isinstance(k, int | np.integer) and not isinstance(k, bool) for k in (first, last))
    if not whole or not low <= first <= last <= high:
        held = f"{low} to {high}" if low <= high else "none: it is shorter than a cycle"
        raise ExperimentError(
            "those engine cycles are not whole in the record",
            seen=f"cycles {first!r} to {last!r}",
            allowed=f"first <= last, whole cycles of the record: {held}",
            cure="ask for cycles that the record holds",
        )
    start = crossing(tdc + (first - 1) * cycle_length, time, angle)
    stop = crossing(tdc + last * cycle_length, time, angle)
    names = _inputs(experiment, inputs)
    channels = _cut(experiment, start, stop, names, closed=False)
    arguments = {
        "first": int(first),
        "last": int(last),
        "cycle_length": cycle_length,
        "theta": theta,
        "tdc": tdc,
        "inputs": list(names),
    }
    return changed(experiment, "cycles", arguments, channels)


def crossing(target: float, time: FloatArray, angle: FloatArray) -> float:
    """Time at which the crank passes an angle; just outside the record when it never does."""
    if target < angle[0]:
        return float(time[0])
    if target > angle[-1]:
        return float(np.nextafter(time[-1], np.inf))
    return float(np.interp(target, angle, time))
