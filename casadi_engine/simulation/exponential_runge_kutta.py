"""Propagation of a linear core with nonlinear laws over all shooting intervals at once, by an exponential integrator.

dx/dt = A x + B v + G w(s, u, t; z), s = q x: the core is integrated exactly, whatever its fastest mode, and the laws
by Krogstad's scheme of fourth order (see ``exponential_step``). A step of all intervals and all sensitivities is a
few matrix products; the laws are small, and their derivatives are evaluated on the whole record at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from casadi_engine.errors import SimulationError
from casadi_engine.model import Model
from casadi_engine.simulation import jets
from casadi_engine.simulation.exponential_curvature import contracted
from casadi_engine.simulation.exponential_step import STAGE_NODES, STAGES, StepCore, StepMatrices
from casadi_engine.simulation.grid import Drives, DriveSamples, Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.laws import Laws
from casadi_engine.simulation.sample_rows import to_rows
from casadi_engine.simulation.split import Split

MOST_SUBSTEPS = 64
# Feedback h |dw/ds q G| of a step above which an explicit scheme loses its accuracy, and soon its stability.
_STRONGEST = 1.0


@dataclass(frozen=True)
class Steps:
    """Everything of value along the K = L * substeps steps, interval by interval (M).

    columns : (K, M, n + 2 m + 4 nw) the factors [x; v_0; v_1; w] of each step; end : (M, n)
    s : (K, 4, ns, M) signals of the stages
    """

    columns: Array
    end: Array
    s: Array


@dataclass
class ExponentialTrajectory:
    """Outputs and sensitivities; shapes as in ``GeneralTrajectory``.

    y : (1+nz, R*ny, b, M); ys : (R*ny, b, M, n); last : (M, n, n+nz) sensitivities of the ends
    inner : (M, K+1, n + 4 nw, n + nz) of states and law torques, ds : (M, K, 4 ns, n + nz) of signals, at order 2
    """

    nodes: Array
    steps: Steps
    matrices: StepMatrices
    slopes: tuple[Array, Array]
    y: Array
    ys: Array
    last: Array
    substeps: int
    inner: Array = field(default_factory=lambda: np.zeros((0, 0, 0, 0)))
    ds: Array = field(default_factory=lambda: np.zeros((0, 0, 0, 0)))

    @property
    def x(self) -> Array:
        """(L+1, n, M) states at the samples."""
        n = self.steps.end.shape[1]
        states = self.steps.columns[:: self.substeps, :, :n].transpose(0, 2, 1)
        return np.concatenate([states, self.steps.end.T[None]])

    @property
    def end(self) -> Array:
        """(n, M)."""
        return self.steps.end.T

    @property
    def end_z(self) -> Array:
        """(nz, n, M)."""
        return np.ascontiguousarray(self.last[:, :, self.last.shape[1] :].transpose(2, 1, 0))

    @property
    def end_s(self) -> Array:
        """(M, n, n)."""
        return self.last[:, :, : self.last.shape[1]]


class ExponentialPropagator:
    """A split model over one record; arguments as in ``GeneralPropagator``.

    substeps : steps to a sample; it is doubled by itself where the laws' feedback asks for it
    Raises SimulationError for substeps that are not a whole number from 1 to 64.
    """

    def __init__(
        self,
        model: Model,
        parts: Split,
        grid: Grid,
        intervals: Intervals,
        z: ca.SX,
        physical: ca.SX,
        *,
        scale: Array,
        substeps: int = 1,
    ) -> None:
        if isinstance(substeps, bool) or substeps != int(substeps) or not 1 <= substeps <= MOST_SUBSTEPS:
            raise SimulationError(
                "the number of integration steps to a sample is not acceptable",
                seen=repr(substeps),
                allowed=f"a whole number from 1 to {MOST_SUBSTEPS}",
                cure="leave it out, or give substeps=4, for instance",
            )
        inner = parts.model
        self.intervals, self.nz, self.n = intervals, int(z.numel()), len(scale)
        self.ny, self.grid = len(model.outputs), grid
        self._own_drives = len(model.drives)
        self._drives = Drives(inner, grid, z, physical)
        self.core = StepCore(parts.core, inner, z, physical, hold=self._drives.holds, scale=scale)
        symbols = (inner.x, inner.u, inner.t, inner.p)
        self.laws = Laws(symbols, parts.laws, self.core.groups, z, physical, scale)
        self._lay(int(substeps))

    def _lay(self, substeps: int) -> None:
        self.substeps = substeps
        self.steps = self.intervals.length * substeps
        self._given = self.laws.given(self.grid, self.intervals, substeps)
        self._held: tuple[DriveSamples, Array, Array, Array] | None = None

    def refined(self, substeps: int) -> ExponentialPropagator:
        """The same propagator with another number of steps to a sample."""
        other = object.__new__(ExponentialPropagator)
        other.__dict__.update(self.__dict__)
        other._lay(substeps)
        return other

    # ---- drives

    def drives_at(self, z: Array) -> Array:
        """(m, N) drives of the model on the grid."""
        return self._drives.at(z).value[: self._own_drives]

    def _columns(self, v: Array) -> Array:
        """Merged drives (..., m, N) as columns of the steps, (..., K, M, 2 m): at a step's start and end."""
        plan, sub = self.intervals, self.substeps
        tail = np.repeat(v[..., -1:], plan.padded + 1 - v.shape[-1], axis=-1)
        padded = np.concatenate([v, tail], axis=-1)
        low = padded[..., :-1].reshape(*v.shape[:-1], plan.m, plan.length)
        high = padded[..., 1:].reshape(*v.shape[:-1], plan.m, plan.length)
        if sub > 1:
            share = np.arange(sub) / sub
            rise = np.where(self.core.first[:, None, None, None], (high - low)[..., None], 0.0)
            fine = low[..., None] + share * rise
            low = fine.reshape(*v.shape[:-1], plan.m, -1)
            high = (fine + rise / sub).reshape(low.shape)
        joined = np.concatenate([low, high], axis=-3)
        return np.ascontiguousarray(np.moveaxis(joined, (-3, -2, -1), (-1, -2, -3)))

    def _merged(self, drives: Array, constant: float) -> Array:
        """(..., m, N) columns of the core from the drives of the model."""
        merged = np.zeros((*drives.shape[:-2], self.core.m, drives.shape[-1]))
        for column, group in enumerate(self.core.drives):
            merged[..., column, :] = drives[..., list(group), :].sum(axis=-2)
        if self.core.constant:
            merged[..., -1, :] = constant
        return merged

    def drive_columns(self, z: Array) -> tuple[DriveSamples, Array, Array, Array]:
        """Drive samples and their columns: value (K, M, 2m), first (a, K, M, 2m) and second (pairs, K, M, 2m)."""
        samples = self._drives.at(z)
        if self._held is None or self._held[0] is not samples:
            value = self._columns(self._merged(samples.value, 1.0))
            none = np.zeros((0, *value.shape))
            first = self._columns(self._merged(samples.first, 0.0)) if len(samples.active) else none
            second = self._columns(self._merged(samples.second, 0.0)) if len(samples.active) else none
            self._held = (samples, value, first, second)
        return self._held

    def law_columns(self, steps: Steps) -> tuple[Array, Array]:
        """Signals (ns, K*4*M) and channel terms (rows, K*4*M) of all stages side by side."""
        s = np.ascontiguousarray(steps.s.transpose(2, 0, 1, 3)).reshape(self.laws.size, -1)
        given = self._given[:, list(STAGE_NODES)].transpose(2, 0, 1, 3)
        return s, np.ascontiguousarray(given).reshape(given.shape[0], -1)

    # ---- forward

    # A trial point of the search may be far off: what overflows is found by its result.
    @np.errstate(all="ignore")
    def propagate(self, z: Array, nodes: Array, order: int = 1) -> ExponentialTrajectory:
        """Advance all intervals from ``nodes`` (M, n), scaled states, at z : (nz,)."""
        z = np.asarray(z, dtype=float)
        while True:
            step = self.grid.step / self.substeps
            matrices = self.core.at(z, order, step, self.laws.q)
            steps = self._values(z, nodes, matrices)
            slopes = self._slopes(z, steps)
            if self.substeps >= MOST_SUBSTEPS or self._feedback(matrices, slopes[0]) <= _STRONGEST:
                break
            self._lay(min(2 * self.substeps, MOST_SUBSTEPS))
        value = self._outputs(steps, matrices, z)
        if not (np.isfinite(steps.end).all() and np.isfinite(value).all()):
            raise FloatingPointError("the model's state is not finite here")
        if order == 0:
            none = np.zeros((0, 0, 0))
            rows = to_rows(self.intervals, value[None])
            return ExponentialTrajectory(
                np.array(nodes), steps, matrices, slopes, rows, none[None], none, self.substeps
            )
        return self._sensitivities(z, nodes, steps, matrices, slopes, value, order)

    def _values(self, z: Array, nodes: Array, matrices: StepMatrices) -> Steps:
        """The states, signals and law torques of all steps."""
        n, m, ns, nw, count = self.n, matrices.m, self.laws.size, self.laws.count, self.intervals.m
        p = matrices.p[0]
        _, v, _, _ = self.drive_columns(z)
        free = p[:, :n]
        pushed = np.matmul(p[:, n : n + 2 * m], v.transpose(0, 2, 1))
        turn = p[:n, n + 2 * m :]
        feeds = [p[n + i * ns : n + (i + 1) * ns, n + 2 * m : n + 2 * m + i * nw] for i in range(STAGES)]
        columns = np.empty((self.steps, count, p.shape[1]))
        columns[:, :, n : n + 2 * m] = v
        signals = np.empty((self.steps, STAGES, ns, count))
        torques = np.empty((STAGES * nw, count))
        constants, x = self.laws.constants(z), np.array(nodes, dtype=float).T
        law, given = self.laws.torques, self._given
        for k in range(self.steps):
            rows = free @ x
            rows += pushed[k]
            stage = rows[n:].reshape(STAGES, ns, count)
            for i in range(STAGES):
                if i:
                    stage[i] += feeds[i] @ torques[: i * nw]
                torques[i * nw : (i + 1) * nw] = law(stage[i], given[k, STAGE_NODES[i]], constants)
            signals[k] = stage
            columns[k, :, :n] = x.T
            columns[k, :, n + 2 * m :] = torques.T
            x = rows[:n] + turn @ torques
        return Steps(columns, np.ascontiguousarray(x.T), signals)

    def _slopes(self, z: Array, steps: Steps) -> tuple[Array, Array]:
        """Derivatives of the laws: by signals (K, 4, M, entries), by the active z (K, 4, M, nw, active)."""
        s, given = self.law_columns(steps)
        by_signal, by_z = self.laws.slopes(s, given, z)
        shape = (self.steps, STAGES, self.intervals.m)
        return (
            np.ascontiguousarray(by_signal.T).reshape(*shape, -1),
            np.ascontiguousarray(by_z.transpose(2, 1, 0)).reshape(*shape, *by_z.shape[1::-1]),
        )

    def _feedback(self, matrices: StepMatrices, slopes: Array) -> float:
        """The largest h |q G dw/ds| of any stage; 0 where it is not a number, which the caller finds by itself."""
        ns, nw, n, m = self.laws.size, self.laws.count, self.n, matrices.m
        last = matrices.p[0][n + 3 * ns :, n + 2 * m + 2 * nw : n + 2 * m + 3 * nw]
        law, signal = self.laws.entries
        size = np.abs(slopes).max(axis=(0, 1, 2), initial=0.0)
        gain = np.zeros((nw, ns))
        gain[law, signal] = size
        if not np.isfinite(gain).all():
            return 0.0
        return float(np.abs(np.linalg.eigvals(np.abs(last) @ gain)).max())

    def _outputs(self, steps: Steps, matrices: StepMatrices, z: Array) -> Array:
        """(ny, points, M) outputs."""
        x, v = self.at_samples(steps, z)
        y = x @ matrices.c[0].T
        if matrices.d[0].any():
            y += v @ matrices.d[0].T
        return np.ascontiguousarray(y.transpose(2, 0, 1))

    def at_samples(self, steps: Steps, z: Array) -> tuple[Array, Array]:
        """States (points, M, n) and drives (points, M, m) at the samples."""
        n, m, points = self.n, self.core.m, self.intervals.points
        x, v = steps.columns[:: self.substeps, :, :n], self.drive_columns(z)[1][:: self.substeps, :, :m]
        if points > self.intervals.length:
            x = np.concatenate([x, steps.end[None]])
            v = np.concatenate([v, self.drive_columns(z)[1][-1:, :, m:]])
        return x, v

    def _sensitivities(
        self,
        z: Array,
        nodes: Array,
        steps: Steps,
        matrices: StepMatrices,
        slopes: tuple[Array, Array],
        value: Array,
        order: int,
    ) -> ExponentialTrajectory:
        n, nz, ns, nw = self.n, self.nz, self.laws.size, self.laws.count
        count, wide, keep = self.intervals.m, self.n + self.nz, order >= 2
        at_law = n + 2 * matrices.m
        p = matrices.p[0]
        stages = np.ascontiguousarray(p[n:, :n])
        advance = np.ascontiguousarray(np.concatenate([p[:n, :n], p[:n, at_law:]], axis=1))
        feeds = [
            np.ascontiguousarray(p[n + i * ns : n + (i + 1) * ns, at_law : at_law + i * nw])
            for i in range(STAGES)
        ]
        law, signal = self.laws.entries
        plain = len(law) == nw == ns and (law == signal).all()
        inner = np.empty((count, self.steps + 1 if keep else 2, n + STAGES * nw, wide))
        kept = np.empty((count, self.steps if keep else 1, STAGES * ns, wide))
        inner[:, 0, :n] = 0.0
        inner[:, 0, :n, :n] = np.eye(n)
        found = np.empty((self.ny, self.intervals.points, count, wide))
        pushes = self._pushes(steps, matrices, z) if nz else None
        own = n + self.laws.active
        by_signal, by_z = slopes
        for k in range(self.steps):
            now, after = (k, k + 1) if keep else (k % 2, (k + 1) % 2)
            current = inner[:, now]
            if k % self.substeps == 0:
                _observe(matrices.c[0], current, found[:, k // self.substeps])
            s = kept[:, now if keep else 0]
            np.matmul(stages, current[:, :n], out=s)
            if pushes is not None:
                push = next(pushes)
                s[:, :, n:] += push[:, n:]
            for i in range(STAGES):
                stage = s[:, i * ns : (i + 1) * ns]
                torque = current[:, n + i * nw : n + (i + 1) * nw]
                if i:
                    stage += feeds[i] @ current[:, n : n + i * nw]
                slope = by_signal[k, i][:, :, None]
                if plain:
                    np.multiply(slope, stage, out=torque)
                else:
                    np.add.reduceat(slope * stage[:, signal], self.laws.starts, axis=1, out=torque)
                if len(own):
                    torque[:, :, own] += by_z[k, i]
            np.matmul(advance, current, out=inner[:, after, :n])
            if pushes is not None:
                inner[:, after, :n, n:] += push[:, :n]
        last = inner[:, self.steps if keep else self.steps % 2, :n]
        if self.intervals.points > self.intervals.length:
            _observe(matrices.c[0], last, found[:, -1])
        if nz:
            self._push_outputs(steps, matrices, z, found)
        y = np.concatenate([value[None], found[..., n:].transpose(3, 0, 1, 2)])
        ys = to_rows(self.intervals, found[..., :n].transpose(3, 0, 1, 2)).transpose(1, 2, 3, 0)
        made = ExponentialTrajectory(
            np.array(nodes), steps, matrices, slopes, to_rows(self.intervals, y),
            np.ascontiguousarray(ys), last.copy(), self.substeps,
        )  # fmt: skip
        if keep:
            inner[:, -1, n:] = 0.0
            made.inner, made.ds = inner, kept
        return made

    def _pushes(self, steps: Steps, matrices: StepMatrices, z: Array) -> Iterator[Array]:
        """For each step what z does to it directly, (M, n + 4 ns, nz): by the matrices and by the drives."""
        n, m = self.n, matrices.m
        samples, _, first, _ = self.drive_columns(z)
        rows = np.ascontiguousarray(matrices.p[1 : 1 + self.nz].transpose(2, 1, 0))
        flat = rows.reshape(rows.shape[0], -1)
        held = np.ascontiguousarray(matrices.p[0][:, n : n + 2 * m].T)
        push = np.empty((self.intervals.m, flat.shape[1]))
        shaped = push.reshape(self.intervals.m, -1, self.nz)
        for k in range(self.steps):
            np.matmul(steps.columns[k], flat, out=push)
            for row, index in enumerate(samples.active):
                shaped[:, :, index] += first[row, k] @ held
            yield shaped

    def _push_outputs(self, steps: Steps, matrices: StepMatrices, z: Array, found: Array) -> None:
        """Add what z does to the outputs directly."""
        n = self.n
        c, d = matrices.c, matrices.d
        samples, _, first, _ = self.drive_columns(z)
        x, v = self.at_samples(steps, z)
        if not jets.is_constant(c):
            found[..., n:] += np.einsum("zyi,pmi->ypmz", c[1 : 1 + self.nz], x)
        if not jets.is_constant(d):
            found[..., n:] += np.einsum("zyi,pmi->ypmz", d[1 : 1 + self.nz], v)
        if d[0].any():
            for row, index in enumerate(samples.active):
                found[..., n + index] += np.einsum("yi,pmi->ypm", d[0], self.slope_samples(first[row]))

    def slope_samples(self, first: Array) -> Array:
        """Columns (K, M, 2m) of one derivative of the drives, at the samples (points, M, m)."""
        m = self.core.m
        v = first[:: self.substeps, :, :m]
        if self.intervals.points > self.intervals.length:
            v = np.concatenate([v, first[-1:, :, m:]])
        return v

    # ---- second order

    @np.errstate(all="ignore")
    def contraction(
        self, z: Array, path: ExponentialTrajectory, rho: Array, lam: Array
    ) -> tuple[Array, Array, Array]:
        """Second derivatives of sum(rho * y) + sum(lam * end): (z, z), (z, start) and (start, start)."""
        z = np.asarray(z, dtype=float)
        if not path.inner.size or path.substeps != self.substeps:
            path = self.propagate(z, path.nodes, 2)
        return contracted(self, z, path, rho, lam)


def _observe(c: Array, current: Array, out: Array) -> None:
    """out (ny, M, n+nz) = c x for the sensitivities of one sample; an output is a state or two as a rule."""
    for row, factors in enumerate(c):
        places = np.flatnonzero(factors)
        if not len(places):
            out[row] = 0.0
            continue
        np.multiply(current[:, places[0]], factors[places[0]], out=out[row])
        for place in places[1:]:
            out[row] += factors[place] * current[:, place]
