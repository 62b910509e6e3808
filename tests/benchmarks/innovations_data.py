"""Two masses under process noise, made with NumPy and SciPy alone: an exact sampling of the stochastic equation.

dx = (A x + B u) dt + dw with white noise w of known intensity on both speeds, u interpolated linearly between samples,
y = omega_eng + v. The covariance of what w adds in a step is integrated by Van Loan's matrix exponential, so that the
samples have the very distribution of the continuous process at any rate.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

Array = NDArray[np.float64]

TRUTH = {"J_eng": 1 / 2.557, "J_load": 1 / 5.646, "K_el": 1992.0, "C_el": 2.5, "C_eng": 0.1541}
PROCESS = {"omega_eng": 2.0, "omega_load": 1.0}  # rad/s per sqrt(s)
SIGMA = 0.1  # rad/s
RATE, SAMPLES = 720.0, 3600


@dataclass(frozen=True)
class Run:
    """time (N,) s; torque, load (N,) N m; y (N,) rad/s; states (N, 3)."""

    time: Array
    torque: Array
    load: Array
    y: Array
    states: Array


def matrices(p: dict[str, float] = TRUTH) -> tuple[Array, Array]:
    """A and B of (4.3), states omega_eng, omega_load, twist, inputs T, T_load."""
    je, jl, k, c, d = (p[name] for name in ("J_eng", "J_load", "K_el", "C_el", "C_eng"))
    a = np.array([[-(c + d) / je, c / je, k / je], [c / jl, -c / jl, -k / jl], [-1.0, 1.0, 0.0]])
    return a, np.array([[1 / je, 0.0], [0.0, -1 / jl], [0.0, 0.0]])


def step_noise(a: Array, density: Array, h: float) -> Array:
    """Covariance that white noise of this density adds in a step of h seconds (Van Loan 1978)."""
    n = len(a)
    big = np.zeros((2 * n, 2 * n))
    big[:n, :n], big[:n, n:], big[n:, n:] = -a * h, density * h, a.T * h
    power = expm(big)
    q = power[n:, n:].T @ power[:n, n:]
    return (q + q.T) / 2


def inputs(n: int = SAMPLES, rate: float = RATE) -> tuple[Array, Array, Array]:
    """Time [s], engine torque and load torque [N m]: firing orders, a first order of misfire, slow changes."""
    t = np.arange(n) / rate
    turn = 2 * np.pi * 20.0 * t + 6.0 * np.sin(2 * np.pi * 0.4 * t)
    torque = 76 + 120 * np.sin(2 * turn) + 35 * np.sin(4 * turn + 0.7) + 18 * np.sin(0.5 * turn + 0.2)
    torque = torque + 9 * np.sin(turn + 1.1) + 6 * np.sin(2 * np.pi * 1.7 * t)
    load = 57 + 4 * np.sin(2 * np.pi * 1.3 * t) + 3 * np.sin(2 * np.pi * 3.1 * t + 1.0)
    return t, torque, load


def run(seed: int, *, n: int = SAMPLES, rate: float = RATE, process: float = 1.0) -> Run:
    """One record; ``process`` scales the process noise."""
    rng = np.random.default_rng(seed)
    t, torque, load = inputs(n, rate)
    a, b = matrices()
    h, u = 1 / rate, np.array([torque, load])
    big = np.zeros((7, 7))
    big[:3, :3], big[:3, 3:5], big[3:5, 5:] = a * h, b * h, np.eye(2)
    big = expm(big)
    f, held, ramp = big[:3, :3], big[:3, 3:5], big[:3, 5:]
    density = process**2 * np.diag([PROCESS["omega_eng"] ** 2, PROCESS["omega_load"] ** 2, 0.0])
    values, vectors = np.linalg.eigh(step_noise(a, density, h))
    shake = (vectors * np.sqrt(np.maximum(values, 0.0))) @ rng.standard_normal((3, n))
    x = np.empty((n, 3))
    x[0] = [125.0, 125.0, -57 / TRUTH["K_el"]]
    for k in range(n - 1):
        x[k + 1] = f @ x[k] + held @ u[:, k] + ramp @ (u[:, k + 1] - u[:, k]) + shake[:, k]
    return Run(t, torque, load, x[:, 0] + SIGMA * rng.standard_normal(n), x)


def stationary_gain(*, rate: float = RATE) -> tuple[Array, Array, float]:
    """L (3,), K = A_D L (3,) and the innovations' standard deviation at the truth, by SciPy's Riccati solver."""
    a, c = matrices()[0], np.array([[1.0, 0.0, 0.0]])
    f = expm(a / rate)
    q = step_noise(a, np.diag([PROCESS["omega_eng"] ** 2, PROCESS["omega_load"] ** 2, 0.0]), 1 / rate)
    p = solve_discrete_are(f.T, c.T, q, np.array([[SIGMA**2]]))
    s = float(p[0, 0] + SIGMA**2)
    lift = p[:, 0] / s
    return lift, f @ lift, float(np.sqrt(s))
