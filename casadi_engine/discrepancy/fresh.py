"""Data that the repair was not found from: fresh records, or cycles held out; and the gap before and after on both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from casadi_engine.discrepancy.assumed_pressure import SCATTER, is_carried, with_priors
from casadi_engine.discrepancy.compression import scatter_columns
from casadi_engine.discrepancy.confirmation import Gap, PairedGain, Residuals, gap, hold_out, paired_gain
from casadi_engine.discrepancy.fresh_misfit import MEMORY
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.noise_choice import NoiseChoice, scatter_of, white_p
from casadi_engine.discrepancy.noise_model import NoiseModel, left_over
from casadi_engine.discrepancy.null_model import FOUR_STROKE, Index, NullModel, null_model
from casadi_engine.discrepancy.parameter_doubt import doubted, pooled, within_errors
from casadi_engine.discrepancy.path import first_states_on
from casadi_engine.discrepancy.refit import Addition, Refitter
from casadi_engine.discrepancy.repaired import Side
from casadi_engine.discrepancy.start import Start
from casadi_engine.effects.candidate import cycles_of
from casadi_engine.errors import CasadiEngineError, ExperimentError
from casadi_engine.estimation import Fit, estimate
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.model.port_view import PortView
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise
from casadi_engine.validation.held import parameters_for
from casadi_engine.validation.parameter_prior import PriorSplit

Source = Literal["records", "cycles"]

# Fewest cycles that tell a gain from chance; fewest of a record that the search keeps.
_HELD, _KEPT = 3, 3
_PIECES = 10
# Fresh data whose chi-squared per sample is so many times that of the fit are tried from other initial states too.
_POOR = 1.1
# Iterations for first states from which no path led to rest: a model that is far off has none that fit.
_LOST, _MOST = 20, 60


@dataclass(frozen=True, eq=False)
class Portions:
    """data to search in; fresh ones to confirm on; where the fresh ones came from; and why there are none."""

    data: tuple[Experiment, ...]
    fresh: tuple[Experiment, ...]
    source: Source | None
    why: str | None = None


def portions(
    model: Model, data: tuple[Experiment, ...], fresh: tuple[Experiment, ...], *, share: float
) -> Portions:
    """Fresh records as they are; without them the last ``share`` of every record's cycles is held out, at least three
    cycles together, if three are left to search in. Raises ExperimentError for a fresh record that is searched in."""
    for record in fresh:
        twin = next((one for one in data if _same(model, one, record)), None)
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


def _same(model: Model, one: Experiment, other: Experiment) -> bool:
    """True if all outputs that both records hold have the same samples."""
    both = [out.name for out in model.outputs if out.name in one and out.name in other]
    pairs = [(one[name], other[name]) for name in both]
    return bool(pairs) and all(
        np.array_equal(a.time, b.time) and np.array_equal(a.values, b.values, equal_nan=True)
        for a, b in pairs
    )


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


# ---- parameters held, initial states found ------------------------------------------------------------


def held_fit(
    fit: Fit, record: Experiment, *, noise: NoiseModel, idle: Sequence[str] = (), model: Model | None = None
) -> Fit:
    """The fit's parameters held on one record; initial states, and what is wrong with assumed pressures, found.

    A parameter that varies by experiment has the value of the record of the same name; in a record of another name it
    is found there too, beside the scatter of the fit's records where three or more tell it (``parameters_for``).
    idle : amplitudes that are zero there; model : in place of the fit's, with the same parameters.
    Raises EstimationError where the model fails.
    """
    model = fit.model if model is None else model
    held = _held_parameters(fit, record, idle, model)
    levels: dict[str, Any] = {
        out.name: noise.sigma[out.name] for out in fit.model.outputs if out.name in noise.sigma
    }
    method = str(fit.options.get("method", "exact"))

    found, fault = None, None
    starts: list[Start | None] = [first_states_on(model, record, held, levels), None]
    for number in range(3):
        if number == 2:
            if found is None:
                break
            # a state that no output shows may rest elsewhere: on a side of a play, which short intervals lose
            starts.append(_unseen_from(fit, found))
        most = _LOST if number == 0 and (starts[0] is None or not starts[0].converged) else _MOST
        try:
            made = estimate(
                model, record, parameters=held, noise=Noise(**levels), method=method, warm=starts[number],
                progress=False, max_iterations=most,
            )  # fmt: skip
        except (CasadiEngineError, FloatingPointError) as error:
            fault = error
            continue
        if made.status == "interrupted":
            raise KeyboardInterrupt
        found = made if found is None else min(found, made, key=lambda one: (not one.converged, one.cost))
        if found.cost / found.n <= _POOR * _misfit(fit, noise):
            break
    if found is None:
        assert fault is not None
        raise fault
    return found


def _held_parameters(fit: Fit, record: Experiment, idle: Sequence[str], model: Model) -> Parameters:
    """The set for ``held_fit``: what assumed pressures carry is free again, for other cycles burn otherwise."""
    held, fresh = parameters_for(fit, record.name), model.parameters()
    for name in held:
        own = held[name]
        if is_carried(name) and name != SCATTER and own.tie is None:
            own.set(fresh[name].value)
        elif name in idle and own.tie is None:
            own.set(0.0, min=min(own.min, 0.0), max=max(own.max, 0.0))
            held.fix(name)
    return with_priors(held)


def _misfit(fit: Fit, noise: NoiseModel) -> float:
    """Chi-squared per sample of a fit on its own data, by the levels of another noise."""
    parts = [
        trace.residual[np.isfinite(trace.residual)] / noise.sigma[output]
        for traces in fit.traces.values()
        for output, trace in traces.items()
        if output in noise.sigma
    ]
    return float(np.mean(np.concatenate(parts) ** 2)) if parts else math.inf


def _unseen_from(fit: Fit, found: Fit) -> Start:
    """Initial states as found, but those that no output shows alone as in the records of a fit."""
    shown = {out.name() for out in ca.vertsplit(fit.model.output_expressions) if out.is_symbolic()}
    (name,) = found.initial
    own = {state: one.value for state, one in found.initial[name].items()}
    seen = next(iter(fit.initial.values()))
    own |= {state: one.value for state, one in seen.items() if state not in shown}
    return Start(found.values, {name: own})


def fresh_sides(
    fit: Fit, effects: Sequence[Addition], portion: Portions, noise: NoiseModel, refitter: Refitter
) -> list[tuple[Fit, NullModel]] | None:
    """The fit on all fresh records, parameters held; None where a simulation fails.

    Events of one record do not act in other ones. Those that last to the end of the data searched go on in the cycles
    held out; of a single cycle at the end nobody knows, so that it stops or goes on, whichever fits.
    """
    found = []
    for record in portion.fresh:
        idle = [e.amplitude for e in effects if e.placed and not _goes_on(e, record, portion)]
        try:
            fits = [
                held_fit(fit, record, noise=noise, idle=idle, model=model)
                for model in _continued(fit, effects, record, portion, refitter)
            ]
            held = min(fits, key=lambda one: one.cost)
            found.append((held, null_model(held)))
        except (CasadiEngineError, FloatingPointError):
            return None
    return found


def _continued(
    fit: Fit, effects: Sequence[Addition], record: Experiment, portion: Portions, refitter: Refitter
) -> list[Model]:
    """The models to be held on a record: events that last to the end of the data searched go on in it."""
    lasting = [e for e in effects if _goes_on(e, record, portion) and _lasts(e, fit, record, portion)]
    if not lasting:
        return [fit.model]
    values = record["theta"].values
    end = float(np.ceil(values.max() / FOUR_STROKE)) + 1
    longer = refitter.extended([_until(e, end) if e in lasting else e for e in effects])
    one = all(e.candidate.nuisance["first"] < e.candidate.nuisance["last"] for e in lasting)
    return [longer] if one else [fit.model, longer]


def _lasts(effect: Addition, fit: Fit, record: Experiment, portion: Portions) -> bool:
    """True for an event in cycles whose last one is the last of the data searched."""
    made = effect.candidate.source
    grid = made.effect.nuisance.get("last")
    searched = [one for one in portion.data if one.name == record.name]
    if grid is None or grid.over != "cycle" or "theta" not in record or not searched:
        return False
    view = PortView(made.model, made.model.ports[effect.candidate.port])
    numbers = {name: fit.values[name] for name in made.model.parameter_names if name in fit.values}
    return bool(made.values["last"] >= cycles_of(view, searched[0], numbers)[-1])


def _until(effect: Addition, last: float) -> Addition:
    """The event with another last cycle."""
    source = effect.candidate.source
    source = replace(source, values=dict(source.values) | {"last": last})
    return replace(effect, candidate=replace(effect.candidate, source=source))


def _goes_on(effect: Addition, record: Experiment, portion: Portions) -> bool:
    """True if an event of the search's record lasts into this one: cycles held out of it."""
    return portion.source == "cycles" and effect.record in (None, record.name)


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


def side(pairs: Sequence[tuple[Fit, NullModel]], choice: NoiseChoice, *, source: Fit | None = None) -> Side:
    """What one side of the comparison shows: gap, whiteness of the residuals, traces.

    source : the fit whose parameters are held, on fresh data: what errors of these explain is no colour
    """
    white: dict[str, dict[str, float | None]] = {}
    traces: dict[str, Any] = {}
    splits: list[PriorSplit] = []
    for fit, held_null in pairs:
        traces |= fit.traces
        null = held_null if source is None else doubted(source, fit)
        if source is not None:
            splits.append(within_errors(source, null, residuals([null], choice.noise)))
        scatter = scatter_of(null, fit.data, choice.cylinders) if choice.scatter else ()
        random = {r.name: scatter_columns(r, scatter) for r in null.records} if scatter else None
        slopes = {record.name: dict(record.slopes) for record in null.records}
        left = left_over(null, choice.noise, slopes, random)
        for record in null.records:
            white[record.name] = {}
            for output in record.outputs:
                held = record.slopes[output]
                if random is not None:
                    held = np.concatenate([held, random[record.name][output]], axis=1)
                p = white_p(record, output, left[record.name][output], held)
                white[record.name][output] = p
    memory = MEMORY if choice.noise.colour else 1.0
    within, chance = pooled(splits, memory)
    found = gap_of([null for _, null in pairs], choice.noise)
    return Side(found, white, traces, within, chance, tuple(fit for fit, _ in pairs))


@dataclass(frozen=True)
class Judgement:
    """What fresh data say: the gain per cycle; confirmed, or refused; and why not, in words."""

    gain: PairedGain | None
    confirmed: bool | None
    refused: bool = False
    why: str | None = None


def judge(before: Sequence[NullModel], after: Sequence[NullModel], noise: NoiseModel) -> Judgement:
    """Compare two models on fresh data."""
    gain = paired_gain(residuals(before, noise), residuals(after, noise))
    if gain.confirmed is None or gain.mean is None or gain.se is None:
        return Judgement(gain, None, why=gain.why)
    if gain.confirmed:
        return Judgement(gain, True)
    part = "cycle" if any(v.name == "theta" for v in before[0].model.inputs) else "piece"
    size = f"{gain.mean:.3g} ± {gain.se:.2g} per {part}"
    if gain.refused:
        return Judgement(gain, False, True, f"fresh data refuse it: the gap grows, the gain is {size}")
    return Judgement(
        gain, False, False, f"fresh data do not confirm it: the gain is {size}, which chance may make"
    )
