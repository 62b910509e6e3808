"""Noise: what is known of the measurement noise of each output, of process noise, and of the predictor's gain."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_engine.errors import EstimationError

Level = float | Literal["estimate"]


class Noise:
    """Noise of the measurement and of the process: known, or estimated.

    levels : for each output its standard deviation, in its unit, or one of two words; outputs that are not named are
        "estimate"
        "estimate" : the standard deviation is found from the residual
        "innovations" : there is process noise of unknown kind; the predictor (2.10) corrects its state by this output,
        with a gain that is estimated with the physical parameters and keeps the predictor stable, and the standard
        deviation found is that of the innovations
    process : white noise that drives the states, from which the gain follows by the Riccati equation (2.11, 2.12):
        state -> standard deviation that it adds to the state in one second [state's unit/sqrt(s)], or "estimate";
        "estimate" alone frees it for every state that a drive acts on. States that are not named have none. The levels
        are then those of the measurement alone. A drive's name stands for noise on that drive [drive's unit sqrt(s)].
    gain : the (n, ny) correction gain L of a one-step predictor if it is known, x+ = x + L (y - y_hat) before each
        step, dimensioned as state per output; K = A_D L in (2.10). L = 1 for one measured state makes the predictor
        start each step from the measurement.

    Without "innovations", ``process`` and ``gain`` the model is simulated: output error. Where an output is missing its
    correction is skipped.

    Raises EstimationError for a level that is none of these, for a gain that is not a matrix of finite numbers, and
    where the gain is asked for in two ways.

    >>> Noise(omega=0.1).level("omega")
    0.1
    >>> Noise(omega=0.1, process={"omega_eng": "estimate"})
    Noise(omega=0.1, process={'omega_eng': 'estimate'})
    """

    def __init__(
        self,
        *,
        gain: ArrayLike | None = None,
        process: Mapping[str, Level] | Literal["estimate"] | None = None,
        **levels: Any,
    ) -> None:
        for output, level in levels.items():
            if not _word(level, "estimate", "innovations") and not _positive(level):
                raise EstimationError(
                    f"the noise level of {output} is not acceptable",
                    seen=level if isinstance(level, str) else repr(level),
                    allowed='a standard deviation > 0 in the unit of the output, or "estimate", or "innovations"',
                    cure=f'write Noise({output}="estimate") if it is not known',
                )
        self._levels: Mapping[str, Level] = {
            name: "estimate" if isinstance(level, str) else float(level) for name, level in levels.items()
        }
        self.innovations: tuple[str, ...] = tuple(
            k for k, level in levels.items() if _word(level, "innovations")
        )
        self.process: Mapping[str, Level] | Literal["estimate"] | None = _process(process)
        self.gain: NDArray[np.float64] | None = None if gain is None else _matrix(gain)
        ways = {
            "gain": self.gain is not None,
            "process": self.process is not None,
            '"innovations"': bool(self.innovations),
        }
        if sum(ways.values()) > 1:
            raise EstimationError(
                "the gain of the predictor is asked for in more ways than one",
                seen=" and ".join(name for name, given in ways.items() if given),
                allowed='one of gain=, process= and output="innovations"',
                cure='give process= where the noise is known, "innovations" where it is not',
            )

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs that a level was given for."""
        return tuple(self._levels)

    @property
    def predicts(self) -> bool:
        """True if residuals are those of a one-step predictor; False for output error."""
        return self.gain is not None or self.process is not None or bool(self.innovations)

    def level(self, output: str) -> Level:
        """Sigma of the output, or "estimate"."""
        return self._levels.get(output, "estimate")

    def __repr__(self) -> str:
        own = dict.fromkeys(self.innovations, "innovations")
        words = [f"{name}={own.get(name, level)!r}" for name, level in self._levels.items()]
        if self.process is not None:
            given = self.process if isinstance(self.process, str) else dict(self.process)
            words.append(f"process={given!r}")
        if self.gain is not None:
            words.append(f"gain={self.gain.tolist()}")
        return f"Noise({', '.join(words)})"


def _word(level: Any, *words: str) -> bool:
    """True for one of the words; an array is compared with none of them."""
    return isinstance(level, str) and level in words


def _positive(level: Any) -> bool:
    """True for a number > 0 of any kind, NumPy's scalars with it."""
    if isinstance(level, (bool, np.bool_, str, bytes)) or np.ndim(level):
        return False
    try:
        return math.isfinite(level) and level > 0
    except (TypeError, ValueError, OverflowError):
        return False


def _process(process: Any) -> Mapping[str, Level] | Literal["estimate"] | None:
    """The process noise, checked and read only."""
    if process is None:
        return None
    if _word(process, "estimate"):
        return "estimate"
    named = isinstance(process, Mapping) and len(process) > 0
    if named and all(_word(level, "estimate") or _positive(level) for level in process.values()):
        return MappingProxyType(
            {k: "estimate" if isinstance(v, str) else float(v) for k, v in process.items()}
        )
    raise EstimationError(
        "the process noise is not acceptable",
        seen=repr(process),
        allowed='state -> a standard deviation > 0 per square root of a second, or "estimate"; or "estimate" alone',
        cure='write Noise(omega=0.1, process={"omega_eng": "estimate"}), or leave it out for output error',
    )


def _matrix(gain: ArrayLike) -> NDArray[np.float64]:
    """A read-only copy of a gain, as a matrix."""
    try:
        matrix = np.atleast_2d(np.array(gain, dtype=float))
    except (TypeError, ValueError, OverflowError):
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
