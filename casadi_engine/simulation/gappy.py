"""A predictor over a record in which outputs are missing, or measured at some of the grid points only.

Where an output is missing its correction is skipped, so that the matrices of a step hang on what was measured there:
one set of them for each pattern of outputs. All intervals advance together, sample by sample.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import ask
from casadi_engine.model import Model
from casadi_engine.simulation import jets
from casadi_engine.simulation.discretisation import DiscreteCore, Discretisation, Method
from casadi_engine.simulation.drives import Drives
from casadi_engine.simulation.gain import Gain, Seen, corrected
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array

Index = NDArray[np.intp]


@dataclass
class GappyTrajectory:
    """States and outputs; shapes as in ``RungeKuttaTrajectory``.

    x : (L+1, n, M); s : (L+1, n, nz+n, M) sensitivities to (z, start); y : (1+nz, R*ny, b, M);
    ys : (R*ny, b, M, n)
    """

    x: Array
    s: Array
    y: Array
    ys: Array
    parts: list[Discretisation]

    @property
    def end(self) -> Array:
        """(n, M)."""
        return self.x[-1]

    @property
    def end_z(self) -> Array:
        """(nz, n, M)."""
        nz = self.s.shape[2] - self.s.shape[1]
        return np.ascontiguousarray(self.s[-1][:, :nz].transpose(1, 0, 2))

    @property
    def end_s(self) -> Array:
        """(M, n, n)."""
        nz = self.s.shape[2] - self.s.shape[1]
        return np.ascontiguousarray(self.s[-1][:, nz:].transpose(2, 0, 1))


class GappyPredictor:
    """The linear core of a model with a gain, over one record; arguments as in ``LinearPropagator``.

    feedback : (ny, N) measured outputs, anything finite where there are none; seen : (ny, N) True where there are
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
        gain: Gain,
        feedback: Array,
        seen: NDArray[np.bool_],
        method: Method = "exact",
    ) -> None:
        self.intervals, self.nz = intervals, int(z.numel())
        self._drives, self.gain = Drives(model, grid, z, physical), gain
        self.core = DiscreteCore(
            model, z, physical, step=grid.step, hold=self._drives.holds, scale=scale, method=method
        )
        self.n, self.ny = self.core.states, self.core.outputs
        self._feedback, self._samples = feedback, grid.samples
        self._lay_patterns(seen)

    def _lay_patterns(self, seen: NDArray[np.bool_]) -> None:
        """Which pattern each sample has, and the intervals of each pattern at each step."""
        plan = self.intervals
        padded = np.zeros((self.ny, plan.padded), dtype=bool)
        padded[:, : self._samples] = seen
        kinds, which = np.unique(padded.T, axis=0, return_inverse=True)
        self.patterns: list[Seen] = [tuple(bool(part) for part in kind) for kind in kinds]
        number = which.reshape(plan.m, plan.length).T
        everywhere = slice(None)
        self._at: list[list[tuple[int, Index | slice]]] = [
            [(int(row[0]), everywhere)]
            if (row == row[0]).all()
            else [(int(p), np.flatnonzero(row == p)) for p in np.unique(row)]
            for row in number
        ]
        flat = number.ravel()
        self._columns = [np.flatnonzero(flat == p) for p in range(len(self.patterns))]

    # ---- drives

    def drives_at(self, z: Array) -> Array:
        """(m, N) drives of the model on the grid."""
        return self._drives.at(z).value

    def _wide(self, drives: Array, *, value: bool) -> tuple[Array, Array]:
        """Columns of the core at the samples and one later, (..., m', L*M): step of the interval, then interval."""
        core, plan = self.core, self.intervals
        merged = np.zeros((*drives.shape[:-2], core.drives + self.ny, plan.padded + 1))
        count = self._samples
        for column, group in enumerate(core.groups):
            merged[..., column, :count] = drives[..., list(group), :].sum(axis=-2)
        if value:
            merged[len(core.groups) : core.drives] = 1.0
            merged[core.drives :, :count] = self._feedback
        merged[..., count:] = merged[..., count - 1 : count]
        both = []
        for part in (merged[..., :-1], merged[..., 1:]):
            cut = part.reshape(*part.shape[:-1], plan.m, plan.length)
            both.append(np.ascontiguousarray(cut.swapaxes(-1, -2)).reshape(*part.shape[:-1], -1))
        return both[0], both[1]

    def _parts(self, z: Array, order: int) -> list[Discretisation]:
        """The predictor's matrices for each pattern."""
        discrete = self.core.at(z, order)
        return [corrected(discrete, self.gain.at(z, self.core, discrete, seen)) for seen in self.patterns]

    # ---- forward

    @np.errstate(over="ignore", invalid="ignore")
    def propagate(self, z: Array, nodes: Array, order: int = 1) -> GappyTrajectory:
        """Advance all intervals from ``nodes`` (M, n), scaled states, at z : (nz,)."""
        plan, n, nz = self.intervals, self.n, self.nz if order else 0
        z = np.asarray(z, dtype=float)
        parts = self._parts(z, order)
        force, through = self._forced(z, parts, nz)
        width = 1 + nz + (n if order else 0)
        t = np.zeros((plan.length + 1, n, width, plan.m))
        t[0, :, 0] = nodes.T
        if order:
            t[0, :, 1 + nz :] = np.eye(n)[:, :, None]
        for k, groups in enumerate(self._at):
            ask(plan.m)
            for p, at in groups:
                now, f = t[k][:, :, at], parts[p].f
                moved = (f[0] @ now.reshape(n, -1)).reshape(now.shape)
                if nz:
                    turned = f[1 : 1 + nz].reshape(nz * n, n) @ now[:, 0]
                    moved[:, 1 : 1 + nz] += turned.reshape(nz, n, -1).transpose(1, 0, 2)
                t[k + 1][:, :, at] = moved
            t[k + 1, :, : 1 + nz] += force[:, :, k].transpose(1, 0, 2)
        y = self._outputs(t, through, parts, nz)
        if not (np.isfinite(t[-1]).all() and np.isfinite(y).all()):
            raise FloatingPointError("the model's state is not finite here")
        rows = self._rows(y.reshape(width, self.ny, plan.length, plan.m))
        ys = np.ascontiguousarray(rows[1 + nz :].transpose(1, 2, 3, 0))
        return GappyTrajectory(
            t[:, :, 0], t[:, :, 1:], np.ascontiguousarray(rows[: 1 + nz]), ys if order else np.zeros(0), parts
        )

    def _forced(self, z: Array, parts: list[Discretisation], nz: int) -> tuple[Array, Array]:
        """What the drives add to state (1+nz, n, L, M) and outputs (1+nz, ny, L*M), with z-derivatives."""
        plan, samples = self.intervals, self._drives.at(z)
        v0, v1 = self._value = self._wide(samples.value, value=True)
        w0, w1 = self._wide(samples.first, value=False) if len(samples.active) else (v0[:0], v1[:0])
        force = np.zeros((1 + nz, self.n, plan.length * plan.m))
        through = np.zeros((1 + nz, self.ny, plan.length * plan.m))
        for part, at in zip(parts, self._columns, strict=True):
            now, later = v0[:, at], v1[:, at]
            force[:, :, at] = part.g0[: 1 + nz] @ now + part.g1[: 1 + nz] @ later
            through[:, :, at] = part.d[: 1 + nz] @ now
            for k, a in enumerate(samples.active if nz else ()):
                force[1 + a][:, at] += part.g0[0] @ w0[k][:, at] + part.g1[0] @ w1[k][:, at]
                through[1 + a][:, at] += part.d[0] @ w0[k][:, at]
        return force.reshape(1 + nz, self.n, plan.length, plan.m), through

    def _outputs(self, t: Array, through: Array, parts: list[Discretisation], nz: int) -> Array:
        """(width, ny, L*M) outputs, their z-derivatives and their derivatives in the start."""
        length = self.intervals.length
        at_samples = np.ascontiguousarray(t[:length].transpose(1, 2, 0, 3)).reshape(self.n, t.shape[2], -1)
        y = np.zeros((self.ny, *at_samples.shape[1:]))
        for part, at in zip(parts, self._columns, strict=True):
            now = at_samples[:, :, at]
            y[:, :, at] = (part.c[0] @ now.reshape(self.n, -1)).reshape(self.ny, *now.shape[1:])
            if nz:
                y[:, 1 : 1 + nz, at] += (part.c[1 : 1 + nz] @ now[:, 0]).transpose(1, 0, 2)
        y[:, : 1 + nz] += through.transpose(1, 0, 2)
        return y.transpose(1, 0, 2)

    def _rows(self, y: Array) -> Array:
        """(., ny, L, M) to the batch's layout (., R*ny, b, M)."""
        plan = self.intervals
        rows = y[:, :, plan.samples[:, None] + plan.q * np.arange(plan.b)]
        return np.ascontiguousarray(rows.transpose(0, 2, 1, 3, 4)).reshape(len(y), -1, plan.b, plan.m)

    # ---- second order

    @np.errstate(over="ignore", invalid="ignore")
    def contraction(
        self, z: Array, path: GappyTrajectory, rho: Array, lam: Array
    ) -> tuple[Array, Array, Array]:
        """Second derivatives of sum(rho * y) + sum(lam * end), as ``LinearPropagator.contraction`` gives them."""
        plan, n, nz = self.intervals, self.n, self.nz
        none = np.zeros((plan.m, n, n))
        if nz == 0:
            return np.zeros((0, 0)), np.zeros((0, n, plan.m)), none
        if path.parts[0].order < 2:
            path.parts = self._parts(np.asarray(z, dtype=float), 2)
        rows = self._adjoint(path.parts, rho, lam)
        samples = self._drives.at(z)
        (v0, v1), w = self._wide(samples.value, value=True), None
        if len(samples.active):
            w = (*self._wide(samples.first, value=False), *self._wide(samples.second, value=False))
        x = path.x[:-1].transpose(1, 0, 2).reshape(n, -1)
        s = np.ascontiguousarray(path.s[:-1].transpose(2, 1, 0, 3)).reshape(nz + n, n, -1)
        hzz, i_j = np.zeros((nz, nz)), jets.pairs(nz)
        pulled = np.zeros((nz, n, plan.length * plan.m))
        for part, at in zip(path.parts, self._columns, strict=True):
            p, r = _whole(part), rows[:, at]
            second = (
                p[1 + nz :].reshape(len(i_j[0]), -1)
                @ (r @ np.concatenate([x[:, at], v0[:, at], v1[:, at]]).T).ravel()
            )
            hzz[i_j] += second
            off = i_j[0] != i_j[1]
            hzz[i_j[1][off], i_j[0][off]] += second[off]
            width = v0.shape[0]
            sensitive = np.zeros((nz, n + 2 * width, len(at)))
            sensitive[:, :n] = s[:nz][:, :, at]
            for k, a in enumerate(samples.active if w is not None else ()):
                sensitive[a, n : n + width], sensitive[a, n + width :] = w[0][k][:, at], w[1][k][:, at]  # type: ignore[index]
            product = r @ sensitive.transpose(0, 2, 1)
            cross = p[1 : 1 + nz].reshape(nz, -1) @ product.reshape(nz, -1).T
            hzz += cross + cross.T
            if w is not None:
                hzz += self._bent_drives(p, r, w[2][..., at], w[3][..., at], samples.active)
            pulled[:, :, at] = p[1 : 1 + nz, :, :n].transpose(0, 2, 1) @ r
        start = s[nz:].reshape(n, n, plan.length, plan.m)  # (start, state, step, interval)
        hzs = np.einsum("zaki,baki->zbi", pulled.reshape(nz, n, plan.length, plan.m), start, optimize=True)
        return hzz, hzs, none

    def _adjoint(self, parts: list[Discretisation], rho: Array, lam: Array) -> Array:
        """(n + ny, L*M): the multipliers of the step from each sample, and the weights of the outputs there."""
        plan, n = self.intervals, self.n
        spread = np.zeros((plan.length, self.ny, plan.m))
        for sample, row in zip(plan.samples, rho.reshape(-1, self.ny, plan.b, plan.m), strict=True):
            spread[sample :: plan.q] += row.transpose(1, 0, 2)
        rows = np.empty((plan.length, n + self.ny, plan.m))
        rows[:, n:] = spread
        mu = lam
        for k in range(plan.length - 1, -1, -1):
            rows[k, :n] = mu
            before = np.empty((n, plan.m))
            for p, at in self._at[k]:
                part = parts[p]
                before[:, at] = part.f[0].T @ mu[:, at] + part.c[0].T @ spread[k][:, at]
            mu = before
        return np.ascontiguousarray(rows.transpose(1, 0, 2)).reshape(n + self.ny, -1)

    def _bent_drives(self, p: Array, rows: Array, now: Array, later: Array, active: Index) -> Array:
        """What the drives' own second derivatives (pairs, m', columns) add to the Hessian."""
        total, width = np.zeros((self.nz, self.nz)), now.shape[1]
        force = p[0, :, self.n :].T @ rows
        extra = np.tensordot(now, force[:width], 2) + np.tensordot(later, force[width:], 2)
        a, c = np.triu_indices(len(active))
        total[active[a], active[c]] = extra
        total[active[c], active[a]] = extra
        return total


def _whole(part: Discretisation) -> Array:
    """Jet of [[F, G0, G1], [C, D, 0]]."""
    top = np.concatenate([part.f, part.g0, part.g1], axis=2)
    return np.concatenate([top, np.concatenate([part.c, part.d, np.zeros_like(part.d)], axis=2)], axis=1)
