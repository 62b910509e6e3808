"""Data that the repair was not found from: fresh records, or cycles held out; and the gap before and after on both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from casadi_engine.discrepancy.compression import scatter_columns
from casadi_engine.discrepancy.confirmation import (
    Gap,
    PairedGain,
    Residuals,
    gap,
    hold_out,
    is_foretold,
    paired_gain,
)
from casadi_engine.discrepancy.fresh_misfit import MEMORY
from casadi_engine.discrepancy.late_samples import beyond, leaving_out
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.noise_choice import NoiseChoice, scatter_of, white_p
from casadi_engine.discrepancy.noise_model import NoiseModel, left_over
from casadi_engine.discrepancy.null_model import FOUR_STROKE, Index, NullModel
from casadi_engine.discrepancy.parameter_doubt import doubted, pooled, within_errors
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.repaired import Side
from casadi_engine.errors import ExperimentError
from casadi_engine.estimation import Fit
from casadi_engine.experiment import Experiment
from casadi_engine.experiment.pace import paced
from casadi_engine.experiment.twins import refuse_twins, twin_of
from casadi_engine.model import Model
from casadi_engine.simulation.grid import lay_grid
from casadi_engine.validation.parameter_prior import PriorSplit, felt

Source = Literal["records", "cycles"]

# Fewest cycles that tell a gain from chance; fewest of a record that the search keeps.
_HELD, _KEPT = 3, 3
_PIECES = 10

# How it begins what is said of a gain that chance may make.
NOT_CONFIRMED = "fresh data do not confirm it"


@dataclass(frozen=True, eq=False)
class Portions:
    """data to search in; fresh ones to confirm on; where the fresh ones came from; and why there are none."""

    data: tuple[Experiment, ...]
    fresh: tuple[Experiment, ...]
    source: Source | None
    why: str | None = None


def check_fresh(model: Model, record: Experiment) -> None:
    """Raise ExperimentError for a record without the model's channels, without any of its outputs, or with no more
    samples than first states that are found there."""
    measured = tuple(out.name for out in model.outputs if out.name in record)
    if not measured:
        raise ExperimentError(
            f"{record.place} has nothing to confirm on",
            seen=", ".join(record.names),
            allowed=f"a record with {' or '.join(out.name for out in model.outputs)}",
            cure="give another fresh record, or none",
        )
    lay_grid(model, record, outputs=measured)
    samples, states = sum(int(record[name].mask.sum()) for name in measured), len(model.states)
    if samples <= states:
        raise ExperimentError(
            f"{record.place} is too short to confirm anything",
            seen=f"{samples} sample{'s' if samples != 1 else ''}",
            allowed=f"more than the {states} first state{'s' if states != 1 else ''} that are found there",
            cure="give a longer fresh record, or none",
        )


def portions(
    model: Model, data: tuple[Experiment, ...], fresh: tuple[Experiment, ...], *, share: float
) -> Portions:
    """Fresh records as they are; without them the last ``share`` of every record's cycles is held out, at least three
    cycles together, if three are left to search in. Raises ExperimentError for a fresh record that is searched in, and
    for one that is given twice."""
    outputs = [out.name for out in model.outputs]
    data, fresh = (tuple(paced(record, outputs) for record in own) for own in (data, fresh))
    refuse_twins(data, outputs)
    for record in fresh:
        twin = twin_of(record, data, outputs)
        if twin is not None:
            raise ExperimentError(
                f"{record.place} is to confirm what is found in the same data",
                seen=f"the measurements of {twin.place}, sample by sample",
                allowed="a record that the search does not see",
                cure="give another fresh record, or none: then the last cycles are held out",
            )
    if fresh:
        return Portions(data, fresh, "records")
    if share <= 0:
        return Portions(data, (), None, "no fresh data and nothing held out: nothing confirms what was found")
    numbers = [_cycles(model, record) for record in data]
    cycles = [sorted({int(n) for n in own}) for own, _ in numbers]
    total = sum(len(c) for c in cycles)
    word = "engine cycle" if _turns(model, data[0]) else "piece"
    if total < _HELD + _KEPT:
        many = f"{total} {word}{'s' if total > 1 else ''}"
        return Portions(
            data, (), None, f"no fresh data, and {many}: too few to hold {_HELD} out, so nothing is confirmed"
        )
    share = max(share, _HELD / total)
    kept, held = [], []
    for record, (number, time), own in zip(data, numbers, cycles, strict=True):
        _, last = hold_out(own, share=share)
        if not last:
            kept.append(record)
            continue
        stop = int(np.searchsorted(number, last[0]))
        inputs = [v.name for v in model.inputs if v.name in record]
        kept.append(record.between(float(time[0]), float(time[stop - 1]), inputs=inputs))
        held.append(record.between(float(time[stop]), float(time[-1]), inputs=inputs))
    return Portions(tuple(kept), tuple(held), "cycles")


def _turns(model: Model, record: Experiment) -> bool:
    return any(v.name == "theta" for v in model.inputs) and "theta" in record


def _cycles(model: Model, record: Experiment) -> tuple[Array, Array]:
    """Cycle number at each sample of the first measured output, never falling, and the samples' times. A last cycle of
    which less than half is there counts with the one before."""
    output = next((out.name for out in model.outputs if out.name in record), None)
    time = record[output].time if output is not None else np.linspace(*record.span, 11)
    if not _turns(model, record):
        share = (time - time[0]) / (time[-1] - time[0])
        return np.minimum(np.floor(share * _PIECES), _PIECES - 1), time
    theta = np.interp(time, record["theta"].time, record["theta"].values)
    turns = theta / FOUR_STROKE
    number = np.maximum.accumulate(np.floor(turns))
    if turns[-1] - np.floor(turns[-1]) < 0.5 and number[-1] > number[0]:
        number = np.minimum(number, number[-1] - 1)
    return number, time


# ---- the gap ------------------------------------------------------------------------------------------


def residuals(nulls: Sequence[NullModel], noise: NoiseModel) -> list[Residuals]:
    """Residuals of all outputs of all records, with the standard deviation of their noise, colour and all."""
    found = []
    for null in nulls:
        for record in null.records:
            for output, e in record.residual.items():
                spread = math.sqrt(_power(noise, record.name, output))
                measured = record.path.grid.measured[output].values
                cycle = _without_stubs(record.cycle[output])
                found.append(Residuals(record.name, output, e, measured, cycle, spread * noise.sigma[output]))
    return found


def _power(noise: NoiseModel, record: str, output: str) -> float:
    """Variance of an output's noise over that of its innovations; of a record that the search has not seen, the mean
    of those it has."""
    own = noise.colour.get((record, output))
    if own is not None:
        return float(own.variances[0])
    if any(name == record for name, _ in noise.colour):
        return 1.0
    others = [float(c.variances[0]) for (_, name), c in noise.colour.items() if name == output]
    return float(np.mean(others)) if others else 1.0


def _without_stubs(cycle: Index) -> Index:
    """Cycle numbers in which one of less than half the usual length counts with its neighbour."""
    numbers, counts = np.unique(cycle, return_counts=True)
    if len(numbers) < 2:
        return cycle
    short = numbers[counts < 0.5 * np.median(counts)]
    out = cycle.copy()
    for number in short:
        near = numbers[~np.isin(numbers, short)]
        out[cycle == number] = near[np.argmin(np.abs(near - number))]
    return out


def gap_of(nulls: Sequence[NullModel], noise: NoiseModel) -> Gap:
    """The gap of null models."""
    return gap(residuals(nulls, noise))


def told_by_both(
    before: Sequence[NullModel], after: Sequence[NullModel]
) -> tuple[list[NullModel], list[NullModel]]:
    """Two models by the samples that both tell of; first states go along, to first order."""
    lost = [beyond(one) for one in (*before, *after)]
    if not any(lost):
        return list(before), list(after)
    every = {
        key: np.unique(np.concatenate([own[key] for own in lost if key in own]))
        for own in lost
        for key in own
    }
    old, new = ([leaving_out(one, every, free=True) for one in models] for models in (before, after))
    return old, new


def side(
    pairs: Sequence[tuple[Fit, NullModel]],
    choice: NoiseChoice,
    *,
    source: Fit | None = None,
    other: Sequence[tuple[Fit, NullModel]] = (),
) -> Side:
    """What one side of the comparison shows: gap, whiteness of the residuals, traces.

    source : the fit whose parameters are held, on fresh data: what errors of these explain is no colour
    other : the other side; the gap is that of the samples that both tell of
    """
    white: dict[str, dict[str, float | None]] = {}
    traces: dict[str, Any] = {}
    splits: list[PriorSplit] = []
    shares: dict[str, list[tuple[float, float]]] = {}
    for fit, held_null in pairs:
        traces |= fit.traces
        null = held_null
        with suppress(*FAILURES):  # where no slopes are to be had, all of the gap stands for itself
            null = held_null if source is None else doubted(source, fit)
        parts: dict[tuple[str, str], tuple[Array, Array]] = {}
        if source is not None and null is not held_null:
            whole = residuals([null], choice.noise)
            splits.append(within_errors(source, null, whole))
            ends = np.cumsum([len(one.e) for one in whole])[:-1]
            each = (np.split(part, ends) for part in (splits[-1].within, splits[-1].frame))
            for one, part, frame in zip(whole, *each, strict=True):
                parts[one.record, one.output] = part * one.sigma, felt(frame)
                squares = float(one.e @ one.e) / one.sigma**2
                shares.setdefault(one.output, []).append((float(part @ part), squares))
        scatter = scatter_of(null, fit.data, choice.cylinders) if choice.scatter else ()
        random = {r.name: scatter_columns(r, scatter) for r in null.records} if scatter else None
        slopes = {record.name: dict(record.slopes) for record in null.records}
        left = left_over(null, choice.noise, slopes, random)
        for record in null.records:
            white[record.name] = {}
            for output in record.outputs:
                rest, held = left[record.name][output], record.slopes[output]
                if random is not None:
                    held = np.concatenate([held, random[record.name][output]], axis=1)
                elif (record.name, output) in parts:  # what others determine takes nothing of it
                    rest, held = parts[record.name, output]
                white[record.name][output] = white_p(record, output, rest, held)
    memory = MEMORY if choice.noise.colour else 1.0
    within, chance = pooled(splits, memory)
    found = gap_of(told_by_both([one for _, one in pairs], [one for _, one in other])[0], choice.noise)
    sums = {output: np.sum(own, axis=0) for output, own in shares.items()}
    still = {output: float(then / first) if first > 0 else 1.0 for output, (then, first) in sums.items()}
    return Side(found, white, traces, within, chance, tuple(fit for fit, _ in pairs), still)


@dataclass(frozen=True)
class Judgement:
    """What fresh data say: the gain per cycle; confirmed, or refused; and why not, in words."""

    gain: PairedGain | None
    confirmed: bool | None
    refused: bool = False
    why: str | None = None


def judge(before: Sequence[NullModel], after: Sequence[NullModel], noise: NoiseModel) -> Judgement:
    """Compare two models on fresh data, by the samples that both tell of."""
    old, new = (residuals(one, noise) for one in told_by_both(before, after))
    gain = paired_gain(old, new)
    if gain.confirmed is None or gain.mean is None or gain.se is None:
        return Judgement(gain, None, why=gain.why)
    if gain.confirmed:
        return Judgement(gain, True)
    part = "cycle" if any(v.name == "theta" for v in before[0].model.inputs) else "piece"
    size = f"{gain.mean:.3g} ± {gain.se:.2g} per {part}"
    found = sum(len(one.parameters) for one in after) - sum(len(one.parameters) for one in before)
    if gain.mean > 0 and not noise.colour and not noise.scatter and is_foretold(old, new, max(found, 0)):
        why = f"the gain differs from {part} to {part} as what the effects do does; what is left in all of them is the"
        return Judgement(gain, True, why=f"{why} noise of the search, which confirms it")
    if gain.refused:
        return Judgement(gain, False, True, f"fresh data refuse it: the gap grows, the gain is {size}")
    return Judgement(gain, False, False, f"{NOT_CONFIRMED}: the gain is {size}, which chance may make")
