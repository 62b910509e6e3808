"""Samples of a fit that its sensor, or what records it, made up: a few wild ones, a limit, a row that stands still."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.fit import Fit, Trace
from casadi_engine.estimation.loss import loss_of
from casadi_engine.experiment.resolution import step_of

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Key of a fit's options under which is kept what else may be wrong with its data.
IN_DOUBT = "data in doubt"
# Fewest samples by which anything is said of an output.
_FEW = 8
# Standard deviations, by the median, beyond which a sample is wild; share of all squared residuals that wild ones hold
# where they decide the fit; share of the samples that they are at most, and up to which they are single faults: more
# are the tails of a noise that is not normal, for which there is a loss.
_WILD, _DECIDE, _MOST, _RARE = 8.0, 0.5, 0.2, 0.01
# A code for a missing value: samples, so many in a row at most, that stand out of those around them by so many times
# the usual step from one sample to the next, by its quantile, where those beside them stand out by few.
_ROWS, _FAR_OUT, _AROUND, _USUAL = 4, 20.0, 5.0, 0.95
# Share of its median absolute deviation that the standard deviation of a normal variable is.
_MAD = 1.4826
_NAMED = 5
# Equal samples in a row from which a sensor stands still that is never so for a tenth as long elsewhere; how often
# second differences change sign where noise is in them, without which that may be a machine at rest (white noise does
# in 0.73 of all samples, smooth motion in next to none); times the level of the noise by which the simulation moves
# meanwhile.
_ROW, _ELSEWHERE, _NOISY, _MEANWHILE = 10, 10, 0.5, 5.0
# Times that an output comes to its limit, and samples, or share of all, in which it is there then; and how many times
# as many as it shows a value beside it again, which a counter does with all of them.
_TIMES, _LIMITED, _PART, _OFTEN = 2, 6, 0.005, 4
# Values next to a limit that tell how often one comes back where there is none.
_BESIDE = 10


def faults(fit: Fit) -> tuple[str, ...]:
    """All that follows, and outputs without any noise to estimate, as they are one number everywhere; in words."""
    found = (_constant(fit), wild_samples(fit, tails=True), at_its_limit(fit), stands_still(fit))
    return tuple(words for words in found if words is not None)


def _constant(fit: Fit) -> str | None:
    found = []
    for output, (_, estimated) in fit.noise.items():
        traces = [own[output] for own in fit.traces.values() if output in own]
        if not (estimated and traces):
            continue
        values = np.concatenate([np.unique(one.measured[one.mask]) for one in traces])
        if sum(len(one.time) for one in traces) >= _FEW and len(np.unique(values)) == 1:
            found.append(f"{output} is {values[0]:.6g} in all samples")
    if not found:
        return None
    return (
        f"{' and '.join(found)}, without any noise: nothing can be learnt from that; look whether the sensor is "
        "connected and the channel is the right one"
    )


def wild_samples(fit: Fit, *, tails: bool = False) -> str | None:
    """What to say where a few single samples hold most of the squared residuals: they decide what is fitted, and what
    could be seen beside them. None where there are none, or the loss is one that they do not decide.

    tails : also of so many that they are the tails of a noise
    """
    if loss_of(fit).robust:
        return None
    found, count, cure, many = [], 0, "", False
    for record, traces in fit.traces.items():
        for output, trace in traces.items():
            places = _wild(trace, _MOST if tails else _RARE)
            if not len(places):
                continue
            count, many = count + len(places), many or len(places) > max(1, _RARE * trace.mask.sum())
            times = ", ".join(f"{time:.6g}" for time in trace.time[places[:_NAMED]])
            more = f" and {len(places) - _NAMED} more" if len(places) > _NAMED else ""
            found.append(f"{output} of {record} at {times} s{more}")
            cure = cure or _left_out(output)
    if not found:
        return None
    one = count == 1
    sample = "1 single sample holds" if one else f"{count} single samples hold"
    those = "It decides the fit, and hides" if one else "They decide the fit, and hide"
    if many:
        cure += ', or fit with loss="huber", which bounds what each does'
    return (
        f"{sample} most of what the model leaves: {'; '.join(found[:_NAMED])}. {those} what is missing: leave "
        f"{'it' if one else 'them'} out, {cure}, if {'it is a fault' if one else 'they are faults'} of the measurement"
    )


def at_its_limit(fit: Fit) -> str | None:
    """What to say where an output comes back to its largest or least value exactly, or stays there for long beside
    noise elsewhere, though it does not read in steps: its sensor is at its limit there, which no effect of the model
    is. None where there is none."""
    found, cure = [], ""
    for record, traces in fit.traces.items():
        for output, trace in traces.items():
            y = trace.measured[trace.mask]
            if len(y) < _FEW or step_of(y) is not None:
                continue
            counts = np.unique(y, return_counts=True)[1]
            for limit, side, others in ((y.max(), "more", counts[::-1]), (y.min(), "less", counts)):
                # what reads in steps, which may be written unevenly, comes back to any value beside this one
                usual = int(others[1 : 1 + _BESIDE].max(initial=1))
                there = y == limit
                times = int(there[0]) + int(np.count_nonzero(~there[:-1] & there[1:]))
                # at rest a sensor reads 0 exactly, which is no limit
                least = max(_LIMITED, _PART * len(y), _OFTEN * (usual - 1))
                if limit == 0 or there.sum() < least:
                    continue
                row = None if times >= _TIMES else _longest_row(trace)
                if times >= _TIMES or (row is not None and trace.measured[row[0]] == limit):
                    found.append(
                        f"{output} of {record} reads {limit:.6g} in {int(there.sum())} samples and never {side}"
                    )
                    cure = cure or _left_out(output)
    if not found:
        return None
    return (
        f"{'; '.join(found[:_NAMED])}: the sensor is at its limit there, and reads something else than what it "
        f"measures: leave these samples out, {cure}"
    )


def stands_still(fit: Fit) -> str | None:
    """What to say where an output that has noise reads one number for a while, and the simulation moves meanwhile: its
    sensor, or what records it, stood still. None where there is none."""
    found, cure = [], ""
    for record, traces in fit.traces.items():
        for output, trace in traces.items():
            row = _longest_row(trace, moving=True)
            if row is None:
                continue
            time = trace.time[row]
            found.append(
                f"{output} of {record} reads {trace.measured[row[0]]:.6g} in all {len(row)} samples from "
                f"{time[0]:.6g} to {time[-1]:.6g} s"
            )
            cure = cure or _left_out(output)
    if not found:
        return None
    return (
        f"{'; '.join(found[:_NAMED])}, though it has noise elsewhere, and the simulation moves meanwhile: the sensor, "
        f"or what records it, is frozen there: leave these samples out, {cure}"
    )


def _left_out(output: str) -> str:
    return f'with empty cells in their file or record.masked("{output}", keep), keep False there'


def _longest_row(trace: Trace, *, moving: bool = False) -> Index | None:
    """Numbers of the samples of the longest row of equal ones, where there is noise elsewhere; moving : where no
    machine at rest is."""
    there = np.flatnonzero(trace.mask)
    y = trace.measured[there]
    if len(y) < 2 * _ROW or step_of(y) is not None:
        return None
    edges = np.flatnonzero(np.r_[True, np.diff(y) != 0, True])
    lengths = np.diff(edges)
    k = int(np.argmax(lengths))
    others = max(np.delete(lengths, k).max(initial=1), 1)
    if lengths[k] < max(_ROW, _ELSEWHERE * others) or len(y) - lengths[k] < _ROW:
        return None
    first, last = edges[k], edges[k + 1]
    outside = np.r_[y[:first], np.nan, y[last:]]
    twice = np.diff(outside, 2)
    noise = float(np.nanmedian(np.abs(twice))) / np.sqrt(6) * _MAD
    turns = twice[:-1] * twice[1:]
    if not np.mean(turns[np.isfinite(turns)] < 0) > _NOISY:
        return None
    row = there[first:last]
    return row if not moving or float(np.ptp(trace.simulated[row])) > _MEANWHILE * noise else None


def _wild(trace: Trace, most: float) -> Index:
    """Numbers of the samples whose residual, and not their neighbours', is far beyond the others', where they hold most
    of its squares: what an event does lasts for more than one sample, and where the output runs through its range from
    one sample to the next, a value between its neighbours is none that its sensor made up. most : share of the samples
    that they are at most"""
    there = np.flatnonzero(trace.mask)
    e = trace.residual[there]
    if len(e) < _FEW:
        return there[:0]
    off = np.abs(e - np.median(e))
    beyond = off > _WILD * _MAD * max(float(np.median(off)), 1e-300)
    near = np.r_[False, beyond[:-1]] | np.r_[beyond[1:], False]
    single = beyond & ~near
    single &= _outside(trace, there) > _WILD * _MAD * max(float(np.median(off)), 1e-300)
    few = single.sum() <= max(1, most * len(e))
    found = there[single] if few and off[single] @ off[single] > _DECIDE * (off @ off) else there[:0]
    return np.union1d(found, _spikes(trace, there))


def _spikes(trace: Trace, there: Index) -> Index:
    """Numbers of samples, up to a few in a row, that stand far out of what is measured around them, and that the
    simulation does not show: a fit that bends to them leaves nothing that is small beside what it leaves there."""
    y = trace.measured[there]
    usual = float(np.quantile(np.abs(np.diff(y)), _USUAL))
    padded = np.pad(y, _ROWS, mode="edge")
    out = np.abs(y - np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * _ROWS + 1), axis=1))
    edges = np.flatnonzero(np.diff(np.r_[0, out > _AROUND * usual, 0]))
    lengths = np.repeat(np.diff(np.r_[0, edges, len(y)]), np.diff(np.r_[0, edges, len(y)]))
    spikes = (out > _FAR_OUT * usual) & (lengths <= _ROWS) & (np.abs(trace.residual[there]) > 0.5 * out)
    return there[spikes] if usual > 0 and spikes.sum() <= max(_ROWS, _RARE * len(y)) else there[:0]


def _outside(trace: Trace, there: Index) -> Array:
    """(N,) by how much each measured sample lies outside all that is measured in the samples next to it, and simulated
    there."""
    y, simulated = trace.measured[there], trace.simulated[there]
    padded, around = np.pad(y, 1, mode="edge"), np.pad(simulated, 1, mode="edge")
    others = np.stack([padded[:-2], padded[2:], around[:-2], simulated, around[2:]])
    return np.asarray(np.maximum(others.min(axis=0) - y, y - others.max(axis=0)))
