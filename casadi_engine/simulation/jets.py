"""Jets: matrix functions carried together with their first and second derivatives in the parameters.

A jet of order 2 in d parameters is one array of shape (1 + d + d(d+1)/2, rows, columns): the value, the d first
derivatives, then the second derivatives of the pairs (i, j), i <= j, in the order of ``numpy.triu_indices(d)``.
A jet of order 1 holds the first 1 + d of them, one of order 0 the value alone. Products of jets follow Leibniz' rule
with batched matrix products, so the cost of all derivatives is that of a few small matrix multiplications.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@cache
def pairs(d: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices (i, j), i <= j, of the second derivatives in d parameters."""
    i, j = np.triu_indices(d)
    return i, j


def count(d: int, order: int) -> int:
    """Number of matrices in a jet of the given order in d parameters."""
    return 1 + (d if order >= 1 else 0) + (d * (d + 1) // 2 if order >= 2 else 0)


def constant(value: Array, d: int, order: int) -> Array:
    """A jet whose derivatives vanish."""
    jet = np.zeros((count(d, order), *value.shape))
    jet[0] = value
    return jet


def product(x: Array, y: Array, d: int) -> Array:
    """The jet of the matrix product, of the order of its factors (both (k, ., .) of the same k)."""
    out = x[0] @ y
    if d == 0 or len(x) == 1:
        return out
    out[1:] += x[1:] @ y[0]
    if len(x) > 1 + d:
        i, j = pairs(d)
        cross = np.matmul(x[1 : 1 + d, None], y[None, 1 : 1 + d])
        out[1 + d :] += cross[i, j] + cross[j, i]
    return out


def transpose(x: Array) -> Array:
    """The jet of the transposed matrix."""
    return x.transpose(0, 2, 1)


def orders(x: Array, d: int) -> list[slice]:
    """The rows of first and of second derivatives that a jet holds, in this order.

    What solves an equation is found order by order: the equation's own jet at an unknown whose derivatives of the
    present order are still zero is the right-hand side for them.
    """
    found = [slice(1, 1 + d)] if len(x) > 1 else []
    return [*found, slice(1 + d, len(x))] if len(x) > 1 + d else found


def inverse(x: Array, d: int) -> Array:
    """The jet of the inverse of a square matrix."""
    y = np.zeros_like(x)
    y[0] = np.linalg.inv(x[0])
    for part in orders(x, d):
        y[part] = -y[0] @ product(x, y, d)[part]
    return y


def cholesky(x: Array, d: int) -> Array:
    """The jet of the lower triangular factor y of x = y y', x symmetric and positive definite."""
    y = np.zeros_like(x)
    y[0] = np.linalg.cholesky(x[0])
    back = np.linalg.inv(y[0])
    for part in orders(x, d):
        missing = back @ (x - product(y, transpose(y), d))[part] @ back.T
        half = np.tril(missing)
        index = np.arange(x.shape[1])
        half[:, index, index] /= 2
        y[part] = y[0] @ half
    return y


def is_constant(x: Array) -> bool:
    """True if all derivatives vanish."""
    return not x[1:].any()


def norm(x: Array) -> float:
    """The 1-norm of a jet's value."""
    return float(np.abs(x[0]).sum(axis=0).max()) if x[0].size else 0.0
