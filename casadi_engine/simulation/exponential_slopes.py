"""First derivatives of the exponential integrator's steps: by the state where a step begins, and by z.

They are worked out for all steps of one length at once, from the laws' slopes along the record; `chain` then carries
them through the intervals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.drives import DriveSamples
from casadi_engine.simulation.exponential_step import STAGE_NODES, STAGES, StepMatrices
from casadi_engine.simulation.exponential_values import Steps
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.laws import Laws
from casadi_engine.simulation.local_steps import LocalSteps

# Numbers that are worked out together: they then stay in the cache.
_PART = 250_000


@dataclass(frozen=True)
class Columns:
    """Drives at the steps' starts and ends: value (2m, K), first (a, 2m, K) and second (pairs, 2m, K) derivatives, and
    the samples that they are made of."""

    samples: DriveSamples
    value: Array
    first: Array
    second: Array


@dataclass(frozen=True)
class Linearised:
    """Steps at one point, and what their derivatives are made of.

    matrices : of each level; by_signal : (4, entries, K) and by_z : (4, active, nw, K) the laws' slopes
    """

    laid: LocalSteps
    laws: Laws
    matrices: list[StepMatrices]
    steps: Steps
    columns: Columns
    by_signal: Array
    by_z: Array
    nz: int

    def factors(self, steps: slice | NDArray[np.intp]) -> Array:
        """(n + 2m + 4 nw, k) the factors [x; v; w] of some steps."""
        own, k = self.steps, self.laid.steps
        parts = (own.begun[:, :k], self.columns.value, own.torques)
        return np.concatenate([part[:, steps] for part in parts])

    def part(self, level: int, steps: slice | NDArray[np.intp]) -> tuple[Array, Array, Array]:
        """Derivatives by (x, z) of signals (4 ns, n+nz, k), torques (4 nw, n+nz, k) and ends (n, n+nz, k) of some steps
        of a level."""
        jet, laws = self.matrices[level], self.laws
        p, n, m, ns, nw = jet.p[0], jet.n, jet.m, laws.size, laws.count
        at_law, push = n + 2 * m, self._push(level, steps)
        count = push.shape[2]
        s, torques = np.empty((2, STAGES, max(ns, nw), n + self.nz, count))
        s, torques = s[:, :ns], torques[:, :nw]
        for i in range(STAGES):
            rows = slice(n + i * ns, n + (i + 1) * ns)
            s[i, :, :n], s[i, :, n:] = p[rows, :n, None], push[rows]
            for j in range(i):
                feed = p[rows, at_law + j * nw : at_law + (j + 1) * nw]
                if feed.any():
                    s[i] += (feed @ torques[j].reshape(nw, -1)).reshape(s[i].shape)
            torques[i] = 0.0
            for entry, (law, signal, _) in enumerate(laws.pattern):
                torques[i, law] += self.by_signal[i, entry, steps] * s[i, signal]
            for row, index in enumerate(laws.active):
                torques[i, :, n + index] += self.by_z[i, row][:, steps]
        s, torques = s.reshape(STAGES * ns, n + self.nz, count), torques.reshape(STAGES * nw, -1, count)
        ends = (p[:n, at_law:] @ torques.reshape(len(torques), -1)).reshape(n, n + self.nz, count)
        ends[:, :n] += p[:n, :n, None]
        ends[:, n:] += push[:n]
        return s, torques, ends

    def _push(self, level: int, steps: slice | NDArray[np.intp]) -> Array:
        """(n + 4 ns, nz, k) what z does to some steps by the matrices and the drives, the state and the laws held."""
        jet, nz = self.matrices[level], self.nz
        factors = self.factors(steps)
        push = np.zeros((jet.p.shape[1], nz, factors.shape[1]))
        moving = np.flatnonzero(jet.p[1 : 1 + nz].any(axis=(1, 2)))
        if len(moving):
            low, high = int(moving[0]), int(moving[-1]) + 1
            matrix = np.ascontiguousarray(jet.p[1 + low : 1 + high].transpose(1, 0, 2))
            push[:, low:high] = (matrix.reshape(-1, matrix.shape[2]) @ factors).reshape(
                -1, high - low, push.shape[2]
            )
        held = jet.p[0][:, jet.n : jet.n + 2 * jet.m]
        for row, index in enumerate(self.columns.samples.active):
            push[:, index] += held @ self.columns.first[row][:, steps]
        return push

    def maps(self) -> Array:
        """(K, n, n+nz) derivatives of every step's end."""
        n, wide = self.matrices[0].n, self.matrices[0].n + self.nz
        found = np.empty((self.laid.steps, n, wide))
        each = wide * (self.matrices[0].p.shape[1] + STAGES * self.laws.count)
        for level, steps in self.laid.parts(max(64, _PART // each)):
            found[steps] = self.part(level, steps)[2].transpose(2, 0, 1)
        return found


def law_slopes(laid: LocalSteps, laws: Laws, steps: Steps, z: Array) -> tuple[Array, Array]:
    """Derivatives of the laws by signals (4, entries, K) and by the active z (4, active, nw, K)."""
    found = [laws.slopes(steps.s[:, i], laid.given[node], z) for i, node in enumerate(STAGE_NODES)]
    return np.array([one for one, _ in found]), np.array([other for _, other in found])


def chain(laid: LocalSteps, maps: Array) -> Array:
    """(K+M, n, n+nz) derivatives of the states where steps begin, and where intervals end, by (start, z)."""
    n = maps.shape[1]
    found = np.zeros((laid.steps + laid.plan.m, *maps.shape[1:]))
    found[laid.layout.at[0], :, :n] = np.eye(n)
    for own, after, _ in laid.rows:
        here = maps[own]
        ahead = here[:, :, :n] @ found[own]
        ahead[:, :, n:] += here[:, :, n:]
        found[after] = ahead
    return found
