"""Parameters that explain the data as well with their values exchanged: the rates of a chain of which the last member
alone is measured, the two exponentials of a sum. No search from one start meets the other optimum, and all that is
looked at around one says nothing of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ModelError
from casadi_engine.estimation.final_check import printed_cost, residual, response
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.standard_errors import Uncertainty
from casadi_engine.estimation.starts import nodes_by_first

Array = NDArray[np.float64]

# Squared standard errors within which values that are exchanged are the same ones; samples that are simulated at most.
_ALIKE, _WORK = 25.0, 3e6
# Share of the information below which a state shows nothing.
_BLIND = 1e-12


@dataclass(frozen=True)
class Twin:
    """Two parameters that may be exchanged: their names, the point v (nv,) where they are, and its chi-squared above
    the optimum's."""

    names: tuple[str, str]
    v: Array
    higher: float


def twins(search: Search, errors: Uncertainty, residuals: Sequence[Array], limit: float) -> list[Twin]:
    """The pairs of one unit whose exchange raises chi-squared by less than ``limit``, all else as it is but for the
    first states of linear models, which are at their best.

    residuals : (K, M) of each record at the optimum
    """
    here, found = printed_cost(search, errors.v, residuals), []
    nv = search.problem.nv
    metric = np.linalg.pinv(errors.covariance.matrix[:nv, :nv], hermitian=True)
    most = int(_WORK // max(search.problem.samples, 1))
    for count, (i, j) in enumerate(_pairs(search)):
        if count == most:
            break
        z = search.coordinates.values(errors.v)
        z[[i, j]] = z[[j, i]]
        if not (search.pmap.lower <= z).all() or not (z <= search.pmap.upper).all():
            continue
        v = search.coordinates.of(z)
        moved = v - errors.v
        if moved @ metric @ moved < _ALIKE or search.constraints.violated(v):
            continue
        try:
            with np.errstate(all="ignore"):  # a model may have no value there
                left = [_best(search, record, v, errors.x, k) for k, record in enumerate(search.records)]
        except (FloatingPointError, np.linalg.LinAlgError, ModelError):
            continue
        higher = printed_cost(search, v, left) - here
        if higher < limit:
            found.append(Twin((search.pmap.free[i], search.pmap.free[j]), v, higher))
    return found


def _pairs(search: Search) -> Iterator[tuple[int, int]]:
    """Numbers of free parameters that have one unit."""
    units = [search.parameters[name.split("@")[0]].unit for name in search.pmap.free]
    for i, unit in enumerate(units):
        yield from ((i, j) for j in range(i + 1, len(units)) if units[j] == unit)


def _best(search: Search, record: RecordTerm, v: Array, x: Array, k: int) -> Array:
    """The weighted residual (K, M) of a record with parameters v, its first state as it serves best."""
    lay = search.problem.layouts[k]
    start = lay.take(x)[0]
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
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    moved = -np.linalg.lstsq(matrix / np.outer(size, size), gradient / size, rcond=_BLIND)[0] / size
    return np.asarray(left + (js @ (powers @ moved).T) * record.weight)
