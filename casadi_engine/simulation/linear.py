"""Propagation of a linear model over all shooting intervals of a record at once.

Inside, samples stand in the layout (R*ny, b, M): row of a block, block of an interval, interval; one block is one
matrix product for all M intervals and all parameter sensitivities (see ``blocks``).
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_engine.model import Model
from casadi_engine.simulation import jets
from casadi_engine.simulation.blocks import Blocks, block_matrices
from casadi_engine.simulation.discretisation import Discretisation, Method
from casadi_engine.simulation.gain import Gain, corrected
from casadi_engine.simulation.grid import Drives, DriveSamples, Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.shared_core import Cores


@dataclass
class LinearTrajectory:
    """States and outputs of all intervals with their first derivatives.

    x : (b+1, 1+nz, n, M) block states and their z-derivatives; y : (1+nz, R*ny, b, M) outputs and z-derivatives;
    phi : (b+1, n, n) d(block state)/d(interval start), the same for every interval; ys : (R*ny, b, n) dy/d(start)
    """

    blocks: Blocks
    drives: DriveSamples
    v: Array
    x: Array
    y: Array
    phi: Array
    ys: Array

    @property
    def end(self) -> Array:
        """(n, M) states at the intervals' ends."""
        return self.x[-1, 0]

    @property
    def end_z(self) -> Array:
        """(nz, n, M)."""
        return self.x[-1, 1:]

    @property
    def end_s(self) -> Array:
        """(1, n, n): shared by all intervals."""
        return self.phi[-1:]


class LinearPropagator:
    """The linear core of a model over one record.

    z : (nz,) SX local estimated vector; physical : (np,) SX of it; gain : of a one-step predictor, or None;
    feedback : (ny, N) measured outputs for its correction; cores : shared with further records, or None
    """

    def __init__(
        self,
        model: Model,
        grid: Grid,
        intervals: Intervals,
        z: ca.SX,
        physical: ca.SX,
        *,
        scale: Array,
        method: Method = "exact",
        gain: Gain | None = None,
        feedback: Array | None = None,
        cores: Cores | None = None,
    ) -> None:
        self.intervals, self.nz = intervals, int(z.numel())
        self._drives = Drives(model, grid, z, physical)
        self._shared = (cores or Cores()).of(
            model, z, physical, step=grid.step, hold=self._drives.holds, scale=scale, method=method
        )
        self.core = self._shared.core
        self.n, self.ny = self.core.states, self.core.outputs
        self._samples = grid.samples
        self.gain = gain
        self._feedback = feedback
        self._width = self.core.drives + (0 if feedback is None else len(feedback))
        self._block_drives: tuple[DriveSamples, Array, Array, Array] | None = None
        self._merged_drives: tuple[DriveSamples, DriveSamples] | None = None

    # ---- drives

    def _merged(self, drives: Array) -> Array:
        """(..., m, N) drives of the model as (..., m', N) columns of the core; constants and feedback are zero."""
        merged = np.zeros((*drives.shape[:-2], self._width, self._samples))
        for column, group in enumerate(self.core.groups):
            one = drives[..., group[0], :] if len(group) == 1 else drives[..., list(group), :].sum(axis=-2)
            merged[..., column, :] = one
        return merged

    def _value_columns(self, drives: Array) -> Array:
        merged = self._merged(drives)
        merged[len(self.core.groups) : self.core.drives] = 1.0
        if self._feedback is not None:
            merged[self.core.drives :] = self._feedback
        return self._columns(merged)

    def _columns(self, v: Array) -> Array:
        """(..., m', N) as block columns (..., (q+1)*m', b*M): sample of the block and drive down, blocks across."""
        plan, lead, width = self.intervals, v.shape[:-2], v.shape[-2]
        tail = np.repeat(v[..., -1:], plan.padded + 1 - self._samples, axis=-1)
        padded = np.concatenate([v, tail], axis=-1)
        columns = np.empty((*lead, plan.q + 1, width, plan.b, plan.m))
        whole = padded[..., :-1].reshape(*lead, width, plan.m, plan.b, plan.q)
        columns[..., : plan.q, :, :, :] = np.moveaxis(whole, (-1, -4, -2, -3), (-4, -3, -2, -1))
        last = padded[..., plan.q :: plan.q].reshape(*lead, width, plan.m, plan.b)
        columns[..., plan.q, :, :, :] = last.swapaxes(-1, -2)
        return columns.reshape(*lead, (plan.q + 1) * width, plan.b * plan.m)

    def _drive_columns(self, z: Array) -> tuple[DriveSamples, Array, Array, Array]:
        samples = self._drives.at(z)
        if self._block_drives is None or self._block_drives[0] is not samples:
            value = self._value_columns(samples.value)
            first = second = np.zeros((0, *value.shape))
            if len(samples.active):
                first = self._columns(self._merged(samples.first))
                second = self._columns(self._merged(samples.second))
            self._block_drives = (samples, value, first, second)
        return self._block_drives

    def drives_at(self, z: Array) -> Array:
        """(m, N) drives of the model on the grid."""
        return self._drives.at(z).value

    def merged_drives(self, z: Array) -> DriveSamples:
        """The core's drives on the grid, constants among them, with their first derivatives; the second are none."""
        samples = self._drives.at(z)
        if self._merged_drives is None or self._merged_drives[0] is not samples:
            value = self._merged(samples.value)
            value[len(self.core.groups) : self.core.drives] = 1.0
            first = self._merged(samples.first)
            self._merged_drives = (samples, DriveSamples(value, samples.active, first, first[:0]))
        return self._merged_drives[1]

    def discretisation(self, z: Array, order: int) -> Discretisation:
        """The core's discrete matrices at z, without the correction of a predictor."""
        return self._shared.at(z, order)

    # ---- forward

    def _blocks(self, z: Array, order: int) -> Blocks:
        if self.gain is None:
            return self._shared.blocks(z, order, self.intervals.q, self.intervals.samples)
        discrete, seen = self._shared.at(z, order), (True,) * self.ny
        discrete = corrected(discrete, self.gain.at(z, self.core, discrete, seen))
        return block_matrices(discrete, self.intervals.q, self.intervals.samples)

    # A trial point of the search may be far off: what overflows is found by its result.
    @np.errstate(over="ignore", invalid="ignore")
    def propagate(self, z: Array, nodes: Array, order: int = 1) -> LinearTrajectory:
        """Advance all intervals from ``nodes`` (M, n), scaled states, at z : (nz,)."""
        plan, n = self.intervals, self.n
        nz = self.nz if order else 0
        blocks = self._blocks(z, order)
        samples, v, v_first, _ = self._drive_columns(z)
        p = blocks.p[: 1 + nz]
        forced = (p[:, :, n:].reshape(p.shape[0] * p.shape[1], v.shape[0]) @ v).reshape(
            1 + nz, -1, plan.b, plan.m
        )
        if nz:
            for k, i in enumerate(samples.active):
                forced[1 + i] += (p[0, :, n:] @ v_first[k]).reshape(-1, plan.b, plan.m)
        push = np.ascontiguousarray(forced[:, :n].transpose(2, 0, 1, 3))
        x = np.empty((plan.b + 1, 1 + nz, n, plan.m))
        x[0] = 0.0
        x[0, 0] = nodes.T
        phi = np.empty((plan.b + 1, n, n))
        phi[0] = np.eye(n)
        step, turn = p[0, :n, :n], np.ascontiguousarray(p[1:, :n, :n])
        for k in range(plan.b):
            np.matmul(step, x[k], out=x[k + 1])
            x[k + 1] += push[k]
            if nz:
                x[k + 1, 1:] += turn @ x[k, 0]
            np.matmul(step, phi[k], out=phi[k + 1])
        y = forced[:, n:]
        at = np.ascontiguousarray(x[:-1].transpose(1, 2, 0, 3)).reshape(1 + nz, n, -1)
        out = p[:, n:, :n]
        y += (out @ at[0]).reshape(y.shape)
        if nz:
            y[1:] += (out[0] @ at[1:]).reshape(y[1:].shape)
        if not (np.isfinite(x[-1]).all() and np.isfinite(y).all()):
            raise FloatingPointError("the model's state is not finite here")
        ys = (out[0] @ phi[:-1]).transpose(1, 0, 2)
        return LinearTrajectory(blocks, samples, v, x, y, phi, ys)

    # ---- second order

    @np.errstate(over="ignore", invalid="ignore")
    def contraction(
        self, z: Array, path: LinearTrajectory, rho: Array, lam: Array
    ) -> tuple[Array, Array, Array]:
        """Second derivatives of sum(rho * y) + sum(lam * end): (z, z) (nz, nz), (z, start) (nz, n, M) and (start,
        start) (M, n, n), which vanish: the model is linear in its state.

        rho : (R*ny, b, M); lam : (n, M).
        """
        plan, n, nz = self.intervals, self.n, self.nz
        if nz == 0:
            return np.zeros((0, 0)), np.zeros((0, n, plan.m)), np.zeros((plan.m, n, n))
        p = path.blocks.p
        if len(p) == 1 + nz:
            path.blocks = self._blocks(z, 2)
            p = path.blocks.p
        samples, v, v_first, v_second = self._drive_columns(z)
        adjoint = np.empty((plan.b, n + rho.shape[0], plan.m))
        adjoint[:, n:] = rho.transpose(1, 0, 2)
        mu, back = lam, p[0].T[:n]
        for k in range(plan.b - 1, -1, -1):
            adjoint[k, :n] = mu
            mu = back @ adjoint[k]
        rows = np.ascontiguousarray(adjoint.transpose(1, 0, 2)).reshape(n + rho.shape[0], -1)
        at = path.x[:-1].transpose(1, 2, 0, 3).reshape(1 + nz, n, -1)
        outer = np.concatenate([rows @ at[0].T, rows @ v.T], axis=1)
        i, j = jets.pairs(nz)
        hzz = np.zeros((nz, nz))
        hzz[i, j] = p[1 + nz :].reshape(len(i), -1) @ outer.ravel()
        hzz[j, i] = hzz[i, j]
        sensitive = np.zeros((nz, rows.shape[0], p.shape[2]))
        sensitive[:, :, :n] = rows @ at[1:].transpose(0, 2, 1)
        for k, a in enumerate(samples.active):
            sensitive[a, :, n:] = rows @ v_first[k].T
        cross = p[1 : 1 + nz].reshape(nz, -1) @ sensitive.reshape(nz, -1).T
        hzz += cross + cross.T
        if len(samples.active):
            a, c = np.triu_indices(len(samples.active))
            force = p[0, :, n:].T @ rows
            extra = np.tensordot(v_second, force, axes=([1, 2], [0, 1]))
            block = np.zeros((len(samples.active),) * 2)
            block[a, c] = extra
            block[c, a] = extra
            hzz[np.ix_(samples.active, samples.active)] += block
        pulled = np.matmul(p[1 : 1 + nz, :, :n].transpose(0, 2, 1), rows).reshape(nz, n, plan.b, plan.m)
        # (nz*M, b*n) @ (b*n, n): the block states hang on the interval's start by phi.
        flat = np.ascontiguousarray(pulled.transpose(0, 3, 2, 1)).reshape(nz * plan.m, -1)
        hzs = (flat @ path.phi[:-1].reshape(-1, n)).reshape(nz, plan.m, n).transpose(0, 2, 1)
        return hzz, hzs, np.zeros((plan.m, n, n))
