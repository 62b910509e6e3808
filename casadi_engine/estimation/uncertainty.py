"""Covariance of the estimate, through continuity, priors, ties, constraints and active bounds.

The intervals are chained first, so that only the parameters and the initial states remain; their information
matrix is restricted to the directions that active bounds and constraints leave open and inverted there.
Directions without information are named instead of inverted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.record import Blocks, RecordPoint, RecordTerm

Array = NDArray[np.float64]

# Eigenvalues of the information matrix, scaled to unit diagonal, below which a direction counts as not
# determined: the rounding of the matrix itself is about 1e-15 times its condition.
_NOTHING = 1e-12
# Standard errors, in units of an entry's scale or value, from which it counts as not determined by itself.
_LOST = 1e8


@dataclass(frozen=True)
class Covariance:
    """Errors over the N entries of [v; initial states of the records].

    matrix : (N, N); rank : number of directions that the data determine; directions : orthonormal
    vectors (N,) in scaled units that they do not
    """

    matrix: Array
    rank: int
    directions: list[Array]


def chained_information(record: RecordTerm, point: RecordPoint, blocks: Blocks) -> Array:
    """Information matrix (nz+n, nz+n) of a record's active parameters and initial state, nodes eliminated."""
    nz, chain = len(record.active), chained(record, point)
    total = np.einsum("mia,mij,mjb->ab", chain, blocks.ss, chain, optimize=True)
    mixed = np.einsum("zam,mab->zb", blocks.zs, chain, optimize=True)
    total[:nz] += mixed
    total[:, :nz] += mixed.T
    total[:nz, :nz] += blocks.zz
    return total


def chained(record: RecordTerm, point: RecordPoint) -> Array:
    """What a record's active parameters and initial state do to the starts of its intervals, (M, n, nz + n)."""
    nz, n, m = len(record.active), record.n, record.plan.m
    end_z, end_s = point.path.end_z, point.path.end_s
    chain = np.empty((m, n, nz + n))
    chain[0, :, :nz], chain[0, :, nz:] = 0.0, np.eye(n)
    for i in range(m - 1):
        np.matmul(end_s[i if len(end_s) > 1 else 0], chain[i], out=chain[i + 1])
        chain[i + 1, :, :nz] += end_z[:, :, i].T
    return chain


def chained_gradient(record: RecordTerm, point: RecordPoint, slope: Array) -> Array:
    """Gradient (nz+n,) in a record's active parameters and initial state from that in its nodes (M, n), these
    eliminated; the parameters' own direct part is not in it."""
    nz, n = len(record.active), record.n
    found = np.zeros(nz + n)
    found[nz:] = slope[0]
    if len(slope) > 1:
        lam = joint_multipliers(point.path.end_s, slope)
        found[:nz] = np.einsum("zam,am->z", point.path.end_z[:, :, :-1], lam)
        found[nz:] += point.path.end_s[0].T @ lam[:, 0]
    return found


def joint_multipliers(end_s: Array, slope: Array) -> Array:
    """Multipliers (n, M-1) of continuity from the gradient (M, n) in the nodes, by one backward sweep."""
    m, n = slope.shape
    lam = np.empty((max(m - 1, 0), n))
    total = np.zeros(n)
    for i in range(m - 1, 0, -1):
        total = slope[i] + end_s[i if len(end_s) > 1 else 0].T @ total
        lam[i - 1] = total
    return lam.T


def invert(
    information: Array, closed: NDArray[np.bool_], active_rows: Array, at: Array | None = None
) -> Covariance:
    """Covariance from the information (N, N); closed : (N,) entries at a bound or fixed; active_rows : (c, N)
    gradients of the active constraints; at : (N,) the entries, whose size counts where they are beyond their scale.

    Where a slope is not finite (a root at zero) nothing is known: the matrix is NaN, the rank 0."""
    from scipy.linalg import null_space

    size = len(information)
    if not np.isfinite(information).all():
        return Covariance(np.full((size, size), np.nan), 0, [])
    free = ~closed
    basis = np.eye(size)[:, free]
    if len(active_rows):
        basis = basis @ null_space(active_rows[:, free])
    inner = basis.T @ information @ basis
    spread = np.sqrt(np.maximum(np.diag(inner), 0.0))
    size_of = np.ones(size) if at is None else np.maximum(1.0, np.abs(at))
    blind = spread * _LOST <= 1.0 / np.maximum(1.0, np.abs(basis).T @ size_of)
    spread = np.where(blind, 1.0, spread)
    values, vectors = np.linalg.eigh(inner / np.outer(spread, spread))
    lost = values < _NOTHING * max(1.0, values[-1] if len(values) else 1.0)
    seen = vectors[:, ~lost] / spread[:, None]
    matrix = basis @ (seen / values[~lost]) @ seen.T @ basis.T
    # Orthonormal, or all would lie along the entry that leaves the least trace and hide what they say of the others;
    # as what is at right angles to all that is seen, which rounding spoils least.
    told = vectors[:, ~lost].T * spread
    told /= np.linalg.norm(told, axis=1, keepdims=True)
    directions = basis @ np.linalg.svd(told)[2][len(told) :].T
    return Covariance(matrix, int(np.sum(~lost)), list(directions.T))


def orthonormal(vectors: Sequence[Array], turn: Array) -> Array:
    """Orthonormal (N, k) columns of the space that vectors (N,) span where ``turn`` (N, N) leads them."""
    if not len(vectors):
        return np.zeros((len(turn), 0))
    return np.asarray(np.linalg.qr(turn @ np.array(vectors).T)[0])


def in_words(vector: Array, names: list[str], most: int = 4) -> tuple[str, dict[str, float]]:
    """A direction in words, largest entries first, in units of the largest: ``J_eng - 0.5*C_eng``."""
    size = np.abs(vector) / np.abs(vector).max()
    order = np.argsort(-np.round(size, 6), kind="stable")  # equal entries stay in the order of their names
    weights = {names[i]: float(vector[i] / vector[order[0]]) for i in order if size[i] > 1e-3}
    text = ""
    for name, share in list(weights.items())[:most]:
        factor = f"{abs(share):.3g}*".removeprefix("1*")
        sign = ("" if share > 0 else "-") if not text else (" + " if share > 0 else " - ")
        text += f"{sign}{factor}{name}"
    return text + (" ..." if len(weights) > most else ""), weights
