"""Free parameters that move a jump of an output: searches and standard errors need slopes, and there is none."""

from __future__ import annotations

import casadi as ca

from casadi_engine.errors import EstimationError
from casadi_engine.model import Model
from casadi_engine.model.jumps import jumps, jumps_in
from casadi_engine.parameters import Parameters


def refuse_moved_jumps(model: Model, parameters: Parameters) -> None:
    """Raise EstimationError if a free parameter moves a jump of an output.

    By its derivative, 0, the parameter would stay at its start and the others take its part, with small errors. Jumps
    of the equations are met at their instants, which have slopes.
    """
    if not model.has_jumps:
        return
    free = {name for name, one in parameters.items() if one.vary or one.tie is not None}
    rows = [row for row, name in enumerate(model.parameter_names) if name in free]
    moving = model.p[rows] if rows else ca.SX(0, 1)
    if not jumps_in(model.closed_outputs, moving):
        return
    for row, variable in enumerate(model.outputs):
        for switch in jumps(model.closed_outputs[row], moving):
            if switch.kind == "kink":
                continue
            names = [model.parameter_names[k] for k in rows if ca.depends_on(switch.g, model.p[k])]
            place = "a whole number" if switch.kind == "integer" else 0
            raise EstimationError(
                f"the free parameter {names[0]} moves a jump, and the effect of that on the outputs has no slope",
                seen=f"the output {variable.name} jumps at {switch.g} = {place}",
                allowed="free parameters outside of sign, floor and conditions in outputs",
                cure=f"fix {names[0]} and compare fits at several values, or round the jump: "
                "0.5*(1 + tanh(v/width)) for v > 0",
            )
