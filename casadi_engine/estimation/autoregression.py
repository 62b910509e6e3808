"""An autoregression of a noise that is seen through a regression: restricted likelihood, by expectation-maximisation.

What columns X explain is taken from the noise e too, most of it where the columns are: a colour fitted to the remainder
alone has too little power there. The expected products e(t - i) e(t - j), given the data, are those of the remainder
plus those of X T, where T T' is the covariance of the coefficients: with them the fit is that of the restricted
likelihood (Patterson & Thompson 1971; Harville 1977).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from casadi_engine.estimation.fit_percent import FloatArray as Array

LARGEST_ORDER = 25


@dataclass(frozen=True, eq=False)
class Autoregression:
    """predictors : (1, -a_1, ..., -a_j) of order j = 0..p; variances : (p + 1,) of their innovations
    covariance : (p, p) of a_1 ... a_p
    """

    predictors: tuple[Array, ...]
    variances: Array
    covariance: Array


def autoregression(noise: Array, valid: NDArray[np.bool_]) -> Autoregression:
    """Fit autoregressions of rising order by least squares; the order is chosen by Akaike's criterion.

    noise : (n, 1 + q) the remainder, and columns that stand for what is not known of the rest; zeros where not valid
    Only rows whose whole past is present take part. The largest order leaves a quarter of the samples and ten rows a
    coefficient.
    """
    index = np.arange(len(valid))
    run = index - np.maximum.accumulate(np.where(valid, -1, index))
    lengths = np.bincount(np.minimum(run, LARGEST_ORDER + 1), minlength=LARGEST_ORDER + 2)
    rows = np.cumsum(lengths[:0:-1])[::-1]
    needed = np.maximum(10 * np.arange(1, LARGEST_ORDER + 2), np.count_nonzero(valid) / 4)
    largest = int(np.flatnonzero(rows >= needed).max(initial=0))
    products = _products(noise, run, largest)
    variances = _variances(np.linalg.cholesky(products.sum(axis=0)), rows[largest])
    order = int(np.argmin(rows[largest] * np.log(variances) + 2.0 * np.arange(largest + 1)))
    products = _products(noise, run, order)
    factor = np.linalg.cholesky(products.sum(axis=0))
    variances = _variances(factor, rows[order])
    predictors = tuple(
        np.append(1.0, -np.linalg.solve(factor[:j, :j].T, factor[-1, :j])) for j in range(order + 1)
    )
    # what is not known of the noise tells nothing of its colour
    seen = np.linalg.inv(products[0, :-1, :-1]) * variances[-1] if order else np.zeros((0, 0))
    return Autoregression(predictors, variances, seen)


def _products(noise: Array, run: NDArray[np.intp], order: int) -> Array:
    """(2, order + 1, order + 1) sums of products of e(t - 1) ... e(t - order), e(t): of the first column, and of all
    others together."""
    now = np.flatnonzero(run > order)
    out = np.zeros((2, order + 1, order + 1))
    if len(now) and now[-1] - now[0] + 1 == len(now):
        piece = noise[now[0] - order : now[-1] + 1]
        for k, part in enumerate((piece[:, :1], piece[:, 1:])):
            out[k] = np.roll(_lagged(part, order)[::-1, ::-1], -1, axis=(0, 1))
    else:
        for k, column in enumerate(noise.T):
            window = sliding_window_view(column, order + 1)[now - order]
            out[min(k, 1)] += np.roll((window.T @ window)[::-1, ::-1], -1, axis=(0, 1))
    # a column that predicts itself perfectly, or is zero, has no factor
    out[0][np.diag_indices(order + 1)] += 1e-12 * float(np.vdot(noise, noise)) + np.finfo(float).tiny
    return out


def _lagged(piece: Array, order: int) -> Array:
    """(order + 1, order + 1) sums over t and columns of e(t + a) e(t + b), for as many t as all lags have; by what
    enters and leaves a sum from one pair of lags to the next (Morf et al. 1977)."""
    rows = len(piece) - order
    out = np.empty((order + 1, order + 1))
    out[0] = [np.vdot(piece[:rows], piece[b : b + rows]) for b in range(order + 1)]
    first, last = piece[:order], piece[rows : rows + order]
    moved = last @ last.T - first @ first.T
    for a in range(order):
        out[a + 1, a + 1 :] = out[a, a:order] + moved[a, a:]
    return np.asarray(np.triu(out) + np.triu(out, 1).T)


def _variances(factor: Array, rows: int) -> Array:
    return np.asarray(np.cumsum(factor[-1, ::-1] ** 2)[::-1] / rows)
