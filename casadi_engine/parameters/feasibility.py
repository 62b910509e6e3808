"""Proof that what is asked of parameters contradicts itself before any data are seen: constraints that are linear in
the free parameters and cannot be met within the bounds, and priors that have next to nothing within them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ConstraintError, ParameterError

if TYPE_CHECKING:
    from casadi_engine.parameters.compiled import CompiledConstraint, CompiledPrior

# Levels of operations to which two expressions are compared.
_DEEP = 20
SLACK = 1e-9
# Standard deviations beyond which less than one in a million of a normal prior lies.
OUTSIDE = 5.0
INFEASIBLE = 2  # scipy.optimize.linprog's status


def check_feasible(
    z: Any,
    constraints: Sequence[CompiledConstraint],
    start: NDArray[np.float64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
) -> None:
    """Raise ConstraintError if the constraints that are affine in `z` cannot be met within the bounds.

    z : SX (nz, 1); start, lower, upper : (nz,). The cheapest answer comes first: a start that meets
    everything; then interval arithmetic, which names one constraint; then a linear program, which names
    them all. Constraints that are not affine are left to the solver, but for bounds of one expression that have
    nothing in common.
    """
    if not constraints:
        return
    stacked = ca.vertcat(*(constraint.expression for constraint in constraints))
    low = np.array([constraint.min for constraint in constraints])
    high = np.array([constraint.max for constraint in constraints])
    value, slope = (part.full() for part in ca.Function("g", [z], [stacked, ca.jacobian(stacked, z)])(start))
    value = value.ravel()
    sides = np.stack((np.where(np.isfinite(low), low, 0), np.where(np.isfinite(high), high, 0), value))
    slack = SLACK * np.nan_to_num(np.abs(sides)).max(axis=0)
    if np.all((value >= low - slack) & (value <= high + slack)):
        return
    affine = [i for i, constraint in enumerate(constraints) if ca.is_linear(constraint.expression, z)]
    _check_alike([one for i, one in enumerate(constraints) if i not in affine])
    if not affine:
        return
    value, slope, low, high, slack = value[affine], slope[affine], low[affine], high[affine], slack[affine]
    for row, index in enumerate(affine):
        _check_interval(constraints[index], value[row], slope[row], slack[row], lower - start, upper - start)
    told = [f"{constraints[i].label} {_limits(constraints[i].min, constraints[i].max)}" for i in affine]
    _check_together(told, value, slope, low, high, start, lower, upper)


def _check_alike(constraints: Sequence[CompiledConstraint]) -> None:
    """Raise ConstraintError for two constraints on one expression whose bounds have nothing in common."""
    for one, other in combinations(constraints, 2):
        apart = one.min > other.max or one.max < other.min
        if apart and ca.is_equal(one.expression, other.expression, _DEEP):
            raise ConstraintError(
                f"two constraints on {one.label} cannot be met together",
                seen=f"{one.min:g} to {one.max:g}, and {other.min:g} to {other.max:g}",
                allowed="bounds that have values in common",
                cure="correct one of them, or give both sides in one call",
            )


def check_priors(
    z: Any, priors: Sequence[CompiledPrior], lower: NDArray[np.float64], upper: NDArray[np.float64]
) -> None:
    """Raise ParameterError for a prior that is affine in `z` and has next to nothing of its probability within the
    bounds: lower, upper : (nz,)."""
    affine = [one for one in priors if ca.is_linear(one.expression, z)]
    if not affine:
        return
    stacked = ca.vertcat(*(one.expression for one in affine))
    function = ca.Function("priors", [z], [stacked, ca.jacobian(stacked, z)])
    value, slope = (part.full() for part in function(np.zeros(z.numel())))
    for one, at, own in zip(affine, value.ravel(), slope, strict=True):
        used = own != 0  # 0 * inf is nan
        if not used.any():  # it hangs on what is fixed, as in a profile: a number that is added
            continue
        ends = np.stack((own[used] * lower[used], own[used] * upper[used]))
        least, most = at + ends.min(axis=0).sum(), at + ends.max(axis=0).sum()
        if max(least - one.mean, one.mean - most) > OUTSIDE * one.sigma:
            raise ParameterError(
                f"the prior of {one.label} lies outside its bounds",
                seen=f"{one.mean:.6g} ± {one.sigma:.3g}, where bounds leave {least:.6g} to {most:.6g}",
                allowed=f"a prior with a mean within {OUTSIDE:g} of its standard deviations from the bounds",
                cure="widen the bounds, or correct the prior",
            )


def _check_interval(
    constraint: CompiledConstraint,
    value: float,
    slope: NDArray[np.float64],
    slack: float,
    down: NDArray[np.float64],
    up: NDArray[np.float64],
) -> None:
    used = slope != 0  # 0 * inf is nan
    ends = np.stack((slope[used] * down[used], slope[used] * up[used]))
    least, most = value + ends.min(axis=0).sum(), value + ends.max(axis=0).sum()
    if least > constraint.max + slack or most < constraint.min - slack:
        raise ConstraintError(
            f"the constraint {constraint.label} cannot be met within the bounds of its parameters",
            seen=f"it can be {least:.6g} to {most:.6g} at most",
            allowed=f"{constraint.min:.6g} to {constraint.max:.6g}",
            cure="widen the bounds of the parameters, or the constraint",
        )


def _limits(low: float, high: float) -> str:
    """``from 1 to 3``, and one side where there is one."""
    if low == high:
        return f"= {low:g}"
    if math.isinf(low):
        return f"<= {high:g}"
    return f">= {low:g}" if math.isinf(high) else f"from {low:g} to {high:g}"


def _check_together(
    labels: Sequence[str],
    value: NDArray[np.float64],
    slope: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    start: NDArray[np.float64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
) -> None:
    if len(labels) < 2:
        return  # the interval has answered for a single one
    from scipy.optimize import linprog  # 0.1 s to import, and hardly ever needed

    # in steps from the start, in units of each parameter's magnitude, rows of magnitude one
    scale = np.where(start != 0, np.abs(start), 1.0)
    rows = slope * scale
    size = np.abs(rows).max(axis=1)
    size[size == 0] = 1.0
    rows, low, high = rows / size[:, None], (low - value) / size, (high - value) / size
    matrix = np.concatenate((rows[np.isfinite(high)], -rows[np.isfinite(low)]))
    limit = np.concatenate((high[np.isfinite(high)], -low[np.isfinite(low)]))
    box = [
        (a if math.isfinite(a) else None, b if math.isfinite(b) else None)
        for a, b in zip((lower - start) / scale, (upper - start) / scale, strict=True)
    ]
    answer = linprog(np.zeros(start.size), A_ub=matrix, b_ub=limit, bounds=box, method="highs")
    if answer.status == INFEASIBLE:
        raise ConstraintError(
            "the constraints cannot be met together within the bounds of the parameters",
            seen="; ".join(labels),
            allowed="constraints that leave some values of the parameters",
            cure="take out or widen one of them, or widen the bounds",
        )
