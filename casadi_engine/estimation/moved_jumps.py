"""Free parameters that move a jump: searches and standard errors need slopes, and there is none in its place."""

from __future__ import annotations

import casadi as ca

from casadi_engine.errors import EstimationError
from casadi_engine.model import Model
from casadi_engine.model.jumps import jumps, jumps_in
from casadi_engine.parameters import Parameters


def refuse_moved_jumps(model: Model, parameters: Parameters) -> None:
    """Raise EstimationError if a free parameter moves a jump whose place has no slope.

    Those are jumps of outputs, and jumps of equations that depend on states: by their derivative, 0, the parameter
    would stay at its start and the others take its part, with small errors. A jump of the equations that depends on
    channels and time alone is met at its instant, which has a slope.
    """
    free = {name for name, one in parameters.items() if one.vary or one.tie is not None}
    rows = [row for row, name in enumerate(model.parameter_names) if name in free]
    moving = model.p[rows] if rows else ca.SX(0, 1)
    if not jumps_in(ca.vertcat(model.closed_ode, model.closed_outputs), moving):
        return
    for what, column, inside in (("ode", model.closed_ode, model.x), ("output", model.closed_outputs, None)):
        variables = model.states if what == "ode" else model.outputs
        for row, variable in enumerate(variables):
            for switch in jumps(column[row], moving):
                if switch.kind == "kink" or (inside is not None and not ca.depends_on(switch.g, inside)):
                    continue
                names = [model.parameter_names[k] for k in rows if ca.depends_on(switch.g, model.p[k])]
                where = f"the {what} of {variable.name}"
                raise EstimationError(
                    f"the free parameter {names[0]} moves a jump, and the effect of that on the outputs has no slope",
                    seen=f"{where} jumps at {switch.g} = {'a whole number' if switch.kind == 'integer' else 0}",
                    allowed="free parameters outside of sign, floor and conditions on states",
                    cure=f"fix {names[0]} and compare fits at several values, or round the jump: "
                    "0.5*(1 + tanh(v/width)) for v > 0",
                )
