"""The usual strong formulation of problem A with SciPy: exact discretisation, `lfilter`, analytic Jacobian.

The model's transfer functions in the delay filter the two torques and an impulse that stands for the initial
state; the sensitivities are filters of the same denominator. The rest is `scipy.optimize.least_squares`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from opponent_two_mass import COMPLEX_STEP, NAMES, WIDTH, discretise
from scipy.optimize import least_squares
from scipy.signal import lfilter

Array = NDArray[np.float64]


def _difference(v: Array, times: int) -> Array:
    return np.diff(v, n=times, prepend=np.zeros(times)) if times else v


def _delay(v: Array, samples: int) -> Array:
    return np.concatenate([np.zeros(samples), v[: v.size - samples]]) if samples else v


def _denominator(a: Array) -> Array:
    """d^3 + a1 d^2 z + a2 d z^2 + a3 z^3 in powers of the delay z, with d = 1 - z."""
    first = np.array([1.0, -1.0])
    second = np.convolve(first, first)
    return (
        np.array([1, -3, 3, -1.0])
        + a[0] * np.r_[0, second]
        + a[1] * np.r_[0, 0, first]
        + a[2] * np.r_[0, 0, 0, 1]
    )


class _Model:
    """Output and Jacobian at one point, worked out once."""

    def __init__(self, y: Array, torques: tuple[Array, Array], step: float, first: Array) -> None:
        self.y, self.step, self.first = y, step, first
        self.twist_scale = float(np.sqrt(first[2] * (1 / first[0] + 1 / first[1])))
        self.inputs = np.array([_delay(_difference(u, 3 - k), k) for u in torques for k in range(4)])
        impulse = np.zeros(y.size)
        impulse[0] = 1.0
        self.basis = np.array([_delay(_difference(impulse, 2 - k), k) for k in range(3)])
        model = discretise(first, step, self.twist_scale)
        free = lfilter([1.0], _denominator(model.a[0].real), self.basis)
        self.scale = 10 / np.linalg.norm(free, axis=1)
        forced = lfilter([1.0], _denominator(model.a[0].real), model.b[0].real.ravel() @ self.inputs)
        self.start = np.linalg.lstsq(free.T * self.scale, y - forced, rcond=None)[0]
        self._at: Array | None = None

    def _run(self, point: Array) -> None:
        if self._at is not None and np.array_equal(self._at, point):
            return
        self._at = point.copy()
        self.model = discretise(self.first * np.exp(point[:5]), self.step, self.twist_scale)
        self.poles = _denominator(self.model.a[0].real)
        drive = self.model.b[0].real.ravel() @ self.inputs + (point[5:] * self.scale) @ self.basis
        self.output = lfilter([1.0], self.poles, drive)

    def residual(self, point: Array) -> Array:
        self._run(point)
        return np.asarray(self.output - self.y)

    def jacobian(self, point: Array) -> Array:
        self._run(point)
        zeros = self.model.b.imag.reshape(5, 8) / COMPLEX_STEP
        poles = self.model.a.imag / COMPLEX_STEP
        past = np.array([_delay(_difference(self.output, 2 - k), k + 1) for k in range(3)])
        rows = np.empty((8, self.y.size))
        rows[:5] = lfilter([1.0], self.poles, zeros @ self.inputs - poles @ past)
        rows[5:] = self.scale[:, None] * lfilter([1.0], self.poles, self.basis)
        return rows.T


def fit(
    y: Array, torque_eng: Array, torque_load: Array, step: float, start: Mapping[str, float]
) -> dict[str, Any]:
    """As `opponent_two_mass.fit`; the three transient coefficients are free beside the parameters."""
    first = np.array([start[name] for name in NAMES], dtype=float)
    model = _Model(y, (torque_eng, torque_load), step, first)
    limit = np.r_[np.full(5, np.log(WIDTH)), np.full(3, np.inf)]
    result = least_squares(
        model.residual,
        np.r_[np.zeros(5), model.start],
        jac=model.jacobian,
        bounds=(-limit, limit),
        method="dogbox",
        ftol=1e-8,
        xtol=1e-8,
        gtol=1e-8,
    )
    values = first * np.exp(result.x[:5])
    cost = 2 * float(result.cost)
    covariance = np.linalg.inv(result.jac.T @ result.jac)[:5, :5] * cost / (y.size - 8)
    return {
        "parameters": dict(zip(NAMES, values.tolist(), strict=True)),
        "covariance": covariance * values * values[:, None],
        "cost": cost,
        "evaluations": int(result.nfev),
    }
