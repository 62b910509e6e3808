"""Whitening of a coloured residual with gaps by an autoregression, for the tests in residual_tests.

References: H. B. Mann and A. Wald (1943) for the autoregression, H. Akaike (1974) for its order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from casadi_engine.estimation.autoregression import autoregression
from casadi_engine.estimation.fit_percent import BoolArray, FloatArray

if TYPE_CHECKING:
    from scipy import sparse

SPECTRUM = 1024


@dataclass(frozen=True, eq=False)
class Whitener:
    """The colour of a residual as an autoregression, and the linear map that removes it.

    predictors : (1, −a_1, …, −a_j) of order j = 0..p, the coefficients of the innovation
    variances : (p + 1,) innovation variance of each order
    valid : (n,) bool, which samples are present
    """

    predictors: tuple[FloatArray, ...]
    variances: FloatArray
    valid: BoolArray

    @staticmethod
    def white(valid: BoolArray) -> Whitener:
        """Return the map that changes nothing."""
        return Whitener((np.ones(1),), np.ones(1), valid)

    @staticmethod
    def of(residual: FloatArray, valid: BoolArray, uncertain: FloatArray | None = None) -> Whitener:
        """Fit the autoregression to an (n,) residual that holds zeros where a sample is missing.

        uncertain : (n, q) square root of the covariance of what a regression took from the residual; zeros there too
        """
        columns = residual[:, None] if uncertain is None else np.column_stack([residual, uncertain])
        found = autoregression(columns, valid)
        return Whitener(found.predictors, found.variances, valid)

    @property
    def order(self) -> int:
        """Order p of the autoregression; 0 for a white residual, which the map leaves as it is."""
        return len(self.predictors) - 1

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """Return the (n, n) lower banded map of a complete stretch to white noise of one variance."""
        return _whitening_matrix(self.predictors, self.variances, self.valid.size)

    def largest_gain_over(self, other: Whitener) -> float:
        """Return by how much at most, over frequency, this map amplifies more than another one."""
        own, others = (
            np.abs(np.fft.rfft(noise.predictors[-1], SPECTRUM)) ** 2 / noise.variances[-1]
            for noise in (self, other)
        )
        return float(np.max(own / others))

    def apply(self, columns: FloatArray) -> FloatArray:
        """Whiten (n, k) columns that hold zeros at missing samples, as if only the others existed."""
        return columns if self.order == 0 else np.asarray(self.matrix @ self.filled(columns))

    @property
    def log_determinant(self) -> float:
        """Return the logarithm of the determinant of the present samples' covariance, per innovation variance."""
        start = np.log(self.variances[:-1] / self.variances[-1])[: self.valid.size]
        found = float(start.sum())
        if self.order and not self.valid.all():
            _, bands = self._gaps
            from scipy import linalg

            found += 2 * float(np.log(linalg.cholesky_banded(bands, lower=True)[0]).sum())
        return found

    def filled(self, columns: FloatArray) -> FloatArray:
        """Return (n, k) columns with their missing samples as the others predict them."""
        if self.order == 0 or self.valid.all():
            return columns
        return _filled(columns, self.valid, self.matrix, *self._gaps)

    @cached_property
    def _gaps(self) -> tuple[sparse.csc_array, FloatArray]:
        return _gap_precision(self.valid, self.matrix, self.order)


def _whitening_matrix(
    predictors: tuple[FloatArray, ...], variances: FloatArray, size: int
) -> sparse.csr_array:
    """Return the (n, n) matrix that turns a stretch of the process into white noise of one variance.

    The first rows have less past than the order: they use the predictors of lower order, scaled. A
    stretch may be shorter than the order.
    """
    from scipy import sparse

    order = len(predictors) - 1
    rows, columns, entries = [], [], []
    for j, predictor in enumerate(predictors[:-1][:size]):
        rows.append(np.full(j + 1, j))
        columns.append(np.arange(j, -1, -1))
        entries.append(predictor * np.sqrt(variances[-1] / variances[j]))
    later = np.arange(order, size)
    for lag, coefficient in enumerate(predictors[-1]):
        rows.append(later)
        columns.append(later - lag)
        entries.append(np.full(later.size, coefficient))
    placed = (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_array(placed, shape=(size, size))


def _filled(
    columns: FloatArray,
    valid: BoolArray,
    matrix: sparse.csr_array,
    gaps: sparse.csc_array,
    bands: FloatArray,
) -> FloatArray:
    """Fill columns that hold zeros at missing samples so that they whiten as if only the present samples existed.

    With W the whitening matrix, filling the gaps so that ‖W x‖ is least gives xᵀ V⁻¹ x of the present
    samples exactly (Schur complement of the banded precision WᵀW), for all columns in one banded solve.
    """
    from scipy import linalg

    filled = columns.copy()
    filled[~valid] = -linalg.solveh_banded(bands, gaps.T @ (matrix @ columns), lower=True)
    return filled


def _gap_precision(
    valid: BoolArray, matrix: sparse.csr_array, order: int
) -> tuple[sparse.csc_array, FloatArray]:
    """Return the map's columns at missing samples, and their products in bands below the diagonal."""
    gaps = matrix.tocsc()[:, ~valid]
    precision = gaps.T @ gaps
    size = precision.shape[0]
    bands = np.zeros((min(order, size - 1) + 1, size))
    for below in range(bands.shape[0]):
        bands[below, : size - below] = precision.diagonal(-below)
    return gaps, bands
