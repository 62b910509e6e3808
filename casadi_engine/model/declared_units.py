"""The units that a Blueprint declares: the unit of its time, and names that are declared twice."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from casadi_engine.errors import ModelError, UnitError
from casadi_engine.experiment.units import NOT_STATED, read_unit
from casadi_engine.model.amounts import amount_of, is_of_one_kind
from casadi_engine.model.declarations import ParameterDeclaration, Variable


def seconds_in(time_unit: Any) -> float:
    """Seconds in a unit of time, 1 for None; ModelError for anything else."""
    if time_unit is None:
        return 1.0
    try:
        found = read_unit(time_unit)
    except UnitError:
        found = None
    if found is None or found.si != "s":
        raise ModelError(
            "the time unit of a blueprint is not a unit of time",
            seen=repr(time_unit),
            allowed="ns, us, ms, s, min, h, d",
            cure='write Blueprint("name", time_unit="h") for odes that are per hour',
        )
    times, over, _ = found.steps_to(read_unit("s"))
    return times / over


def check_shared_units(inputs: Sequence[Variable], outputs: Sequence[Variable]) -> None:
    """Raise ModelError for a channel that is declared as input and as output in two units."""
    declared = {variable.name: variable.unit for variable in inputs}
    for name, unit in ((out.name, out.unit) for out in outputs if out.name in declared):
        other = declared[name]
        if unit == other:
            continue
        stated = NOT_STATED not in (unit, other)
        if stated and read_unit(unit).steps_to(read_unit(other)) == (1.0, 1.0, 0.0):
            continue
        raise ModelError(
            f"the channel {name} is declared as input and as output in two units",
            seen=" and ".join("not stated" if one == NOT_STATED else one for one in (other, unit)),
            allowed="one unit: the data of a channel arrive in one",
            cure=f"give unit={(other if unit == NOT_STATED else unit)!r} in both places",
        )


def check_output_units(
    outputs: Sequence[tuple[Variable, Any]], states: Sequence[tuple[Variable, Any]]
) -> None:
    """Raise ModelError for an output that is a state as it stands, in another unit than the state's.

    Pairs of what was declared and its SX scalar.
    """
    own = {symbol.element_hash(): state for state, symbol in states}
    for out, value in outputs:
        state = own.get(value.element_hash()) if value.is_symbolic() else None
        if state is None or NOT_STATED in (out.unit, state.unit):
            continue
        there, here = read_unit(out.unit), read_unit(state.unit)
        if not is_of_one_kind(amount_of(out.unit), amount_of(state.unit)):
            raise ModelError(
                f"the output {out.name} is the state {state.name} as it stands, and counts something else",
                seen=f"{out.name} in {out.unit}, {state.name} in {state.unit}",
                allowed=f"an expression that is in {out.unit}, or an output in {state.unit}",
                cure="write the expression that is measured, or mend one of the units",
            )
        if there.dimension != here.dimension or here.steps_to(there) == (1.0, 1.0, 0.0):
            continue
        times, over, plus = here.steps_to(there)
        written = state.name if times == over else f"{times / over:.12g}*{state.name}"
        written += f" {'-' if plus < 0 else '+'} {abs(plus):.12g}" if plus else ""
        raise ModelError(
            f"the output {out.name} is the state {state.name} as it stands, in another unit",
            seen=f"{out.name} in {out.unit}, {state.name} in {state.unit}",
            allowed="an expression that is in the unit of the output",
            cure=f"write {written}, or declare the output in {state.unit}",
        )


def check_crank_angle(inputs: Sequence[Variable]) -> None:
    """Raise ModelError for an input theta in degrees: cycles are counted by it, in rad, wherever a record turns."""
    for variable in inputs:
        if variable.name == "theta" and variable.unit != NOT_STATED:
            unit = read_unit(variable.unit)
            if unit.dimension == "rad" and not unit.is_si:
                raise ModelError(
                    "an input called theta is the crank angle, and that is in rad",
                    seen=f"theta in {variable.unit}",
                    allowed="rad",
                    cure='declare it with unit="rad" (the data may be in any unit of angle), or call it otherwise',
                )


def refuse_other_clocks(name: str, entering: Sequence[Variable | ParameterDeclaration]) -> None:
    """Raise ModelError for a unit such as 1/h in equations of which nobody said whether they are per hour."""
    for item in entering:
        clocks = () if item.unit == NOT_STATED else read_unit(item.unit).clocks
        if clocks:
            raise ModelError(
                f"is the time of the model {name} in s or in {clocks[0]}? It was not stated",
                seen=f"{item.name} in {item.unit}; without time_unit an ode is a rate per second",
                allowed="time_unit=... of the Blueprint: ns, us, ms, s, min, h, d",
                cure=f'write Blueprint("{name}", time_unit="{clocks[0]}") if the odes are per {clocks[0]}, or '
                f'time_unit="s" if they are per second and convert {item.name} themselves',
            )
