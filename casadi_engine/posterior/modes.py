"""The optima of a posterior: searches from the fit's own, along what the data tell least of, and from around."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.levenberg_marquardt import Minimum, driven, steps_of
from casadi_engine.estimation.same_response import same_response
from casadi_engine.posterior.box import Box
from casadi_engine.posterior.mixture import Mixture
from casadi_engine.posterior.target import Target, first_states
from casadi_engine.posterior.valley import valleys

Array = NDArray[np.float64]

# Starts along the weakest directions, in standard errors, and their number; others are drawn so many times as wide,
# in turn, or from all over the bounds.
ALONG, WEAK, WIDE = (3.0, 6.0, 12.0), 2, (4.0, 16.0, np.inf)
# Other optima from which searches start again, and how far below the best they may be for that.
_AGAIN, _NEAR = 3, 10.0
# Information of which less is none: numbers below underflow.
_NONE = 1e-200
# Searches one after another that meet no new optimum so near the best: those from around, and those from rivals, end.
IDLE = 12
# Exchanges of parameters that are starts.
_PAIRS = 8
# Optima of which more is exchanged.
_EXPANDED = 16
# Directions along which valleys are looked for.
_DIRECTIONS = 6
# Two optima are one within this distance, in squared standard errors; those so far below the best are left out.
_SAME, _FAR = 0.05, 15.0
# Between two modes the density falls by this (in its logarithm) below the lower one; it is looked at so many points.
_DIP, _LOOKS = 1.0, 9
_STEPS, _FALL = 60, 1e-3
# Proposals are wider than the quadratic at an optimum foretells.
_WIDER = 1.5


@dataclass(frozen=True)
class Modes:
    """Optima at (k, d), the best first; information (k, d, d); height : (k,) log densities.

    ended : (k,) searches that ended at each; searches : all of them
    valley : points (m, d) along the valleys that lead away from the best ones, with the information (m, d, d) there
        and log densities (m,); looked : points v (l, nv) where valleys were looked for
    """

    at: Array
    information: Array
    height: Array
    ended: NDArray[np.intp]
    searches: int
    valley: tuple[Array, Array, Array]
    looked: Array

    def places(self, nv: int) -> Array:
        """The optima, the points along their valleys and those where one was looked for, as v (k, nv)."""
        return np.concatenate([self.at[:, :nv], self.valley[0][:, :nv], self.looked])

    def again(self, target: Target) -> Modes:
        """The same with the heights of a target that has other bins by now."""
        at, information, _ = self.valley
        height = target.log_density(self.at)
        order = np.argsort(-height)
        return replace(
            self,
            at=self.at[order],
            information=self.information[order],
            height=height[order],
            ended=self.ended[order],
            valley=(at, information, target.log_density(at)),
        )

    def mixture(self, box: Box) -> Mixture:
        """A proposal from the quadratics at the optima, and along their valleys; in the coordinates of ``box``."""
        at, information, height = self.valley
        scale = np.asarray(np.linalg.inv(np.concatenate([self.information, information])), dtype=np.float64)
        mass = np.concatenate([self.height, height]) + 0.5 * np.linalg.slogdet(scale)[1]
        share = np.exp(mass - mass.max())
        return box.mixture(
            share / share.sum() + 0.3 / len(share), np.concatenate([self.at, at]), _WIDER * scale
        )


def find_modes(
    target: Target, fit: Fit, random: np.random.Generator, *, wide: int, met: Sequence[Array] = ()
) -> Modes | None:
    """The optima that searches lead to; ``wide`` of them start around, others at points v that were ``met``. None where
    the data do not hold a parameter."""
    first = target.squares(target.start[: target.nv])
    if first is None or not _definite(first.matrix):
        return None
    starts, around = _starts(target, fit, inverse(first.matrix), random, wide)
    searches = _Searches(target)
    searches.several(starts)
    _exchanges(target, searches)
    known = np.array([one.fixed for one in next(iter(fit.initial.values())).values()], dtype=bool)
    begun = first_states(target.search, fit)
    alike = [at for at, _ in same_response(target.search, target.start[: target.nv], begun, known)]
    searches.several([*alike, *met])
    searches.until_idle(around)
    found = searches.found
    if wide and len(found) > 1:  # from the rivals, as from the fit's own
        rivals = sorted((one for one in found[1:] if searches.near(one[2])), key=lambda one: one[2])
        searches.until_idle([at for x, matrix, _ in rivals[:_AGAIN] for at in along(x, inverse(matrix))])
    best = sorted(found, key=lambda one: one[2])[: _AGAIN if wide else 1]
    paths = [valleys(target, x, matrix, _DIRECTIONS) for x, matrix, _ in best]
    searches.several([one for path in paths for one in path.onwards[:_AGAIN]])
    ends = [(x, matrix) for x, matrix, _ in found]
    at, information, height = _dense(target, ends)
    near = np.flatnonzero(height > height.max(initial=-np.inf) - _FAR)
    order = near[np.argsort(-height[near])]
    if not len(order):
        return None
    along_valleys = [
        one for path in paths for one in zip(path.at, path.information, strict=True) if _definite(one[1])
    ]
    return Modes(
        at[order], information[order], height[order], np.array(searches.ended)[order], searches.tried,
        _dense(target, along_valleys), np.array([one for path in paths for one in path.looked]).reshape(-1, target.nv),
    )  # fmt: skip


class _Searches:
    """Optima (v, information, cost) that searches ended in, how many ended in each, and how many were tried."""

    def __init__(self, target: Target) -> None:
        self._target = target
        self._low, self._high = target.low[: target.nv], target.high[: target.nv]
        self.found: list[tuple[Array, Array, float]] = []
        self.ended: list[int] = []
        self.tried = 0

    def near(self, cost: float) -> bool:
        """Whether a cost is near the best one's."""
        return cost < min(own for _, _, own in self.found) + _NEAR

    def several(self, starts: Sequence[Array]) -> list[bool]:
        """Searches side by side; for each whether it ends in a new optimum that is near the best."""
        low, high = self._low, self._high
        begun = [steps_of(one, low, high, fall=_FALL, steps=_STEPS) for one in starts]
        return [self._take(end) for end in driven(begun, self._target.steep_of)]

    def _take(self, end: Minimum | None) -> bool:
        self.tried += 1
        low, high = self._low, self._high
        if end is None or not end.converged or not _definite(end.squares.matrix):
            return False
        x, more = self._target.met(end.x)
        if more.any():  # at the limits of constraints
            own = self._target.squares(x)
            if own is None or not _definite(own.matrix):
                return False
            end = replace(end, x=x, squares=own)
        same = _place(self.found, end.x)
        if same is not None:
            self.ended[same] += 1
            return False
        self.found.append((end.x, _held(end, low, high) + more, end.squares.cost))
        self.ended.append(1)
        return self.near(end.squares.cost)

    def until_idle(self, starts: Sequence[Array]) -> None:
        """Searches, until so many meet nothing new."""
        idle, left = 0, [*starts]
        while left and idle < IDLE:
            now, left = left[: IDLE - idle], left[IDLE - idle :]
            for new in self.several(now):
                idle = 0 if new else idle + 1


def _dense(target: Target, points: list[tuple[Array, Array]]) -> tuple[Array, Array, Array]:
    """Points u (k, d) at the fit's noise levels, the information (k, d, d) and log density (k,) there."""
    d = len(target.start)
    at = np.array([np.concatenate([x, target.start[target.nv :]]) for x, _ in points]).reshape(-1, d)
    information = np.array([target.information(matrix) for _, matrix in points]).reshape(-1, d, d)
    return at, information, target.log_density(at)


def inverse(matrix: Array) -> Array:
    """Of a symmetric matrix, by its scaled entries; directions without any information stay out of it."""
    told = np.diag(matrix) > _NONE
    size = np.sqrt(np.where(told, np.diag(matrix), 1.0))
    scaled = np.where(np.outer(told, told), matrix, 0.0) / np.outer(size, size)
    return np.asarray(np.linalg.pinv(scaled, hermitian=True) / np.outer(size, size), dtype=np.float64)


def _definite(matrix: Array) -> bool:
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return bool(np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix / np.outer(size, size))[0] > 1e-11)


def _held(end: Minimum, low: Array, high: Array) -> Array:
    """The information (nv, nv) at an optimum. On a bound towards which the density still rises it falls inwards as an
    exponential of that slope, and a normal density is as wide with the slope's square as its information."""
    slope = end.squares.gradient
    pressed = ((end.x <= low) & (slope > 0)) | ((end.x >= high) & (slope < 0))
    return np.asarray(end.squares.matrix + np.diag(np.where(pressed, slope, 0.0) ** 2))


def _place(found: list[tuple[Array, Array, float]], x: Array) -> int | None:
    for k, (at, matrix, _) in enumerate(found):
        moved = x - at
        if moved @ matrix @ moved < _SAME:
            return k
    return None


def along(centre: Array, covariance: Array) -> list[Array]:
    """Points to either side of a point along the weakest directions."""
    values, vectors = np.linalg.eigh(covariance)
    return [
        centre + side * far * np.sqrt(values[k]) * vectors[:, k]
        for k in np.argsort(values)[::-1][:WEAK]
        for far in ALONG
        for side in (-1.0, 1.0)
    ]


def _starts(
    target: Target, fit: Fit, covariance: Array, random: np.random.Generator, wide: int
) -> tuple[list[Array], list[Array]]:
    """Where searches start: the fit's optima and points along what the data tell least of, and ``wide`` from around."""
    centre = target.start[: target.nv]
    known = []
    for optimum in fit.optima:
        if optimum.status == "converged" and all(name in optimum.values for name in target.free):
            known.append(target.coordinates.of(np.array([optimum.values[name] for name in target.free])))
    lines = along(centre, covariance) if wide else along(centre, covariance)[:2]
    factor = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    around = [_drawn(target, centre, factor, WIDE[k % len(WIDE)], random) for k in range(wide)]
    return [centre, *known, *lines], around


def _exchanges(target: Target, searches: _Searches) -> None:
    """Searches from the fit's own point with something exchanged, and from every optimum that these lead to: of several
    signs that are not told, each doubles the optima."""
    left, most = [target.start[: target.nv]], _EXPANDED
    while left and most:
        most -= 1
        before = len(searches.found)
        searches.several(_exchanged(target, left.pop(0)))
        left += [at for at, _, cost in searches.found[before:] if searches.near(cost)]


def _exchanged(target: Target, v: Array) -> list[Array]:
    """A point v (nv,) with a parameter of the other sign, or all that may have it, with two of one unit exchanged, or
    two such pairs: rates in a row and branches side by side often have another optimum there, which no direction from
    here leads to."""
    z = target.coordinates.values(v)
    low, high = target.low[: target.nv], target.high[: target.nv]
    pairs = [(i, j) for i, j in combinations(range(target.nv), 2) if target.units[i] == target.units[j]]
    twice = [both for both in combinations(pairs, 2) if len({*both[0], *both[1]}) == 4]
    others = [np.where(np.arange(target.nv) == k, -z, z) for k in np.flatnonzero(z)]
    pmap = target.search.pmap
    others.append(np.where((pmap.lower <= -z) & (-z <= pmap.upper), -z, z))  # gains of one state go together
    for exchange in islice([*((pair,) for pair in pairs), *twice], _PAIRS):
        others.append(z.copy())
        for i, j in exchange:
            others[-1][[i, j]] = others[-1][[j, i]]
    with np.errstate(invalid="ignore"):  # a logarithm has one sign
        found = [target.coordinates.of(one) for one in others]
    return [at for at in found if (at >= low).all() and (at <= high).all()]


def _drawn(target: Target, centre: Array, factor: Array, wide: float, random: np.random.Generator) -> Array:
    """A start so many standard errors away, at random; between the bounds where these are nearer."""
    away = factor @ random.standard_normal(target.nv)
    low, high = target.low[: target.nv], target.high[: target.nv]
    if np.isfinite(wide):
        return np.asarray(centre + wide * away)
    width = high - low
    bounded = np.isfinite(width)
    anywhere = np.where(bounded, low, 0.0) + random.random(len(low)) * np.where(bounded, width, 0.0)
    return np.where(bounded, anywhere, centre + WIDE[-2] * away)


def separate(modes: Modes, target: Target) -> list[list[int]]:
    """Optima (their numbers) that belong together, as no dip of the density lies between them: one list for a mode."""
    groups: list[list[int]] = []
    share = np.linspace(0, 1, _LOOKS + 2)[1:-1, None]
    for k, at in enumerate(modes.at):
        for group in groups:
            best = group[0]
            line = target.log_density(modes.at[best] + share * (at - modes.at[best]))
            if line.min() > min(modes.height[best], modes.height[k]) - _DIP:
                group.append(k)
                break
        else:
            groups.append([k])
    return groups
