"""A chain of inertias in plain NumPy: equations, exact discretisation and a linear simulator.

It shares nothing with the package. The equations are written once, for any array library whose `@` and
`diag` work alike (NumPy, jax.numpy, CasADi), because every opponent needs the same ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shape:
    """What does not depend on the parameters: n inertias in a line, the throws, the load.

    throws : (c,) number of the inertia, from 0, that each cylinder's torque (or the summed torque) turns
    damped : numbers of the inertias with an absolute damper
    The load brakes the last inertia. States: speeds (n,), then twists θ_{i+1} − θ_i (n−1,).
    """

    size: int
    throws: tuple[int, ...]
    damped: tuple[int, ...]

    @property
    def states(self) -> int:
        return 2 * self.size - 1

    @property
    def inputs(self) -> int:
        return len(self.throws) + 1

    @property
    def names(self) -> tuple[str, ...]:
        """J1.., K21.., C21.., and C of the absolute dampers, in the order of the full parameter vector."""
        n = self.size
        couplings = [f"{i + 2}{i + 1}" for i in range(n - 1)]
        inertias = [f"J{i + 1}" for i in range(n)]
        return (
            *inertias,
            *(f"K{c}" for c in couplings),
            *(f"C{c}" for c in couplings),
            *(f"C{i + 1}" for i in self.damped),
        )

    @property
    def difference(self) -> Array:
        """Speeds to rates of twist, (n−1, n)."""
        return np.diff(np.eye(self.size), axis=0)

    @property
    def torque_rows(self) -> Array:
        """Inputs to torques on the inertias, (n, inputs)."""
        rows = np.zeros((self.size, self.inputs))
        for column, inertia in enumerate(self.throws):
            rows[inertia, column] = 1.0
        rows[-1, -1] = -1.0
        return rows

    @property
    def damper_rows(self) -> Array:
        """Absolute dampers to inertias, (n, dampers)."""
        rows = np.zeros((self.size, len(self.damped)))
        for column, inertia in enumerate(self.damped):
            rows[inertia, column] = 1.0
        return rows

    def split(self, full: Any) -> tuple[Any, Any, Any, Any]:
        """Inertias, stiffnesses, coupling dampers, absolute dampers of a full vector."""
        n = self.size
        return full[:n], full[n : 2 * n - 1], full[2 * n - 1 : 3 * n - 2], full[3 * n - 2 :]

    def blocks(self, full: Any, diag: Any) -> tuple[Any, Any, Any]:
        """A_ww (n, n), A_wt (n, n−1) and B_w (n, inputs); A_tw is `difference`, the rest is zero.

        diag : the library's function from a vector to a diagonal matrix
        """
        inertia, stiffness, damping, absolute = self.split(full)
        inverse, turn = diag(1 / inertia), self.difference
        friction = turn.T @ diag(damping) @ turn + diag(self.damper_rows @ absolute)
        return -(inverse @ friction), -(inverse @ (turn.T @ diag(stiffness))), inverse @ self.torque_rows

    def matrices(self, full: Array) -> tuple[Array, Array]:
        """A (states, states) and B (states, inputs) of ẋ = A x + B u."""
        n, m = self.size, self.states
        a, b = np.zeros((m, m), np.result_type(full, float)), np.zeros((m, self.inputs), np.result_type(full))
        a[:n, :n], a[:n, n:], b[:n] = self.blocks(full, np.diag)
        a[n:, :n] = self.difference
        return a, b


def discretise(shape: Shape, full: Array, step: float) -> tuple[Array, Array, Array]:
    """First-order hold by one matrix exponential: x⁺ = F x + G u + H u⁺."""
    a, b = shape.matrices(full)
    n, m = shape.states, shape.inputs
    block = np.zeros((n + 2 * m, n + 2 * m))
    block[:n, :n], block[:n, n : n + m], block[n : n + m, n + m :] = a * step, b * step, np.eye(m)
    power = expm(block)
    late = power[:n, n + m :]
    return power[:n, :n], power[:n, n : n + m] - late, late


@dataclass(frozen=True)
class Channels:
    """The noise-free channels of a record: all that a drive is made of, but the measured speed.

    constant, quadratic : (c, N) N m and N m s²: torque of cylinder c = constant − quadratic · speed²
    load : (N,) N m; channels : theta, p1.., T_load as the package reads them
    """

    constant: Array
    quadratic: Array
    load: Array
    channels: dict[str, Array]

    @property
    def samples(self) -> int:
        return int(self.load.size)

    def torques(self, speed: Array) -> Array:
        """Inputs (c + 1, N) for a measured wheel speed (N,) rad/s."""
        return np.vstack([self.constant - self.quadratic * speed**2, self.load])


def simulate(
    shape: Shape, full: Array, start: Array, source: Channels, noise: Array, step: float
) -> tuple[Array, Array]:
    """Measured speed (N,) of the linear form, and its drives (c + 1, N).

    The reciprocating torque is made of the *measured* speed, noise and all, exactly as a fit will make it: the
    record obeys the linear form to rounding, and the residual at the truth is the noise.
    """
    f, g, h = discretise(shape, full, step)
    f_t, g_t, h_t = f.T.copy(), g.T.copy(), h.T.copy()
    count = source.samples
    speed, drives = np.empty(count), np.empty((count, shape.inputs))
    constant, quadratic, load = source.constant.T.copy(), source.quadratic.T.copy(), source.load
    x = np.array(start, dtype=float)
    for k in range(count):
        if k:
            base = x @ f_t + drives[k - 1] @ g_t
            u = drives[k - 1].copy()
            for _ in range(2):  # the speed at the end of a step needs the torque there: it converges at once
                seen = base[0] + u @ h_t[:, 0] + noise[k]
                u[:-1] = constant[k] - quadratic[k] * seen**2
                u[-1] = load[k]
            x = base + u @ h_t
            drives[k] = u
            speed[k] = x[0] + noise[k]
        else:
            speed[0] = x[0] + noise[0]
            drives[0, :-1] = constant[0] - quadratic[0] * speed[0] ** 2
            drives[0, -1] = load[0]
    return speed, drives.T.copy()
