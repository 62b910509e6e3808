"""Other optima of one parameter: the likelihood is walked along from bound to bound, the other parameters on their way.

A frequency, a delay or a switching time has optima side by side between its bounds, each so narrow that no search which
starts some standard errors away, or at random, ends there. One step of Gauss and Newton at each place tells how low the
cost gets with the other parameters at their best, and at what these are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.levenberg_marquardt import Squares
from casadi_engine.posterior.modes import inverse
from casadi_engine.posterior.target import Target

Array = NDArray[np.float64]
Place = tuple[float, Array]  # cost, point v (nv,)

# Places that are looked at in all, for the parameters along which a coarse walk meets other dips; those of that, and at
# least for a parameter; how far apart they are at least, in standard errors.
PLACES, COARSE, _FEWEST, _APART = 400, 100, 8, 1.5
# Standard errors to either side where there is no bound.
_OPEN = 100.0
# Dips from which searches start, those that the cost falls lowest in; how far it may stay above the lowest, and how
# much lower a dip lies than the ridges beside it.
_DIPS, _ABOVE, _DEEP = 12, 15.0, 0.5
# A way of the other parameters that is longer than this share of what is between their bounds leads nowhere.
_FAR = 0.25


def dips(target: Target) -> list[Array]:
    """Points v (nv,) in which the cost may have other optima than the fit's, the lowest first."""
    centre = target.squares(target.start[: target.nv])
    if centre is None:
        return []
    lines = _coarse(target, centre, list(range(target.nv)))
    uneven = [k for k, places in lines.items() if _of_line(target, k, places)]
    finer = _finer(target, {k: lines[k] for k in uneven})
    every = [one for k, places in (lines | finer).items() for one in _of_line(target, k, places)]
    lowest = min([centre.cost, *(cost for cost, _ in every)])
    every.sort(key=lambda one: one[0])
    return [at for cost, at in every[:_DIPS] if cost < lowest + _ABOVE]


def _of_line(target: Target, k: int, places: list[Place]) -> list[Place]:
    """The dips of places along a parameter, but for the fit's own."""
    costs, found = [cost for cost, _ in places], []
    for j in range(1, len(costs) - 1):
        ridge = min(max(costs[:j]), max(costs[j + 1 :]))
        low = costs[j] <= min(costs[j - 1], costs[j + 1]) and costs[j] < ridge - _DEEP
        if low and places[j][1][k] != target.start[k]:
            found.append(places[j])
    return found


def _coarse(target: Target, centre: Squares, which: list[int]) -> dict[int, list[Place]]:
    """Places along each of these parameters in the order of its values, from the fit's own to either side."""
    covariance, here = inverse(centre.matrix), target.start[: target.nv]
    lines, sides = _lines(target, covariance, which, COARSE), dict[int, tuple[_Walk, _Walk]]()
    for k, values in lines.items():
        own, way = int(np.searchsorted(values, here[k])), covariance[:, k] / covariance[k, k]
        sides[k] = _Walk(target, k, values[:own][::-1], here, way), _Walk(target, k, values[own:], here, way)
    _walked(target, [one for both in sides.values() for one in both])
    return {k: [*reversed(down.found), (centre.cost, here), *up.found] for k, (down, up) in sides.items()}


def _finer(target: Target, lines: dict[int, list[Place]]) -> dict[int, list[Place]]:
    """More places between those along these parameters: each gap is gone through by itself, all side by side, from its
    place next to the fit's own."""
    walks, still = list[tuple[int, int, bool, _Walk]](), np.zeros(target.nv)
    for k, places in lines.items():
        values = np.array([at[k] for _, at in places])
        more = PLACES // len(lines) / max(len(values) - 1, 1)
        for j in range(len(values) - 1):
            up = values[j] >= target.start[k]
            between = np.linspace(values[j], values[j + 1], max(int(more), 1) + 1)[1:-1]
            begun = places[j if up else j + 1][1]
            walks.append((k, j, up, _Walk(target, k, between if up else between[::-1], begun, still)))
    _walked(target, [one for *_, one in walks])
    found: dict[int, list[Place]] = {k: [] for k in lines}
    for k, j, up, walk in walks:
        found[k] += [lines[k][j], *(walk.found if up else reversed(walk.found))]
    return {k: [*own, lines[k][-1]] for k, own in found.items()}


def _lines(target: Target, covariance: Array, which: list[int], places: int) -> dict[int, Array]:
    """For each of these parameters the values that are looked at, in their order, its own not among them. One that has
    many standard errors between its bounds gets what others leave."""
    here, size = target.start[: target.nv], np.sqrt(np.diag(covariance))
    low, high = target.low[: target.nv], target.high[: target.nv]
    low, high = (
        np.where(np.isfinite(end), end, here + side * _OPEN * size)
        for side, end in ((-1.0, low), (1.0, high))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        wanted = np.where(size > 0, (high - low) / (_APART * size), 0.0)
    left, lines = places, {}
    for done, k in enumerate(sorted(which, key=lambda k: wanted[k])):
        count = int(min(max(left // (len(which) - done), _FEWEST), wanted[k]))
        left -= count
        apart = (high[k] - low[k]) / max(count, 1)
        below = np.arange(here[k] - apart, low[k], -apart)[::-1] if count else np.empty(0)
        lines[k] = np.append(below, np.arange(here[k] + apart, high[k], apart) if count else below)
    return lines


class _Walk:
    """Values of a parameter, one after another from a point ``begun``; found : places at those so far.

    way : (nv,) what the others do beside the parameter there
    """

    def __init__(self, target: Target, k: int, values: Array, begun: Array, way: Array) -> None:
        self._k, self._values, self._target = k, values, target
        self._low, self._high = target.low[: target.nv], target.high[: target.nv]
        width = self._high - self._low
        self._width = np.where(np.isfinite(width), width, np.inf)
        self._others = np.arange(target.nv) != k
        self._at, self._way, self.found = begun.copy(), way, list[Place]()

    def next(self) -> Array | None:
        """The point v (nv,) that is looked at next; None at the end."""
        if len(self.found) == len(self._values):
            return None
        value, others = self._values[len(self.found)], self._others
        at = self._at + (value - self._at[self._k]) * np.where(others, self._way, 1.0)
        self._at = np.clip(at, self._low, self._high)
        self._at[self._k] = value
        return self._at

    def take(self, there: Squares | None) -> None:
        """What was found there."""
        at, others = self._at, self._others
        self._way = np.zeros(len(at))
        if there is None or not np.isfinite(there.cost):
            self.found.append((np.inf, at.copy()))
            self._at = self._target.start[: self._target.nv].copy()
            return
        step = np.zeros(len(at))
        if others.any():
            own = there.matrix[np.ix_(others, others)]
            step[others] = -inverse(own) @ there.gradient[others]
            if (np.abs(step) > _FAR * self._width).any():
                step[:] = 0.0
        fall = -0.5 * float(there.gradient @ step)
        self._at = np.clip(at + step, self._low, self._high)
        self.found.append((there.cost - max(fall, 0.0), self._at.copy()))


def _walked(target: Target, walks: list[_Walk]) -> None:
    """Go all of these ways to their ends, side by side."""
    while left := [(one, at) for one in walks if (at := one.next()) is not None]:
        found = target.squares_of(np.array([at for _, at in left]), roughly=True)
        for (one, _), there in zip(left, found, strict=True):
            one.take(there)
