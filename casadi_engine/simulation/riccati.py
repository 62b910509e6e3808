"""The stationary Kalman predictor, (2.11) and (2.12), with first and second derivatives.

Of x[k+1] = A x[k] + w[k], y[k] = C x[k] + v[k] with white w, v of covariances Q, R the predictor's error has the
covariance P = A P A' + Q - A P C' (C P C' + R)^-1 C P A'. P is found by structured doubling (Chu, Fan & Lin 2005);
a derivative of the equation is a Lyapunov equation in the derivative of P, with the closed loop F = A - K C as its
matrix: dP = F dP F' + (dA P .. + dQ ..), the sum being the equation's own derivative at fixed P. One factorised
squaring of F solves it for all right-hand sides at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation import jets
from casadi_engine.simulation.exponential import phi_functions
from casadi_engine.simulation.jets import Array

# Each doubling squares the closed loop: 2^60 steps are for ever.
_DOUBLINGS = 60
_SETTLED = 1e-15
# Below this 1-norm of A h the noise of a step is integrated by a series of few terms.
_RADIUS = 0.25


@dataclass(frozen=True)
class Kalman:
    """Jets of the predictor: lift (k, n, ny), x+ = x + lift (y - y_hat) before a step; innovation (k, ny, ny), the
    covariance of y - y_hat; error (k, n, n), that of x - x_hat before the correction."""

    lift: Array
    innovation: Array
    error: Array


@np.errstate(over="ignore", invalid="ignore")
def riccati(
    a: NDArray[np.float64], c: NDArray[np.float64], q: NDArray[np.float64], r: NDArray[np.float64]
) -> Array:
    """The stabilising solution P (n, n) of (2.12) for A (n, n), C (ny, n), Q (n, n) >= 0, R (ny, ny) > 0.

    Raises FloatingPointError where there is none: a mode on or outside the unit circle that the outputs do not show,
    or one on the circle that no noise drives.
    """
    n = len(a)
    step, g, h = a.T.copy(), c.T @ np.linalg.solve(r, c), (q + q.T) / 2
    identity = np.eye(n)
    for _ in range(_DOUBLINGS):
        both = np.linalg.solve(identity + g @ h, np.hstack([step, g]))
        turned, push = both[:, :n], both[:, n:]
        grown = step.T @ h @ turned
        if not np.isfinite(grown).all():
            break
        g = g + step @ push @ step.T
        h = h + (grown + grown.T) / 2
        step = step @ turned
        if float(np.abs(grown).max(initial=0.0)) <= _SETTLED * float(np.abs(h).max(initial=0.0)):
            return h
    raise FloatingPointError("the Riccati equation has no stabilising solution here")


@np.errstate(over="ignore", invalid="ignore")
def lyapunov(f: NDArray[np.float64], w: Array) -> Array:
    """X = F X F' + W for every W (k, n, n), the spectral radius of F below one (Smith's method, squared).

    Raises FloatingPointError where F is not stable.
    """
    x, power = w.copy(), f
    for _ in range(_DOUBLINGS):
        grown = power @ x @ power.T
        x = x + grown
        if not np.isfinite(x).all():
            break
        if float(np.abs(grown).max(initial=0.0)) <= _SETTLED * float(np.abs(x).max(initial=0.0)):
            return x
        power = power @ power
    raise FloatingPointError("the closed loop of the predictor is not stable here")


def kalman(a: Array, c: Array, q: Array, r: Array, d: int) -> Kalman:
    """The stationary predictor of jets A (k, n, n), C (k, ny, n), Q (k, n, n), R (k, ny, ny) in d parameters."""
    p = np.zeros_like(q)
    p[0] = riccati(a[0], c[0], q[0], r[0])
    cross, innovation = _output(p, c, r, d)
    gain = a[0] @ np.linalg.solve(innovation[0], cross[0].T).T
    closed = a[0] - gain @ c[0]
    for part in jets.orders(q, d):
        cross, innovation = _output(p, c, r, d)
        carried = jets.product(a, cross, d)
        spread = jets.product(jets.product(a, p, d), jets.transpose(a), d)
        taken = jets.product(carried, jets.inverse(innovation, d), d)
        right = (spread + q - jets.product(taken, jets.transpose(carried), d))[part]
        p[part] = lyapunov(closed, (right + right.transpose(0, 2, 1)) / 2)
    cross, innovation = _output(p, c, r, d)
    return Kalman(jets.product(cross, jets.inverse(innovation, d), d), innovation, p)


def _output(p: Array, c: Array, r: Array, d: int) -> tuple[Array, Array]:
    """P C' and C P C' + R."""
    cross = jets.product(p, jets.transpose(c), d)
    return cross, jets.product(c, cross, d) + r


def step_noise(a: Array, density: Array, step: float, d: int) -> Array:
    """The covariance of what white noise adds to the state in one step: the integral of exp(A s) S exp(A' s).

    a : jet (k, n, n) of A; density : jet (k, n, n) of S, variance per second; step [s]. By the exponential of the
    matrix [[-A, S], [0, A']] (Van Loan 1978) over a part of the step in which it loses no digits, and doubling.
    """
    n = a.shape[1]
    size = jets.norm(a) * step
    halvings = max(0, int(np.ceil(np.log2(size / _RADIUS)))) if size > _RADIUS else 0
    part = step / 2**halvings
    # Scaled so that noise of any size leaves the exponential as small as A h is.
    scale = float(np.abs(density[0]).max(initial=0.0)) or 1.0
    wide = np.zeros((len(a), 2 * n, 2 * n))
    wide[:, :n, :n], wide[:, n:, n:] = -a * part, jets.transpose(a) * part
    wide[:, :n, n:] = density * (_RADIUS / (n * scale))
    power = phi_functions(wide, d)[0]
    transition = jets.transpose(power[:, n:, n:])
    total = jets.product(transition, power[:, :n, n:], d)
    for _ in range(halvings):
        moved = jets.product(jets.product(transition, total, d), jets.transpose(transition), d)
        total = total + moved
        transition = jets.product(transition, transition, d)
    total = total * (part * n * scale / _RADIUS)
    return (total + jets.transpose(total)) / 2


def over_steps(a: Array, q: Array, steps: int, d: int) -> tuple[Array, Array]:
    """Transition and noise of ``steps`` steps, each with the jets A (k, n, n) and Q (k, n, n)."""
    power, spread = jets.constant(np.eye(a.shape[1]), d, _order(a, d)), np.zeros_like(q)
    one, noise = a, q
    while steps:
        if steps & 1:  # the steps gathered so far, then these
            spread = jets.product(jets.product(one, spread, d), jets.transpose(one), d) + noise
            power = jets.product(one, power, d)
        noise = noise + jets.product(jets.product(one, noise, d), jets.transpose(one), d)
        one = jets.product(one, one, d)
        steps >>= 1
    return power, spread


def _order(x: Array, d: int) -> int:
    return len(jets.orders(x, d))
