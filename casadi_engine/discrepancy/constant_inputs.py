"""A constant at a port that is one and the same as an input which reads too high: what the data cannot tell."""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca

from casadi_engine.estimation.summary import with_error
from casadi_engine.experiment.units import NOT_STATED
from casadi_engine.model.port_view import constant_of

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import Repair

_CONSTANT = "constant_torque"
# What lies between degrees Celsius and kelvin, and the share of it that an offset may be off.
_ZERO, _CLOSE = 273.15, 0.01


def constant_inputs(repair: Repair) -> list[str]:
    """A sentence for each constant that was found where an input with an offset does just the same, with its size: of
    a temperature, that degrees Celsius may have been read as kelvin."""
    model, said = repair.null_fit.model, []
    for one in repair.effects:
        if one.name != _CONSTANT or one.at not in model.ports:
            continue
        port, size = model.ports[one.at], one.amplitude
        for variable, symbol in zip(model.inputs, ca.vertsplit(model.channels), strict=True):
            share = constant_of(model, port, symbol, repair.fit.values)
            if not share:
                continue
            offset, error = size.value / share, None if size.stderr is None else size.stderr / abs(share)
            unit = "" if variable.unit == NOT_STATED else f" {variable.unit}"
            words = (
                f"{_CONSTANT} at {one.at} is one and the same as an offset of the input {variable.name} by "
                f"{with_error(offset, error)}{unit}: no data of these outputs tell which"
            )
            if variable.unit == "K" and abs(abs(offset) - _ZERO) < _CLOSE * _ZERO:
                words += f"; {_ZERO} K lie between °C and K, so that its column may be in degC"
            said.append(words)
    return said
