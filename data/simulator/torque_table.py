"""Cylinder torques as piecewise polynomials of the crank angle: the same function, many times faster.

At a given crank angle the torque of a cylinder is a part of its own, a part in proportion to the burn strength,
and a part in proportion to speed squared. Each part is sampled once over a cycle.
"""

from dataclasses import dataclass

import numpy as np

from .engine import TDC
from .geometry import CYCLE, cylinder_torque
from .pressure import SEAM, Cylinders, pressure
from .shaft import Shaft

CELLS = 7200  # per cycle: a cell is 0.1 degrees, and the narrowest switch of the pressure is 8 degrees wide
DEGREE = 5


@dataclass(frozen=True)
class TorqueTable:
    """Parts of the torque on each throw that carries cylinders.

    throws (H,) inertia of each throw; cylinders (H, S) which cylinders (from 0) turn it
    coefficients (H * CELLS, DEGREE + 1, S + 2): own part, speed-squared part, then one part per cylinder,
    highest power first
    """

    throws: np.ndarray
    cylinders: np.ndarray
    coefficients: np.ndarray

    def torques(self, angle: np.ndarray, speed: np.ndarray, strength: np.ndarray) -> np.ndarray:
        """Torque on each throw (H, B) [N m] at its angle and speed; strength (S, H, B) [Pa]."""
        place = angle * (CELLS / CYCLE)
        cell = np.floor(place)
        inside = place - cell
        row = cell.astype(np.intp) % CELLS
        if len(self.throws) > 1:
            row += self._first
        parts = np.empty((*angle.shape, 2 + len(strength), 1))
        parts[..., 0, 0] = 1.0
        np.multiply(speed, speed, out=parts[..., 1, 0])
        for one, share in enumerate(strength):
            parts[..., 2 + one, 0] = share
        polynomial = (self.coefficients[row] @ parts)[..., 0]
        value = polynomial[..., 0] * inside
        for power in range(1, DEGREE):
            value += polynomial[..., power]
            value *= inside
        return value + polynomial[..., DEGREE]

    @property
    def _first(self) -> np.ndarray:
        return (np.arange(len(self.throws)) * CELLS)[:, None]

    def events(self, angle: np.ndarray) -> np.ndarray:
        """Which combustion of each cylinder (S, H, B) the throws' angles (H, B) are in, as in engine.py."""
        local = angle - TDC[self.cylinders.T][..., None]
        return np.floor((local - SEAM) / CYCLE).astype(np.intp) + 2


def make_table(shaft: Shaft, cylinders: Cylinders) -> TorqueTable:
    """Sample the torques of these cylinders on this shaft."""
    throws = np.array(sorted(set(shaft.throws)))
    sharing = np.array([[c for c in range(4) if shaft.throws[c] == throw] for throw in throws])
    nodes = 0.5 - 0.5 * np.cos((2 * np.arange(DEGREE + 1) + 1) * np.pi / (2 * (DEGREE + 1)))
    to_powers = np.linalg.inv(np.vander(nodes, DEGREE + 1))
    angle = (np.arange(CELLS)[:, None] + nodes) * (CYCLE / CELLS)
    tables = []
    for mates in sharing:
        own, squared, burning = np.zeros_like(angle), np.zeros_like(angle), []
        for c in mates:
            local, zero = angle - TDC[c], np.zeros_like(angle)
            shape = (cylinders.intake[c], cylinders.delay[c])
            motored = cylinder_torque(local, zero, pressure(local, 0.0, *shape))
            own += motored
            squared += cylinder_torque(local, zero + 1.0, pressure(local, 0.0, *shape)) - motored
            burning.append((cylinder_torque(local, zero, pressure(local, 1e6, *shape)) - motored) / 1e6)
        parts = np.stack([own, squared, *burning], axis=-1)
        tables.append(np.einsum("pn,cnk->cpk", to_powers, parts))
    return TorqueTable(throws, sharing, np.ascontiguousarray(np.concatenate(tables)))
