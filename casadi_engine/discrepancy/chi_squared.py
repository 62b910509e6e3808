"""What a null model leaves of the data."""

from __future__ import annotations

from collections.abc import Mapping

from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel


def chi_squared(null: NullModel, sigma: Mapping[str, float]) -> float:
    """Sum of ((y - y_hat)/sigma)^2 and of the priors; sigma : output -> standard deviation of white noise."""
    noise = NoiseModel(sigma)
    found = float((null.prior[:, -1] ** 2).sum())
    for record in null.records:
        for name, e in record.residual.items():
            found += float((noise.whiten(record, name, e[:, None]) ** 2).sum())
    return found
