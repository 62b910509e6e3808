"""Points along the valleys that lead away from an optimum, where a posterior falls more slowly than its quadratic says.

Draws that are proposed from the quadratics at optima do not find a thin valley that goes on for many standard errors,
and weights cannot tell what no draw has met. Along each of the directions that the data tell least of, the density is
looked at four standard errors away, everything else at its best; where it has not fallen as the quadratic foretells,
the valley is followed to its end. Where a direction leads out of the bounds, one parameter is moved in its place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.levenberg_marquardt import Squares, minimise
from casadi_engine.posterior.target import Target

Array = NDArray[np.float64]

# Where is looked at first [standard errors]; share of the fall that the quadratic foretells from which it holds.
LOOKED, HOLDS = (2.0, 4.0), 0.75
# How far one goes on at a time [standard errors, of the optimum or of the last point where these are smaller]; fall of
# the log density from one point to the next beyond which half of that is gone, so often at most.
STEP, STEEP, _HALVINGS = 1.5, 3.0, 4
# A valley ends where the log density is so far below its optimum, or after so many steps.
DEPTH, MOST = 12.0, 40
# A rise by this after a fall leads to another optimum.
_RISE = 0.5
# Searches across: the fall of the cost that ends them, their steps, and the longest of these [standard errors].
_FALL, _STEPS, _LONGEST = 1e-2, 20, 100.0


@dataclass(frozen=True)
class Valley:
    """Points at (k, nv) of a valley with the information (k, nv, nv) there, those from which the density rises, and
    those where it was looked at first."""

    at: list[Array]
    information: list[Array]
    onwards: list[Array]
    looked: list[Array]


def valleys(target: Target, centre: Array, information: Array, directions: int) -> Valley:
    """From an optimum of v (nv,), both ways along each of the directions that the data tell least of."""
    values, vectors = np.linalg.eigh(np.linalg.inv(information + between(target)))
    order = np.argsort(values)[::-1]
    axes = (vectors * np.sqrt(values))[:, order]  # (nv, nv), one standard error long
    found = Valley([], [], [], [])
    for k in range(min(directions, len(order))):
        for side in (-1.0, 1.0):
            if not _Side(target, centre, axes, k, side).follow(found):
                _Walled(target, centre, axes, k, side).follow(found)
    return found


def between(target: Target) -> Array:
    """(nv, nv) of the information that the bounds hold: that of a uniform density between them."""
    width = target.high[: target.nv] - target.low[: target.nv]
    return np.diag(12.0 / np.square(np.where(np.isfinite(width), np.maximum(width, 1e-300), np.inf)))


@dataclass
class _Point:
    """A point of a valley: ``far`` along its direction, ``near`` (nv - 1,) across, ``drop`` below the optimum."""

    far: float
    near: Array
    at: Array
    drop: float
    information: Array


class _Side:
    """One side of one direction from an optimum."""

    def __init__(self, target: Target, centre: Array, axes: Array, k: int, side: float) -> None:
        self._target, self._centre, self._axes, self._k = target, centre, axes, k
        self._way, self._rest = side * axes[:, k], np.delete(axes, k, axis=1)
        self._top, self._prior = _height(target, centre), between(target)

    def follow(self, found: Valley) -> bool:
        """Add the points of the valley on this side; False where nothing can be said of it."""
        centre = _Point(0.0, np.zeros(self._rest.shape[1]), self._centre, 0.0, np.zeros(0))
        looked = [self._point(far, centre.near) for far in LOOKED]
        found.looked.extend(one.at for one in looked if one is not None)
        if looked[-1] is None and not isinstance(self, _Walled):
            return False
        if looked[-1] is not None and looked[-1].drop > HOLDS * 0.5 * LOOKED[-1] ** 2:
            return True
        before, last, lowest, step = centre, centre, 0.0, STEP
        for _ in range(MOST):
            there = self._onwards(before, last, step)
            if there is None or there.drop > DEPTH:
                break
            if there.drop < lowest - _RISE:
                found.onwards.append(there.at)
            lowest = max(lowest, there.drop)
            found.at.append(there.at)
            found.information.append(there.information)
            before, last, step = last, there, STEP * min(self._error(there), 1.0)
        return True

    def _onwards(self, before: _Point, last: _Point, step: float) -> _Point | None:
        """The next point from the last one; None at a bound, and where there is no valley."""
        slope = (last.near - before.near) / (last.far - before.far) if last.far else np.zeros_like(last.near)
        for _ in range(_HALVINGS):
            there = self._point(last.far + step, last.near + slope * step)
            if there is None and slope.any():
                there = self._point(last.far + step, last.near)
            if there is not None and there.drop < last.drop + STEEP:
                return there
            step *= 0.5
        return there

    def _point(self, far: float, guess: Array) -> _Point | None:
        """The best point at a distance along the direction, from a guess (nv - 1,) across it."""
        start = self._centre + far * self._way
        end = minimise(
            _across(self._target, start, self._rest), guess,
            np.full(len(guess), -np.inf), np.full(len(guess), np.inf),
            fall=_FALL, steps=_STEPS, longest=lambda y: np.full_like(y, _LONGEST),
        )  # fmt: skip
        at = None if end is None else start + self._rest @ end.x
        squares = self._target.squares(at) if at is not None and _inside(self._target, at) else None
        if end is None or at is None or squares is None:
            return None
        return _Point(far, end.x, at, self._top - _height(self._target, at), squares.matrix + self._prior)

    def _error(self, point: _Point) -> float:
        """The standard error along the direction at a point, in units of the optimum's."""
        matrix = self._axes.T @ point.information @ self._axes
        return float(np.sqrt(np.linalg.pinv(matrix, hermitian=True)[self._k, self._k]))


class _Walled(_Side):
    """One side of one direction that leads out of the bounds: the parameter that it moves most goes on, in its standard
    errors, and all others are at their best between theirs."""

    def __init__(self, target: Target, centre: Array, axes: Array, k: int, side: float) -> None:
        super().__init__(target, centre, axes, k, side)
        self._held = int(np.argmax(np.abs(self._way) / np.linalg.norm(axes, axis=1)))
        self._others = np.delete(np.arange(target.nv), self._held)

    def _point(self, far: float, guess: Array) -> _Point | None:
        """The best point with the parameter so far on, from a guess (nv - 1,) of how far the others are from theirs."""
        low, high = (end[: self._target.nv] for end in (self._target.low, self._target.high))
        at = self._centre + far * self._way
        if not low[self._held] <= at[self._held] <= high[self._held]:
            return None
        others = self._others
        ahead = guess if guess.any() else far * self._way[others]
        end = minimise(
            _beside(self._target, at, others),
            np.clip(self._centre[others] + ahead, low[others], high[others]), low[others], high[others],
            fall=_FALL, steps=_STEPS, longest=lambda y: np.full_like(y, _LONGEST),
        )  # fmt: skip
        if end is None:
            return None
        at[others] = end.x
        squares = self._target.squares(at)
        if squares is None:
            return None
        drop = self._top - _height(self._target, at)
        return _Point(far, end.x - self._centre[others], at, drop, squares.matrix + self._prior)


def _beside(target: Target, at: Array, others: NDArray[np.intp]) -> Callable[[Array], Squares | None]:
    """The problem in some parameters, the others being held."""

    def evaluate(y: Array) -> Squares | None:
        there = at.copy()
        there[others] = y
        found = target.squares(there)
        return found and Squares(found.cost, found.gradient[others], found.matrix[np.ix_(others, others)])

    return evaluate


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
