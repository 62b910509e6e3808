"""Parameters that explain the data as well with their values exchanged: the rates of a chain of which the last member
alone is measured, the two exponentials of a sum. No search from one start meets the other optimum, and all that is
looked at around one says nothing of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ModelError
from casadi_engine.estimation.chained import chained_slopes
from casadi_engine.estimation.final_check import printed_cost, residual, response
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.standard_errors import Uncertainty
from casadi_engine.estimation.starts import chained_nodes, nodes_by_first

Array = NDArray[np.float64]

# Squared standard errors within which values that are exchanged are the same ones; samples that are simulated at most.
_ALIKE, _WORK = 25.0, 3e6
# Share of the information below which a state shows nothing.
_BLIND = 1e-12
# Steps of the others at an exchange; chi-squared that one leaves, as a share, for another to be worth its time.
_STEPS, _FALLS = 8, 0.5
# Coordinates within which two ends are one.
_SAME = 1e-2


@dataclass(frozen=True)
class Twin:
    """Parameters that may be exchanged: their names by pairs, the point v (nv,) where they are, and its chi-squared
    above the optimum's."""

    pairs: tuple[tuple[str, str], ...]
    v: Array
    higher: float

    def __str__(self) -> str:
        """ "k1 and k2", or "R1 and R2, and C1 and C2"."""
        return ", and ".join(" and ".join(pair) for pair in self.pairs)


def twins(search: Search, errors: Uncertainty, residuals: Sequence[Array], limit: float) -> list[Twin]:
    """The pairs of one unit, and two of them at once, whose exchange raises chi-squared by less than ``limit``, the
    others and the first states at their best.

    residuals : (K, M) of each record at the optimum
    """
    here = printed_cost(search, errors.v, residuals)
    found: list[Twin] = []
    nv = search.problem.nv
    metric = np.linalg.pinv(errors.covariance.matrix[:nv, :nv], hermitian=True)
    most = int(_WORK // max(search.problem.samples, 1))
    free = search.pmap.free
    for pairs in _exchanges(search):
        if most <= 0:
            break
        z, ways = search.coordinates.values(errors.v), {k for pair in pairs for k in pair}
        for i, j in pairs:
            z[[i, j]] = z[[j, i]]
        if not (search.pmap.lower <= z).all() or not (z <= search.pmap.upper).all():
            continue
        v = search.coordinates.of(z)
        moved = v - errors.v
        if moved @ metric @ moved < _ALIKE:
            continue
        exchange = _Exchange(search, errors, sorted(ways), here + limit)
        try:
            with np.errstate(all="ignore"):  # a model may have no value there
                higher = exchange.settled(v) - here
        except (FloatingPointError, np.linalg.LinAlgError, ModelError):
            higher = np.inf
        most -= exchange.work
        new = not any(np.allclose(exchange.v, one.v, rtol=0, atol=_SAME) for one in found)
        if higher < limit and new and not search.constraints.violated(exchange.v):
            found.append(Twin(tuple((free[i], free[j]) for i, j in pairs), exchange.v, higher))
    return found


class _Exchange:
    """Parameters exchanged, and what the others make of it.

    work : simulations so far; v : (nv,) where the exchange ended
    """

    def __init__(self, search: Search, errors: Uncertainty, held: list[int], limit: float) -> None:
        self._search, self._held, self._limit, self.work = search, held, limit, 0
        self.v = errors.v
        self._starts = [lay.take(errors.x)[0] for lay in search.problem.layouts]

    def settled(self, v: Array) -> float:
        """Chi-squared with the exchange at v (nv,), the others going on from there where that serves."""
        cost = self._cost(v)
        for _ in range(_STEPS):
            before = cost
            if cost < self._limit or self._search.predictor.kind != "none":
                break
            v = self._stepped(v)
            cost = self._cost(v)
            if not cost < _FALLS * before:
                break
        self.v = v
        return cost

    def _cost(self, v: Array) -> float:
        self.work += 1
        search = self._search
        left = [
            _best(search, record, v, start, k)
            for k, (record, start) in enumerate(zip(search.records, self._starts, strict=True))
        ]
        return printed_cost(search, v, left)

    def _stepped(self, v: Array) -> Array:
        """The point (nv,) after a Gauss-Newton step of all the others, straight in the parameters as they are printed:
        a gain is met in one, however far it is."""
        search, nv, at = self._search, len(v), len(v)
        sizes = [record.n for record in search.records]
        gradient, matrix = np.zeros(nv + sum(sizes)), np.zeros((nv + sum(sizes), nv + sum(sizes)))
        _, gradient[:nv], _, matrix[:nv, :nv] = search.problem.priors.evaluate(v)
        for record, start in zip(search.records, self._starts, strict=True):
            self.work += 1 + len(record.active) + record.n
            point = record.evaluate(v, chained_nodes(record, v, start))
            slopes = chained_slopes(record, point)
            slopes = slopes.reshape(len(slopes), -1)
            own = np.concatenate([record.active, np.arange(at, at + record.n)])
            gradient[own] += slopes @ point.r.ravel()
            matrix[np.ix_(own, own)] += slopes @ slopes.T
            at += record.n
        unit = np.concatenate([search.coordinates.slope(v), np.ones(sum(sizes))])
        now = np.concatenate([search.coordinates.values(v), *self._starts])
        low, high = self._limits()
        free = low < high
        free[self._held] = False
        moved = _least_squares(gradient / unit, matrix / np.outer(unit, unit), free)
        after = np.clip(now + moved, low, high)
        self._starts = np.split(after[nv:], np.cumsum(sizes)[:-1])
        return search.coordinates.of(after[:nv])

    def _limits(self) -> tuple[Array, Array]:
        """Bounds (N,) of parameters, as they are printed, and of first states."""
        search = self._search
        low, high = (
            np.concatenate([values, *(ends[lay.at : lay.at + lay.n] for lay in search.problem.layouts)])
            for values, ends in ((search.pmap.lower, search.lower), (search.pmap.upper, search.upper))
        )
        return low, high


def _least_squares(gradient: Array, matrix: Array, free: NDArray[np.bool_]) -> Array:
    """The step (N,) to the minimum of a quadratic, of what is free alone; none along what it does not know."""
    if not (np.isfinite(matrix).all() and np.isfinite(gradient).all()):
        raise FloatingPointError("the slopes are not finite here")
    moved = np.zeros(len(gradient))
    size = np.sqrt(np.maximum(np.diag(matrix)[free], 1e-300))
    whole = matrix[np.ix_(free, free)] / np.outer(size, size)
    moved[free] = -np.linalg.lstsq(whole, gradient[free] / size, rcond=_BLIND)[0] / size
    return moved


def _exchanges(search: Search) -> Iterator[tuple[tuple[int, int], ...]]:
    """Pairs of free parameters, by their numbers, that have one unit; then two pairs at once, as a resistance and a
    capacity of one branch are exchanged with those of another."""
    units = [search.parameters[name.split("@")[0]].unit for name in search.pmap.free]
    pairs = [(i, j) for i, j in combinations(range(len(units)), 2) if units[i] == units[j]]
    yield from ((pair,) for pair in pairs)
    yield from (both for both in combinations(pairs, 2) if len({*both[0], *both[1]}) == 4)


def _best(search: Search, record: RecordTerm, v: Array, start: Array, k: int) -> Array:
    """The weighted residual (K, M) of a record with parameters v from a first state; linear models as it serves
    best."""
    lay = search.problem.layouts[k]
    if not record.linear:
        return residual(record, response(record, v, start)[0])
    own = slice(lay.at, lay.at + lay.n)
    return linear_residual(record, v, start, np.isinf(search.lower[own]) & np.isinf(search.upper[own]))


def linear_residual(record: RecordTerm, v: Array, start: Array, free: NDArray[np.bool_]) -> Array:
    """The weighted residual (K, M) of a linear model from a first state (n,), whose free entries are at their best."""
    point = record.evaluate(v, np.zeros((record.plan.m, record.n)), order=0)
    js, n, by_first = point.js, record.n, nodes_by_first(point)
    powers, left = by_first[..., :n], point.r + (js @ by_first[..., n].T) * record.weight
    start = np.where(free, 0.0, start)
    left = left + (js @ (powers @ start).T) * record.weight
    if not free.any():
        return np.asarray(left)
    powers = powers[..., free]
    turned = powers.swapaxes(1, 2)
    gradient = (turned @ ((left * record.weight).T @ js)[..., None]).sum(axis=0)[:, 0]
    matrix = (turned @ record.gauss_newton(point).ss @ powers).sum(axis=0)
    if not (np.isfinite(matrix).all() and np.isfinite(gradient).all()):
        raise FloatingPointError("the slopes of the first states are not finite here")
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    moved = -np.linalg.lstsq(matrix / np.outer(size, size), gradient / size, rcond=_BLIND)[0] / size
    return np.asarray(left + (js @ (powers @ moved).T) * record.weight)
