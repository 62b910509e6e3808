"""What an input may do as well: delays, or lags, of all sensors by one and the same time, and a constant at a port."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from casadi_engine.discrepancy.clocks import Clock, clock_of
from casadi_engine.effects.protocol import moves
from casadi_engine.estimation.fit import Estimate
from casadi_engine.estimation.summary import with_error
from casadi_engine.model.linearity import is_affine

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import Repair
    from casadi_engine.model import Model

_DELAY, _LAG = "sensor_delay", "sensor_lag"
# What is said where fresh data tell a late sensor from a late input.
_OF_BOTH = re.compile(
    r"fresh data tell (sensor|input)_(delay|lag) at \S+ from (?!\1)(sensor|input)_(delay|lag) "
)
_CONSTANT, _SAME = "constant_torque", " does the same"
# Standard errors within which times are one.
_ALIKE = 3.0
# Points at which equations are asked whether they know the time, and the slope that is none.
_POINTS, _NOTHING = 3, 1e-9


def common_delay(repair: Repair) -> str:
    """What to say where every sensor is late by the same time, or in a linear model behind by the same lag; ""
    elsewhere, and of a model without inputs or whose equations depend on time itself.

    Else the states do not know the time: with inputs that act late by τ all outputs are those without delay at t - τ,
    but for where the record begins, and events whose times are found come τ later. And a linear model answers what
    passes a filter as what it answered passes it.
    """
    model = repair.model
    sensors = {port.name for port in model.ports if port.kind == "sensor"}
    inputs = [variable.name for variable in model.inputs]
    equations = ca.vertcat(model.closed_ode, model.output_expressions)
    events = [one.key for one in model.effects if moves(one.effect)]
    if not inputs or _know_the_time(model, equations, events):
        return ""
    later = f", and {' and '.join(events)} later by that" if events else ""
    clock = clock_of(model)
    which = f"the input {inputs[0]} acts" if len(inputs) == 1 else "the inputs act"
    late = {one.at: one.amplitude for one in repair.effects if one.name == _DELAY}
    if set(late) == sensors and (time := _one_time(late.values(), clock)):
        where = f"{which} {time} later than recorded (an actuator, another clock){later}"
        return _said(len(sensors), "late", where)
    if any(m.name == "input_lag" for one in repair.effects for m in one.members):
        return ""  # it is in the class
    time = _whole_times(repair, _LAG, sensors, clock)
    if time and _is_linear(model):
        return _said(len(sensors), "behind", f"{which} through a lag of {time} (an actuator)")
    return ""


def late_input(repair: Repair) -> str:
    """The same where all of every input acts late, or through a lag, by one time: sensors that are late by it, or in a
    linear model behind by it, show the same; "" elsewhere."""
    model = repair.model
    ports = {f"input_{variable.name}" for variable in model.inputs}
    sensors = [port.name for port in model.ports if port.kind == "sensor"]
    if any(m.name in (_DELAY, _LAG) for one in repair.effects for m in one.members):
        return ""  # it is in the class, or beside it
    events = [one.key for one in model.effects if moves(one.effect)]
    equations = ca.vertcat(model.closed_ode, model.output_expressions)
    if not sensors or events or _know_the_time(model, equations, events):
        return ""
    which = "the only sensor is" if len(sensors) == 1 else f"all {len(sensors)} sensors are"
    for name, what in (("input_delay", "late"), ("input_lag", "behind")):
        time = _whole_times(repair, name, ports, clock_of(model))
        if time and (name == "input_delay" or _is_linear(model)):
            many = "The input acts" if len(ports) == 1 else "All inputs act"
            return f"{many} late: where {which} {what} by {time}, the data are the same"
    return ""


def other_cause(repair: Repair) -> str:
    """What may be late in place of what was found to be, one clause; "" where nothing else shows the same."""
    if said := common_delay(repair):
        inputs = [variable.name for variable in repair.model.inputs]
        how = "behind" if "through a lag" in said else "late"
        return f"{inputs[0]} acts {how}" if len(inputs) == 1 else f"the inputs act {how}"
    if said := late_input(repair):
        return f"the sensors are {'behind' if ' behind by ' in said else 'late'}"
    return ""


def with_other_cause(repair: Repair) -> Repair:
    """The repair as a class where inputs may be late in place of sensors, without words by which fresh data tell one
    from the other: what they tell is how a record begins, or how well the law of a delay holds it."""
    if not repair.effects or not other_cause(repair):
        return repair
    kept = [words for words in repair.messages if not _OF_BOTH.match(words)]
    verdict = "class" if repair.verdict == "named" else repair.verdict
    return replace(repair, verdict=verdict, messages=tuple(kept))


def _whole_times(repair: Repair, name: str, ports: set[str], clock: Clock) -> str:
    """The time by which all of what passes each of these ports is late, with its error; "" where there is none."""
    found = {one.at: one for one in repair.effects if one.name == name}
    if not found or set(found) != ports or not all(_is_whole(one.amplitude) for one in found.values()):
        return ""
    return _one_time([one.parameters[f"{at}.{name}.time"] for at, one in found.items()], clock)


def _know_the_time(model: Model, equations: ca.SX, events: Sequence[str]) -> bool:
    """True of equations that change where the time and those of events are counted from another instant."""
    if not ca.depends_on(equations, model.t):
        return False
    slope = ca.jacobian(equations, model.t)
    for key in events:
        slope += ca.jacobian(equations, model.p[model.parameter_names.index(f"{key}.time")])
    symbols = [model.x, model.u, model.d, model.w, model.t, model.p]
    look, random = ca.Function("look", symbols, [ca.densify(slope)]), np.random.default_rng(0)
    found = [look(*(random.uniform(0.5, 1.5, one.numel()) for one in symbols)) for _ in range(_POINTS)]
    return not np.allclose(np.array(found, dtype=float), 0.0, atol=_NOTHING)


def _is_linear(model: Model) -> bool:
    """True of a model that answers a sum of inputs by the sum of its answers, with the effects that were found."""
    return is_affine(
        ca.vertcat(model.closed_ode, model.closed_outputs), ca.vertcat(model.x, model.u), ca.SX(0, 1)
    )


def as_an_input(repair: Repair) -> list[str]:
    """What to say where a constant stands for an offset of an input that does the same, and was not looked for."""
    said = []
    for why in repair.not_applicable:
        place = why.why.removeprefix(f"{_CONSTANT} at ").removesuffix(_SAME)
        named = [
            one for one in repair.effects if any((m.name, m.at) == (_CONSTANT, place) for m in one.members)
        ]
        if why.effect == "input_offset" and why.why.endswith(_SAME) and named:
            name = why.at.partition("_")[2]
            said.append(
                f"A constant at {place} is what an offset of the input {name} does: no data tell them apart"
            )
    return said


def _said(count: int, what: str, where: str) -> str:
    if count == 1:
        return f"The only sensor is {what}: where {where}, the data are the same"
    time = "time" if what == "late" else "lag"
    return f"All {count} sensors are {what} by one {time}: where {where}, the data are the same, and one cause does it"


def _is_whole(share: Estimate) -> bool:
    """True of a share that is 1 within its errors."""
    error = share.stderr or share.quadratic or 0.0
    return abs(share.value - 1.0) <= _ALIKE * error


def _one_time(times: Iterable[Estimate], clock: Clock) -> str:
    """The time that all of these are within their errors, with its own; "" where there is none."""
    times = tuple(times)
    sizes = [(one.value, one.stderr or one.quadratic or 0.0) for one in times]
    if not sizes or not all(error > 0 for _, error in sizes):
        return ""
    weight = sum(error**-2 for _, error in sizes)
    mean, error = sum(value / own**2 for value, own in sizes) / weight, weight**-0.5
    alike = all(abs(value - mean) <= _ALIKE * own for value, own in sizes)
    if not alike:
        return ""
    one, _ = clock.told(Estimate(mean, error, "s"), always=False)
    if any(own.stderr is None for own in times):  # no error describes it
        ends = clock.told(times[0], always=False)[0].interval if len(times) == 1 else None
        if ends is None or None in ends:
            return f"about {one.value:.3g} {one.unit}"
        return f"{one.value:.4g} ({ends[0]:.4g} to {ends[1]:.4g}) {one.unit}"
    return f"{with_error(one.value, one.stderr)} {one.unit}"
