"""Least squares on columns that may repeat one another: bases, projections and triangular compression."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Columns that repeat others to this relative size count once.
REPEATED = 1e-10


def svd(columns: Array) -> tuple[Array, Array, Array]:
    """The thin singular value decomposition (U, s, V') of finite columns: the fast algorithm fails on one of a million
    matrices, the plain one on none."""
    try:
        frame, strength, turn = np.linalg.svd(columns, full_matrices=False)
    except np.linalg.LinAlgError:
        from scipy import linalg

        if not np.isfinite(columns).all():
            raise
        frame, strength, turn = linalg.svd(columns, full_matrices=False, lapack_driver="gesvd")
    return np.asarray(frame), np.asarray(strength), np.asarray(turn)


def basis(columns: Array) -> Array:
    """(m, r) orthonormal basis of the span of (m, k) columns of any scale, also zero."""
    size = np.linalg.norm(columns, axis=0)
    used = size > 0
    if not used.any():
        return np.zeros((len(columns), 0))
    frame, strength, _ = svd(columns[:, used] / size[used])
    return np.asarray(frame[:, strength > REPEATED * strength[0]])


def without(frame: Array, columns: Array) -> Array:
    """The columns less their share in an orthonormal frame, projected twice against rounding."""
    out = columns - frame @ (frame.T @ columns)
    return np.asarray(out - frame @ (frame.T @ out))


def triangle(rows: Array) -> Array:
    """An upper triangular matrix with the same inner products between columns as ``rows``, never taller."""
    if len(rows) <= rows.shape[1]:
        return rows
    return np.asarray(np.linalg.qr(rows, mode="r"))


def coefficients(columns: Array, target: Array) -> Array:
    """Least-squares coefficients (k, ...) of ``target`` in columns of any scale; the least ones where they repeat."""
    size = np.linalg.norm(columns, axis=0)
    scale = np.where(size > 0, size, 1.0)
    frame, strength, turn = svd(columns / scale)
    good = strength > REPEATED * strength.max(initial=0.0)
    inner = (frame[:, good].T @ target) / strength[good].reshape(-1, *[1] * (target.ndim - 1))
    found = turn[good].T @ inner
    return np.asarray(found / scale.reshape(-1, *[1] * (target.ndim - 1)))


def inverse(turn: Array) -> Array:
    """(n, nz) the pseudo-inverse of directions (nz, n) in parameters of any size: a modulus of 1e10 and a leak of 1e-7
    stand in one matrix, of which the plain one takes the smaller for zero."""
    size = np.abs(turn).max(axis=1, initial=0.0)
    size = np.where(size > 0, size, 1.0)
    return np.asarray(np.linalg.pinv(turn / size[:, None]) / size)
