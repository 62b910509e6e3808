"""Whether a start has ended where no other one can be better: nothing is left to explain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.autoregression import autoregression
from casadi_engine.estimation.followed import FOLLOWED
from casadi_engine.estimation.residual_noise import own_noise
from casadi_engine.estimation.search import Attempt, Search

Array = NDArray[np.float64]


def nothing_left(search: Search, attempt: Attempt) -> bool:
    """True for an optimum whose residual is white, of the stated level where there is one, and beside what the
    simulation follows: at another one the residual could only be less than its own noise.

    A white residual that is most of an output may be a response to an input that is white itself.
    """
    if attempt.solution.status != "converged" or attempt.pending or not attempt.run:
        return False
    search._weigh(attempt.sigma)
    try:
        return _nothing_left(search, attempt)
    except FloatingPointError:  # it ended where the model has no numbers: the other starts may do better
        return False


def _nothing_left(search: Search, attempt: Attempt) -> bool:
    """See ``nothing_left``; of an optimum that is simulated."""
    if own_noise(search, attempt):
        return False
    points = search.problem.at(attempt.solution.x).records
    for record, point in zip(search.records, points, strict=True):
        for name in record.observation.where:
            r = record.observation.series(point.r, name)
            valid = record.observation.series(record.observation.valid, name).astype(bool)
            if not valid.any():
                continue
            measured = record.grid.measured[name].values / search.sigma[search.records[0].outputs.index(name)]
            size = float(np.std(measured[np.isfinite(measured)]))
            left = float(np.sqrt(np.mean(r[valid] ** 2)))
            if left > (1 - FOLLOWED / 100) * size or not is_white(np.where(valid, r, 0.0), valid):
                return False
    return True


def is_white(residual: Array, valid: NDArray[np.bool_]) -> bool:
    """True if no autoregression of a residual (N,) is worth its coefficients."""
    if not residual.any():
        return True
    variances, count = autoregression(residual[:, None], valid).variances, int(valid.sum())
    return int(np.argmin(count * np.log(variances) + np.log(count) * np.arange(len(variances)))) == 0
