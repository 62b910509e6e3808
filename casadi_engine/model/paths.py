"""Paths: an input of a model that may act at a further port."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from casadi_engine.experiment.units import NOT_STATED, read_unit
from casadi_engine.model.declarations import Port

if TYPE_CHECKING:
    from casadi_engine.model.model import Model

# Columns that are one but for rounding.
_ALIKE = 1e-9


def is_further(model: Model, path: Port, effect: Any) -> bool:
    """True if an effect may act by an input at a port beside what the input does in the model.

    One that reads by how much the input is above the port's own signal asks for that. One in proportion to the input
    asks that the input was recorded and acts on nothing; or that it has the unit of what acts there, or acts at other
    ports of that unit by a constant (the sun by an area on the air, and so on the floor), and that it does not act
    there alone, where that would be a wrong gain of it. What is an output too is no cause: stiff enough, a way from
    what was measured to where it is measured leads through every sample, whatever the model lacks.
    """
    (end,) = path.ends
    name = path.name.removesuffix(f"_to_{end}")
    if any(out.name == name for out in model.outputs):
        return False
    if "link" in effect.attaches or "pipe" in effect.attaches:
        return "difference" in path.signals
    symbol = model.u[[one.name for one in model.inputs].index(name)]
    if name in model.idle_inputs:
        return True
    if path.unit == NOT_STATED or path.units.get("input") in (None, NOT_STATED):
        return False
    acts = read_unit(path.unit).exponents
    alike = [port for port in model.ports if port.kind == "inertia" and _exponents(port) == acts]
    slots = [model.ports[end].slot, *(port.slot for port in alike if port.name != end)]
    by_input = ca.jacobian(model.closed_ode, symbol)
    by_slots = ca.jacobian(model.ode, ca.vertcat(*slots))
    unknown = [model.x, model.u, model.d, model.w, model.t]
    missing = {one.amplitude for one in model.effects}  # what they add is no part of what the input does
    values = ca.vertcat(*[0.0 if one.name in missing else one.value for one in model.declarations])
    look = ca.Function("look", [*unknown, model.p], [ca.horzcat(by_input, by_slots)])
    rng = np.random.default_rng(0)
    found, again = (
        np.array(look(*(rng.uniform(0.5, 1.5, one.numel()) for one in unknown), values)) for _ in range(2)
    )
    size = np.maximum(np.linalg.norm(found, axis=0), 1e-300)
    found, again = found / size, again / size
    if read_unit(path.units["input"]).exponents != acts:
        left = found[:, 0] - found[:, 1:] @ np.linalg.lstsq(found[:, 1:], found[:, 0], rcond=None)[0]
        levers = (
            np.abs(again[:, 0] - found[:, 0]).max() > _ALIKE
        )  # as a pressure by a crank: no share of it elsewhere
        if not found[:, 0].any() or levers or np.linalg.norm(left) > _ALIKE:
            return False
    return bool(np.linalg.matrix_rank(found[:, :2], tol=_ALIKE) > 1)


def _exponents(port: Port) -> object:
    """Those of the unit of what acts at a port; None where it is not stated."""
    return None if port.unit == NOT_STATED or port.slot is None else read_unit(port.unit).exponents
