"""Noise from white noise: the recursion of an autoregression.

For records of usual length a triangular banded solve does it; `scipy.signal` takes longer to import than a fit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

Array = NDArray[np.float64]

# Numbers of the band that is laid out, 16 MB; longer ones ask for the library that needs none.
_BAND = 2_000_000


def all_pole(predictor: Array, x: Array, gain: float = 1.0) -> Array:
    """Columns y (n, k) with y_t + a_1 y_(t-1) + ... + a_p y_(t-p) = gain x_t, at rest before.

    predictor : (1, a_1, ..., a_p); x : (n, k)
    """
    if len(predictor) * len(x) > _BAND:
        from scipy.signal import lfilter

        return np.asarray(lfilter([gain], predictor, x, axis=0))
    band = np.repeat(np.asarray(predictor, dtype=float)[: len(x), None], len(x), axis=1)
    found, _ = dtbtrs(band, gain * x, uplo="L")
    return np.asarray(found)
