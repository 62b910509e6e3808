"""The linear variational equation ds/dt = A(t) s + g(t) along a trajectory, for many columns g at once.

A step is the fourth-order Magnus exponential of A (Iserles & Nørsett 1999) with g taken as the parabola through its
values at the start, the middle and the end of the step; for a constant A and a parabola that is exact. Steps are then
chained by a two-level scan: stretches of samples advance side by side, so that no Python work is done per sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from casadi_engine.simulation.jets import Array

# Below this norm the Taylor series of phi_3 needs few terms.
_RADIUS = 0.5
_TAYLOR = 1e-17


@dataclass(frozen=True)
class Steps:
    """s[k+1] = f_k s[k] + start_k g[k] + middle_k g[k+1/2] + end_k g[k+1]; each (T, n, n), or (1, n, n) for all."""

    f: Array
    start: Array
    middle: Array
    end: Array


def phi_functions(z: Array) -> tuple[Array, Array, Array, Array]:
    """phi_0 .. phi_3 of a stack of matrices z : (T, n, n), phi_l(z) = sum z^k / (k + l)!."""
    size = float(np.abs(z).sum(axis=-2).max(initial=0.0))
    doublings = max(0, math.ceil(math.log2(size / _RADIUS))) if size > _RADIUS else 0
    z, size = z / 2.0**doublings, size / 2.0**doublings
    degree = 1
    while size**degree / math.factorial(degree + 3) > _TAYLOR:
        degree += 1
    one = np.eye(z.shape[-1])
    phi3 = z / math.factorial(degree + 3) + one / math.factorial(degree + 2)
    for k in range(degree - 2, -1, -1):
        phi3 = z @ phi3 + one / math.factorial(k + 3)
    phi2 = z @ phi3 + one / 2
    phi1 = z @ phi2 + one
    phi0 = z @ phi1 + one
    for _ in range(doublings):
        phi3 = (phi0 @ phi3 + phi1 / 2 + phi2 + phi3) / 8
        phi2 = (phi0 @ phi2 + phi1 + phi2) / 4
        phi1 = (phi0 @ phi1 + phi1) / 2
        phi0 = phi0 @ phi0
    return phi0, phi1, phi2, phi3


def step_matrices(start: Array, middle: Array, end: Array, step: float | Array) -> Steps:
    """The steps of length ``step`` [s], a number or (T, 1, 1), from A at their start, middle and end, each (T, n, n) or
    (1, n, n)."""
    omega = (step / 6) * (start + 4 * middle + end)
    moves = start is not end
    if moves:
        change = end - start
        omega = omega - (step**2 / 12) * (middle @ change - change @ middle)
    phi0, phi1, phi2, phi3 = phi_functions(omega)
    weight = step * (4 * phi2 - 8 * phi3)
    if moves:  # the same commutator, between A and g
        weight = weight + (step**2 / 12) * (phi1 @ change)
    return Steps(phi0, step * (phi1 - 3 * phi2 + 4 * phi3), weight, step * (4 * phi3 - phi2))


def scan(f: Array, push: Array, start: Array) -> Array:
    """All states of s[k+1] = f_k s[k] + push_k from ``start`` (n, K); push : (T, n, K); returns (T+1, n, K)."""
    count, n, width = push.shape
    length = max(1, math.isqrt(count))
    many = math.ceil(count / length)
    padded = np.zeros((many * length, n, width))
    padded[:count] = push
    padded = padded.reshape(many, length, n, width).swapaxes(0, 1)
    if len(f) > 1:
        steps = np.broadcast_to(np.eye(n), (many * length, n, n)).copy()
        steps[:count] = f
        steps = steps.reshape(many, length, n, n).swapaxes(0, 1)
    else:
        steps = np.broadcast_to(f[0], (length, 1, n, n))
    # within stretches from zero, and what a stretch makes of its start
    states = np.empty((length, many, n, width))
    turn = np.empty((length, steps.shape[1], n, n))
    states[0], turn[0] = padded[0], steps[0]
    for k in range(1, length):
        np.matmul(steps[k], states[k - 1], out=states[k])
        states[k] += padded[k]
        np.matmul(steps[k], turn[k - 1], out=turn[k])
    starts = np.empty((many, n, width))
    starts[0] = start
    whole = np.broadcast_to(turn[-1], (many, n, n))
    for j in range(1, many):
        starts[j] = whole[j - 1] @ starts[j - 1] + states[-1, j - 1]
    states += turn @ starts
    flat = states.swapaxes(0, 1).reshape(many * length, n, width)
    return np.concatenate([np.asarray(start)[None], flat[:count]])


def balance(a: Array) -> Array:
    """(n,) factors by which states are divided so that rows and columns of A (T, n, n) have like sizes; a slope that is
    infinite, as that of a root at 0, says nothing of these."""
    from scipy.linalg import matrix_balance

    mean = np.where(np.isfinite(a), np.abs(a), 0.0).mean(axis=0)
    _, (scale, _) = matrix_balance(mean, permute=False, separate=True)
    return np.asarray(scale, dtype=np.float64)
