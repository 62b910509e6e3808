"""Delays of all sensors by one and the same time: what an input that acts late does."""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca

from casadi_engine.estimation.summary import with_error

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import Repair

_DELAY = "sensor_delay"
# Standard errors within which delays are one.
_ALIKE = 3.0


def common_delay(repair: Repair) -> str:
    """What to say where every sensor is late by the same time; "" elsewhere, and of a model without inputs or whose
    equations depend on time itself, as by an event.

    Else the states do not know the time: with inputs that act late by τ all outputs are those without delay at t - τ,
    but for where the record begins.
    """
    model = repair.model
    late = {one.at: one.amplitude for one in repair.effects if one.name == _DELAY}
    sensors = [port.name for port in model.ports if port.kind == "sensor"]
    inputs = [variable.name for variable in model.inputs]
    equations = ca.vertcat(model.closed_ode, model.output_expressions)
    if not inputs or set(late) != set(sensors) or ca.depends_on(equations, model.t):
        return ""
    sizes = [(one.value, one.stderr or one.quadratic or 0.0) for one in late.values()]
    if not all(error > 0 for _, error in sizes):
        return ""
    weight = sum(error**-2 for _, error in sizes)
    mean, error = sum(value / own**2 for value, own in sizes) / weight, weight**-0.5
    if any(abs(value - mean) > _ALIKE * own for value, own in sizes):
        return ""
    which = f"the input {inputs[0]} acts" if len(inputs) == 1 else "the inputs act"
    far = f"{with_error(mean, error)} s later than recorded"
    if len(sizes) == 1:
        return f"The only sensor is late: where {which} {far} (an actuator, another clock), the data are the same"
    return (
        f"All {len(sizes)} sensors are late by one time: where {which} {far} (an actuator, another clock), the data "
        "are the same, and one cause does it"
    )
