"""Where the slots of ports stand: in an equation of motion, and not in the one that says what a speed is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from casadi_engine.errors import ModelError
from casadi_engine.experiment.units import NOT_STATED, read_unit
from casadi_engine.model.declarations import Port, Variable
from casadi_engine.model.port_units import is_speed

# Units of a place, and how near to each other two ratios are that are one.
_PLACES, _NEAR = ("m", "rad"), 1e-9
_SPEEDS = ("speed", "twist_rate")


def check_slots_are_used(ports: Mapping[str, Port], odes: Mapping[str, Any], laws: Mapping[str, Any]) -> None:
    """Raise ModelError for a port whose slot enters no ode, neither itself nor through the law of another port."""
    slots = {name: port.slot for name, port in ports.items() if port.slot is not None}
    read = ca.vertcat(*odes.values())
    reached: set[str] = set()
    while True:
        found = {name for name, slot in slots.items() if ca.depends_on(read, slot)} - reached
        if not found:
            break
        reached |= found
        read = ca.vertcat(*[laws[name] for name in found if name in laws], ca.SX(0))
    for name, port in ports.items():
        if port.slot is None or name in reached:
            continue
        raise ModelError(
            f"the slot of the port {name} stands in no ode: what is added there would do nothing",
            seen=f"{port.slot.name()}, the symbol that b.port({name!r}, ...) returned, in none of the odes of "
            f"{', '.join(odes)}",
            allowed="a slot that is a term of an ode, beside what acts there already",
            cure=_cure(name, port, [*odes]),
        )


def _cure(name: str, port: Port, states: Sequence[str]) -> str:
    """The line that puts a slot into an ode: that of the state that is the port's signal, if there is one."""
    own = [str(signal) for key in ("speed", "twist_rate") if (signal := port.signals.get(key)) is not None]
    state = next((one for one in own if one in states), states[-1])
    sign = "-" if port.kind == "coupling" else "+"
    return (
        f'slot = b.port({name!r}, ...); b.ode("{state}", (... {sign} slot) / ...), beside the other torques, forces, '
        f"flows or powers; or leave the port out"
    )


def check_slots_act(
    ports: Mapping[str, Port],
    states: Mapping[str, tuple[Variable, Any]],
    odes: Mapping[str, Any],
    stated: Mapping[str, str],
) -> None:
    """Raise ModelError for a slot in an ode that says what a speed is, d(angle)/dt = speed: no torque can stand there.

    states : name -> (variable, symbol); stated : the units of slots that were given. A slot of which it was said that
    its unit is one of a speed may stand there: a slip, or a creep.
    """
    symbols = ca.vertcat(*[symbol for _, symbol in states.values()])
    every = ca.vertcat(ca.SX(0, 1), *[port.slot for port in ports.values() if port.slot is not None])
    for name, port in ports.items():
        if port.slot is None or is_speed(stated.get(name, NOT_STATED)):
            continue
        for state, rate in odes.items():
            if not ca.depends_on(rate, port.slot):
                continue
            rest = ca.substitute(rate, every, ca.SX.zeros(every.shape))
            if not _is_kinematic(rest, state, states, symbols, port):
                continue
            raise ModelError(
                f"the slot of the port {name} is added to a speed: it stands in the ode of the position {state}",
                seen=f"d({state})/dt = {_short(rest)} + ... {port.slot.name()}",
                allowed="a slot in the ode of a speed, where torques and forces act; of a slip or creep, a slot whose "
                "unit says that it is a speed",
                cure=f"move it from b.ode({state!r}, ...) into the ode of the speed, (... + slot) / inertia; or give "
                f'b.port({name!r}, ..., unit="{_speed_unit(states[state][0])}") if a slip is meant',
            )


def _is_kinematic(
    rest: Any, state: str, states: Mapping[str, tuple[Variable, Any]], symbols: Any, port: Port
) -> bool:
    """True if a rate without slots is a speed and nothing else: a sum of other states' shares, of a position."""
    own = states[state][0].unit
    used = [variable for variable, symbol in states.values() if ca.depends_on(rest, symbol)]
    if not used or ca.depends_on(rest, states[state][1]):
        return False  # a rate of its own place is a law, as of a spring against a damper
    if ca.depends_on(ca.jacobian(rest, symbols), symbols) or not _is_of_states(rest, symbols, states):
        return False
    units = {variable.unit for variable in used}
    if own in ("1", NOT_STATED) or units & {"1", NOT_STATED}:
        return any(_are_proportional(rest, port.signals[key]) for key in _SPEEDS if key in port.signals)
    return read_unit(own).dimension in _PLACES and all(is_speed(unit) for unit in units)


def _is_of_states(rest: Any, symbols: Any, states: Mapping[str, tuple[Variable, Any]]) -> bool:
    """True if a rate vanishes with the states: no input pushes it."""
    at_rest = ca.substitute(rest, symbols, ca.SX.zeros(len(states)))
    return bool(ca.simplify(at_rest).is_zero())


def _are_proportional(one: Any, other: Any) -> bool:
    """True if two scalars differ by a factor that is a number."""
    inputs = ca.symvar(ca.vertcat(one, other))
    function = ca.Function("both", [ca.vertcat(*inputs)], [ca.vertcat(one, other)])
    at = np.random.default_rng(0).uniform(0.5, 1.5, (len(inputs), 3))
    values = np.array(function(at), dtype=float)
    with np.errstate(all="ignore"):
        ratio = values[0] / values[1]
    return bool(np.isfinite(ratio).all() and np.ptp(ratio) <= _NEAR * abs(ratio[0]) and ratio[0] != 0)


def _short(expression: Any) -> str:
    written = str(expression)
    return written if len(written) <= 60 else written[:57] + "..."


def _speed_unit(position: Variable) -> str:
    if position.unit in ("1", NOT_STATED):
        return "rad/s"
    return f"{position.unit}/s"
