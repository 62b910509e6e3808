"""A simulated record on one time axis, as a data file has it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from casadi_engine.experiment import Channel, Experiment

# Times that differ by less than this share of a step are the same sample, reached by different roundings.
SAME_SAMPLE = 1e-3

Time = NDArray[np.float64]


def on_one_time(experiment: Experiment, outputs: Sequence[str]) -> Experiment:
    """Return the experiment with all channels on the time of its simulated `outputs`.

    An input that was recorded at the same samples lends its times, as they stood in its file. One with other
    times is taken at those of the outputs, by its own hold.
    """
    grid = experiment[outputs[0]].time
    inputs = [experiment[name] for name in experiment.names if name not in outputs]
    time = next((channel.time for channel in inputs if _same(channel.time, grid)), grid)
    result = experiment
    for name in experiment.names:
        channel = experiment[name]
        if channel.time is not time:
            result = result.with_channel(_moved(channel, time))
    return result


def _same(time: Time, other: Time) -> bool:
    if time.size != other.size:
        return False
    return bool(np.abs(time - other).max() <= SAME_SAMPLE * np.diff(other).min())


def _moved(channel: Channel, time: Time) -> Channel:
    """The channel at other times: its own samples where the times are the same, else by its hold."""
    if _same(channel.time, time):
        values = channel.values
    elif channel.hold == "first":
        values = np.interp(time, channel.time, channel.values)
    else:
        slack = SAME_SAMPLE * np.diff(time).min()
        held = np.searchsorted(channel.time, time + slack, side="right") - 1
        values = channel.values[np.maximum(held, 0)]
    nothing = np.zeros(0, dtype=bool), np.zeros(0, dtype=np.int64)
    return dataclasses.replace(channel, time=time, values=values, mask=nothing[0], rows=nothing[1])
