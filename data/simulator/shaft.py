"""A chain of inertias joined by springs and dampers, driven by four cylinders, braked at its last inertia."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Shaft:
    """Inertias (n,) kg m2, couplings K (n-1,) N m/rad and C (n-1,) N m s/rad, bearings C_abs (n,) N m s/rad.

    `throws` (4,) says which inertia (counted from 0) each cylinder turns.
    State: angle of the first inertia [rad], speeds (n,) [rad/s], twists theta_{i+1} - theta_i (n-1,) [rad].
    """

    inertia: np.ndarray
    stiffness: np.ndarray
    coupling_damping: np.ndarray
    absolute_damping: np.ndarray
    throws: tuple[int, ...]

    @property
    def size(self) -> int:
        return len(self.inertia)

    def matrix(self) -> np.ndarray:
        """Linear part (2n, 2n) of the state equation."""
        n = self.size
        matrix = np.zeros((2 * n, 2 * n))
        matrix[0, 1] = 1.0
        for i in range(n):
            matrix[1 + i, 1 + i] -= self.absolute_damping[i] / self.inertia[i]
        for i in range(n - 1):
            twist, near, far = 1 + n + i, 1 + i, 2 + i
            matrix[twist, far], matrix[twist, near] = 1.0, -1.0
            # the coupling's torque, K twist + C twist rate, pulls the near inertia on and the far one back
            torque = np.zeros(2 * n)
            torque[twist] = self.stiffness[i]
            torque += self.coupling_damping[i] * matrix[twist]
            matrix[near] += torque / self.inertia[i]
            matrix[far] -= torque / self.inertia[i + 1]
        return matrix

    def torque_columns(self) -> np.ndarray:
        """State derivatives per unit of each cylinder's torque, (2n, 4)."""
        columns = np.zeros((2 * self.size, len(self.throws)))
        for cylinder, i in enumerate(self.throws):
            columns[1 + i, cylinder] = 1.0 / self.inertia[i]
        return columns

    def angle_rows(self) -> np.ndarray:
        """Rows (n, 2n) that give every inertia's absolute angle."""
        rows = np.zeros((self.size, 2 * self.size))
        rows[:, 0] = 1.0
        for i in range(1, self.size):
            rows[i, 1 + self.size : 1 + self.size + i] = 1.0
        return rows

    def steady_state(self, speed: float, engine_torque: float) -> np.ndarray:
        """State (2n,) of even running at `speed` [rad/s], the cylinders sharing `engine_torque` [N m]."""
        n = self.size
        state = np.zeros(2 * n)
        state[1 : 1 + n] = speed
        carried = 0.0
        for i in range(n - 1):
            carried += engine_torque * self.throws.count(i) / len(self.throws)
            carried -= self.absolute_damping[i] * speed
            state[1 + n + i] = -carried / self.stiffness[i]
        return state

    def natural_frequencies(self) -> np.ndarray:
        """Damped natural frequencies |lambda| / 2 pi [Hz], rising, without the rigid-body mode."""
        eigenvalues = np.linalg.eigvals(self.matrix()[1:, 1:])
        pairs = eigenvalues[eigenvalues.imag > 1e-6]
        return np.sort(np.abs(pairs)) / (2.0 * np.pi)

    def energy(self, states: np.ndarray) -> np.ndarray:
        """Kinetic plus elastic energy [J] of states (2n, N)."""
        n = self.size
        kinetic = 0.5 * self.inertia @ states[1 : 1 + n] ** 2
        return kinetic + 0.5 * self.stiffness @ states[1 + n :] ** 2


def two_mass_shaft() -> Shaft:
    """Engine and load, truth of Table 4.1."""
    return Shaft(
        inertia=1.0 / np.array([2.557, 5.646]),
        stiffness=np.array([1992.0]),
        coupling_damping=np.array([2.5]),
        absolute_damping=np.array([0.1541, 0.0]),
        throws=(0, 0, 0, 0),
    )


def crankshaft_shaft() -> Shaft:
    """Damping wheel, four throws, flywheel, dynamometer: Table 4.12 and the values its listing holds fixed.

    Each absolute damper sits on the inertia of its own cylinder (J2..J5, C2..C5); the appendix's matrices
    print them, and some inertias, one index off.
    """
    return Shaft(
        inertia=1.0 / np.array([33.39, 22.3, 22.3, 22.3, 22.3, 5.968, 5.646]),
        stiffness=np.array([241.8e3, 1270e3, 1270e3, 1270e3, 1427e3, 1992.0]),
        coupling_damping=np.array([15.0, 2.5, 2.5, 2.5, 2.5, 2.5]),
        absolute_damping=np.array([0.0, 1, 1, 1, 1, 0, 0]) * 0.1541 / 4.0,
        throws=(1, 2, 3, 4),
    )
