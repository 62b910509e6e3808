"""The last look at an optimum: is it stationary, and do the values as they are printed explain the data as it does?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.fit import Optimum
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.standard_errors import Uncertainty, uncertainty

Array = NDArray[np.float64]

# Chi-squared that one more Gauss-Newton step may promise at most: the optimum is then within 0.03 standard errors
# in every direction, which no reader of the estimates can tell.
_STATIONARY = 1e-3
# What is called an optimum against the solver's word promises less still: 0.001 standard errors.
_EXACT = 1e-6
_STUCK = ("Search_Direction_Becomes_Too_Small", "Maximum_Iterations_Exceeded")
# Chi-squared by which the simulation from the printed values may differ from what the search found: the same amount,
# and a share for the rounding of long sums and the tolerance of continuity.
_ALIKE, _SHARE = 1e-3, 1e-6


def printed_cost(search: Search, v: Array, residuals: Sequence[Array], sigma: Array | None = None) -> float:
    """Chi-squared and priors of the simulation from the printed values.

    v : (nv,); residuals : (K, M) of each record, weighted by the search's levels; sigma : (ny,) other levels
    """
    total = search.problem.priors.evaluate(v)[0]
    for record, r in zip(search.records, residuals, strict=True):
        ratio = 1.0 if sigma is None else (search.sigma / sigma)[record.observation.column]
        total += search.loss.value(r * ratio)
    return 2 * float(total)


def verdict(
    search: Search, best: Attempt, errors: Uncertainty, residuals: Sequence[Array]
) -> tuple[str, str | None]:
    """The status of the best point, and why it is no optimum, or is not what is printed, though the solver says so.

    A point at which the solver stopped for want of shorter steps or of iterations is an optimum all the same if it is
    stationary and joined. Levels that were estimated from data without noise are taken no smaller than a search can
    resolve.
    """
    status = best.solution.status
    stuck = best.solution.words in _STUCK and not search.settles and not errors.directions
    if status != "converged" and (not stuck or search.constraints.violated(errors.v)):
        return status, None
    weights = search.levels.weights(best.sigma)
    decrement, found, shown = errors.decrement, best.cost, printed_cost(search, errors.v, residuals)
    if not np.array_equal(weights, best.sigma):
        shown = printed_cost(search, errors.v, residuals, weights)
        found = search.cost_of(best, weights)
        decrement = uncertainty(search, best).decrement
        search._weigh(best.sigma)
    alike = abs(shown - found) <= _ALIKE + _SHARE * abs(found)
    if status != "converged":
        return ("converged" if alike and decrement <= _EXACT else status), None
    if not alike:
        reason = (
            f"the simulation from the printed values has chi-squared {shown:.6g}, the search found {found:.6g} with "
            "its shooting intervals joined within its tolerance only"
        )
    elif not decrement <= _STATIONARY:
        reason = f"one more step would still lower chi-squared by {decrement:.3g}, more than {_STATIONARY:g}"
    else:
        return status, None
    return f"not converged: {reason}", reason


def cure(reason: str) -> str:
    """What to do about such a doubt."""
    if reason.startswith("one more step"):
        return f"{reason}: go on from here (warm=fit), start elsewhere, or fix what the data do not determine"
    return (
        f"{reason}: the motion is so sensitive to its start that the record cannot be simulated in one piece: "
        "take a shorter record; or states are far from their scale: give b.state(..., scale=...)"
    )


def relabelled(optima: Sequence[Optimum], status: str) -> tuple[Optimum, ...]:
    """The optima with this status of the best one."""
    return tuple(one if one.apart else replace(one, status=status) for one in optima)
