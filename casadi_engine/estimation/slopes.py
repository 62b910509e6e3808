"""Whether a point of a search has slopes: a root, a power or a quotient may have a value without one."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from casadi_engine.errors import EstimationError
from casadi_engine.estimation.record import RecordPoint, RecordTerm
from casadi_engine.estimation.shooting import Point
from casadi_engine.model import Model


def check_slopes(records: Sequence[RecordTerm], point: Point) -> None:
    """Raise EstimationError where the residuals have no finite slopes: no search can leave such a point."""
    if has_slopes(point):
        return
    parts = zip(records, point.records, strict=True)
    bad = [record.experiment.name for record, part in parts if not _sloped(part)]
    names = sorted({name for record in records for name in _kinks(record.model)})
    raise EstimationError(
        "the equations have values but no finite slopes at the start values",
        seen=f"{', '.join(bad) or 'the priors'}: " + (", ".join(names) or "a slope that is not finite"),
        allowed="a start at which a small change of every state and parameter changes the outputs by a finite amount",
        cure="start away from there (initial=, or a start value), or make the equations smooth there: "
        "sqrt(h) has no slope at 0, sqrt(h + 1e-6) has",
    )


def has_slopes(point: Point) -> bool:
    """True where residuals and priors have finite slopes."""
    return bool(np.isfinite(point.gradient).all()) and all(_sloped(part) for part in point.records)


def _sloped(found: RecordPoint) -> bool:
    rows = (a for part in found.parts for a in (part.jz, part.js))
    return all(np.isfinite(a).all() for a in (found.path.end_s, found.path.end_z, *rows))


def _kinks(model: Model) -> list[str]:
    """Slopes of the equations that are not finite where the states are 0, in words."""
    slope = ca.jacobian(ca.vertcat(model.closed_ode, model.closed_outputs), ca.vertcat(model.x, model.p))
    function = ca.Function("slope", [model.x, model.u, model.t, model.p], [slope])
    at_zero = np.asarray(function(0, 1, 0, model.parameter_vector()), dtype=float)
    rows = [f"d{state.name}/dt" for state in model.states] + [out.name for out in model.outputs]
    columns = [*(state.name for state in model.states), *model.parameter_names]
    return [f"the slope of {rows[i]} by {columns[j]} at 0" for i, j in np.argwhere(~np.isfinite(at_zero))]
