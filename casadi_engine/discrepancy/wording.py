"""Words that the screen and the page of a repair share: what was not tested, units, and what acts at a port."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations
from typing import TYPE_CHECKING

import casadi as ca

from casadi_engine.discrepancy.common_delay import as_an_input, common_delay, late_input
from casadi_engine.discrepancy.constant_inputs import constant_inputs
from casadi_engine.discrepancy.exchanged_units import exchanges
from casadi_engine.estimation.summary import BOUND_WORDS, count, number, with_error
from casadi_engine.experiment.units import NOT_STATED
from casadi_engine.model.port_side import TURNED
from casadi_engine.model.port_units import is_speed

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import FoundEffect, Member, Repair
    from casadi_engine.estimation import Estimate, Fit
    from casadi_engine.model import Model

# Who stopped a search.
USER, BUDGET = "the user", "the time budget"
# Status of a repair whose data cannot be used as they are.
AT_FAULT = "the data are at fault"
# Key of a repair's options under which what may be wrong with its data is kept, where that is no more than a doubt.
HINT = "hint"
BOUNDS, STARTS = "bounds in the way", "first states in the way"
# Its key where all that is unexplained may come of corners that are rounded.
ROUNDED = "rounded corners"
# Status of a repair whose gap may be what rounds the corners of the user's own laws.
# Status of a fit without effects whose share of the time was over before it arrived.
SHARE_OVER = "not converged: its share of the time budget was over"
UNRESOLVED = "the corners of the model's own laws are not resolved"
# Names listed in a sentence; correlation beyond which two effects are one.
LISTED, _TWINS = 6, 0.995
# What a negative delay may be.
EARLY = (
    "no sensor is early: clocks differ, it shows a share of the rate too, as behind a series resistance, or what acts "
    "has a memory that the model lacks"
)
# A gain that is known to this share of itself, and is within so many errors of a ratio of units, tells which they are.
_SURE, _WITHIN = 0.02, 3.0
# Standard errors within which a size is none for all that they say.
HOLDS = 2.0


def first_words(repair: Repair) -> list[str]:
    """What has to be known before the verdict is read: where nothing physical was tested, and what was not tried."""
    said = [
        str(repair.options[key])
        for key in (BOUNDS, STARTS, HINT, "exchanged", "hold", "left out")
        if key in repair.options
    ]
    said += [late] if (late := common_delay(repair) or late_input(repair)) else []
    said += as_an_input(repair)
    said += constant_inputs(repair)
    said += _of_internal_ports(repair.null_fit.model)
    said += _of_unknown_units(repair.null_fit.model)
    if is_blind(repair) and _only_internal(repair.null_fit.model):
        said.append("Besides, wrong fixed parameters and sensor errors alone were tested")
    elif is_blind(repair):
        said.append(
            f"{_why_blind(repair)}: wrong fixed parameters and sensor errors alone were tested. Where the model is "
            f"written, {_cure_blind(repair)}"
        )
    if repair.stopped:
        missed = repair.not_searched
        names = ", ".join(missed[:LISTED]) + (
            f" and {count(len(missed) - LISTED)} more" if len(missed) > LISTED else ""
        )
        said.append(f"Stopped by {repair.stopped}; not searched: {names or 'further effects'}")
    return said


def _only_internal(model: Model) -> bool:
    """True if all ports at which something may act are internal."""
    return bool(model.ports.with_slot) and all(port.kind == "internal" for port in model.ports.with_slot)


def _of_internal_ports(model: Model) -> list[str]:
    """What is looked for at internal ports: functions of their signals, or nothing, but for what has a law anyway."""
    said = []
    own = [port for port in model.ports if port.is_own]
    if own:
        listed = "; ".join(f"{port.name} ({', '.join(port.signals)})" for port in own)
        said.append(
            f"Of internal ports unknown functions of their signals are looked for, and no effect of the library: "
            f'{listed}. For its effects give such a port the kind "inertia" or "coupling"'
        )
    rows = zip(model.ports.with_slot, ca.vertsplit(model.laws) if model.laws.numel() else (), strict=False)
    idle = [port.name for port, law in rows if port.kind == "internal" and not port.signals and law.is_zero()]
    if idle:
        said.append(
            f"Nothing is looked for at {', '.join(idle)}: an internal port without signals. Give it what acts there "
            f'may depend on: b.port("{idle[0]}", "internal", {{"signal": ...}}), or the kind "inertia" or "coupling"'
        )
    return said


def _of_unknown_units(model: Model) -> list[str]:
    """What is not looked for as nobody said in what it would be: what passes from one port to another."""
    able = [port for port in model.ports if port.kind == "inertia" and port.unit == NOT_STATED]
    pairs = [(a, b) for a, b in combinations(able, 2) if set(a.signals) & set(b.signals) - {"angle"}]
    if not pairs:
        return []
    names = " and ".join(", ".join(dict.fromkeys(one.name for pair in pairs for one in pair)).rsplit(", ", 1))
    return [
        f"Nothing that passes between {names} is looked for, as the unit of what acts there is not stated. Give states "
        f'and parameters their units, "1" for a number, or b.port("{pairs[0][0].name}", ..., unit="...")'
    ]


def names_own_law(repair: Repair) -> bool:
    """True if what is missing was found as a function at an internal port."""
    ports, unknown = repair.null_fit.model.ports, repair.unknown
    return unknown is not None and unknown.port in ports.names and ports[str(unknown.port)].is_own


def is_blind(repair: Repair) -> bool:
    """True where no physical effect could be looked for."""
    return repair.blind or bool(port_cure(repair.null_fit.model))


def _why_blind(repair: Repair) -> str:
    without = bool(port_cure(repair.null_fit.model))
    if without:
        return "The model has no port at which a physical effect can act"
    if turned := _turned_ports(repair):
        return f"No effect can act at {' and '.join(turned)}, as friction would drive there"
    return "No effect of the library can act at the ports of the model, which lack signals"


def _turned_ports(repair: Repair) -> list[str]:
    """The ports whose slots act the other way round."""
    return list(dict.fromkeys(one.at for one in repair.not_applicable if TURNED in one.why))


def _cure_blind(repair: Repair) -> str:
    model = repair.null_fit.model
    if not port_cure(model) and (turned := _turned_ports(repair)):
        return f"exchange the sign of the slot of {' and '.join(turned)} in the ode, or of the signal"
    lacks = next((one for one in repair.not_applicable if one.missing and one.at in model.ports.names), None)
    if port_cure(model) or lacks is None:
        return f"give it one: {port_cure(model)}" if port_cure(model) else "give the ports what laws read"
    signals = ", ".join(f'"{name}": ...' for name in lacks.missing)
    return f'give them what laws read: b.port("{lacks.at}", "{model.ports[lacks.at].kind}", {{{signals}}})'


def port_cure(model: Model) -> str:
    """The line of a Blueprint that gives a model a port, for its own states; "" for one that has some.

    A state that is a speed comes first, else one that inputs act on.
    """
    if model.ports.with_slot:
        return ""
    acted_on = [
        ca.depends_on(model.ode[k], model.d) if model.d.numel() else False for k in range(len(model.states))
    ]
    order = sorted(
        range(len(model.states)), key=lambda k: (not is_speed(model.states[k].unit), not acted_on[k])
    )
    name = model.states[order[0]].name
    return f'missing = b.port("at_{name}", "inertia", {{"speed": {name}}}), added to what acts in b.ode("{name}", ...)'


def in_unit(unit: str) -> str:
    """A unit behind a number: nothing for 1, and said where it was not stated."""
    return "" if unit == "1" else " (unit not stated)" if unit == NOT_STATED else f" {unit}"


def si(unit: str) -> str:
    """A unit behind a number, nothing where it was not stated."""
    return "" if unit == NOT_STATED else in_unit(unit)


def as_fitted(fit: Fit) -> str:
    """The parameters that the data do not determine together, as an inertia, a stiffness and a damper but for their
    ratios: sizes of effects hold with these as fitted; "" without any."""
    weights: Mapping[str, float] = max((one.weights for one in fit.undetermined), key=len, default={})
    names = [name for name in weights if name in fit.free]
    return ", ".join(names) if len(names) > 1 else ""


def held_out(repair: Repair) -> str:
    """What was kept for confirmation where there is no fresh record."""
    turns = any(variable.name == "theta" for variable in repair.model.inputs)
    return "its last cycles" if turns else "its last part"


def twins(one: FoundEffect) -> tuple[Member, ...]:
    """The members of a class that act as its lead does in these data, but for their size and sign."""
    return tuple(m for m in one.members[1:] if abs(m.rho) > _TWINS and not m.more)


def why_leads(one: FoundEffect) -> str:
    """Why a class is led by one that is not its most probable member; "" where it is."""
    own, most = one.members[0].probability, max(m.probability for m in one.members)
    if own >= most:
        return ""
    if own > most / math.e:
        return "within a factor of e the data tell none apart: the simplest leads, or the one found first"
    return (
        "what is more probable does not lead where its fit did not end, its size is within its errors, or fresh data "
        "refuse it or show nothing of what it does more"
    )


def what_acts(model: Model, port: str) -> tuple[str, str]:
    """What an unknown law at a port is a part of, and its unit: a torque, or the value of an input, a sensor or a
    parameter."""
    own = next((one for one in model.declarations if port == f"parameter_{one.name}"), None)
    if own is not None:
        return f"change of parameter {own.name}", own.unit
    if port not in (*model.ports.names, *(own.name for own in model.ports.unlisted)):
        return "torque", "N m"
    known = model.ports[port]
    kind, _, name = port.partition("_")
    if known.kind in ("input", "sensor"):
        every = model.inputs if known.kind == "input" else model.outputs
        unit = next((one.unit for one in every if one.name == name), NOT_STATED)
        return f"part of {kind} {name}", unit
    return known.quantity, known.unit


def acting_at(model: Model, port: str) -> str:
    """``a torque at PORT``, in the words of what acts there."""
    acts = model.ports[port].quantity if port in model.ports.names else "torque"
    return f"{_with_article(acts)} at {port}"


def _with_article(noun: str) -> str:
    return f"{'an' if noun[0] in 'aeiou' else 'a'} {noun}"


def told(one: Estimate, unit: str = "") -> str:
    """An estimate with its error; without one its 95 % interval, or that it is held, at a bound, or not known."""
    if one.stderr is not None:
        return f"{with_error(one.value, one.stderr)}{unit}"
    why = f"{BOUND_WORDS[one.at_bound]} bound" if one.at_bound else "held" if one.fixed else "error not known"
    if one.interval is not None:
        why = f"{one.interval[0]:.4g} to {one.interval[1]:.4g}"
    return f"{with_error(one.value, None)}{unit} ({why})"


def of_either_sign(one: Estimate) -> str:
    """What is said of a size that its errors do not tell from none, though its effect is beyond chance: least squares
    weigh all samples alike, and coloured noise hides less of what it does than of how large it is."""
    if one.stderr is None or one.fixed or abs(one.value) >= HOLDS * one.stderr:
        return ""
    return " (its 95 % interval contains 0)"


def is_untold(one: FoundEffect) -> bool:
    """True for an effect whose size its errors do not tell from none, or which has grown to a bound of it; or whose
    size has no error, and its shape is at a bound."""
    size = one.amplitude
    if of_either_sign(size) or size.at_bound is not False:
        return True
    known = size.fixed or size.stderr is not None or size.interval is not None
    shapes = (own for own in one.parameters.values() if own is not size and not own.fixed)
    return not known and any(own.at_bound is not False for own in shapes)


def acts_as(one: FoundEffect, name: str, model: Model) -> str:
    """What a "torque" is at a port where none acts: `` (a force)``; "" for anything else."""
    known = model.ports[one.at].quantity if one.at in model.ports.names else "torque"
    return f" ({_with_article(known)})" if name.rpartition(".")[2] == "torque" != known else ""


def is_early(one: FoundEffect) -> bool:
    """True for a sensor that would show what comes, beyond its errors."""
    return one.name == "sensor_delay" and one.amplitude.value < -_WITHIN * (one.amplitude.stderr or 0.0)


def right_value(one: FoundEffect, repair: Repair) -> str:
    """What was stated wrong, as the data have it: ``m_s = 356.5 ± 1.8 kg, stated 300``; the unit of an output that its
    gain tells; or what a sensor that is early may be. "" for other effects."""
    port = repair.model.ports[one.at] if one.at in repair.model.ports.names else None
    if port is not None and one.name in ("sensor_gain", "input_gain"):
        return _other_unit(one, repair.model)
    if one.name == "sensor_delay":
        return EARLY if is_early(one) else ""
    stated = None if port is None else repair.fit.estimates.get(port.parameter)
    if port is None or not port.parameter or stated is None:
        return ""
    by_share = next(iter(one.parameters)).endswith(".share")
    factor, size = (stated.value, one.amplitude) if by_share else (1.0, one.amplitude)
    error = None if size.stderr is None else abs(factor) * size.stderr
    value = with_error(stated.value + factor * size.value, error)
    return f"{port.parameter} = {value}{in_unit(stated.unit)}, stated {number(stated.value)}"


def _other_unit(one: FoundEffect, model: Model) -> str:
    """The units that were exchanged where a gain is their ratio within its error; "" for others."""
    kind, _, name = one.at.partition("_")
    channel = next(own for own in (model.inputs if kind == "input" else model.outputs) if own.name == name)
    factor, error = 1 + one.amplitude.value, one.amplitude.stderr
    if error is None or error > _SURE * abs(factor):
        return ""
    if kind == "input":  # what acts is the channel times the factor: its numbers are too large by the inverse
        factor, error = 1 / factor, error / factor**2
    for right, label, share in exchanges(channel.unit):
        if abs(factor - share) <= _WITHIN * error:
            times_large = with_error(factor, error)
            return f"{name} is {times_large} times as large, as numbers in {right} labelled {label} would be"
    return ""
