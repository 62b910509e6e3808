"""Records that hold the same measurement: counted twice they make errors that are too small, and confirm nothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ExperimentError
from casadi_engine.experiment.channel import Channel
from casadi_engine.experiment.experiment import Experiment

Array = NDArray[np.float64]

# Share of the shorter record's samples that both hold from which they are one measurement; of those, that are equal to
# the last digit. Values that occur once in each record, at least, which tell by how much its time was shifted.
_COMMON, _EQUAL, _FEWEST = 0.5, 0.95, 8
# Decimals of a file that was written with fewer of them than its source, at most.
_DECIMALS = 12
# Share of a step within which two times are the same one.
_TIME = 1e-3


def twin_of(record: Experiment, others: Iterable[Experiment], outputs: Sequence[str]) -> Experiment | None:
    """The first of the others that holds the same measurement as a record: half of its samples or more, in all outputs
    that both hold and that move, whether it was shifted in time, cut or thinned since. Two sensors at rest may well
    show the same."""
    return next((one for one in others if _same(record, one, outputs)), None)


def refuse_twins(records: Sequence[Experiment], outputs: Sequence[str]) -> None:
    """Raise ExperimentError for a measurement that is given twice."""
    for k, record in enumerate(records):
        twin = twin_of(record, records[:k], outputs)
        if twin is not None:
            raise ExperimentError(
                f"{record.place} is given twice",
                seen=f"the measurements of {twin.place}, sample by sample",
                allowed="records that were measured apart: the same one twice makes errors that are too small",
                cure="leave one of them out",
            )


def _same(one: Experiment, other: Experiment, outputs: Sequence[str]) -> bool:
    pairs = [(one[name], other[name]) for name in outputs if name in one and name in other]
    pairs = [(a, b) for a, b in pairs if _moves(a) and _moves(b)]
    if not pairs:
        return False
    if all(
        np.array_equal(a.time, b.time) and np.array_equal(a.values, b.values, equal_nan=True)
        for a, b in pairs
    ):
        return True
    if all(_is_rounded(a, b) for a, b in pairs):
        return True
    shift = next((found for a, b in pairs if (found := _shift(a, b)) is not None), None)
    return shift is not None and all(_overlap(a, b, shift) for a, b in pairs)


def _is_rounded(one: Channel, other: Channel) -> bool:
    """True if one channel holds what the other one does with fewer decimals."""
    if len(one.time) != len(other.time) or not np.allclose(
        one.time, other.time, rtol=0, atol=_within(one, other)
    ):
        return False
    both = one.mask & other.mask
    coarse, fine = sorted((one.values[both], other.values[both]), key=_decimals)
    # two sensors that read in wide steps may well show the same, and so do two at rest
    told = len(np.unique(coarse)) >= max(_FEWEST, _COMMON * len(coarse))
    if not told or _decimals(coarse) >= min(_decimals(fine), _DECIMALS):
        return False
    digits = _decimals(coarse)
    return bool(np.mean(np.abs(np.round(fine, digits) - coarse) <= _TIME * 10.0**-digits) >= _EQUAL)


def _decimals(values: Array) -> int:
    """The decimals that all of these values are written with, up to those of a table."""
    size = np.abs(values).max(initial=0.0)
    fits = (k for k in range(_DECIMALS) if np.all(np.abs(np.round(values, k) - values) <= 1e-12 * size))
    return next(fits, _DECIMALS)


def _moves(channel: Channel) -> bool:
    return bool(channel.mask.any()) and float(np.ptp(channel.values[channel.mask])) > 0


def _once(channel: Channel) -> tuple[Array, Array]:
    """The values that a channel shows once, in order, and their times."""
    values, first, count = np.unique(channel.values[channel.mask], return_index=True, return_counts=True)
    return values[count == 1], channel.time[channel.mask][first[count == 1]]


def _shift(one: Channel, other: Channel) -> float | None:
    """By how much the time of what both show once differs, where it does so by one amount for most; None elsewhere."""
    (values, time), (known, there) = _once(one), _once(other)
    _, own, its = np.intersect1d(values, known, assume_unique=True, return_indices=True)
    if len(own) < max(_FEWEST, _COMMON * min(len(values), len(known))):
        return None
    shift = there[its] - time[own]
    middle = float(np.median(shift))
    return middle if np.mean(np.abs(shift - middle) <= _within(one, other)) >= _EQUAL else None


def _within(one: Channel, other: Channel) -> float:
    """The difference of times that are the same one."""
    return _TIME * min(float(np.diff(a.time).min(initial=np.inf)) for a in (one, other))


def _overlap(one: Channel, other: Channel, shift: float) -> bool:
    """True if half of the shorter one's samples, or more, are at times of the other one, and show the same."""
    short, long, sign = (one, other, 1.0) if one.mask.sum() <= other.mask.sum() else (other, one, -1.0)
    time, values = long.time[long.mask], long.values[long.mask]
    at = short.time[short.mask] + sign * shift
    near = np.clip(np.searchsorted(time, at), 1, max(len(time) - 1, 1))
    near -= (at - time[near - 1]) < (time[near] - at)
    met = np.abs(time[near] - at) <= _within(one, other)
    equal = values[near[met]] == short.values[short.mask][met]
    return bool(met.sum() >= _COMMON * len(at) and np.mean(equal) >= _EQUAL)
