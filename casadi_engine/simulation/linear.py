"""Propagation of a linear model over all shooting intervals of a record at once.

Inside, samples stand in the layout (R*ny, b, M): row of a block, block of an interval, interval; one block is one
matrix product for all M intervals and all parameter sensitivities (see ``blocks``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import ask
from casadi_engine.model import Model
from casadi_engine.simulation import jets
from casadi_engine.simulation.blocks import Blocks, block_matrices
from casadi_engine.simulation.discretisation import Discretisation, Method
from casadi_engine.simulation.drives import Drives, DriveSamples
from casadi_engine.simulation.gain import Gain, corrected
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.shared_core import Cores

# Samples whose drives are laid out at a time, so that no copy of a long record is made on the way.
_LAID = 32768


@dataclass(frozen=True)
class Columns:
    """Drives of the core at the samples of L blocks of every interval, sample of the block and drive down.

    value : (W, L*M), W = (q+1)*m'; first : (a, W, L*M) and second : (pairs of a, W, L*M) in the ``active`` entries of z
    """

    active: NDArray[np.intp]
    value: Array
    first: Array
    second: Array


@dataclass
class LinearTrajectory:
    """States and outputs of L blocks of all intervals, the first of which begin at ``at``, with first derivatives.

    x : (L+1, 1+nz, n, M) block states and their z-derivatives; y : (1+nz, R*ny, L, M) outputs and z-derivatives;
    phi : (L+1, n, n) d(block state)/d(interval start), the same for every interval; ys : (R*ny, L, n) dy/d(start)
    """

    blocks: Blocks
    columns: Columns
    at: slice
    x: Array
    y: Array
    phi: Array
    ys: Array

    @property
    def end(self) -> Array:
        """(n, M) states at the end; at the intervals' ends where the last blocks are among these."""
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
        self._constant: Array | None = None
        self._merged_drives: tuple[Array, DriveSamples] | None = None
        self._corrected: tuple[Array, int, Blocks] | None = None

    def parts(self, samples: int) -> list[slice]:
        """The blocks of every interval in runs that hold about so many samples of all intervals."""
        plan = self.intervals
        count = max(1, min(plan.b, round(plan.padded / samples)))
        edges = [plan.b * k // count for k in range(count + 1)]
        return [slice(begin, end) for begin, end in pairwise(edges)]

    # ---- drives

    def forget(self) -> None:
        """Give the memory back that the drives of a long record take; they are made anew when they are needed."""
        if self._samples > _LAID:
            self._constant = self._merged_drives = None

    def _merged(self, drives: Array) -> Array:
        """(..., m, N) drives of the model as (..., m', N) columns of the core; constants and feedback are zero."""
        merged = np.zeros((*drives.shape[:-2], self._width, drives.shape[-1]))
        for column, group in enumerate(self.core.groups):
            one = drives[..., group[0], :] if len(group) == 1 else drives[..., list(group), :].sum(axis=-2)
            merged[..., column, :] = one
        return merged

    def _columns(self, v: Array, length: int) -> Array:
        """(..., m', M*(length*q+1)) samples of blocks as columns (..., W, length*M)."""
        plan, lead, width = self.intervals, v.shape[:-2], v.shape[-2]
        own = v.reshape(*lead, width, plan.m, length * plan.q + 1)
        columns = np.empty((*lead, plan.q + 1, width, length, plan.m))
        whole = own[..., :-1].reshape(*lead, width, plan.m, length, plan.q)
        columns[..., : plan.q, :, :, :] = np.moveaxis(whole, (-1, -4, -2, -3), (-4, -3, -2, -1))
        columns[..., plan.q, :, :, :] = own[..., plan.q :: plan.q].swapaxes(-1, -2)
        return columns.reshape(*lead, (plan.q + 1) * width, length * plan.m)

    def _laid(self, z: Array, at: slice) -> Columns:
        """Columns of the blocks ``at``; what is behind the record's end is as its last sample."""
        plan, length = self.intervals, at.stop - at.start
        inside = np.arange(at.start * plan.q, at.stop * plan.q + 1)
        points = (plan.length * np.arange(plan.m)[:, None] + inside).ravel()
        points = np.minimum(points, self._samples - 1)
        samples = self._drives.part(z, points)
        value = self._merged(samples.value)
        value[len(self.core.groups) : self.core.drives] = 1.0
        if self._feedback is not None:
            value[self.core.drives :] = self._feedback[:, points]
        found = self._columns(value, length)
        first = second = np.zeros((0, *found.shape))
        if len(samples.active):
            first = self._columns(self._merged(samples.first), length)
            second = self._columns(self._merged(samples.second), length)
        return Columns(samples.active, found, first, second)

    def _drive_columns(self, z: Array, at: slice) -> Columns:
        """Columns of the blocks ``at``: made once for the whole record where they are the same for every z."""
        if len(self._drives.active):
            return self._laid(z, at)
        plan = self.intervals
        if self._constant is None:
            self.forget()  # who works on the columns has no use for the drives side by side
            self._constant = np.empty(((plan.q + 1) * self._width, plan.b, plan.m))
            for part in self.parts(_LAID):
                found = self._laid(z, part).value
                self._constant[:, part] = found.reshape(self._constant[:, part].shape)
        value = self._constant[:, at].reshape(len(self._constant), (at.stop - at.start) * plan.m)
        none = np.zeros((0, *value.shape))
        return Columns(self._drives.active, value, none, none)

    def drives_at(self, z: Array, points: NDArray[np.intp] | None = None) -> Array:
        """(m, k) drives of the model at the grid points with these numbers (k,), all by default."""
        return self._drives.part(z, points).value

    @property
    def drives_active(self) -> NDArray[np.intp]:
        """Entries of z that the drives depend on."""
        return self._drives.active

    def forget_merged(self) -> None:
        """Give back the memory of what ``merged_drives`` keeps."""
        self._merged_drives = None

    def merged_drives(self, z: Array) -> DriveSamples:
        """The core's drives on the grid, constants among them, with their first derivatives; the second are none."""
        known, active = self._merged_drives, self._drives.active
        if known is None or (len(active) and not np.array_equal(known[0], z)):
            self.forget()  # who works on these has no use for the columns
            value = np.empty((self._width, self._samples))
            first = np.empty((len(active), *value.shape))
            for begin in range(0, self._samples, _LAID):
                points = np.arange(begin, min(begin + _LAID, self._samples))
                samples, at = self._drives.part(z, points), slice(begin, begin + _LAID)
                value[:, at] = self._merged(samples.value)
                first[..., at] = self._merged(samples.first)
            value[len(self.core.groups) : self.core.drives] = 1.0
            known = self._merged_drives = (z.copy(), DriveSamples(value, active, first, first[:0]))
        return known[1]

    def discretisation(self, z: Array, order: int) -> Discretisation:
        """The core's discrete matrices at z, without the correction of a predictor."""
        return self._shared.at(z, order)

    # ---- forward

    @np.errstate(over="ignore", invalid="ignore")
    def _blocks(self, z: Array, order: int, *, lasting: bool = True) -> Blocks:
        if self.gain is None:
            lasting = lasting and order == 0
            return self._shared.blocks(z, order, self.intervals.q, self.intervals.samples, lasting=lasting)
        last = self._corrected
        if last is None or last[1] != order or not np.array_equal(last[0], z):
            discrete, seen = self._shared.at(z, order), (True,) * self.ny
            discrete = corrected(discrete, self.gain.at(z, self.core, discrete, seen))
            made = block_matrices(discrete, self.intervals.q, self.intervals.samples)
            last = self._corrected = (z.copy(), order, made)
        return last[2]

    def propagate(self, z: Array, nodes: Array, order: int = 1) -> LinearTrajectory:
        """Advance all intervals from ``nodes`` (M, n), scaled states, at z : (nz,)."""
        return next(self.run(z, nodes, order, [slice(0, self.intervals.b)]))

    def run(
        self,
        z: Array,
        nodes: Array,
        order: int,
        parts: list[slice],
        *,
        outputs: bool = True,
        lasting: bool = True,
    ) -> Iterator[LinearTrajectory]:
        """The same, the blocks in one part after the other, so that a long record takes little memory.

        outputs : False for the states alone, which is all that `contraction` needs
        lasting : see `block_matrices`
        """
        nz = self.nz if order else 0
        blocks = made = self._blocks(z, order, lasting=lasting)
        if not outputs:
            blocks = replace(made, p=made.p[: 1 + nz, : self.n])
        x, phi = np.zeros((1 + nz, self.n, self.intervals.m)), np.eye(self.n)
        x[0] = nodes.T
        for at in parts:
            ask((at.stop - at.start) * self.intervals.m)
            path = self._advance(blocks, self._drive_columns(z, at), at, x, phi)
            x, phi, path.blocks = path.x[-1], path.phi[-1], made
            yield path

    # A trial point of the search may be far off: what overflows is found by its result.
    @np.errstate(over="ignore", invalid="ignore")
    def _advance(
        self, blocks: Blocks, columns: Columns, at: slice, begin: Array, turned: Array
    ) -> LinearTrajectory:
        """Some blocks from the states (1+nz, n, M) that they begin with, and the slopes (n, n) of these."""
        n, nz, count, length = self.n, len(begin) - 1, self.intervals.m, at.stop - at.start
        p, v = blocks.p[: 1 + nz], columns.value
        forced = (p[:, :, n:].reshape(p.shape[0] * p.shape[1], v.shape[0]) @ v).reshape(
            1 + nz, -1, length, count
        )
        if nz:
            for k, i in enumerate(columns.active):
                forced[1 + i] += (p[0, :, n:] @ columns.first[k]).reshape(-1, length, count)
        push = np.ascontiguousarray(forced[:, :n].transpose(2, 0, 1, 3))
        x, phi = np.empty((length + 1, *begin.shape)), np.empty((length + 1, n, n))
        x[0], phi[0] = begin, turned
        step, turn = p[0, :n, :n], np.ascontiguousarray(p[1:, :n, :n])
        for k in range(length):
            np.matmul(step, x[k], out=x[k + 1])
            x[k + 1] += push[k]
            if nz:
                x[k + 1, 1:] += turn @ x[k, 0]
            np.matmul(step, phi[k], out=phi[k + 1])
        y = forced[:, n:]
        states = np.ascontiguousarray(x[:-1].transpose(1, 2, 0, 3)).reshape(1 + nz, n, -1)
        out = p[:, n:, :n]
        y += (out @ states[0]).reshape(y.shape)
        if nz:
            y[1:] += (out[0] @ states[1:]).reshape(y[1:].shape)
        if not (np.isfinite(x[-1]).all() and np.isfinite(y).all()):
            raise FloatingPointError("the model's state is not finite here")
        ys = (out[0] @ phi[:-1]).transpose(1, 0, 2)
        return LinearTrajectory(blocks, columns, at, x, y, phi, ys)

    # ---- second order

    @np.errstate(over="ignore", invalid="ignore")
    def _second_products(self, z: Array, path: LinearTrajectory, outer: Array) -> Array:
        """Sums (pairs,) of the products of the block matrix's second derivatives with ``outer`` of its shape."""
        plan, known = self.intervals, len(path.blocks.p) > 1 + self.nz
        if not known and self.gain is None:
            found = self._shared.second_products(z, plan.q, plan.samples, outer)
            if found is not None:
                return found
        if not known:
            path.blocks = self._blocks(z, 2)
        return np.asarray(path.blocks.p[1 + self.nz :].reshape(-1, outer.size) @ outer.ravel())

    @np.errstate(over="ignore", invalid="ignore")
    def pulled_back(self, z: Array, rho: Array, lam: Array) -> Array:
        """The multipliers (n, M) at the start of L blocks from those at their end and the weights (R*ny, L, M)."""
        return self._adjoint(self._blocks(z, 2).p[0], rho, lam)[1]

    def _adjoint(self, p: Array, rho: Array, lam: Array) -> tuple[Array, Array]:
        """Multipliers of the blocks' ends and outputs (L, n + R*ny, M), and those of their start (n, M)."""
        n, length = self.n, rho.shape[1]
        adjoint = np.empty((length, n + rho.shape[0], self.intervals.m))
        adjoint[:, n:] = rho.transpose(1, 0, 2)
        mu, back = lam, p.T[:n]
        for k in range(length - 1, -1, -1):
            adjoint[k, :n] = mu
            mu = back @ adjoint[k]
        return adjoint, mu

    @np.errstate(over="ignore", invalid="ignore")
    def contraction(
        self, z: Array, path: LinearTrajectory, rho: Array, lam: Array
    ) -> tuple[Array, Array, Array]:
        """Second derivatives of sum(rho * y) + sum(lam * end): (z, z) (nz, nz), (z, start) (nz, n, M) and (start,
        start) (M, n, n), which vanish: the model is linear in its state.

        rho : (R*ny, L, M) of the blocks of the path; lam : (n, M) at their end.
        """
        plan, n, nz, length = self.intervals, self.n, self.nz, rho.shape[1]
        if nz == 0:
            return np.zeros((0, 0)), np.zeros((0, n, plan.m)), np.zeros((plan.m, n, n))
        p, active = path.blocks.p, path.columns.active
        adjoint, _ = self._adjoint(p[0], rho, lam)
        rows = np.ascontiguousarray(adjoint.transpose(1, 0, 2)).reshape(n + rho.shape[0], -1)
        at = path.x[:-1].transpose(1, 2, 0, 3).reshape(1 + nz, n, -1)
        outer = np.concatenate([rows @ at[0].T, rows @ path.columns.value.T], axis=1)
        i, j = jets.pairs(nz)
        hzz = np.zeros((nz, nz))
        hzz[i, j] = self._second_products(z, path, outer)
        hzz[j, i] = hzz[i, j]
        sensitive = np.zeros((nz, rows.shape[0], p.shape[2]))
        sensitive[:, :, :n] = rows @ at[1:].transpose(0, 2, 1)
        for k, a in enumerate(active):
            sensitive[a, :, n:] = rows @ path.columns.first[k].T
        cross = p[1 : 1 + nz].reshape(nz, -1) @ sensitive.reshape(nz, -1).T
        hzz += cross + cross.T
        if len(active):
            a, c = np.triu_indices(len(active))
            force = p[0, :, n:].T @ rows
            extra = np.tensordot(path.columns.second, force, axes=([1, 2], [0, 1]))
            block = np.zeros((len(active),) * 2)
            block[a, c] = extra
            block[c, a] = extra
            hzz[np.ix_(active, active)] += block
        pulled = np.matmul(p[1 : 1 + nz, :, :n].transpose(0, 2, 1), rows).reshape(nz, n, length, plan.m)
        # (nz*M, L*n) @ (L*n, n): the block states hang on the interval's start by phi.
        flat = np.ascontiguousarray(pulled.transpose(0, 3, 2, 1)).reshape(nz * plan.m, -1)
        hzs = (flat @ path.phi[:-1].reshape(-1, n)).reshape(nz, plan.m, n).transpose(0, 2, 1)
        return hzz, hzs, np.zeros((plan.m, n, n))
