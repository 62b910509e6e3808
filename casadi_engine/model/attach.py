"""Put an effect into a model: a new model whose equations hold the term, and the old one at amplitude 0.

A torque goes where it costs the simulation least. One that is affine in the states, with coefficients of
parameters alone, goes into the ode; one made of channels and time alone becomes a drive; any other is a law of
the port's slot. So the model keeps its linear core, and a linear model stays one where it can.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import casadi as ca

from casadi_engine.effects.protocol import Attachment
from casadi_engine.model.declarations import Port, Ports, Variable
from casadi_engine.model.lags import with_delays
from casadi_engine.model.late_inputs import earlier
from casadi_engine.model.linearity import affine_parts, is_affine
from casadi_engine.model.port_side import check_side
from casadi_engine.model.rates import with_rates
from casadi_engine.model.term import Term, read_term, takes_torque

if TYPE_CHECKING:
    from casadi_engine.model.model import Model


def attach(
    model: Model, effect: Any, *, at: Any, values: Mapping[str, float] | None = None, sharp: bool = False
) -> Model:
    """Return `model` with an effect at the port `at`; see `Model.with_effect`."""
    term = read_term(model, effect, at, values=values, sharp=sharp)
    check_side(model, term.port)
    made = Attachment(term.effect, term.port.name, sharp, dict(term.constants), term.width)
    words = f"{effect.name} at {term.port.name}"
    wider = replace(
        model,
        description=f"{model.description}; with {words}" if model.description else f"with {words}",
        declarations=(*model.declarations, *term.declarations),
        p=ca.vertcat(model.p, *term.symbols),
        effects=(*model.effects, made),
    )
    term = _with_named_states(term)
    if term.port.kind in ("input", "parameter"):  # its own states see what is recorded
        return with_rates(with_delays(_with_shift(wider, term)))
    wider = _with_states(wider, term)
    if takes_torque(term.port):
        wider = _with_torque(wider, term)
    elif term.port.kind == "path":
        (end,) = term.port.ends
        wider = _with_torque(wider, replace(term, port=wider.ports[end]))
    elif term.port.kind == "cross":
        (end,) = term.port.ends
        wider, shown = _by_a_drive(wider, term)
        wider = _with_output(wider, replace(term, port=wider.ports[end], value=shown))
    elif term.port.ends:
        first, second = term.port.ends
        wider = _with_torque(wider, replace(term, port=wider.ports[first], value=-term.value))
        wider = _with_torque(wider, replace(term, port=wider.ports[second], value=term.arrives))
    else:
        wider = _with_output(wider, term)
    return with_rates(with_delays(wider))


def _with_named_states(term: Term) -> Term:
    """The term with symbols of its own states that are called as the states: two effects may share a port."""
    old = ca.vertcat(ca.SX(0, 1), *[state.symbol for state in term.states])
    new = ca.vertcat(ca.SX(0, 1), *[ca.SX.sym(state.name) for state in term.states])
    if not term.states:
        return term
    value, arrives, *rates = (
        ca.substitute(column, old, new)
        for column in (term.value, term.arrives, *[state.rate for state in term.states])
    )
    named = zip(term.states, ca.vertsplit(new), rates, strict=True)
    states = tuple(replace(state, symbol=symbol, rate=rate) for state, symbol, rate in named)
    return replace(term, value=value, arrives=arrives, states=states)


def _with_states(model: Model, term: Term) -> Model:
    """Append the effect's own states; a rate that is not affine goes through a slot, to keep the linear core."""
    for state in term.states:
        model = replace(
            model,
            states=(*model.states, Variable(state.name, description=f"state of {term.effect.name}")),
            x=ca.vertcat(model.x, state.symbol),
        )
    for state in term.states:
        if _is_affine(model, state.rate):
            model = replace(model, ode=ca.vertcat(model.ode, state.rate))
            continue
        inside = ca.vertcat(model.x, model.d, model.w)
        parts = affine_parts(state.rate, inside, ca.vertcat(model.u, model.t))
        if parts is not None:
            drive, words = ca.SX.sym(f"d_{state.name}"), f"what moves {state.name} from outside"
            rate = ca.mtimes(parts[0], inside) + drive
            model = with_drive(replace(model, ode=ca.vertcat(model.ode, rate)), drive, parts[1], words)
            continue
        model, slot = _with_slot(model, state.name, f"rate of {state.name}", state.rate)
        model = replace(model, ode=ca.vertcat(model.ode, slot))
    return model


def with_drive(model: Model, drive: Any, expression: Any, words: str, unit: str = "-") -> Model:
    """One more drive, made of channels and time."""
    return replace(
        model,
        drives=(*model.drives, Variable(drive.name(), unit, words)),
        d=ca.vertcat(model.d, drive),
        drive_expressions=ca.vertcat(model.drive_expressions, expression),
    )


def _with_slot(model: Model, name: str, words: str, law: Any) -> tuple[Model, Any]:
    """One more slot inside the model with a law of its own, and its symbol."""
    slot = ca.SX.sym(f"w_{name}")
    port = Port(name, "internal", words, {}, slot)
    wider = replace(
        model,
        w=ca.vertcat(model.w, slot),
        laws=ca.vertcat(model.laws, law),
        ports=Ports((*model.ports, port)),
    )
    return wider, slot


def _with_torque(model: Model, term: Term) -> Model:
    slots = [port.name for port in model.ports.with_slot]
    row, slot = slots.index(term.port.name), model.ports[term.port.name].slot
    if _is_affine(model, term.value):
        return replaced(model, slot, slot + term.value)
    inside = ca.vertcat(model.x, model.d, model.w)
    if not ca.depends_on(term.value, inside):
        name = f"T_{term.port.name}_{term.effect.name}"
        drive = ca.SX.sym(name)
        words = f"{term.effect.name} at {term.port.name}"
        return with_drive(replaced(model, slot, slot + drive), drive, term.value, words, term.port.unit)
    laws = ca.SX(model.laws)
    laws[row] = laws[row] + term.value
    return replace(model, laws=laws)


def _is_affine(model: Model, value: Any) -> bool:
    """True if `value` is affine in states, drives and slots, with coefficients of parameters alone."""
    return is_affine(value, ca.vertcat(model.x, model.d, model.w), ca.vertcat(model.u, model.t))


def _with_output(model: Model, term: Term) -> Model:
    sensors = [port for port in model.ports if port.kind == "sensor"]
    row = [port.name for port in sensors].index(term.port.name)
    outputs = ca.SX(model.output_expressions)
    outputs[row] = outputs[row] + term.value
    return replace(model, output_expressions=outputs)


def _by_a_drive(model: Model, term: Term) -> tuple[Model, Any]:
    """What a term adds to an output as a drive, where it is made of channels and time alone, to keep the linear core;
    else as it is."""
    inside = ca.vertcat(model.x, model.d, model.w)
    outside = ca.vertcat(model.channels, model.t)
    if ca.depends_on(term.value, inside) or not ca.depends_on(term.value, outside):
        return model, term.value
    drive = ca.SX.sym(f"{term.port.name}_{term.effect.name}")
    words = f"{term.effect.name} at {term.port.name}"
    return with_drive(model, drive, term.value, words, term.port.unit), drive


def _with_shift(model: Model, term: Term) -> Model:
    """A changed channel or parameter: the symbol is replaced wherever it stands, but for the rates of the effect's own
    states."""
    if term.port.kind == "input":
        name = term.port.name.partition("_")[2]
        symbol = model.u[[variable.name for variable in model.inputs].index(name)]
    else:
        symbol = model.p[model.parameter_names.index(term.port.parameter)]
    if not term.states:
        for at, value in earlier(model, symbol, term.value):
            model = replaced(model, at, at + value)
        return _seen_as_recorded(replaced(model, symbol, symbol + term.value), term)
    return _with_states(_seen_as_recorded(_with_moved_drives(model, symbol, term), term), term)


def _seen_as_recorded(model: Model, term: Term) -> Model:
    """The model whose changed input is what is recorded for the next effect on it, which changes that: of a gain and a
    delay each would else be in the other one."""
    if term.port.kind != "input":
        return model
    ports = (
        replace(one, signals=term.port.signals) if one.name == term.port.name else one for one in model.ports
    )
    return replace(model, ports=Ports(ports))


def _with_moved_drives(model: Model, symbol: Any, term: Term) -> Model:
    """A changed channel that depends on states of the effect's own. Drives are made of channels and time alone: what
    such a state adds to one goes into the equations, by a slot where it is not affine."""
    own = ca.vertcat(*[state.symbol for state in term.states])
    drives = ca.SX(model.drive_expressions)
    for k, expression in enumerate(ca.vertsplit(model.drive_expressions)):
        if not ca.depends_on(expression, symbol):
            continue
        moved, drive = ca.substitute(expression, symbol, symbol + term.value), model.d[k]
        parts = affine_parts(moved, own, ca.vertcat(model.u, model.t))
        if parts is None:
            words = f"{term.effect.name} in {drive.name()}"
            model, slot = _with_slot(model, f"{term.port.name}_{drive.name()}", words, moved - expression)
            model = replaced(model, drive, drive + slot)
            continue
        drives[k] = parts[1]
        model = replaced(model, drive, drive + ca.mtimes(parts[0], own))
    return replace(replaced(model, symbol, symbol + term.value), drive_expressions=drives)


def replaced(model: Model, symbol: Any, expression: Any) -> Model:
    """Put `expression` in for `symbol` in all equations and signals."""
    columns = [model.ode, model.laws, model.drive_expressions, model.output_expressions]
    ode, laws, drives, outputs = (
        ca.substitute(column, symbol, expression) if column.numel() else column for column in columns
    )
    signals = ca.vertcat(*(value for port in model.ports for value in port.signals.values()))
    moved = iter(ca.vertsplit(ca.substitute(signals, symbol, expression)))
    ports = Ports(replace(port, signals={key: next(moved) for key in port.signals}) for port in model.ports)
    return replace(
        model, ode=ode, laws=laws, drive_expressions=drives, output_expressions=outputs, ports=ports
    )
