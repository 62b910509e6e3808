"""Words that the screen and the page of a repair share: what was not tested, units, and what acts at a port."""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca

from casadi_engine.estimation.summary import count
from casadi_engine.experiment.units import NOT_STATED
from casadi_engine.model.port_units import is_speed

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import FoundEffect, Member, Repair
    from casadi_engine.model import Model

# Who stopped a search.
USER, BUDGET = "the user", "the time budget"
# Status of a repair whose data cannot be used as they are.
AT_FAULT = "the data are at fault"
# Names listed in a sentence; correlation beyond which two effects are one.
LISTED, _TWINS = 6, 0.995


def first_words(repair: Repair) -> list[str]:
    """What has to be known before the verdict is read: where nothing physical was tested, and what was not tried."""
    said = []
    if is_blind(repair):
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


def is_blind(repair: Repair) -> bool:
    """True where no physical effect could be looked for."""
    return repair.blind or bool(port_cure(repair.null_fit.model))


def _why_blind(repair: Repair) -> str:
    without = bool(port_cure(repair.null_fit.model))
    ports = "The model has no port at which a physical effect can act"
    return (
        ports if without else "No effect of the library can act at the ports of the model, which lack signals"
    )


def _cure_blind(repair: Repair) -> str:
    model = repair.null_fit.model
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


def held_out(repair: Repair) -> str:
    """What was kept for confirmation where there is no fresh record."""
    turns = any(variable.name == "theta" for variable in repair.model.inputs)
    return "its last cycles" if turns else "its last part"


def twins(one: FoundEffect) -> tuple[Member, ...]:
    """The members of a class that act as its lead does in these data, but for their size and sign."""
    return tuple(m for m in one.members[1:] if abs(m.rho) > _TWINS)


def acting_at(model: Model, port: str) -> str:
    """``a torque at PORT``, in the words of what acts there."""
    acts = model.ports[port].quantity if port in model.ports.names else "torque"
    return f"{'an' if acts[0] in 'aeiou' else 'a'} {acts} at {port}"
