"""Points along the valleys that lead away from an optimum, where a posterior falls more slowly than its quadratic says.

Draws that are proposed from the quadratics at optima do not find a thin valley that goes on for many standard errors,
and weights cannot tell what no draw has met. Along each of the directions that the data tell least of, the density is
looked at four standard errors away, everything else at its best; where it has not fallen as the quadratic foretells,
the valley is followed to its end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.levenberg_marquardt import Squares, minimise
from casadi_engine.posterior.target import Target

Array = NDArray[np.float64]

# Where is looked, and how far one goes on from there at a time [standard errors]; share of the fall that the quadratic
# foretells from which it holds.
LOOKED, STEP, HOLDS = (2.0, 4.0), 1.5, 0.75
# A valley ends where the log density is so far below its optimum, or after so many steps.
DEPTH, MOST = 12.0, 40
# A rise by this after a fall leads to another optimum.
_RISE = 0.5
# Searches across: the fall of the cost that ends them, their steps, and the longest of these [standard errors].
_FALL, _STEPS, _LONGEST = 1e-2, 20, 100.0


@dataclass(frozen=True)
class Valley:
    """Points at (k, nv) of a valley with the information (k, nv, nv) there, and those from which the density rises."""

    at: list[Array]
    information: list[Array]
    onwards: list[Array]


def valleys(target: Target, centre: Array, information: Array, directions: int) -> Valley:
    """From an optimum of v (nv,), both ways along each of the directions that the data tell least of."""
    values, vectors = np.linalg.eigh(np.linalg.inv(information))
    order = np.argsort(values)[::-1]
    axes = (vectors * np.sqrt(values))[:, order]  # (nv, nv), one standard error long
    found = Valley([], [], [])
    top = _height(target, centre)
    for k in range(min(directions, len(order))):
        for side in (-1.0, 1.0):
            _follow(target, centre, axes, k, side, top, found)
    return found


def _follow(
    target: Target, centre: Array, axes: Array, k: int, side: float, top: float, found: Valley
) -> None:
    """One side of one direction."""
    rest, near = np.delete(axes, k, axis=1), np.zeros(axes.shape[1] - 1)
    before, far, lowest = near, 0.0, 0.0
    points: list[tuple[Array, Array]] = []
    for count in range(len(LOOKED) + MOST):
        last, far = far, LOOKED[count] if count < len(LOOKED) else far + STEP
        guess = near if count < 2 else near + (near - before) * (far - last) / STEP
        start = centre + side * far * axes[:, k]
        end = minimise(
            _across(target, start, rest), guess, np.full(len(near), -np.inf), np.full(len(near), np.inf),
            fall=_FALL, steps=_STEPS, longest=lambda y: np.full_like(y, _LONGEST),
        )  # fmt: skip
        if end is None:
            break
        before, near = near, end.x
        at = start + rest @ near
        squares = target.squares(at) if _inside(target, at) else None
        drop = top - _height(target, at)
        if squares is None or not drop < DEPTH:
            break
        if drop < lowest - _RISE:
            found.onwards.append(at)
        lowest = max(lowest, drop)
        points.append((at, squares.matrix))
        if count == len(LOOKED) - 1 and drop > HOLDS * 0.5 * far**2:
            return
    if len(points) >= len(LOOKED):
        found.at.extend(at for at, _ in points)
        found.information.extend(matrix for _, matrix in points)


def _across(target: Target, start: Array, rest: Array) -> Callable[[Array], Squares | None]:
    """The problem in what is left of v beside one direction."""

    def evaluate(y: Array) -> Squares | None:
        at = start + rest @ y
        found = target.squares(at) if _inside(target, at) else None
        return found and Squares(found.cost, rest.T @ found.gradient, rest.T @ found.matrix @ rest)

    return evaluate


def _inside(target: Target, v: Array) -> bool:
    return bool(((v >= target.low[: target.nv]) & (v <= target.high[: target.nv])).all())


def _height(target: Target, v: Array) -> float:
    return float(target.log_density(np.concatenate([v, target.start[target.nv :]])[None])[0])
