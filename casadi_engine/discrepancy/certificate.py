"""The certificate: what was found and what was not, in numbers and in equations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from casadi_engine.discrepancy.assumed_pressure import carried_cylinders, is_carried, scatter_carried
from casadi_engine.discrepancy.clocks import Clock, clock_of
from casadi_engine.discrepancy.common_noise import BESIDE
from casadi_engine.discrepancy.confirmation import share_closed
from casadi_engine.discrepancy.elsewhere_families import DROP, SHOWN, same_parameters
from casadi_engine.discrepancy.evidence import FACTOR
from casadi_engine.discrepancy.fresh import gap_of, told_by_both
from casadi_engine.discrepancy.latent_torque import LatentTorque
from casadi_engine.discrepancy.linear_algebra import Array, without
from casadi_engine.discrepancy.localisation import where_in_data
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.random_families import PLACE, TIME, Course, Family
from casadi_engine.discrepancy.refit import Addition
from casadi_engine.discrepancy.repaired import (
    FAR_OFF,
    UNTRIED,
    ClassMatrix,
    Equation,
    FoundEffect,
    NoiseFound,
    Place,
    ScoreRow,
    Unknown,
)
from casadi_engine.discrepancy.screening import Screened
from casadi_engine.discrepancy.station import Station
from casadi_engine.discrepancy.unknown_law import UnknownLaw
from casadi_engine.discrepancy.wording import HOLDS
from casadi_engine.effects import candidate as candidate_of
from casadi_engine.estimation import Estimate, Fit
from casadi_engine.model import Model, Port
from casadi_engine.model.sheets import changed_equations

# Candidates drawn in the class matrix.
_MATRIX = 24
# Functions that are named beside the most probable one, where the data do not tell them from it.
_RIVALS = 2
_LIKE = 0.8
# Standard errors by which the ends of a course differ where it is said to rise or to fall: their band holds what is not
# known of its level too.
_SURE = 2.0
# Log odds beyond which no number is said.
_SAID = 9.0
# Share of the squares of what was measured from which it swings at a frequency itself.
_SWINGS = 0.25


def score_rows(screened: Screened) -> tuple[ScoreRow, ...]:
    """The scores of all candidates."""
    s = screened.scores
    detectable = s.detectable(screened.threshold)
    return tuple(
        ScoreRow(
            candidate.effect,
            candidate.port,
            candidate.label,
            dict(candidate.nuisance),
            float(s.z[k]),
            float(s.statistic[k]),
            float(s.p_value[k]),
            float(s.amplitude[k]),
            float(s.error[k]),
            candidate.unit,
            float(detectable[k]),
            float(s.testability[k]),
            bool(s.testable[k]),
            bool(s.testable[k] and s.p_value[k] <= screened.threshold_p),
        )
        for k, candidate in enumerate(screened.candidates)
    )


def class_matrix(screened: Screened) -> ClassMatrix | None:
    """The correlation of the best points of the effects that scored best; None if nothing could be tested."""
    best: dict[tuple[str, str], int] = {}
    for k in screened.order:
        best.setdefault(screened.candidates[k].key, k)
    chosen = list(best.values())[:_MATRIX]
    if not chosen:
        return None
    rho = screened.scores.correlation[np.ix_(chosen, chosen)]
    labels = tuple(screened.candidates[k].label for k in chosen)
    return ClassMatrix(labels, tuple(best)[:_MATRIX], rho)


def found_effects(stations: Sequence[Station]) -> tuple[FoundEffect, ...]:
    """The effects of the last station, each with the numbers of the round in which it came."""
    last = stations[-1]
    return tuple(_found(stations, one, last) for one in last.effects)


def _found(stations: Sequence[Station], one: Addition, last: Station) -> FoundEffect:
    number = next(k for k, s in enumerate(stations) if k and s.effects[-1].label == one.label)
    here, before = stations[number], stations[number - 1]
    screened, lead = before.screened, here.lead
    assert lead is not None
    keys = [name for name in last.fit.estimates if name.partition("@")[0].startswith(f"{one.key}.")]
    # the time of an event that does not happen in a record is no finding
    ends = {f"{one.key}.{name}@{r.name}": r.span[1] for name in one.times for r in last.fit.data}
    keys = [name for name in keys if last.fit.values[name] < ends.get(name, np.inf)]
    # nor is a size that a record says nothing of
    known = [name for name in keys if "@" not in name or _is_told(last.fit.estimates[name])]
    if any(name.partition("@")[0] == one.amplitude for name in known):
        sized = {name.partition("@")[2] for name in known if name.partition("@")[0] == one.amplitude}
        keys = [name for name in known if not sized - {""} or name.partition("@")[2] in {"", *sized}]
    every = before.screened.null.parameters
    shift = dict(zip(every, screened.scores.shift[:, lead].tolist(), strict=True))
    names = [name for name in every if not is_carried(name)]
    moved = {
        name: here.fit.values[name] - before.fit.values[name] for name in names if name in here.fit.values
    }
    noise = last.screened.noise
    both = told_by_both([before.screened.null], [here.screened.null])
    first, then = (gap_of(nulls, noise) for nulls in both)
    share = share_closed(first, then, noise.sigma, coloured=bool(noise.colour))
    made = one.candidate.source
    return FoundEffect(
        one.candidate.effect,
        one.candidate.port,
        made.effect.worded_for(
            here.fit.model.ports[one.candidate.port], last.fit.values.get(one.amplitude, 0.0)
        ),
        dict(one.candidate.nuisance),
        {name: last.fit.estimates[name] for name in keys},
        {name: float(made.values[name]) for name, grid in made.effect.nuisance.items() if grid.whole},
        float(screened.scores.z[lead]),
        screened.pooled(lead),
        here.drop,
        share,
        {name: shift[name] for name in names},
        moved,
        here.frequency,
        here.members,
        _course(stations[0].fit.model, one, last),
    )


def _is_told(one: Estimate) -> bool:
    """True for a number of an event in one record that the record tells from none."""
    if one.stderr is not None and not one.fixed:
        return abs(one.value) >= HOLDS * one.stderr
    return one.fixed or one.interval is not None or one.at_bound is not False


def _course(base: Model, one: Addition, last: Station) -> dict[str, Array]:
    """record -> (2, K): times and what the effect adds along the repaired model."""
    made = one.candidate.source
    found = {}
    for record in last.screened.null.records:
        size = _value(last.fit, one.amplitude, record.name)
        values = {
            name: _value(last.fit, f"{one.key}.{name}", record.name) if not grid.whole else made.values[name]
            for name, grid in made.effect.nuisance.items()
        }
        if size == 0.0 or made.states:
            continue
        term = candidate_of(base, made.effect, one.candidate.port, values, size=size)
        expression = _added(base, one.candidate.port, term)
        if expression is None:
            continue
        course = record.path.function([size * expression])(*record.path.at_samples().arguments)[0][0]
        time = record.path.grid.time
        found[record.name] = np.array([time, np.broadcast_to(course, time.shape)])
    return found


def _value(fit: Fit, name: str, record: str) -> float:
    return float(fit.values.get(f"{name}@{record}", fit.values.get(name, 0.0)))


def _added(model: Model, port: str, term: Any) -> Any:
    """What the effect adds at its port per unit of amplitude; None where that is no torque and no output."""
    slots = [p.name for p in model.ports.with_slot]
    if port in slots:
        return term.slots[slots.index(port)]
    sensors = [p.name for p in model.ports if p.kind == "sensor"]
    return term.outputs[sensors.index(port)] if port in sensors else None


def place_of(null: NullModel, noise: NoiseModel, latent: Sequence[LatentTorque]) -> Place | None:
    """Where the gap of the null model sits."""
    where = where_in_data(null, noise)
    if where is None:
        return None
    location = latent[0].port if latent and latent[0].gain > 0 else None
    return Place(
        location,
        where.record,
        where.time,
        where.cycles,
        where.crank_angle,
        where.order,
        dict(where.excess),
    )


def unknown_of(screened: Screened) -> Unknown | None:
    """What the tests beside the library reject, in words; None if they reject nothing."""
    leftover = screened.leftover
    alarms = leftover.alarms
    if not alarms:
        return None
    family, course = leftover.family, leftover.course
    if leftover.line is not None:
        record, output, line = leftover.line.rsplit("/", 2)
        hertz = float(line.split()[-2])
        often = clock_of(screened.null.model).period(hertz) if hertz else ""
        words = f"the spectrum of the residual of {output} in {record} has a {line}{often}"
        if _swings_at(screened, record, output, hertz):
            return Unknown(
                f"{words}, at which {output} itself swings: something changes how it is driven or dies out",
                alarms,
            )
        words += ": something acts, or is picked up by the sensor, at that frequency"
        if (
            family is not None and alarms.get(family.name, 1.0) < alarms[leftover.line]
        ):  # lines of what it drives
            words += f", or {law_words(screened.null.model, family)}"
        return Unknown(words, alarms)
    if family is None or course is None or family.name not in alarms:
        if leftover.driven_line is not None:
            inputs = leftover.driven[leftover.driven_line]
            return Unknown(_answers(leftover.driven_line, inputs, clock_of(screened.null.model)), alarms)
        first = next(iter(alarms)).rsplit("/", 2)
        if first[2].startswith(BESIDE):
            other = first[2].removeprefix(BESIDE)
            words = f"the residuals of {first[1]} and {other} in {first[0]} are correlated"
            return Unknown(f"{words}, which the noise of two sensors is not", alarms)
        return Unknown(f"the residual of {first[1]} in {first[0]} is not white", alarms)
    words = f"{law_words(screened.null.model, family)}{likeness_words(course, clock_of(screened.null.model))}"
    return Unknown(words, alarms, family.port, family.signal, leftover.family_p, course)


def _answers(name: str, inputs: Sequence[str], clock: Clock) -> str:
    """What a line says that the inputs have too."""
    record, output, line = name.rsplit("/", 2)
    noun, verb = ("input", "does") if len(inputs) == 1 else ("inputs", "do")
    at = line.removeprefix("line ")
    hertz = float(line.split()[-2])
    often = clock.period(hertz) if hertz else ""
    return (
        f"the residual of {output} in {record} repeats what the {noun} {' and '.join(inputs)} {verb} {at}{often}: "
        "what is missing responds to it, or has that period by itself"
    )


def _swings_at(screened: Screened, name: str, output: str, frequency: float) -> bool:
    """True if a good part of what was measured swings at a frequency [Hz], as finely as the record tells it."""
    record = next(one for one in screened.null.records if one.name == name)
    time, measured = record.time[output], record.path.grid.measured[output].values
    turns = 2 * math.pi * np.outer(time - time[0], frequency + np.array([-1, 0, 1]) / (time[-1] - time[0]))
    waves = np.column_stack([np.ones(len(time)), np.cos(turns), np.sin(turns)])
    spread = measured - measured.mean()
    left = without(np.linalg.qr(waves)[0], spread[:, None])
    return float(np.sum(left**2)) <= (1 - _SWINGS) * float(spread @ spread)


def in_place_of(last: Station, law: UnknownLaw, *, far: bool = False) -> Unknown | None:
    """What is said of a law that no effect names in the place of the effects found, or of none, where these do not
    exclude it. far : it is seen along a simulation that is far from the motion"""
    if law.log < (-1 if last.effects else 1) * math.log(FACTOR) and not law.is_curve:
        return None
    family, odds, clock = law.course.family, math.exp(min(law.log, _SAID)), clock_of(last.fit.model)
    words = law_words(last.fit.model, family)
    alike = _alike(last.fit.model, family)
    apart = [one for one in law.rivals if one.signal != family.signal or one.port not in alike]
    rivals = [law_words(last.fit.model, one) for one in apart[:_RIVALS]]
    others = "".join(f", or {said}" for said in dict.fromkeys(rivals) if said != words)
    lost = dict.fromkeys(law_words(last.fit.model, one) for one in law.unheard[:_RIVALS])
    others += "".join(f", or {said}, which was not followed to its end" for said in lost)
    names = " and ".join(one.name for one in last.effects)
    much = f"{odds:.2g} times" if law.log < _SAID else "far"
    if names and law.is_beside:
        words += f"{likeness_words(law.course, clock)}{others}, beside {names}"
        return Unknown(words, {}, family.port, family.signal, None, law.course)
    if not names:
        rest = "noise of that colour" if last.screened.noise.colour else "noise alone"
        words += f"{likeness_words(law.course, clock, far=far)}{others}: {much} more probable than {rest}"
        words += f", but by a simulation that is far from the motion: {FAR_OFF}" if far else ""
    elif law.is_curve and odds < 1:
        words += f", in the place of {names}, explains no less: fewer numbers alone speak for these"
    elif odds < FACTOR:
        words += f", in the place of {names}, is not excluded ({odds:.2g} times as probable)"
    else:
        near = (
            ""
            if law.excludes or law.share > 1
            else f", which explains {100 * law.share:.0f} % of what that does"
        )
        words += (
            f"{likeness_words(law.course, clock)}{others}: {much} more probable than {names}, the nearest of the "
            f"library{near}"
        )
    return Unknown(words, {}, family.port, family.signal, None, law.course, odds)


def as_untried(sentence: str) -> str:
    """What is said of a law, where the time was up before it was tried in the equations."""
    far = f": {FAR_OFF}"
    law, then, others = sentence.partition("; ")
    return f"{law.removesuffix(far)}, {'and' if law.endswith(far) else 'but'} {UNTRIED}{then}{others}"


def law_words(model: Model, family: Family) -> str:
    """An unknown law in words: what acts, where, and what it depends on."""
    port = model.ports[family.port]
    kind, _, name = family.port.partition("_")
    if port.kind == "sensor" and family.signal == TIME:
        return f"the sensor {name} drifts with time"
    if port.kind == "sensor" and family.signal not in port.signals:
        return f"the sensor {name} depends on {family.signal} too"
    if port.kind == "input" and name in model.idle_inputs:
        return f"something depends on {name}, which no equation uses"
    if port.kind == "input" and family.signal not in port.signals:
        return f"what acts as the input {name} depends on {family.signal} too"
    if port.kind in ("input", "sensor"):
        return f"the {kind} {name} {'acts as' if kind == 'input' else 'shows'} another function of its value"
    if port.kind == "parameter":
        others = " or ".join(name.removeprefix("parameter_") for name in _alike(model, family))
        same = f", or {others}, which no data tell from it," if others else ""
        what = family.signal
        if what.startswith(DROP) and what not in port.signals:
            ends = model.ports[what.removeprefix(DROP)].ends
            what = f"the difference between {' and '.join(ends)}"
        if what.startswith(SHOWN) and what not in port.signals:
            what = _shown_words(model.ports[what.removeprefix(SHOWN)])
        return f"the parameter {port.parameter}{same} seems not to be constant: it depends on {what}"
    where = f"between {' and '.join(port.ends)}" if port.ends else f"at {family.port}"
    acts = f"an unknown {port.quantity} {where}"
    if family.order:
        often = "once" if family.order == 1 else f"{family.order} times"
        return f"{acts} that comes back {often} a turn"
    if family.signal not in {TIME, PLACE, *port.signals}:
        return f"{acts} that depends on {family.signal}"
    named = port.is_mechanical and family.signal != TIME
    own = "place, its speed added up" if family.signal == PLACE else port.called(family.signal)
    return f"{acts} that depends on {'its ' if named else ''}{own}"


def _shown_words(port: Port) -> str:
    """What a port shows first, in words."""
    first = next(iter(port.signals))
    said = port.called(first)
    return f"the {said} of {port.name}" if said == first.replace("_", " ") else said


def _alike(model: Model, family: Family) -> list[str]:
    """Ports of other parameters at which the same function of a parameter does the same."""
    port = model.ports[family.port]
    if port.kind != "parameter":
        return []
    return [f"parameter_{name}" for name in same_parameters(model, port)]


def likeness_words(course: Course, clock: Clock, *, far: bool = False) -> str:
    """What a course looks like, where it does. far : it is seen along a simulation that is far from the motion"""
    if course.family.order:
        return ""
    shape, like = next(iter(course.looks_like.items()), ("", 0.0))
    if course.family.port.startswith("parameter_") and shape == "linear" and like > _LIKE:
        way = float(course.mean[-1] - course.mean[0])
        sure = not far and abs(way) > _SURE * math.hypot(course.band[0], course.band[-1])
        return f", and {'rises' if way > 0 else 'falls'} with it" if sure else ""
    if shape == "periodic" and math.isfinite(course.period) and like > _LIKE:
        return f" and comes back about every {clock.about(course.period)}"
    # the model has lines of its own
    return f" and looks {shape}" if like > _LIKE and shape != "linear" else ""


def equation_of(model: Model, base: Model) -> Equation:
    """The equations of the repaired model, and the lines that are not those of the first one."""
    return Equation(model.equations(), model.latex(), changed_equations(model, base))


def noise_found(screened: Screened, levels: Mapping[str, tuple[float, bool]]) -> NoiseFound:
    """The noise of the tests; a level is known if it is still what the fit was told."""
    noise = screened.noise
    sigma = {
        name: (value, name not in levels or levels[name][1] or value != levels[name][0])
        for name, value in noise.sigma.items()
    }
    colour = {f"{record}/{output}": c.order for (record, output), c in noise.colour.items() if c.order}
    scatter = dict(noise.scatter)
    if carried_cylinders(screened.null.model):
        scatter["combustion"] = scatter_carried(screened.null)
    return NoiseFound(sigma, colour, scatter, bool(colour) and screened.choice.is_coloured)
