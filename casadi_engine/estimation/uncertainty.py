"""Covariance of the estimate, through continuity, priors, ties, constraints and active bounds.

The intervals are chained first, so that only the parameters and the initial states remain; their information matrix
is restricted to the directions that active bounds and constraints leave open and inverted there. Directions without
information are named instead of inverted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from casadi_engine.estimation.record import Blocks, RecordPoint, RecordTerm

Array = NDArray[np.float64]

# Eigenvalues of the information matrix, scaled to unit diagonal, below which a direction counts as undetermined: the
# rounding of the matrix itself is about 1e-15 times its condition.
_NOTHING = 1e-12


@dataclass(frozen=True)
class Covariance:
    """matrix : (N, N) over [v; initial states of the records]; open : (N,) True where an entry has an error;
    directions : list of unit vectors (N,) in scaled units that the data do not determine"""

    matrix: Array
    open: NDArray[np.bool_]
    directions: list[Array]


def chained_information(record: RecordTerm, point: RecordPoint, blocks: Blocks) -> Array:
    """Information matrix (nz+n, nz+n) of [active parameters; initial state] of one record, nodes eliminated."""
    nz, n, m = len(record.active), record.n, record.plan.m
    end_z, end_s = point.path.end_z, point.path.end_s
    chain = np.empty((m, n, nz + n))
    chain[0, :, :nz], chain[0, :, nz:] = 0.0, np.eye(n)
    for i in range(m - 1):
        np.matmul(end_s[i if len(end_s) > 1 else 0], chain[i], out=chain[i + 1])
        chain[i + 1, :, :nz] += end_z[:, :, i].T
    total = np.einsum("mia,mij,mjb->ab", chain, blocks.ss, chain, optimize=True)
    mixed = np.einsum("zam,mab->zb", blocks.zs, chain, optimize=True)
    total[:nz] += mixed
    total[:, :nz] += mixed.T
    total[:nz, :nz] += blocks.zz
    return total


def invert(information: Array, closed: NDArray[np.bool_], active_rows: Array) -> Covariance:
    """Covariance from the information (N, N); closed : (N,) entries at a bound or fixed; active_rows : (c, N)
    gradients of the active constraints."""
    size = len(information)
    free = ~closed
    basis = np.eye(size)[:, free]
    if len(active_rows):
        basis = basis @ null_space(active_rows[:, free])
    inner = basis.T @ information @ basis
    spread = np.sqrt(np.maximum(np.diag(inner), 0.0))
    blind = spread <= 1e-150
    spread = np.where(blind, 1.0, spread)
    values, vectors = np.linalg.eigh(inner / np.outer(spread, spread))
    lost = values < _NOTHING * max(1.0, values[-1] if len(values) else 1.0)
    seen = vectors[:, ~lost] / spread[:, None]
    matrix = basis @ (seen / values[~lost]) @ seen.T @ basis.T
    directions, open_ = [], free.copy()
    for vector in (vectors[:, lost] / spread[:, None]).T:
        whole = basis @ vector
        whole = whole / np.linalg.norm(whole)
        directions.append(whole)
        open_ &= np.abs(whole) < 1e-6
    return Covariance(matrix, open_ & (np.diag(matrix) > 0), directions)


def in_words(vector: Array, names: list[str], most: int = 4) -> tuple[str, dict[str, float]]:
    """A direction in words: its largest entries, normalised to the largest."""
    order = np.argsort(-np.abs(vector))
    lead = vector[order[0]]
    weights = {names[i]: float(vector[i] / lead) for i in order if abs(vector[i] / lead) > 1e-3}
    terms = [f"{share:+.3g}*{name}" for name, share in list(weights.items())[:most]]
    text = " ".join(terms).lstrip("+").replace("1*", "", 1) if terms else ""
    if len(weights) == 1:
        return names[order[0]], weights
    return text + (" ..." if len(weights) > most else ""), weights
