"""Filters and resampling: each verb changes the channels that it names and leaves the others alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.errors import ExperimentError

from .channel import Channel, Step, frozen, sampling_rate
from .header import name_list
from .holes import holes, holes_in, refuse_holes
from .units import FloatArray

if TYPE_CHECKING:
    from .experiment import Experiment

# A filter does not see a jitter of a thousandth of a step, such as times that were rounded when written.
FILTER_JITTER = 1e-3
MAX_ORDER = 12


def changed(
    experiment: Experiment,
    function: str,
    arguments: Mapping[str, Any],
    channels: Mapping[str, Channel],
) -> Experiment:
    """Experiment with some channels replaced and one more line of history."""
    rows_in = max((len(experiment[name]) for name in channels), default=0)
    rows_out = max((len(channel) for channel in channels.values()), default=0)
    return dataclasses.replace(
        experiment,
        channels=tuple(channels.get(channel.name, channel) for channel in experiment.channels),
        history=(*experiment.history, Step(function, dict(arguments), rows_in, rows_out)),
    )


def picked(channel: Channel, keep: Any) -> Channel:
    """Channel with some of its samples: an index array or a slice."""
    return dataclasses.replace(
        channel,
        time=channel.time[keep],
        values=channel.values[keep],
        mask=channel.mask[keep],
        rows=channel.rows[keep] if channel.rows.size else channel.rows,
    )


def _whole(value: Any, what: str, *, allowed: str, low: int, high: int | None = None) -> int:
    good = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not good or value < low or (high is not None and value > high):
        raise ExperimentError(
            f"{what} is not acceptable", seen=repr(value), allowed=allowed, cure="change the number"
        )
    return int(value)


def _some(channels: Mapping[str, Any], verb: str) -> None:
    if not channels:
        raise ExperimentError(
            f"{verb} was given no channel", cure=f"name the channels by keyword: {verb}(omega=15)"
        )


def resample(experiment: Experiment, factors: Mapping[str, int]) -> Experiment:
    """Keep every n-th sample of the named outputs alone, beginning with the first."""
    _some(factors, "resample")
    done: dict[str, Channel] = {}
    for name, factor in factors.items():
        channel = experiment[name]
        most = (len(channel) - 1) or 1
        number = _whole(
            factor,
            f"the resampling factor of {name!r}",
            allowed=f"a whole number from 1 to {most}, which leaves two samples",
            low=1,
            high=most,
        )
        done[name] = picked(channel, slice(None, None, number))
        if (name in experiment.inputs or not experiment.inputs) and holes(done[name]).size < holes(
            channel
        ).size:
            refuse_holes(
                experiment,
                channel,
                "among fewer samples the hole would not be seen any more",
                "split the record there by split_at_holes(); or say by with_inputs(...) which channels are inputs, if "
                f"{name!r} is none",
            )
    return changed(experiment, "resample", {name: int(factor) for name, factor in factors.items()}, done)


def low_pass(
    experiment: Experiment, *, cutoff_hz: float, order: int, channels: Iterable[str] | str
) -> Experiment:
    """Butterworth low-pass run forwards and backwards."""
    names = name_list(channels, "channels")
    if not names:
        raise ExperimentError("low_pass was given no channel", cure='name the channels: channels=("omega",)')
    order = _whole(
        order,
        "the order of the low-pass",
        allowed=f"a whole number from 1 to {MAX_ORDER}",
        low=1,
        high=MAX_ORDER,
    )
    for name in names:
        refuse_holes(
            experiment,
            experiment[name],
            "a low-pass would run across the hole",
            "split the record there by split_at_holes(), and filter the pieces",
        )
    done = {name: _low_passed(experiment[name], cutoff_hz, order) for name in names}
    arguments = {"cutoff_hz": float(cutoff_hz), "order": order, "channels": list(names)}
    return changed(experiment, "low_pass", arguments, done)


def _low_passed(channel: Channel, cutoff_hz: float, order: int) -> Channel:
    from scipy import signal

    what = f"channel {channel.name!r}"
    rate = sampling_rate(channel.time, FILTER_JITTER)
    if rate is None:
        raise ExperimentError(
            f"{what} is not sampled uniformly, so it cannot be low-pass filtered",
            seen=f"steps from {np.diff(channel.time).min():.4g} to {np.diff(channel.time).max():.4g} s",
            allowed="steps equal within a thousandth",
            cure="use moving_average, or give the channel on a uniform time",
        )
    if channel.missing:
        raise ExperimentError(
            f"{what} has missing samples, so it cannot be low-pass filtered",
            seen=f"{channel.missing} of {len(channel)} missing",
            allowed="no missing sample",
            cure="use moving_average, which leaves missing samples out, or cut the record there",
        )
    number = isinstance(cutoff_hz, int | float | np.number) and not isinstance(cutoff_hz, bool)
    if not number or not 0.0 < cutoff_hz < rate / 2:
        raise ExperimentError(
            "the cutoff frequency is not acceptable",
            seen=f"{cutoff_hz!r} Hz",
            allowed=f"more than 0 and less than half the rate of {what}: {rate / 2:.6g} Hz",
            cure="change cutoff_hz",
        )
    sections = signal.butter(order, cutoff_hz, fs=rate, output="sos")
    edge = 3 * (2 * len(sections) + 1)
    if len(channel) <= edge:
        raise ExperimentError(
            f"{what} is too short for this low-pass",
            seen=f"{len(channel)} samples",
            allowed=f"more than {edge} samples at order {order}",
            cure="lower the order or give a longer record",
        )
    # The ends are mirrored until the slowest pole, at 2 pi fc sin(pi / 2 order), has died away to 1e-9.
    settling = 20.7 / (2 * np.pi * cutoff_hz * np.sin(np.pi / (2 * order)))
    padding = min(max(edge, int(np.ceil(min(settling * rate, len(channel))))), len(channel) - 1)
    return dataclasses.replace(channel, values=signal.sosfiltfilt(sections, channel.values, padlen=padding))


def moving_average(experiment: Experiment, lengths: Mapping[str, int]) -> Experiment:
    """Centred mean over an odd number of samples."""
    _some(lengths, "moving_average")
    done: dict[str, Channel] = {}
    for name, length in lengths.items():
        channel = experiment[name]
        what = f"the window of {name!r}"
        number = _whole(
            length, what, allowed=f"an odd whole number from 1 to {len(channel)}", low=1, high=len(channel)
        )
        if number % 2 == 0:
            raise ExperimentError(
                f"{what} is even, so its mean would lie between two samples",
                seen=f"{number}",
                allowed="an odd number of samples",
                cure=f"use {number + 1} or {number - 1}",
            )
        done[name] = dataclasses.replace(channel, values=_averaged(channel, number))
    return changed(experiment, "moving_average", {name: int(n) for name, n in lengths.items()}, done)


def _averaged(channel: Channel, length: int) -> FloatArray:
    """Mean of the valid samples in a window that shrinks on both sides towards an end, and towards a hole.

    A window shrunk on both sides stays centred, so a straight line comes out unchanged up to its ends.
    """
    size, half = len(channel), length // 2
    if not channel.mask.any():
        return channel.values
    index = np.arange(size)
    cuts = holes_in(channel.time, channel.hold)
    piece = np.searchsorted(cuts, index, side="left")
    begin, end = np.append(0, cuts + 1)[piece], np.append(cuts, size - 1)[piece]
    reach = np.minimum(half, np.minimum(index - begin, end - index))
    centre = channel.values[channel.mask].mean()  # sums of small numbers keep their last digits
    total = np.concatenate([[0.0], np.cumsum(np.where(channel.mask, channel.values - centre, 0.0))])
    count = np.concatenate([[0], np.cumsum(channel.mask)])
    first, last = index - reach, index + reach + 1
    number = np.maximum(count[last] - count[first], 1)
    mean = centre + (total[last] - total[first]) / number
    return frozen(np.where(channel.mask, mean, np.nan), float)


def masked(experiment: Experiment, name: str, mask: Any) -> Experiment:
    """Mark further samples of a channel as missing."""
    channel = experiment[name]
    given = np.asarray(mask)
    if given.shape != channel.mask.shape or given.dtype != np.bool_:
        raise ExperimentError(
            f"the mask for channel {name!r} does not fit",
            seen=f"shape {given.shape}, type {given.dtype}",
            allowed=f"shape {channel.mask.shape}, type bool, True for a valid sample",
            cure="give one truth value for each sample",
        )
    done = dataclasses.replace(channel, mask=channel.mask & given)
    arguments = {"name": name, "newly_missing": done.missing - channel.missing}
    return changed(experiment, "masked", arguments, {name: done})


def each(experiment: Experiment, change: Callable[[Channel], Channel]) -> dict[str, Channel]:
    """Apply a change to every channel; channels on one time array keep sharing it afterwards."""
    times: dict[int, FloatArray] = {}
    done: dict[str, Channel] = {}
    for channel in experiment.channels:
        new = change(channel)
        known = times.setdefault(id(channel.time), new.time)
        if known is not new.time and np.array_equal(known, new.time):
            new = dataclasses.replace(new, time=known)
        done[channel.name] = new
    return done
