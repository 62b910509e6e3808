"""A coloured residual that is none of the noise of a sensor."""

from __future__ import annotations

import math

import numpy as np

from casadi_engine.discrepancy.fresh_misfit import SEEN
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.selection import effective_samples, numbers_of

# Independent samples that a coloured residual has to be worth to be called noise, and per cent of an output's motion
# that what its own past foretells of it may be.
_SWINGS, _MOST = 6.0, 50.0
_NOT_NOISE = "no noise of that kind can be told from a missing effect"


def why_no_noise(
    record: str, output: str, e: Array, explained: float | None, innovations: float
) -> str | None:
    """Why a coloured residual e : (N,) is no noise: it swings a few times in its whole record, or is most of what was
    measured, or is seen beside the output and smooth, foretold by its own past. None where it may be noise.

    explained : per cent of the output that the model explains; innovations : standard deviation of what is not foretold
    """
    swings = effective_samples(e)
    if swings < _SWINGS:
        return (
            f"what the model leaves of {output} in {record} changes as slowly as if the record held "
            f"{swings:.0f} independent samples: {_NOT_NOISE}"
        )
    if (swings := numbers_of(e)) < _SWINGS:
        return (
            f"what the model leaves of {output} in {record} oscillates without decaying, as if the record held "
            f"{swings:.0f} independent samples: {_NOT_NOISE}"
        )
    if explained is None:
        return None
    words = f"the model explains {max(explained, 0.0):.0f} % of {output} in {record}, and the rest"
    sudden = innovations / max(float(np.sqrt(np.mean(e**2))), 1e-300)
    if (100 - explained) * math.sqrt(max(1 - sudden**2, 0.0)) > _MOST:
        return f"{words} is coloured: {_NOT_NOISE}"
    if explained < 100 * (1 - SEEN) and sudden < SEEN:
        return f"{words} is predicted from its own past to within {100 * sudden:.0f} %: {_NOT_NOISE}"
    return None


def leaves_no_noise(null: NullModel, noise: NoiseModel) -> bool:
    """True if some coloured residual of a model is no noise."""
    for record in null.records:
        for output, e in record.residual.items():
            varied = float(np.std(record.path.grid.measured[output].values))
            if (record.name, output) not in noise.colour or not varied > 0:
                continue
            explained = 100 * (1 - float(np.sqrt(np.mean(e**2))) / varied)
            if why_no_noise(record.name, output, e, explained, noise.sigma[output]) is not None:
                return True
    return False
