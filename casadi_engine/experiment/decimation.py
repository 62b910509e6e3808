"""A record at a lower rate for the search of a fit: outputs filtered and thinned, inputs prepared for longer steps.

The filter is a root-raised-cosine: shifted by its own period it is orthogonal to itself, so that white noise stays
white. Inputs go through the same filter, which a linear model passes on to its outputs unchanged. Between two samples
of the lower rate an input is a straight line; corners that are sharpened make that line pass the same low frequencies.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .units import FloatArray

if TYPE_CHECKING:
    from .experiment import Experiment

# Roll-off of the filter and its reach to either side in samples of the lower rate: with these the noise stays white
# and the pass band (to a fifth of the lower rate) flat within 1e-3.
_ROLL_OFF, REACH = 0.6, 5
# 1/sinc^2, the loss of a straight line between samples, by second and fourth differences.
_SHARPER = (1 / 90, -1 / 12 - 4 / 90, 1 + 2 / 12 + 6 / 90, -1 / 12 - 4 / 90, 1 / 90)


@dataclass(frozen=True, eq=False)
class Decimation:
    """How a record of a lower rate came about.

    whole : the record it was made of: ``samples``, one every ``step`` seconds from ``start``; factor : of them that
    became one
    """

    whole: Experiment
    factor: int
    start: float
    step: float
    samples: int

    @property
    def count(self) -> int:
        """Samples of the lower rate."""
        return (self.samples - 1) // self.factor + 1

    def sampled(self, values: FloatArray, count: int, *, late: bool, sharp: bool) -> FloatArray:
        """(..., N) values of the whole record filtered, at ``count`` samples of the lower rate; (..., count).

        late : the values hold until the next sample, so that they stand for the middle of their step; sharp : for the
        corners of straight lines. Beyond its ends a record is taken to go on as its point reflection.
        """
        kernel = _kernel(self.factor, late, sharp)
        return _filtered(values, kernel, self.factor, count)

    def whole_filter(self, count: int) -> NDArray[np.bool_]:
        """(count,) True for the samples of the lower rate at which the filter lies within the whole record."""
        at, samples = np.arange(count) * self.factor, self.samples
        return (at >= REACH * self.factor) & (at <= samples - 1 - REACH * self.factor)

    @property
    def deviation(self) -> float:
        """Standard deviation of the filtered noise for one of 1."""
        return float(np.linalg.norm(_kernel(self.factor, False, False)))


def decimated(
    experiment: Experiment, inputs: tuple[str, ...], outputs: tuple[str, ...], factor: int
) -> Experiment:
    """The record with every channel at a rate ``factor`` times lower; outputs are missing where no filter fits.

    All channels have to be sampled together, equally spaced and complete.
    """
    channels = {name: experiment[name] for name in (*inputs, *outputs)}
    time = next(iter(channels.values())).time
    step = float((time[-1] - time[0]) / (len(time) - 1))
    count = (len(time) - 1) // factor + 1
    made = Decimation(experiment, factor, float(time[0]), step, len(time))
    coarse = time[0] + step * factor * np.arange(count)
    there = made.whole_filter(count)
    found = []
    for name, channel in channels.items():
        late = channel.hold == "zero" and name in inputs
        values = made.sampled(channel.values, count, late=late, sharp=False)
        if name not in inputs:
            values = np.where(there, values, np.nan)
        found.append(
            dataclasses.replace(
                channel,
                time=coarse,
                values=values,
                mask=np.isfinite(values),
                hold="first",
                rows=np.zeros(0, dtype=np.int64),
            )
        )
    begin = float(time[0]) if experiment.begin is None else experiment.begin
    return dataclasses.replace(experiment, channels=tuple(found), decimation=made, begin=begin)


@lru_cache(maxsize=64)
def _kernel(factor: int, late: bool, sharp: bool) -> FloatArray:
    """(2 reach factor + 1,) weights of the samples about one of the lower rate."""
    reach = REACH + (len(_SHARPER) // 2 if sharp else 0)
    at = np.arange(-reach * factor, reach * factor + 1) + (0.5 if late else 0.0)
    if not sharp:
        weights = _root_raised_cosine(at / factor)
        return _read_only(weights / weights.sum())
    weights = np.zeros(len(at))
    for shift, share in enumerate(_SHARPER, start=-(len(_SHARPER) // 2)):
        weights += share * _root_raised_cosine(at / factor - shift)
    return _read_only(weights / weights.sum())


def _read_only(weights: FloatArray) -> FloatArray:
    weights.setflags(write=False)
    return weights


def _root_raised_cosine(t: FloatArray) -> FloatArray:
    """The impulse response at t (in periods), 0 beyond its reach."""
    b = _ROLL_OFF
    pole = np.isclose(np.abs(4 * b * t), 1.0)
    safe = np.where(pole | (t == 0), 0.3, t)
    value = np.sin(np.pi * safe * (1 - b)) + 4 * b * safe * np.cos(np.pi * safe * (1 + b))
    value = value / (np.pi * safe * (1 - (4 * b * safe) ** 2))
    value = np.where(t == 0, 1 - b + 4 * b / np.pi, value)
    corner = np.pi / (4 * b)
    edge = b / np.sqrt(2) * ((1 + 2 / np.pi) * np.sin(corner) + (1 - 2 / np.pi) * np.cos(corner))
    return np.where(np.abs(t) > REACH, 0.0, np.where(pole, edge, value))


def _filtered(values: FloatArray, kernel: FloatArray, factor: int, count: int) -> FloatArray:
    """(..., N) through a kernel of odd length, at every ``factor``-th sample; block by block, in bounded memory."""
    half = len(kernel) // 2
    size = values.shape[-1]
    first, last = values[..., :1], values[..., -1:]
    more = max(0, (count - 1) * factor + half + 1 - size)
    before = 2 * first - values[..., _mirrored(half, size)]
    after = 2 * last - values[..., size - 1 - _mirrored(more, size)[::-1]]
    long = np.concatenate([before, values, after], axis=-1)
    blocks = -(-len(kernel) // factor)
    need = (count + blocks) * factor
    spare = np.zeros((*values.shape[:-1], max(0, need - long.shape[-1])))
    rows = np.concatenate([long, spare], axis=-1)[..., :need].reshape(*values.shape[:-1], -1, factor)
    weights = np.concatenate([kernel, np.zeros(blocks * factor - len(kernel))]).reshape(blocks, factor)
    total = rows[..., :count, :] @ weights[0]
    for k in range(1, blocks):
        total += rows[..., k : k + count, :] @ weights[k]
    return np.asarray(total, dtype=np.float64)


def _mirrored(count: int, size: int) -> NDArray[np.intp]:
    """Numbers ``count`` .. 1 of the samples that mirror those before the first; the last one if a record is short."""
    return np.minimum(np.arange(count, 0, -1), size - 1)


def rows_at_lower_rate(rows: FloatArray, factor: int, count: int) -> FloatArray:
    """(..., N) outputs filtered, at ``count`` samples of the lower rate; white noise keeps its size."""
    kernel = _kernel(factor, False, False)
    return _filtered(rows, kernel, factor, count) / float(np.linalg.norm(kernel))
