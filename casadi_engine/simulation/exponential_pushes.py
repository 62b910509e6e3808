"""What the estimated vector does directly to a step of the exponential integrator, the states held."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from casadi_engine.simulation.exponential_step import StepMatrices
from casadi_engine.simulation.exponential_values import Steps
from casadi_engine.simulation.jets import Array

if TYPE_CHECKING:
    from casadi_engine.simulation.exponential_runge_kutta import ExponentialPropagator


class Pushes:
    """What z does to a step directly, by the matrices and by the drives: (n + 4 ns, z of the span, M) of step k.

    The span is the range of entries of z that do anything of this kind; those of the laws alone do not.
    """

    def __init__(self, made: ExponentialPropagator, steps: Steps, matrices: StepMatrices, z: Array) -> None:
        n, m, nz = made.n, matrices.m, made.nz
        samples, _, self._first, _ = made.drive_columns(z)
        moving = np.asarray(matrices.p[1 : 1 + nz].any(axis=(1, 2)))
        moving[samples.active] = True
        places = np.flatnonzero(moving)
        self.low, self.high = (int(places[0]), int(places[-1]) + 1) if len(places) else (0, 0)
        part = matrices.p[1 + self.low : 1 + self.high]
        self.matrix = np.ascontiguousarray(part.transpose(1, 0, 2)).reshape(-1, part.shape[2])
        self._active = [int(index) - self.low for index in samples.active]
        self._held = np.ascontiguousarray(matrices.p[0][:, n : n + 2 * m])
        self._columns = steps.columns
        self._push = np.empty((matrices.p.shape[1], self.high - self.low, steps.end.shape[1]))

    def span(self, offset: int = 0) -> slice:
        """The entries of z, counted from ``offset``."""
        return slice(offset + self.low, offset + self.high)

    def at(self, k: int) -> Array:
        """The push of step k, overwritten by the next call."""
        if len(self.matrix):
            np.matmul(self.matrix, self._columns[k], out=self._push.reshape(len(self.matrix), -1))
        for row, place in enumerate(self._active):
            self._push[:, place] += self._held @ self._first[row, k]
        return self._push
