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
    covariance = inverse(centre.matrix)
    every, uneven = _along(target, centre, covariance, list(range(target.nv)), COARSE)
    if uneven:
        every += _along(target, centre, covariance, uneven, PLACES)[0]
    lowest = min([centre.cost, *(cost for cost, _ in every)])
    every.sort(key=lambda one: one[0])
    return [at for cost, at in every[:_DIPS] if cost < lowest + _ABOVE]


def _along(
    target: Target, centre: Squares, covariance: Array, which: list[int], places: int
) -> tuple[list[tuple[float, Array]], list[int]]:
    """Dips (cost, point) along these parameters, at so many places in all, and the parameters that have any."""
    found: list[tuple[float, Array]] = []
    uneven = []
    for k, values in _lines(target, covariance, which, places).items():
        here = int(np.searchsorted(values, target.start[k]))
        sides = _walk(target, k, values[:here][::-1], covariance), _walk(target, k, values[here:], covariance)
        walked = [*reversed(sides[0]), (centre.cost, target.start[: target.nv]), *sides[1]]
        costs, own = [cost for cost, _ in walked], len(found)
        for j in {*range(1, len(costs) - 1)} - {here}:
            ridge = min(max(costs[:j]), max(costs[j + 1 :]))
            if costs[j] <= min(costs[j - 1], costs[j + 1]) and costs[j] < ridge - _DEEP:
                found.append(walked[j])
        uneven += [k] if len(found) > own else []
    return found, uneven


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


def _walk(target: Target, k: int, values: Array, covariance: Array) -> list[tuple[float, Array]]:
    """(cost, point) at these values of a parameter, one after another from the fit's own."""
    low, high = target.low[: target.nv], target.high[: target.nv]
    width = np.where(np.isfinite(high - low), high - low, np.inf)
    others = np.arange(target.nv) != k
    at, found = target.start[: target.nv].copy(), []
    way = covariance[:, k] / covariance[k, k]  # of the others, where only the fit's own quadratic tells it
    for value in values:
        at = np.clip(at + (value - at[k]) * np.where(others, way, 1.0), low, high)
        at[k] = value
        there = target.squares(at)
        if there is None or not np.isfinite(there.cost):
            found.append((np.inf, at.copy()))
            way, at = np.zeros(len(at)), target.start[: target.nv].copy()
            continue
        step = np.zeros(len(at))
        if others.any():
            own = there.matrix[np.ix_(others, others)]
            step[others] = -inverse(own) @ there.gradient[others]
            if (np.abs(step) > _FAR * width).any():
                step[:] = 0.0
        fall = -0.5 * float(there.gradient @ step)
        at, way = np.clip(at + step, low, high), np.zeros(len(at))
        found.append((there.cost - max(fall, 0.0), at.copy()))
    return found
