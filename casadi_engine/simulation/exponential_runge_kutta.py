"""Propagation of a linear core with nonlinear laws over all shooting intervals at once, by an exponential integrator.

dx/dt = A x + B v + G w(s, u, t; z), s = q x: the core is integrated exactly, whatever its fastest mode, and the laws
by Krogstad's scheme of fourth order (see ``exponential_step``). A step of all intervals and all sensitivities is a
few matrix products; the laws are small, and their derivatives are evaluated on the whole record at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_engine.deadline import ask
from casadi_engine.errors import SimulationError
from casadi_engine.model import Model
from casadi_engine.simulation import jets
from casadi_engine.simulation.drives import Drives, DriveSamples
from casadi_engine.simulation.exponential_curvature import contracted
from casadi_engine.simulation.exponential_pushes import Pushes
from casadi_engine.simulation.exponential_step import STAGE_NODES, STAGES, StepCore, StepMatrices
from casadi_engine.simulation.exponential_values import WIDE, Steps, by_arrays, by_machine
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.laws import Laws
from casadi_engine.simulation.sample_rows import to_rows
from casadi_engine.simulation.split import Split

MOST_SUBSTEPS = 64
# Feedback h |dw/ds q G| of a step above which an explicit scheme loses its accuracy, and soon its stability; and one
# below which steps four times as long are tried at the next point. A trial point of a search that is far off may ask
# for the shortest steps there are, and would else have all later ones pay for it.
_STRONGEST, _EASY, _LONGER = 1.0, 0.2, 4
# Feedback of the shortest steps above which the scheme is not stable: where that of Runge and Kutta's of fourth order
# ends on the real axis.
_UNSTABLE = 2.785
# Times its scale beyond which a state has run away.
_RUN_AWAY = 1e6
# A point that asks for more than so many times the steps of the point before it is not worth them: it is refused, and
# the search comes nearer by a shorter step.
_JUMP = 16


class TooStiff(FloatingPointError):
    """The laws answer faster than the shortest explicit steps can follow: steps in places are wanted."""


@dataclass
class ExponentialTrajectory:
    """Outputs and sensitivities; shapes as in ``RungeKuttaTrajectory``.

    y : (1+nz, R*ny, b, M); ys : (R*ny, b, M, n); last : (n, n+nz, M) sensitivities of the ends to (start, z)
    ds : (K, 4 ns, n+nz, M) sensitivities of the signals
    """

    steps: Steps
    matrices: StepMatrices
    slopes: tuple[Array, Array]
    y: Array
    ys: Array
    last: Array
    ds: Array
    substeps: int

    @property
    def x(self) -> Array:
        """(L+1, n, M) states at the samples."""
        states = self.steps.columns[:: self.substeps, : len(self.steps.end)]
        return np.concatenate([states, self.steps.end[None]])

    @property
    def end(self) -> Array:
        """(n, M)."""
        return self.steps.end

    @property
    def end_z(self) -> Array:
        """(nz, n, M)."""
        return np.ascontiguousarray(self.last[:, len(self.last) :].transpose(1, 0, 2))

    @property
    def end_s(self) -> Array:
        """(M, n, n)."""
        return np.ascontiguousarray(self.last[:, : len(self.last)].transpose(2, 0, 1))


class ExponentialPropagator:
    """A split model over one record; arguments as in ``RungeKuttaPropagator``.

    substeps : least steps to a sample; they are doubled where the laws' feedback asks for it, and fewer again later
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
        self._least = self._next = int(substeps)
        # The most steps to a sample; a point that asks for more than a lower number set here is refused.
        self.most = MOST_SUBSTEPS
        self._begun = False
        self.stiff = False  # True once a point was refused because no explicit step is stable there
        self._lay(self._least)

    def _lay(self, substeps: int) -> None:
        # all or nothing: the time may be up in between, and the propagator goes on
        given = self.laws.given(self.grid, self.intervals, substeps)
        self.substeps, self._given = substeps, given
        self.steps = self.intervals.length * substeps
        self._held: tuple[DriveSamples, Array, Array, Array] | None = None

    def refined(self, substeps: int) -> ExponentialPropagator:
        """The same propagator with another number of steps to a sample."""
        other = object.__new__(ExponentialPropagator)
        other.__dict__.update(self.__dict__)
        other._least = other._next = substeps
        other._begun = False
        other._lay(substeps)
        return other

    def begin(self) -> None:
        """What comes is no step of a search from the point before: as many steps as it asks for are worth it."""
        self._begun = False

    def finer(self, factor: int) -> ExponentialPropagator:
        """The same propagator with every step cut into ``factor`` steps."""
        return self.refined(self.substeps * factor)

    # ---- drives

    def drives_at(self, z: Array) -> Array:
        """(m, N) drives of the model on the grid."""
        return self._drives.at(z).value[: self._own_drives]

    def _columns(self, v: Array) -> Array:
        """Merged drives (..., m, N) as columns of the steps, (..., K, 2 m, M): at a step's start and end."""
        plan, sub = self.intervals, self.substeps
        tail = np.repeat(v[..., -1:], plan.padded + 1 - v.shape[-1], axis=-1)
        padded = np.concatenate([v, tail], axis=-1)
        low = padded[..., :-1].reshape(*v.shape[:-1], plan.m, plan.length)
        high = padded[..., 1:].reshape(*v.shape[:-1], plan.m, plan.length)
        if sub > 1:
            share = np.arange(sub) / sub
            rise = np.where(self.core.first[:, None, None, None], (high - low)[..., None], 0.0)
            fine = low[..., None] + share * rise
            low = fine.reshape(*v.shape[:-1], plan.m, sub * plan.length)
            high = (fine + rise / sub).reshape(low.shape)
        joined = np.concatenate([low, high], axis=-3)
        return np.ascontiguousarray(np.moveaxis(joined, (-3, -2, -1), (-2, -1, -3)))

    def _merged(self, drives: Array, constant: float) -> Array:
        """(..., m, N) columns of the core from the drives of the model."""
        merged = np.zeros((*drives.shape[:-2], self.core.m, drives.shape[-1]))
        for column, group in enumerate(self.core.drives):
            merged[..., column, :] = drives[..., list(group), :].sum(axis=-2)
        if self.core.constant:
            merged[..., -1, :] = constant
        return merged

    def drive_columns(self, z: Array) -> tuple[DriveSamples, Array, Array, Array]:
        """Drive samples and their columns: value (K, 2m, M), first (a, K, 2m, M) and second (pairs, K, 2m, M)."""
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
        return s, np.ascontiguousarray(given).reshape(given.shape[0], s.shape[1])

    # ---- forward

    # A trial point of the search may be far off: what overflows is found by its result.
    @np.errstate(all="ignore")
    def propagate(self, z: Array, nodes: Array, order: int = 1) -> ExponentialTrajectory:
        """Advance all intervals from ``nodes`` (M, n), scaled states, at z : (nz,)."""
        z = np.asarray(z, dtype=float)
        if self._next != self.substeps:
            self._lay(self._next)
        while True:
            step = self.grid.step / self.substeps
            matrices = self.core.at(z, order, step, self.laws.q)
            steps = self._values(z, nodes, matrices)
            slopes = self._slopes(z, steps)
            feedback = self._feedback(matrices, slopes[0])
            if self.substeps >= MOST_SUBSTEPS and feedback > _UNSTABLE:
                self.stiff = True
                raise TooStiff("the laws answer faster than the shortest integration steps can follow")
            lost = not self._begun and self.most >= MOST_SUBSTEPS and self._has_run_away(steps)
            if self.substeps >= MOST_SUBSTEPS or (feedback <= _STRONGEST and not lost):
                break
            if self.most < MOST_SUBSTEPS and self.substeps * feedback > self.most * _STRONGEST:
                raise FloatingPointError("the laws ask for more integration steps than are allowed")
            if self._begun and self.substeps * feedback > _JUMP * self._next * _STRONGEST:
                raise FloatingPointError("the laws are far stiffer here than at the point before")
            # a state beyond all numbers tells no feedback
            self._lay(min((_JUMP if lost else 2) * self.substeps, MOST_SUBSTEPS))
        self._begun = True
        self._next = max(self._least, self.substeps // _LONGER) if feedback < _EASY else self.substeps
        value = self._outputs(steps, matrices, z)
        if not (np.isfinite(steps.end).all() and np.isfinite(value).all()):
            raise FloatingPointError("the model's state is not finite here")
        if order == 0:
            none = np.zeros((self.n, 0, 0))
            rows = to_rows(self.intervals, value[None])
            return ExponentialTrajectory(
                steps, matrices, slopes, rows, none[None], none, none[None], self.substeps
            )
        return self._sensitivities(z, steps, matrices, slopes, value)

    def _values(self, z: Array, nodes: Array, matrices: StepMatrices) -> Steps:
        """The states, signals and law torques of all steps."""
        _, v, _, _ = self.drive_columns(z)
        run, plan = by_arrays if self.intervals.m >= WIDE else by_machine, self.intervals
        steps = run(matrices, self.laws, self._given, v, z, np.asarray(nodes, dtype=float))
        last = (self.grid.samples - 1 - (plan.m - 1) * plan.length) * self.substeps
        return steps.until(last, self.laws.count)

    def _slopes(self, z: Array, steps: Steps) -> tuple[Array, Array]:
        """Derivatives of the laws: by signals (K, 4, entries, M), by the active z (K, 4, active, nw, M)."""
        s, given = self.law_columns(steps)
        by_signal, by_z = self.laws.slopes(s, given, z)
        shape = (self.steps, STAGES, self.intervals.m)
        return (
            np.ascontiguousarray(by_signal.reshape(-1, *shape).transpose(1, 2, 0, 3)),
            np.ascontiguousarray(by_z.reshape(*by_z.shape[:2], *shape).transpose(2, 3, 0, 1, 4)),
        )

    def _feedback(self, matrices: StepMatrices, slopes: Array) -> float:
        """The largest h |q G dw/ds| of any stage; 0 where it is not a number, which the caller finds by itself."""
        ns, nw, n, m = self.laws.size, self.laws.count, self.n, matrices.m
        last = matrices.p[0][n + 3 * ns :, n + 2 * m + 2 * nw : n + 2 * m + 3 * nw]
        law, signal = self.laws.entries
        size = np.abs(slopes).max(axis=(0, 1, 3), initial=0.0)
        gain = np.zeros((nw, ns))
        gain[law, signal] = size
        if not np.isfinite(gain).all():
            return 0.0
        return float(np.abs(np.linalg.eigvals(np.abs(last) @ gain)).max())

    def _has_run_away(self, steps: Steps) -> bool:
        """True where states leave all numbers by growing, as of steps that are too long: where an equation has no value
        they are none at once."""
        if np.isfinite(steps.end).all():
            return False
        x = steps.columns[:, : self.n]
        return bool(np.abs(x, where=np.isfinite(x), out=np.zeros_like(x)).max(initial=0.0) > _RUN_AWAY)

    def _outputs(self, steps: Steps, matrices: StepMatrices, z: Array) -> Array:
        """(ny, L, M) outputs."""
        x, v = self.at_samples(steps, z)
        y = matrices.c[0] @ x
        if matrices.d[0].any():
            y += matrices.d[0] @ v
        return np.ascontiguousarray(y.transpose(1, 0, 2))

    def at_samples(self, steps: Steps, z: Array) -> tuple[Array, Array]:
        """States (L, n, M) and drives (L, m, M) at the samples."""
        x = steps.columns[:: self.substeps, : self.n]
        return x, self.drive_samples(self.drive_columns(z)[1])

    def drive_samples(self, columns: Array) -> Array:
        """Drive columns (K, 2m, M), at the samples (L, m, M)."""
        m = self.core.m
        return columns[:: self.substeps, :m]

    def _sensitivities(
        self, z: Array, steps: Steps, matrices: StepMatrices, slopes: tuple[Array, Array], value: Array
    ) -> ExponentialTrajectory:
        """The first derivatives to (start, z), all of them and all intervals together, step by step."""
        n, ns, nw, count, wide = self.n, self.laws.size, self.laws.count, self.intervals.m, self.n + self.nz
        p, at_law = matrices.p[0], n + 2 * matrices.m
        stages = np.ascontiguousarray(p[n:, :n])
        advance = np.ascontiguousarray(np.concatenate([p[:n, :n], p[:n, at_law:]], axis=1))
        feeds = [
            np.ascontiguousarray(p[n + i * ns : n + (i + 1) * ns, at_law : at_law + i * nw])
            for i in range(STAGES)
        ]
        current, after = (np.zeros((n + STAGES * nw, wide, count)) for _ in range(2))
        current[range(n), range(n)] = 1.0
        ds = np.empty((self.steps, STAGES * ns, wide, count))
        found = np.empty((self.ny, self.intervals.length, wide, count))
        pushes = Pushes(self, steps, matrices, z)
        touched, feed, product = pushes.span(n), np.empty((ns, wide, count)), np.empty((wide, count))
        by_signal, by_z = slopes
        shown = [[(int(i), float(row[i])) for i in np.flatnonzero(row)] for row in matrices.c[0]]
        for k in range(self.steps):
            ask(count)
            if k % self.substeps == 0:
                _observe(shown, current, found[:, k // self.substeps])
            s = ds[k]
            np.matmul(stages, current[:n].reshape(n, -1), out=s.reshape(STAGES * ns, -1))
            push = pushes.at(k)
            s[:, touched] += push[n:]
            for i in range(STAGES):
                stage = s[i * ns : (i + 1) * ns]
                torque = current[n + i * nw : n + (i + 1) * nw]
                if i:
                    known = current[n : n + i * nw].reshape(i * nw, -1)
                    np.matmul(feeds[i], known, out=feed.reshape(ns, -1))
                    stage += feed
                torque[self.laws.without_signals] = 0.0
                for entry, (law, signal, opens) in enumerate(self.laws.pattern):
                    if opens:
                        np.multiply(by_signal[k, i, entry], stage[signal], out=torque[law])
                    else:
                        np.multiply(by_signal[k, i, entry], stage[signal], out=product)
                        torque[law] += product
                for row, index in enumerate(self.laws.active):
                    torque[:, n + index] += by_z[k, i, row]
            np.matmul(advance, current.reshape(len(current), -1), out=after[:n].reshape(n, -1))
            after[:n, touched] += push[:n]
            current, after = after, current
        if self.nz:
            self._push_outputs(steps, matrices, z, found)
        y = np.concatenate([value[None], found[:, :, n:].transpose(2, 0, 1, 3)])
        ys = to_rows(self.intervals, found[:, :, :n].transpose(2, 0, 1, 3)).transpose(1, 2, 3, 0)
        return ExponentialTrajectory(
            steps, matrices, slopes, to_rows(self.intervals, y),
            np.ascontiguousarray(ys), current[:n].copy(), ds, self.substeps,
        )  # fmt: skip

    def _push_outputs(self, steps: Steps, matrices: StepMatrices, z: Array, found: Array) -> None:
        """Add what z does to the outputs directly."""
        n, c, d = self.n, matrices.c, matrices.d
        samples, _, first, _ = self.drive_columns(z)
        x, v = self.at_samples(steps, z)
        if not jets.is_constant(c):
            found[:, :, n:] += np.einsum("zyi,pim->ypzm", c[1 : 1 + self.nz], x)
        if not jets.is_constant(d):
            found[:, :, n:] += np.einsum("zyi,pim->ypzm", d[1 : 1 + self.nz], v)
        if d[0].any():
            for row, index in enumerate(samples.active):
                found[:, :, n + index] += np.einsum("yi,pim->ypm", d[0], self.drive_samples(first[row]))

    # ---- second order

    @np.errstate(all="ignore")
    def contraction(
        self, z: Array, path: ExponentialTrajectory, rho: Array, lam: Array
    ) -> tuple[Array, Array, Array]:
        """Second derivatives of sum(rho * y) + sum(lam * end): (z, z), (z, start) and (start, start)."""
        z = np.asarray(z, dtype=float)
        made = self if path.substeps == self.substeps else self.refined(path.substeps)
        if path.matrices.order < 2 and self.nz:
            step = self.grid.step / path.substeps
            path.matrices = self.core.at(z, 2, step, self.laws.q)
        return contracted(made, z, path, rho, lam)


def _observe(c: list[list[tuple[int, float]]], current: Array, out: Array) -> None:
    """out (ny, n+nz, M) = c x for the sensitivities of one sample; an output is a state or two as a rule."""
    for row, terms in enumerate(c):
        if not terms:
            out[row] = 0.0
        for number, (state, factor) in enumerate(terms):
            if number:
                out[row] += factor * current[state]
            else:
                np.multiply(current[state], factor, out=out[row])
