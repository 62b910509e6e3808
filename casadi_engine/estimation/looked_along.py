"""The directions along which an optimum's likelihood is looked at, each one standard error long."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.search import Search
from casadi_engine.estimation.standard_errors import Uncertainty

Array = NDArray[np.float64]

# Variance of a direction, as a share of the largest, from which it is one.
_LEAST = 1e-12


def along_parameters(errors: Uncertainty, nv: int) -> list[Array]:
    """Directions (N,) of [v; initial states], those that the data tell least of first, the initial states on their way
    with them; what is at a bound stays there."""
    matrix = errors.kept
    return [matrix[:, :nv] @ own for own in _roots(matrix[:nv, :nv])]


def along_states(search: Search, errors: Uncertainty) -> list[Array]:
    """Directions (N,) of the initial states of each record that is not linear in them, the parameters held."""
    matrix, nv, found = errors.kept, search.problem.nv, []
    to = matrix[nv:, :nv] @ np.linalg.pinv(matrix[:nv, :nv], hermitian=True)
    rest, at = matrix[nv:, nv:] - to @ matrix[:nv, nv:], 0
    for record in search.records:
        own = slice(at, at + record.n)
        if not record.linear:
            found += [np.append(np.zeros(nv), rest[:, own] @ root) for root in _roots(rest[own, own])]
        at += record.n
    return found


def _roots(matrix: Array) -> list[Array]:
    """Columns r, the largest first, with matrix @ r one standard error along each of its own directions."""
    values, vectors = np.linalg.eigh(matrix)
    order = [k for k in np.argsort(values)[::-1] if values[k] > _LEAST * values[-1] and values[k] > 0]
    return [vectors[:, k] / np.sqrt(values[k]) for k in order]


def together(moves: list[Array]) -> list[Array]:
    """Two directions that go along all of these at once, one standard error long in all."""
    signs = np.ones(len(moves)), (-1.0) ** np.arange(len(moves))
    return [
        np.sum([s * move for s, move in zip(sign, moves, strict=True)], 0) / np.sqrt(len(moves))
        for sign in signs
    ]
