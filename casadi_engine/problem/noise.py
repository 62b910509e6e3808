"""Noise: what is known of the measurement noise of each output, and the gain of the predictor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_engine.errors import EstimationError

Level = float | Literal["estimate"]


class Noise:
    """Standard deviation of the white measurement noise of each output, known or estimated.

    levels : output=sigma in the output's unit, or output="estimate"; outputs that are not named are estimated
    gain : None for output error (the model is simulated); or the (n, ny) correction gain L of a one-step
        predictor, x+ = x + L (y - y_hat) before each step, dimensioned as state per output. L = 1 for one
        measured state makes the innovations form (2.10) with the gain A_D: the predictor starts each step
        from the measurement.

    Raises EstimationError for a level that is not a positive number or "estimate", and for a gain that is not
    a matrix of finite numbers.

    >>> Noise(omega=0.1).level("omega")
    0.1
    """

    def __init__(self, *, gain: ArrayLike | None = None, **levels: Any) -> None:
        for output, level in levels.items():
            number = isinstance(level, (int, float)) and not isinstance(level, bool)
            if level != "estimate" and not (number and math.isfinite(level) and level > 0):
                raise EstimationError(
                    f"the noise level of {output} is not acceptable",
                    seen=level,
                    allowed='a standard deviation > 0 in the unit of the output, or "estimate"',
                    cure=f'write Noise({output}="estimate") if it is not known',
                )
        self._levels: Mapping[str, Level] = dict(levels)
        self.gain: NDArray[np.float64] | None = None if gain is None else _matrix(gain)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs that a level was given for."""
        return tuple(self._levels)

    def level(self, output: str) -> Level:
        """Sigma of the output, or "estimate"."""
        return self._levels.get(output, "estimate")

    def __repr__(self) -> str:
        words = [f"{name}={level!r}" for name, level in self._levels.items()]
        if self.gain is not None:
            words.append(f"gain={self.gain.tolist()}")
        return f"Noise({', '.join(words)})"


def _matrix(gain: ArrayLike) -> NDArray[np.float64]:
    """A read-only copy of a gain, as a matrix."""
    try:
        matrix = np.atleast_2d(np.array(gain, dtype=float))
    except (TypeError, ValueError):
        matrix = np.array(np.nan)
    if matrix.ndim != 2 or not np.all(np.isfinite(matrix)):
        raise EstimationError(
            "the gain of the predictor is not acceptable",
            seen=repr(gain),
            allowed="None, or a matrix of finite numbers, states by outputs",
            cure="write Noise(gain=[[1.0]]) for one state that is measured",
        )
    matrix.flags.writeable = False
    return matrix
