"""Channels of which most samples are missing, on the times at which they have some.

A table holds what was sampled slowly beside what was sampled fast, with empty cells between. Neighbours in time are
what tells of the colour of a noise, and such a channel has none: each is to be beside the one before it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from casadi_engine.experiment.channel import Channel
from casadi_engine.experiment.experiment import Experiment

# Share of the samples that have the next one beside them from which a channel is sampled at all its times, with gaps.
_BESIDE = 0.25


def paced(record: Experiment, names: Iterable[str]) -> Experiment:
    """The record with these of its channels on the times at which they have samples, where few of them have neighbours:
    evenly where they are so, with what is missing between. The same object where none is such a one."""
    found = {name: _paced(record[name]) for name in names if name in record}
    changed = {name: own for name, own in found.items() if own is not record[name]}
    if not changed:
        return record
    return replace(record, channels=tuple(changed.get(own.name, own) for own in record.channels))


def _paced(channel: Channel) -> Channel:
    at = np.flatnonzero(channel.mask)
    gaps = np.diff(at)
    if len(at) < 2 or np.count_nonzero(gaps == 1) >= _BESIDE * len(gaps):
        return channel
    keep = _even(at, int(np.bincount(gaps).argmax()))
    rows = channel.rows[keep] if len(channel.rows) else channel.rows
    return replace(
        channel, time=channel.time[keep], values=channel.values[keep], mask=channel.mask[keep], rows=rows
    )


def _even(at: NDArray[np.intp], step: int) -> NDArray[np.intp]:
    """Every ``step``-th sample from the first to the last one that is there, if that holds all of them, else these."""
    even = step > 1 and not ((at - at[0]) % step).any()
    return np.arange(at[0], at[-1] + 1, step) if even else at
