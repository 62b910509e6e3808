"""Exponential functions of a matrix, phi_0 .. phi_2, with first and second parameter derivatives.

phi_0(Z) = exp(Z), phi_1(Z) = sum Z^k/(k+1)!, phi_2(Z) = sum Z^k/(k+2)!; with them the linear system
dx/dt = A x + v(t) is solved exactly for a held (phi_1) or linearly interpolated (phi_1, phi_2) input
(Hochbruck & Ostermann, Acta Numerica 2010, section 2).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation import jets
from casadi_engine.simulation.jets import Array

# Balancing counts where it lowers the norm by this factor: a digit is lost or won.
_DIGIT = 10.0
# Below this 1-norm the Taylor series needs few terms and loses no digits.
_RADIUS = 0.5


def _degree(size: float) -> int:
    """Terms of the Taylor series of phi_2 after which the rest, and that of two derivatives, is below rounding."""
    degree = 3
    while size ** (degree - 1) / math.factorial(degree - 1) > 1e-18:
        degree += 1
    return degree


def _series(z: Array, d: int, degree: int) -> Array:
    """phi_2 of a small jet by its Taylor polynomial, in groups of three powers (Paterson & Stockmeyer 1973)."""
    square = jets.product(z, z, d)
    cube = jets.product(z, square, d)
    total = np.zeros_like(z)
    for group in range(degree // 3, -1, -1):
        if group < degree // 3:
            total = jets.product(cube, total, d)
        a, b, c = (1 / math.factorial(3 * group + k + 2) for k in range(3))
        total += b * z + c * square
        total[0] += a * np.eye(z.shape[1])
    return total


def _doublings(size: float) -> int:
    return max(0, math.ceil(math.log2(size / _RADIUS))) if size > _RADIUS else 0


def balance(value: Array) -> Array | None:
    """(n,) powers of 2 by which states are divided so that rows and columns of ``value`` (n, n) have like sizes.

    A series loses digits of what is small beside the norm: a heavy mass beside a light one, a position beside a speed.
    None if less than a digit is at stake (Parlett & Reinsch, Numerische Mathematik 13, 1969, 293-304).
    """
    from scipy.linalg.lapack import dgebal

    size = jets.norm(value[None])
    if size <= _RADIUS:
        return None
    balanced, _, _, scale, _ = dgebal(value, scale=1)
    return scale if _DIGIT * jets.norm(balanced[None]) < size else None


def phi_functions(z: Array, d: int) -> tuple[Array, Array, Array]:
    """phi_0, phi_1, phi_2 of the jet ``z`` (k, n, n) in d parameters, by Taylor series and argument doubling."""
    scale = balance(z[0])
    if scale is None:
        return _phi_functions(z, d)
    # A diagonal similarity by constants commutes with derivatives, and powers of 2 round nothing.
    turn = scale[:, None] / scale
    phi0, phi1, phi2 = _phi_functions(z / turn, d)
    return phi0 * turn, phi1 * turn, phi2 * turn


def _phi_functions(z: Array, d: int) -> tuple[Array, Array, Array]:
    """The same of a balanced jet."""
    size = jets.norm(z)
    doublings = _doublings(size)
    z = z / 2.0**doublings
    identity = np.eye(z.shape[1])
    phi2 = _series(z, d, _degree(min(size, _RADIUS)))
    phi1 = jets.product(z, phi2, d)
    phi1[0] += identity
    phi0 = jets.product(z, phi1, d)
    phi0[0] += identity
    for _ in range(doublings):
        phi2 = 0.25 * (jets.product(phi0, phi2, d) + phi1 + phi2)
        shifted = phi0.copy()
        shifted[0] += identity
        phi1 = 0.5 * jets.product(shifted, phi1, d)
        phi0 = jets.product(phi0, phi0, d)
    return phi0, phi1, phi2


def transition(z: NDArray[np.float64], steps: int) -> Array:
    """exp(steps * z) to the last digit of double precision, whatever ``steps``; z : (n, n).

    A transition matrix that is wrong in its last digit gains or loses energy at every step; the extended precision
    of ``numpy.longdouble``, where the machine has one, keeps 1e5 steps of an undamped system below 1e-11.
    """
    scale = balance(np.asarray(z, dtype=np.float64))
    turn = np.ones(z.shape) if scale is None else scale[:, None] / scale
    wide = np.asarray(z / turn, dtype=np.longdouble) * steps
    size = float(np.abs(wide).sum(axis=0).max()) if wide.size else 0.0
    doublings = _doublings(size)
    wide = wide / np.longdouble(2) ** doublings
    identity = np.eye(len(z), dtype=np.longdouble)
    degree = _degree(min(size, _RADIUS)) + 4
    # exp(Z) - I is doubled in place of exp(Z): small entries keep their digits.
    less = wide / math.factorial(degree)
    for power in range(degree - 1, 0, -1):
        less = wide @ less + wide / math.factorial(power)
    for _ in range(doublings):
        less = 2 * less + less @ less
    return np.asarray((identity + less) * turn, dtype=np.float64)
