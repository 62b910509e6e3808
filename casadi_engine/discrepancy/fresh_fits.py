"""A fit on data that it was not found from: parameters held, initial states and what is each record's own found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from casadi_engine.deadline import Deadline, TimeUp, best_wanted, late, unmetered, work_left
from casadi_engine.discrepancy.assumed_pressure import SCATTER, is_carried, with_priors
from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.clocks import clock_of
from casadi_engine.discrepancy.event_times import finer_candidates
from casadi_engine.discrepancy.events import place_of_event
from casadi_engine.discrepancy.first_states import first_states_on
from casadi_engine.discrepancy.fresh import Portions
from casadi_engine.discrepancy.library_candidates import library_candidates
from casadi_engine.discrepancy.linearised import one_step
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import FOUR_STROKE, NullModel, null_at, null_model
from casadi_engine.discrepancy.refit import Addition, Refitter
from casadi_engine.discrepancy.start import Start
from casadi_engine.effects import Effect
from casadi_engine.effects.candidate import cycles_of
from casadi_engine.effects.protocol import Attachment, moves
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Fit, estimate
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.model.port_view import PortView
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise
from casadi_engine.validation.held import parameters_for

# Fresh data whose chi-squared per sample is so many times that of the fit, and more than it is by chance, are tried
# from other initial states too.
_POOR = 1.1
# A further start may take so many times the work of those before: one that loses the motion takes ever shorter steps.
_PATIENCE = 10.0
# Of the work that is allowed, what one start may take while there is no answer from another one: some lead nowhere.
_SHARE = 0.5
# Share of chi-squared by which two optima are the same.
_SAME = 1e-3
# Iterations for first states from which no path led to rest: a model that is far off has none that fit.
_LOST, _MOST = 20, 60
# The status of a simulation whose first states had not settled.
_UNSETTLED = "not converged: its initial states had not settled"
# An effect that was found, or that the user's model has.
Event = Addition | Attachment
# Name of a parameter -> its start, least and largest value.
Places = Mapping[str, tuple[float, float, float]]


def held_fit(
    fit: Fit,
    record: Experiment,
    *,
    noise: NoiseModel,
    idle: Sequence[Event] = (),
    model: Model | None = None,
    places: Places | None = None,
    known: Mapping[str, float] | None = None,
    once: bool = False,
) -> Fit:
    """The fit's parameters held on one record; initial states, and what is wrong with assumed pressures, found.

    A parameter that varies by experiment has the value of the record of the same name; in a record of another name it
    is found there too, beside the scatter of the fit's records where three or more tell it (``parameters_for``).
    idle : effects that do not act there; model : in place of the fit's, with the same parameters; places : parameters
    to be found there, name -> (start, least, most); known : first states by which another structure describes it;
    once : from one start, as it is only to show where an event happens.
    Raises EstimationError where the model fails.
    """
    model = fit.model if model is None else model
    held = _held_parameters(fit, record, idle, model, {} if places is None else places)
    levels: dict[str, Any] = {
        out.name: noise.sigma[out.name] for out in fit.model.outputs if out.name in noise.sigma
    }
    method = str(fit.options.get("method", "exact"))

    found: Fit | None = None
    fault: BaseException | None = None
    with Deadline(best=best_wanted()) as begun:
        near = first_states_on(model, record, held, levels, in_places=_in_places(fit))
    leads = near is not None
    if near is not None and not any(held[name].vary for name in held):
        with begun:
            found = _simulated(fit, near, model, record, held, levels)
        enough = found is not None and found.cost / found.n <= _chance(found) * _misfit(fit, noise)
        if found is not None and near.converged and (once or enough):
            return found
        leads = found is not None and not found.converged  # what cannot be simulated leads nowhere
    starts = _starts(
        fit, near if leads else None, None if known is None else _from_known(fit, model, record, known, near)
    )
    if len(starts) == 1 and found is None:  # from the measurement alone
        starts = [(None, _LOST)]
    last, spent, alike = len(starts), begun.done, False
    for number in range(last + 1):
        if alike and number < last:  # two searches have ended at one optimum
            continue
        if number == last:
            if found is None:
                break
            # a state that no output shows may rest elsewhere: on a side of a play, which short intervals lose
            starts.append((_unseen_from(fit, found), _MOST))
        start, most = starts[number]
        work = _SHARE * work_left() if found is None else _PATIENCE * spent
        limit = Deadline(work=work, best=best_wanted())
        try:
            with limit:
                made = estimate(
                    model, record, parameters=held, noise=Noise(**levels), method=method, warm=start,
                    progress=False, max_iterations=most, interval=fit.options.get("interval", "auto"),
                    errors="quadratic",
                )  # fmt: skip
        except (CasadiEngineError, FloatingPointError, TimeUp) as why:
            if isinstance(why, TimeUp) and (found is not None or late()):
                if found is None:
                    raise
                break
            fault = why
            continue
        finally:
            spent += limit.done
        alike = alike or (found is not None and _alike(made, found))
        found = made if found is None else _better(found, made)
        if found.cost / found.n <= _chance(found) * _misfit(fit, noise):
            break
    if found is None:
        found = _from_own_records(fit, model, record, held, levels)
    if found is None:
        assert fault is not None
        raise fault
    return found


def _starts(fit: Fit, near: Start | None, known: Start | None) -> list[tuple[Start | None, int]]:
    """Where searches for first states begin, the measurement last, and their iterations."""
    found: list[tuple[Start | None, int]] = []
    if near is not None:
        found.append((replace(near, in_places=_in_places(fit)), _MOST if near.converged else _LOST))
    if known is not None:
        found.append((known, _MOST))
    return [*found, (None, _MOST)]


def _from_own_records(
    fit: Fit, model: Model, record: Experiment, held: Parameters, levels: Mapping[str, Any]
) -> Fit | None:
    """The same from where the records of the fit begin, where the model has no value by what the measurement gives to
    begin at; None where it has none there either."""
    for own in fit.initial.values():
        first = {state.name: own[state.name].value for state in model.states if state.name in own}
        start = Start(fit.values, {record.name: first}, in_places=_in_places(fit))
        with suppress(CasadiEngineError, FloatingPointError):
            return estimate(
                model, record, parameters=held, noise=Noise(**levels), warm=start, progress=False,
                method=str(fit.options.get("method", "exact")), interval=fit.options.get("interval", "auto"),
                max_iterations=_MOST, errors="quadratic",
            )  # fmt: skip
    return None


def _from_known(
    fit: Fit, model: Model, record: Experiment, known: Mapping[str, float], near: Start | None
) -> Start:
    """First states as another structure has them; of those that it lacks, as found so far, or none."""
    own = {} if near is None else dict(near.initial.get(record.name, {}))
    first = {state.name: known.get(state.name, own.get(state.name, 0.0)) for state in model.states}
    return Start(fit.values, {record.name: first}, in_places=_in_places(fit))


def _simulated(
    fit: Fit, near: Start, model: Model, record: Experiment, held: Parameters, levels: Mapping[str, Any]
) -> Fit | None:
    """The simulation of a record from first states that were found, as a Fit of nothing; None where there is none, or
    none at the cost that is allowed."""
    try:
        with Deadline(work=_SHARE * work_left(), best=best_wanted()):
            made = estimate(
                model, record, parameters=held, noise=Noise(**levels), initial=near.initial[record.name],
                method=str(fit.options.get("method", "exact")), warm=replace(near, in_places=_in_places(fit)),
                errors="quadratic", interval=fit.options.get("interval", "auto"), progress=False,
            )  # fmt: skip
    except (CasadiEngineError, FloatingPointError):
        return None
    except TimeUp:
        if late():
            raise
        return None
    return made if near.converged else replace(made, status=_UNSETTLED)


def _better(one: Fit, other: Fit) -> Fit:
    """The fit of lower chi-squared; of two that are alike within chance the one that converged."""
    if one.converged != other.converged:
        ready, open_ = (one, other) if one.converged else (other, one)
        return ready if ready.cost <= _chance(ready) * open_.cost else open_
    return min(one, other, key=lambda fit: fit.cost)


def _alike(one: Fit, other: Fit) -> bool:
    """True if two searches from different starts ended at one optimum."""
    return one.converged and other.converged and abs(one.cost - other.cost) <= _SAME * other.cost


def _chance(found: Fit) -> float:
    """Ratio of chi-squared per sample that chance may make between these data and others."""
    return max(_POOR, 1 + 3 * math.sqrt(2 / found.n))


def _held_parameters(
    fit: Fit, record: Experiment, idle: Sequence[Event], model: Model, places: Places
) -> Parameters:
    """The set for ``held_fit``: what assumed pressures carry is free again, for other cycles burn otherwise."""
    held, fresh = parameters_for(fit, record.name), model.parameters()
    amplitudes = [one.amplitude for one in idle]
    stems = tuple(f"{one.key}." for one in idle)
    for name in held:
        own = held[name]
        if is_carried(name) and name != SCATTER and own.tie is None:
            own.set(fresh[name].value)
        elif name in places:
            value, low, high = places[name]
            own.set(value, min=low, max=high, vary=True)
        elif name.startswith(stems) and own.tie is None:
            if name in amplitudes:
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
    return Start(found.values, {name: own}, in_places=_in_places(fit))


def _in_places(fit: Fit) -> bool:
    """True if a fit took short steps in places alone."""
    return any(not one.integrator.startswith("exponential") for one in fit.integration.values())


def fresh_sides(
    fit: Fit, effects: Sequence[Addition], portion: Portions, noise: NoiseModel, refitter: Refitter
) -> list[tuple[Fit, NullModel]] | None:
    """The fit on all fresh records, parameters held; None where a simulation fails.

    Events of one record do not act in other ones, unless in cycles that are found there. Those that last to the end of
    the data searched go on in the cycles held out; of a single cycle at the end nobody knows, so that it stops or goes
    on, whichever fits. An event may happen in fresh records too, at a time that is found there, as its amplitude is
    where every record has its own; one that the user's model has happens there at its time, at another one, or not.
    """
    found = []
    for record in portion.fresh:
        idle = [e for e in effects if e.placed and not _goes_on(e, record, portion)]
        try:
            own = partial(held_fit, fit, record, noise=noise, idle=idle, known=_known_on(record, refitter))
            models = _continued(fit, effects, record, portion, refitter)
            once = any(e.moves for e in effects)
            fits = [own(model=model, once=once) for model in models]
            placed = _with_events(fit, effects, record, noise, idle, fits[0], refitter)
            held = min([*fits, *placed], key=lambda one: one.cost)
            if once and held in fits:  # no event is seen there
                held = min([held, *(own(model=model) for model in models)], key=lambda one: one.cost)
            _remember(held, record, _misfit(fit, noise), refitter)
            with unmetered():  # what was found is to count
                found.append((held, null_model(held)))
        except (CasadiEngineError, FloatingPointError):
            return None
    return found


def _known_on(record: Experiment, refitter: Refitter) -> Mapping[str, float] | None:
    """The first states by which a structure described a fresh record best so far, None at first."""
    return refitter.firsts.get(record.name, (0.0, None))[1]


def _remember(held: Fit, record: Experiment, misfit: float, refitter: Refitter) -> None:
    """Keep the first states of a fresh record if they describe it better than others do, in units of what the
    structure leaves of its own data."""
    ratio = held.cost / held.n / max(misfit, 1e-300)
    if ratio < refitter.firsts.get(record.name, (math.inf, None))[0]:
        refitter.firsts[record.name] = ratio, {n: one.value for n, one in held.initial[record.name].items()}


def _with_events(
    fit: Fit, effects: Sequence[Addition], record: Experiment, noise: NoiseModel, idle: Sequence[Addition],
    held: Fit, refitter: Refitter,
) -> list[Fit]:  # fmt: skip
    """Fits in which events with a time in every record do not go on in the cycles held out, or events happen in fresh
    records at a time, or in cycles, that one step finds, those of the user's own model too.

    idle : effects that do not act in ``held``
    """
    moving = [one for one in effects if one.moves]
    known = record.name in {one.name for one in fit.data}
    declared = [] if known else [one for one in refitter.model.effects if moves(one.effect)]
    events: list[Event] = [*declared, *moving, *(one for one in idle if one.recurs)]
    if not events:
        return []
    if moving and not any(one in idle for one in moving):
        # they go on from the records searched, or have never come
        return [held_fit(fit, record, noise=noise, idle=[*idle, *moving])]
    null = _without_events(held, effects, events, record, refitter)
    places: dict[str, tuple[float, float, float]] = {}
    again: dict[Addition, Addition] = {}  # event -> the same in other cycles
    gone: list[Event] = [one for one in idle if not one.moves]
    for one in events:
        found = _placed(one, null, record, noise, fit)
        if found is None:
            gone.append(one)
            continue
        candidate, size = found
        if isinstance(one, Addition) and one.recurs:
            again[one] = replace(one, candidate=candidate)
            gone.remove(one)
        else:
            places |= {f"{one.key}.{n}": (value, *record.span) for n, value in candidate.nuisance.items()}
        if one.amplitude not in fit.values:  # it varies by record
            bounds = _effect_of(one).amplitude
            places[one.amplitude] = (min(max(size, bounds.min), bounds.max), bounds.min, bounds.max)
    if not places and not again and not declared:
        return []
    model = refitter.extended([again.get(one, one) for one in effects]) if again else None
    return [held_fit(fit, record, noise=noise, idle=gone, model=model, places=places)]


def events_told(sides: Sequence[tuple[Fit, NullModel]], fit: Fit) -> list[str]:
    """In words: where events of a model happened in fresh records, by fits with parameters held.

    fit : of the records searched, with the effects found
    """
    said = []
    for held, _ in sides:
        (record,) = held.data
        for one in fit.model.effects:
            if not moves(one.effect) or record.name in {own.name for own in fit.data}:
                continue
            free = [name for name in held.free if name.partition("@")[0].startswith(f"{one.key}.")]
            times = [name for name in free if name.partition("@")[0] != one.amplitude]
            if times:
                words = ", ".join(clock_of(fit.model).instant(held.values[name]) for name in times)
                said.append(f"{one.key} was found in {record.name} too, at {words}")
            elif held.values_for(record.name)[one.amplitude] == 0:
                said.append(f"{one.key} does not happen in {record.name}")
    return said


def _effect_of(one: Event) -> Effect:
    """The effect of an event that was found, or that the user's model has."""
    made: Effect = one.candidate.source.effect if isinstance(one, Addition) else one.effect
    return made


def _placed(
    one: Event, null: NullModel, record: Experiment, noise: NoiseModel, fit: Fit
) -> tuple[Candidate, float] | None:
    """Where an event happens in a fresh record by one step, and its amplitude; None where it explains nothing."""
    made = library_candidates(null, (record,), (_effect_of(one),), again=True)
    port = one.candidate.port if isinstance(one, Addition) else one.at
    own = [candidate for candidate in made if candidate.port == port]
    step = one_step(null, own, noise.sigma) if own else None
    size = fit.values.get(one.amplitude)
    best = None if step is None else place_of_event(step, size)
    if best is None:
        return None
    near, step = finer_candidates(own[best[0]], null, (record,), noise.sigma, None)
    closer = None if step is None else place_of_event(step, size)
    return (own[best[0]], best[1]) if closer is None else (near[closer[0]], closer[1])


def _without_events(
    held: Fit, effects: Sequence[Addition], events: Sequence[Event], record: Experiment, refitter: Refitter
) -> NullModel:
    """A fit's simulation of a record without the events, to score them along."""
    plain = refitter.extended([one for one in effects if one not in events])
    parameters = plain.parameters()
    values = held.values_for(record.name)
    for one in events:
        if isinstance(one, Attachment):
            values |= {one.amplitude: 0.0}
            for name in (one.amplitude, *(f"{one.key}.{n}" for n in one.effect.nuisance)):
                parameters.fix(name)
    for name, own in parameters.items():
        own.set(values[name], min=min(own.min, values[name]), max=max(own.max, values[name]))
    free = [name for name, own in parameters.items() if own.vary]
    first = np.array([held.initial[record.name][state.name].value for state in plain.states])
    z = np.array([values[name] for name in free])
    return null_at(plain, (record,), parameters, z, {record.name: first})


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
