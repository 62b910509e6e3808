"""The experiment that would split a class: a second sensor, another load, or more cycles, tried by simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.compression import compress
from casadi_engine.discrepancy.library_candidates import direction_of
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import null_at
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.repaired import Member, NextExperiment
from casadi_engine.discrepancy.score import Scores, score, separation
from casadi_engine.discrepancy.station import Station
from casadi_engine.effects import candidate as candidate_of
from casadi_engine.experiment import Channel, Experiment
from casadi_engine.experiment.units import NOT_STATED
from casadi_engine.model import Model
from casadi_engine.model.arrival import channel_unit
from casadi_engine.model.declarations import Variable
from casadi_engine.model.port_units import MECHANICAL, quantity

# Right in 95 % of records; variation of an input, as a share of its largest value, that shows that it may be varied.
_WANTED, _VARIED = 3.3, 0.05
# What rounding leaves of the correlation of one law with itself.
_SAME = 1e-6


def next_experiment(before: Station, after: Station) -> NextExperiment | None:
    """The experiment that splits the class of the effect that was added last; None for a class of one.

    before : the station without the effect; its model, parameters and records serve for the simulations
    """
    if len(after.members) < 2:
        return None
    screened = before.screened
    lead = _number(before, after.members[0])
    # a law that does the very same to every output is the same law in these equations: nothing splits the two
    others = [m for m in after.members[1:] if abs(m.rho) < 1 - _SAME and not m.more]
    known = [(m, k) for m in others if (k := _number(before, m)) is not None]
    if lead is None or not known:
        return None
    members = (after.members[0], *(member for member, _ in known))
    numbers = [lead, *(k for _, k in known)]
    sizes = [float(abs(screened.scores.amplitude[k])) for k in numbers]
    now = _least(screened.scores, numbers, sizes)
    tried: list[tuple[str, float, tuple[str, ...]]] = []
    for change, model, data in _proposals(before):
        scores = _scores(before, [screened.candidates[k] for k in numbers], model, data)
        if scores is not None:
            own = list(range(len(numbers)))
            pairs = _split(scores, own, sizes, members)
            tried.append((change, _least(scores, own, sizes), pairs))
    if now > 0.1 * _WANTED:
        times = int(np.ceil((_WANTED / now) ** 2))
        best = max((d for _, d, _ in tried), default=0.0)
        if now * np.sqrt(times) >= _WANTED and best < _WANTED and times <= 20:
            change = f"measure {times} times as long"
            pairs = _split(screened.scores, numbers, [s * np.sqrt(times) for s in sizes], members)
            tried.append((change, now * float(np.sqrt(times)), pairs))
    if not tried:
        return None
    change, expected, pairs = max(tried, key=lambda one: one[1])
    return NextExperiment(change, pairs, expected, now) if expected > now else None


def _number(station: Station, member: Member) -> int | None:
    """The best candidate of a member; None where it was not tested beside what was found before."""
    screened = station.screened
    own = [k for k, c in enumerate(screened.candidates) if c.key == (member.name, member.at)]
    return max(own, key=lambda k: screened.scores.statistic[k], default=None)


def _least(scores: Scores, numbers: Sequence[int], sizes: Sequence[float]) -> float:
    """The smallest separation of the lead from any other member."""
    lead, size = numbers[0], sizes[0]
    mu = size * np.sqrt(scores.information[lead])
    return min(float(separation(mu, scores.correlation[lead, k])) for k in numbers[1:])


def _split(
    scores: Scores, numbers: Sequence[int], sizes: Sequence[float], members: Sequence[Member]
) -> tuple[str, ...]:
    """The members that are told from the lead, as ``effect at port``."""
    mu = sizes[0] * np.sqrt(scores.information[numbers[0]])
    return tuple(
        f"{member.name} at {member.at}"
        for k, member in zip(numbers[1:], members[1:], strict=True)
        if separation(mu, scores.correlation[numbers[0], k]) >= _WANTED
    )


def _proposals(station: Station) -> list[tuple[str, Model, tuple[Experiment, ...]]]:
    """Changes that a user can make: what to do, the model with its sensors, the records."""
    model, data = station.fit.model, station.fit.data
    found: list[tuple[str, Model, tuple[Experiment, ...]]] = []
    beside = f"(with noise in proportion to that of {model.outputs[0].name})"
    for name, what, signal, unit in _sensors(model):
        found.append((f"measure {what} too {beside}", _with_sensor(model, name, signal, unit), data))
    for variable in model.inputs:
        for words, shape in _shapes(model, variable, data):
            own = tuple(_changed(record, variable.name, shape) for record in data)
            change = f"measure while {variable.name} {words} during the record"
            found.append((change, model, (*data, *own)))
    return found


def _sensors(model: Model) -> list[tuple[str, str, Any, str]]:
    """What no sensor shows: speeds of ports and other states, each with its name, words, signal and unit."""
    shown = {str(e) for e in ca.vertsplit(model.output_expressions)}
    found = []
    for port in model.ports:
        speed = port.signals.get("speed")
        if port.kind == "inertia" and speed is not None and str(speed) not in shown:
            what = f"the speed of {port.name}" if port.is_mechanical else port.called("speed")
            found.append((port.name, what, speed, port.units.get("speed", NOT_STATED)))
            shown.add(str(speed))
    states = zip(model.states, ca.vertsplit(model.x), strict=True)
    return found + [(s.name, s.name, x, s.unit) for s, x in states if str(x) not in shown]


def _shapes(model: Model, variable: Variable, data: Sequence[Experiment]) -> list[tuple[str, Any]]:
    """How an input may be changed: not what a machine's own motion makes (crank angle, cylinder pressures), and nothing
    that the records hold nearly constant, such as a temperature outside; reversed only what acts both ways."""
    cylinders = [port for port in model.ports if port.kind == "cylinder"]
    made = {
        s.name() for port in cylinders for s in ca.symvar(ca.vertcat(ca.SX(0, 1), *port.signals.values()))
    }
    if variable.name == "theta" or variable.name in made or any(variable.name not in one for one in data):
        return []
    acts = quantity(variable.unit) in MECHANICAL
    values = [record[variable.name].values for record in data]
    if not acts and any(np.std(own) <= _VARIED * np.abs(own).max() for own in values):
        return []
    shapes = [("steps to half of its value", _half), ("swings by half of its value", _swing)]
    both = acts or all(own.min() < 0 < own.max() for own in values)
    return [*shapes, ("reverses", _reverse)] if both else shapes


def _half(share: Any) -> Any:
    return np.where(share > 0.5, 0.5, 1.0)


def _swing(share: Any) -> Any:
    return 1 + 0.5 * np.sin(8 * np.pi * share)


def _reverse(share: Any) -> Any:
    return np.where(share > 0.5, -1.0, 1.0)


def _changed(record: Experiment, name: str, shape: Any) -> Experiment:
    channel = record[name]
    share = (channel.time - record.span[0]) / record.duration
    values = channel.values * shape(share)
    made = Channel(name, channel.unit, time=channel.time, values=values, hold=channel.hold, origin="derived")
    return record.with_channel(made).renamed(f"{record.name}_next")


def _with_sensor(model: Model, name: str, signal: Any, unit: str) -> Model:
    return replace(
        model,
        outputs=(*model.outputs, Variable(f"next_{name}", unit, scale=_size(model, signal))),
        output_expressions=ca.vertcat(model.output_expressions, signal),
    )


def _size(model: Model, signal: Any) -> float:
    """The largest declared scale of the states that a signal is made of, 1 for none."""
    states = zip(model.states, ca.vertsplit(model.x), strict=True)
    return max((state.scale for state, x in states if ca.depends_on(signal, x)), default=1.0)


def _scores(
    station: Station, chosen: Sequence[Candidate], model: Model, data: tuple[Experiment, ...]
) -> Scores | None:
    """The scores' R and q with the experiment, from the noise of the first output for all; None if it cannot run."""
    fit, noise = station.fit, station.screened.noise
    first, full = {}, []
    names = [state.name for state in model.states]
    for record in data:
        origin = record.name.removesuffix("_next")
        first[record.name] = np.array([fit.initial[origin][name].value for name in names])
        for out in model.outputs:
            if out.name not in record:
                like = record[model.outputs[0].name]
                blank = Channel(
                    out.name,
                    channel_unit(out, record),
                    time=like.time,
                    values=np.zeros(len(like.time)),
                )
                record = record.with_channel(blank)
        full.append(record)
    if any("@" in name for name in fit.free) and len(data) > len(fit.data):
        return None
    first_output = model.outputs[0]
    share = noise.sigma.get(first_output.name, next(iter(noise.sigma.values()))) / _size(
        model, model.output_expressions[0]
    )
    shown = zip(model.outputs, ca.vertsplit(model.output_expressions), strict=True)
    sigma = {out.name: noise.sigma.get(out.name, share * _size(model, y)) for out, y in shown}
    try:
        null = null_at(model, full, fit.parameters, fit.z, first)
        moved = []
        for one in chosen:
            made = one.source
            direction = direction_of(candidate_of(model, made.effect, one.port, made.values, size=made.size))
            moved.append(replace(one, direction=direction))
        return score(compress(null, moved, NoiseModel(sigma)))
    except FAILURES:
        return None
