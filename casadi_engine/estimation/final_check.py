"""The last look at an optimum: is it stationary, and do the values as they are printed explain the data as it does?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ModelError
from casadi_engine.estimation.fit import Optimum
from casadi_engine.estimation.integration import SHARE, alike
from casadi_engine.estimation.ipopt import ONE_STEP
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.standard_errors import Uncertainty, uncertainty
from casadi_engine.estimation.starts import chained_nodes, joined_nodes

Array = NDArray[np.float64]

# Chi-squared that one more Gauss-Newton step may promise at most: the optimum is then within 0.03 standard errors
# in every direction, which no reader of the estimates can tell.
_STATIONARY = 1e-3
# What is called an optimum against the solver's word promises less still: 0.001 standard errors.
_EXACT = 1e-6
_STUCK = ("Search_Direction_Becomes_Too_Small", "Maximum_Iterations_Exceeded")
# Chi-squared that a step along what has no slope may bring: a tenth of what a standard error changes it by.
_FALL = 0.1
# Parts of a step that are tried where it may lead over a corner.
_PARTS = (1.0, 0.3, 0.1)
# Share of chi-squared by which rounding moves it.
_UNMOVED = 1e-10
# Directions that are tried so, each by itself.
_MOST = 4


def response(record: RecordTerm, v: Array, start: Array) -> tuple[Array, Any]:
    """Outputs (K, M) of the trajectory from ``start`` (n,), or from the first of nodes (M, n) near it, and the
    observation that lays them out."""
    nodes = chained_nodes(record, v, start) if start.ndim == 1 else joined_nodes(record, v, start)
    return record.outputs_at(v, nodes)[0], record.observation


def residual(record: RecordTerm, y: Array) -> Array:
    """The weighted residual (K, M) of outputs (K, M)."""
    return np.where(record.weight > 0, y - record.observation.measured, 0.0) * record.weight


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
    if status == "converged" and not np.isfinite(errors.decrement):
        bare = "the equations have no finite slope at this point: a root, a power or a quotient of a state is at 0"
        return f"not converged: {bare}", bare
    reason = _saddle(search, errors, printed_cost(search, errors.v, residuals))
    if reason is not None:
        return f"not converged: {reason}", reason
    stuck = best.solution.words in _STUCK and not search.settles and not errors.directions
    if status != "converged" and (not stuck or search.constraints.violated(errors.v)):
        return status, None
    weights = search.levels.weights(best.sigma)
    decrement, found, shown = errors.decrement, best.cost, printed_cost(search, errors.v, residuals)
    if not np.array_equal(weights, best.sigma):
        shown = printed_cost(search, errors.v, residuals, weights)
        found = search.cost_of(best, weights)
        errors = uncertainty(search, best)
        decrement = errors.decrement
        search._weigh(best.sigma)
    same = alike(shown, found)
    if status != "converged":
        return ("converged" if same and decrement <= _EXACT else status), None
    if not same:
        reason = (
            f"the simulation from the printed values has chi-squared {shown:.6g}, the search found {found:.6g} with "
            "its shooting intervals joined within its tolerance only"
        )
    elif not decrement <= _STATIONARY and not _corner(search, errors, residuals):
        reason = f"{ONE_STEP} would still lower chi-squared by {decrement:.3g}, more than {_STATIONARY:g}"
    else:
        return status, None
    return f"not converged: {reason}", reason


def _saddle(search: Search, errors: Uncertainty, cost: float) -> str | None:
    """A parameter without slope whose change lowers chi-squared all the same: p where the model has p**2, from 0.

    What the data do not determine is moved to either side by a hundredth of its scale and by all of it, each direction
    by itself, and all together (a product may need two).
    """
    lost = errors.covariance.directions
    if not lost:
        return None
    tried: list[tuple[Any, str]] = [
        (one, words.text) for one, words in zip(lost, errors.directions, strict=True)
    ][:_MOST]
    records = [_in_one_piece(search, record) for record in search.records]
    if len(lost) > 1:
        text = " and ".join(words.text for words in errors.directions)
        alternating = (-1.0) ** np.arange(len(lost))
        tried += [(np.sum(lost, axis=0), text), (alternating @ np.array(lost), text)]
    nv, lower, upper = len(errors.v), search.lower, search.upper
    for direction, text in tried:
        idle, unmoved = not direction[:nv].any(), 0
        for step in (-1e-2, 1e-2, -1.0, 1.0):
            v = np.clip(errors.v + step * direction[:nv], lower[:nv], upper[:nv])
            moved, at = [], nv
            try:
                for record, lay in zip(records, search.problem.layouts, strict=True):
                    start = lay.take(errors.x)[0] + step * direction[at : at + record.n]
                    start = np.clip(start, lower[lay.at : lay.at + lay.n], upper[lay.at : lay.at + lay.n])
                    moved.append(residual(record, response(record, v, start)[0]))
                    at += record.n
                fall = cost - printed_cost(search, v, moved)
            except (FloatingPointError, np.linalg.LinAlgError, ModelError):
                continue
            unmoved += idle and abs(fall) <= _UNMOVED * cost
            if unmoved == 2:
                break  # to both sides: what nothing depends on, as an angle that is counted from anywhere
            if fall > _FALL + SHARE * cost and not search.constraints.violated(v):
                return (
                    f"the data have no slope in {text} here, yet a step of {step:g} times its scale lowers "
                    f"chi-squared by {fall:.3g}"
                )
    return None


def _corner(search: Search, errors: Uncertainty, residuals: Sequence[Array]) -> bool:
    """True where no part of the promised step, too small to see, brings what it promises: slopes jump there.

    Chi-squared has a corner where the instant of an event passes a sample. Along what the data hardly determine the
    step is as long as slopes may hold, by rounding it may be any.
    """
    if errors.step is None:
        return False
    nv, lower, upper = len(errors.v), search.lower, search.upper
    size = np.where(search.coordinates.log, 1.0, np.maximum(1.0, np.abs(errors.v)))
    reach = 1.0 / max(1.0, float(np.abs(errors.step[:nv] / size).max(initial=0.0)))
    if not (reach * (2 - reach) * errors.decrement <= _FALL):
        return False
    cost = printed_cost(search, errors.v, residuals)
    records = [_in_one_piece(search, record) for record in search.records]
    for share in reach * np.array(_PARTS):
        v = np.clip(errors.v + share * errors.step[:nv], lower[:nv], upper[:nv])
        moved, at = [], nv
        try:
            for record, lay in zip(records, search.problem.layouts, strict=True):
                start = lay.take(errors.x)[0] + share * errors.step[at : at + record.n]
                start = np.clip(start, lower[lay.at : lay.at + lay.n], upper[lay.at : lay.at + lay.n])
                moved.append(residual(record, response(record, v, start)[0]))
                at += record.n
            fall = cost - printed_cost(search, v, moved)
        except (FloatingPointError, np.linalg.LinAlgError, ModelError):
            return False
        if fall > 0.5 * share * (2 - share) * errors.decrement:
            return False
    return True


def _in_one_piece(search: Search, record: RecordTerm) -> RecordTerm:
    """The record as its simulation wants it: nonlinear models have to be laid out anew, so once for many points."""
    if record.linear or record.plan.m == 1:
        return record
    whole = record.single()
    whole.set_sigma(search.sigma)
    return whole


def cure(reason: str, length: float | None = None) -> str:
    """What to do about such a doubt; length : [s] of records that can be simulated in one piece, if these cannot."""
    if reason.startswith(ONE_STEP):
        return f"{reason}: go on from here (warm=fit), start elsewhere, or fix what the data do not determine"
    if reason.startswith("the equations have no finite slope"):
        return f"{reason}: take data from before it, or make the equations smooth there"
    if reason.startswith("the data have no slope"):
        return f"{reason}: start elsewhere, not where the outputs do not depend on it (such as 0)"
    if length is not None:
        return (
            f"{reason}: the motion is unstable, and no start leads along the whole record: cut it into pieces of up "
            f"to {length:.2g} s, record.pieces({length:.2g})"
        )
    return (
        f"{reason}: the motion is so sensitive to its start that the record cannot be simulated in one piece: "
        "take a shorter record; or states are far from their scale: give b.state(..., scale=...)"
    )


def relabelled(optima: Sequence[Optimum], status: str) -> tuple[Optimum, ...]:
    """The optima with this status of the best one."""
    return tuple(one if one.apart else replace(one, status=status) for one in optima)
