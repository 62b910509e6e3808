"""Least squares on directions that may repeat one another, for the tests in residual_tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casadi_engine.estimation.fit_percent import FloatArray

# A combination of drive lags with less than this share of the strongest one's energy is numerical dust.
WEAKEST = 1e-6
# A direction of which the fitted parameters absorbed more than 99 % of the energy cannot be tested.
ABSORBED = 1e-2
# Columns of a Jacobian that repeat one another to this relative size count once.
REPEATED = 1e-9


def orthonormal(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the columns' span; they may have any scale, also zero."""
    size = np.linalg.norm(columns, axis=0)
    scaled = columns[:, size > 0] / size[size > 0]
    frame, triangle = np.linalg.qr(scaled)
    rotation, strength, _ = np.linalg.svd(triangle)
    return np.asarray(frame @ rotation[:, strength > REPEATED * strength.max(initial=0.0)])


@dataclass(frozen=True, eq=False)
class QuadraticForm:
    """rᵀ (Φᵀ M Φ)⁺ r with M = I − Q Qᵀ, its rank, and the least-squares coefficients (Φᵀ M Φ)⁺ r."""

    value: float
    rank: int
    coefficients: FloatArray

    @staticmethod
    def of(scores: FloatArray, regressors: FloatArray, nuisance: FloatArray) -> QuadraticForm | None:
        """Return the form, None if M leaves nothing of Φ.

        The rank is found in two steps, for two reasons: first the lags that say the same are merged (a
        smooth drive has few independent lags), then what the fit absorbed is left out.
        """
        energy, directions = np.linalg.eigh(regressors.T @ regressors)
        if energy[-1] <= 0.0:
            return None
        strong = energy > WEAKEST * energy[-1]
        merge = directions[:, strong] / np.sqrt(energy[strong])
        overlap = (nuisance.T @ regressors) @ merge
        left, rotation = np.linalg.eigh(np.eye(merge.shape[1]) - overlap.T @ overlap)
        testable = left > ABSORBED
        if not testable.any():
            return None
        basis = merge @ (rotation[:, testable] / np.sqrt(left[testable]))
        projected = basis.T @ scores
        return QuadraticForm(float(projected @ projected), basis.shape[1], basis @ projected)
