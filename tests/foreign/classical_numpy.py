"""Right-hand sides of the classical test problems in NumPy, for SciPy's solvers: written apart from CasADi's.

Each function takes the time t and the states y (n,) and returns the derivatives (n,).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_MASS = np.array(
    [0.000954786104043, 0.000285583733151, 0.0000437273164546, 0.0000517759138449, 0.00000277777777778]
)


def _lower(rates: Array) -> Array:
    """A chain of decays into each other; the last member stays."""
    matrix = np.diag(-np.append(rates, 0.0))
    return matrix + np.diag(rates, -1)


def _second_differences(n: int) -> Array:
    return np.diag(np.full(n, -2.0)) + np.diag(np.ones(n - 1), 1) + np.diag(np.ones(n - 1), -1)


LINEAR = {
    "B2": np.array([[-1.0, 1, 0], [1, -2, 1], [0, 1, -1]]),
    "C1": _lower(np.ones(9)),
    "C2": _lower(np.arange(1.0, 10)),
    "C3": _second_differences(10),
    "C4": _second_differences(51),
}


def planets(t: float, y: Array) -> Array:
    place = y[:15].reshape(5, 3)
    inverse = (place**2).sum(1) ** -1.5
    apart = place[None] - place[:, None]  # from planet j to planet k
    distance = (apart**2).sum(2)
    np.fill_diagonal(distance, np.inf)
    mutual = np.einsum("k,jkr->jr", _MASS, apart * distance[:, :, None] ** -1.5)
    shared = (_MASS * inverse) @ place
    own = (_MASS * inverse)[:, None] * place
    pull = -((1.00000597682 + _MASS) * inverse)[:, None] * place + mutual - (shared - own)
    return np.concatenate([y[15:], 2.95912208286 * pull.ravel()])


def kepler(t: float, y: Array) -> Array:
    return np.array([y[2], y[3], *(-y[:2] / math.hypot(y[0], y[1]) ** 3)])


def moving_axes(t: float, y: Array) -> Array:
    a, b, c = y
    s = 1 / math.hypot(a, b)
    return np.array([-b - a * c * s, a - b * c * s, a * s])


def rober(t: float, y: Array) -> Array:
    r1, r2, r3 = 0.04 * y[0], 3e7 * y[1] * y[1], 1e4 * y[1] * y[2]
    return np.array([r3 - r1, r1 - r2 - r3, r2])


def orego(t: float, y: Array) -> Array:
    a, b, c = y
    return np.array([77.27 * (b + a - 8.375e-6 * a * a - a * b), (c - b - a * b) / 77.27, 0.161 * (a - c)])


_HIRES = np.zeros((8, 8))
for _row, _column, _value in (
    (0, 0, -1.71), (0, 1, 0.43), (0, 2, 8.32), (1, 0, 1.71), (1, 1, -8.75), (2, 2, -10.03), (2, 3, 0.43),
    (2, 4, 0.035), (3, 1, 8.32), (3, 2, 1.71), (3, 3, -1.12), (4, 4, -1.745), (4, 5, 0.43), (4, 6, 0.43),
    (5, 3, 0.69), (5, 4, 1.71), (5, 5, -0.43), (5, 6, 0.69), (6, 6, -1.81), (7, 6, 1.81),
):  # fmt: skip
    _HIRES[_row, _column] = _value


def hires(t: float, y: Array) -> Array:
    made = _HIRES @ y
    made[0] += 7e-4
    bound = 280.0 * y[5] * y[7]
    made[5:] += bound * np.array([-1.0, 1.0, -1.0])
    return made


def pyrolysis(t: float, y: Array) -> Array:
    r1, r2, r3, r4 = 7.89e-10 * y[0], 1.1e7 * y[0] * y[2], 1.13e9 * y[1] * y[2], 1.13e3 * y[3]
    return np.array([-r1 - r2, r1 - r3, r1 - r2 - r3 + r4, r2 - r4])


def pollu(t: float, y: Array) -> Array:
    (
        no2,
        no,
        o3p,
        o3,
        ho2,
        oh,
        hcho,
        _co,
        ald,
        meo2,
        c2o3,
        _co2,
        pan,
        ch3o,
        _hno3,
        o1d,
        so2,
        _so4,
        no3,
        n2o5,
    ) = y
    r1, r2, r3 = 0.35 * no2, 26.6 * no * o3, 1.23e4 * ho2 * no
    r4, r5, r6 = 8.6e-4 * hcho, 8.2e-4 * hcho, 1.5e4 * hcho * oh
    r7, r8, r9, r10 = 1.3e-4 * ald, 2.4e4 * ald * oh, 1.65e4 * c2o3 * no, 9e3 * c2o3 * no2
    r11, r12, r13, r14 = 2.2e-2 * pan, 1.2e4 * meo2 * no, 1.88 * ch3o, 1.63e4 * no2 * oh
    r15, r16, r17, r18, r19 = 4.8e6 * o3p, 3.5e-4 * o3, 1.75e-2 * o3, 1e8 * o1d, 4.44e11 * o1d
    r20, r21, r22, r23 = 1.24e3 * so2 * oh, 2.1 * no3, 5.78 * no3, 4.74e-2 * no2 * o3
    r24, r25 = 1.78e3 * no3 * no2, 3.12 * n2o5
    return np.array([
        r2 + r3 + r9 + r11 + r12 + r22 + r25 - r1 - r10 - r14 - r23 - r24,
        r1 + r21 - r2 - r3 - r9 - r12,
        r1 + r17 + r19 + r22 - r15,
        r15 - r2 - r16 - r17 - r23,
        2 * r4 + r6 + r7 + r13 + r20 - r3,
        r3 + 2 * r18 - r6 - r8 - r14 - r20,
        r13 - r4 - r5 - r6,
        r4 + r5 + r6 + r7,
        -r7 - r8,
        r7 + r9 - r12,
        r8 + r11 - r9 - r10,
        r9,
        r10 - r11,
        r12 - r13,
        r14,
        r16 - r18 - r19,
        -r20,
        r20,
        r23 + r25 - r21 - r22 - r24,
        r24 - r25,
    ])  # fmt: skip
