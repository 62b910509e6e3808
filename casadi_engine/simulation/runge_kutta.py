"""Propagation of any model, dx/dt = f(x, u, t, p), by Runge-Kutta steps with exact derivatives of the discrete map.

Steps are explicit, or implicit where the equations are stiff; their number differs from sample to sample, as the
estimated error asks for. The states of all shooting intervals advance together; derivatives are then evaluated on all
steps of the record at once and chained by batched products.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import TimeUp, ask
from casadi_engine.model import Model
from casadi_engine.simulation.carried_errors import carried_on
from casadi_engine.simulation.drives import Drives
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.sample_rows import from_rows, to_rows
from casadi_engine.simulation.shown_outputs import ShownOutputs
from casadi_engine.simulation.stage_slope import StageSlope
from casadi_engine.simulation.step_layout import StepLayout, lay_steps
from casadi_engine.simulation.sweeps import Sweeps, advance
from casadi_engine.simulation.tableau import (
    RADAU,
    RUNGE_KUTTA,
    Tableau,
    growth,
    stage_multipliers,
    stage_sensitivities,
    step_sensitivities,
)

# |lambda| h of an explicit step at first: its error is then below 1e-2 of the fastest mode per radian, which few
# records excite; whoever takes a result of it asks how far it is off (`arising`).
_STEP = 1.0
# And the most of it: an explicit step of order 4 grows beyond 2.8.
_UNSTABLE = 2.5
# Explicit steps of a cell of the grid from which implicit steps are the cheaper ones: where every cell asks for them,
# and where some do, as at a corner, for explicit steps are alike everywhere.
_STIFF, _SOMEWHERE = 40, 8
# How often the steps are made shorter at one point before it counts as one that cannot be evaluated: at first, and
# once another point could be, near which it has to be for a search to go there.
_ATTEMPTS, _LATER = 5, 3
# Into how many parts a step is cut at once at most, by what a path says of its error.
_FINER = 16.0
# Steps that are made while one of those is that are hard to make, and where Newton's method starts anew for it.
_LABOUR = 25
# Share of a cell down to which steps are cut because they are hard to make, and steps to a cell that makes at most.
_EASED = 16
# Steps of a record, beyond those of its samples, that are taken at most.
MOST_STEPS = 2_000_000


@dataclass(frozen=True, eq=False)
class Fineness:
    """How finely a record is integrated: the scheme, and (N-1,) steps of each cell of its grid.

    shares : of their cells that steps take, in order of time; None where those of a cell are equal
    """

    scheme: Tableau
    counts: NDArray[np.intp]
    shares: Array | None = None

    @property
    def most(self) -> int:
        """Most steps of a cell."""
        return int(self.counts.max(initial=1))

    def head(self, samples: int) -> Fineness:
        """Of the first points of the grid."""
        counts = self.counts[: samples - 1]
        return Fineness(self.scheme, counts, None if self.shares is None else self.shares[: counts.sum()])

    def cut(self, parts: NDArray[np.intp]) -> Fineness:
        """The steps each cut into so many equal parts, (steps,) in order of time."""
        cell = np.repeat(np.arange(len(self.counts)), self.counts)
        counts = np.bincount(cell, parts, minlength=len(self.counts)).astype(np.intp)
        shares = 1 / self.counts[cell] if self.shares is None else self.shares
        return Fineness(self.scheme, counts, np.repeat(shares / parts, parts))


@dataclass
class RungeKuttaTrajectory:
    """States and sensitivities; shapes as in ``LinearTrajectory``, but no interval shares one.

    x : (L+1, n, M) states at the samples; K steps of all intervals as in ``StepLayout``, M ends behind them:
    begun : (n, K+M) states where they begin; s : (K+M, n, n+nz) their sensitivities to (start, z)
    stages : (4, K, n, n+nz) of the stage values; by_x : (4, K, n, n) slopes' derivatives; at_stage : (4, n, K) values
    a : (K, n, n) steps' derivatives to the state; out : (L, M, ny, n+nz) outputs' to (x, z)
    """

    x: Array
    begun: Array
    s: Array
    a: Array
    by_x: Array
    stages: Array
    at_stage: Array
    out: Array
    y: Array
    ys: Array

    @property
    def end(self) -> Array:
        """(n, M)."""
        return self.x[-1]

    @property
    def end_z(self) -> Array:
        """(nz, n, M)."""
        n = self.x.shape[1]
        return np.ascontiguousarray(self.s[-self.x.shape[2] :, :, n:].transpose(2, 1, 0))

    @property
    def end_s(self) -> Array:
        """(M, n, n)."""
        return self.s[-self.x.shape[2] :, :, : self.x.shape[1]]


class RungeKuttaPropagator:
    """Any model over one record; arguments as in ``LinearPropagator``.

    fineness : None for as many explicit steps as the fastest mode asks for where the first propagation begins, or
        implicit ones where those would be many
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
        fineness: Fineness | None = None,
    ) -> None:
        self.intervals, self.nz, self.n = intervals, int(z.numel()), len(scale)
        self.ny, self.grid = len(model.outputs), grid
        self.slope = StageSlope(model, z, physical, scale)
        self.outputs = ShownOutputs(model, grid, intervals, z, physical, scale)
        self._drives = Drives(model, grid, z, physical)
        self._fineness = fineness
        self._sweeps: Sweeps | None = None
        self._evaluated = False  # at any point so far
        self._most = MOST_STEPS
        # the last path with slopes, and where: what is asked of its error comes from the same point
        self._last: tuple[Array, Array, RungeKuttaTrajectory] | None = None
        if fineness is not None:
            self._lay(fineness)

    # ---- how finely

    @property
    def fineness(self) -> Fineness | None:
        """How finely the record is integrated; None before the first propagation."""
        return self._fineness

    @property
    def substeps(self) -> int:
        """Most steps from one sample to the next."""
        return 1 if self._fineness is None else self._fineness.most

    def refined(self, fineness: Fineness) -> RungeKuttaPropagator:
        """The same propagator, integrating as finely as told."""
        other = object.__new__(RungeKuttaPropagator)
        other.__dict__.update(self.__dict__)
        other._lay(fineness)
        return other

    def finer(self, factor: int) -> RungeKuttaPropagator:
        """The same propagator with every step cut into ``factor`` steps; FloatingPointError for more than 2e6 steps."""
        now = self._fineness
        assert now is not None, "propagated at least once"
        return self.refined(now.cut(np.full(now.counts.sum(), factor)))

    def adapted(self, errors: Array, ratio: float) -> RungeKuttaPropagator:
        """The same propagator with shorter steps where most of the error arises, for an error ``ratio`` times smaller.

        errors : of each step in order of time, see `arising`
        """
        now = self._fineness
        assert now is not None, "propagated at least once"
        finite = np.isfinite(errors)
        if not finite.any():
            raise FloatingPointError("no step of the record can be compared with two of half its length")
        if not finite.all():  # nobody knows by how much the others move the outputs
            ratio = 1.0
        share = np.where(finite, errors, np.inf) / max(float(errors[finite].mean()), 1e-300)
        factor = np.clip((share * ratio) ** (1 / now.scheme.order), 1.0, _FINER)
        return self.refined(now.cut(np.ceil(factor).astype(np.intp)))

    def arising(self, z: Array, path: RungeKuttaTrajectory) -> tuple[Array, Array]:
        """What the steps of a path add to the error: of the outputs (R*ny, b, M), carried along, and by steps.

        Each step is compared with two of half the length; what it is off by is carried through the later ones by the
        sensitivities. By steps, in order of time, it is the size of what arises there, relative to the largest state.
        """
        layout, plan, n, count = self.layout, self.intervals, self.n, self.intervals.m
        whole = np.flatnonzero(layout.part[: layout.steps] == 0)
        ends = whole
        for _ in range(self.slope.parts):
            ends = layout.after[ends]
        low, high = layout.low[:, whole], layout.high[:, whole]
        time, half, middle = layout.time[whole], 0.5 * layout.length[whole], 0.5 * (low + high)
        with np.errstate(all="ignore"):
            x = advance(self.slope, self._scheme, z, path.begun[:, whole], low, middle, time, half)
            x = advance(self.slope, self._scheme, z, x, middle, high, time + half, half)
        own = self._scheme.richardson * (x - path.begun[:, ends]).T
        carried, arises = np.zeros((2, layout.steps + count, n))
        arises[ends] = own
        for steps, after in layout:
            carried[after] = (path.a[steps] @ carried[steps][..., None])[..., 0] + arises[after]
        joined = carried_on(path.end_s, carried[layout.steps + np.arange(count)])
        at = layout.at[: plan.length]
        each = carried[at] + (path.s[at, :, :n] @ joined[None, :, :, None])[..., 0]
        off = (path.out[..., :n] @ each[..., None])[..., 0]
        size = np.abs(path.begun).max(axis=1) + 1e-300
        sizes = np.nan_to_num(np.abs(own / size).max(axis=-1), nan=np.inf, posinf=np.inf)
        each_step = np.empty(len(whole))
        each_step[layout.number[whole]] = sizes
        return to_rows(plan, off.transpose(2, 0, 1)[None])[0], each_step

    def _lay(self, fineness: Fineness) -> None:
        ask()
        if int(fineness.counts.sum()) > self._most + len(fineness.counts):
            raise FloatingPointError("the equations ask for more integration steps than are allowed")
        self._fineness, self._last = fineness, None
        own = self.slope.parts, fineness.shares
        self.layout: StepLayout = lay_steps(self.grid, self.intervals, fineness.counts, *own)
        self._sweeps = Sweeps(self.slope, fineness.scheme, self.layout)

    @contextmanager
    def unchanged(self, most: int) -> Iterator[None]:
        """Within it, finer steps serve the point alone that asks for them, and a point that asks for more than ``most``
        times the steps there are now cannot be evaluated. Of use where points lie far apart: one bad one would make
        all later ones slow."""
        if self._sweeps is None:
            yield
            return
        before = self._fineness, self.layout, self._sweeps, self._most
        assert self._fineness is not None  # as there are sweeps
        self._most = min(self._most, most * int(self._fineness.counts.sum()))
        try:
            yield
        finally:
            self._fineness, self.layout, self._sweeps, self._most = before
            self._last = None

    def _begin(self, z: Array, nodes: Array) -> None:
        """Lay the first steps, by the fastest mode at the intervals' starts."""
        plan, grid = self.intervals, self.grid
        cells = np.minimum(plan.length * np.arange(plan.m), grid.samples - 2)
        span = np.diff(grid.time)
        low = grid.channels[:, cells]
        known = self.slope.known(low, low, grid.time[cells], span[cells], 0.0, np.zeros(plan.m))
        with np.errstate(all="ignore"):
            by_x = self.slope.newton(np.ascontiguousarray(nodes.T), known, z)[1]
        matrices = by_x.reshape(self.n, self.n, plan.m).T / span[cells][:, None, None]
        fine = np.isfinite(matrices).all(axis=(1, 2))
        rates = np.abs(np.linalg.eigvals(matrices[fine])).max(axis=1) if fine.any() else np.zeros(1)
        wanted = np.ceil(float(rates.max(initial=0.0)) * span / _STEP - 1e-6)
        somewhere = np.median(rates) < 0.5 * rates.max(initial=0.0)
        if wanted.max() > (_SOMEWHERE if somewhere else _STIFF):
            self._lay(Fineness(RADAU, np.ones(len(span), np.intp)))
        else:
            self._lay(Fineness(RUNGE_KUTTA, np.maximum(wanted, 1).astype(np.intp)))

    def _finer(self, factor: float | Array) -> None:
        """Steps shorter by a factor, or by one for each, or implicit ones where explicit steps become too many."""
        now = self._fineness
        assert now is not None  # laid by `propagate`
        parts = np.ceil(np.broadcast_to(factor, now.counts.sum())).astype(np.intp)
        if not now.scheme.implicit and parts.max() * now.most > _SOMEWHERE:
            self._lay(Fineness(RADAU, np.maximum(1, now.counts // 8)))
        else:
            self._lay(now.cut(parts))

    def drives_at(self, z: Array) -> Array:
        """(m, N) drives of the model on the grid."""
        return self._drives.at(z).value

    @property
    def sweeps(self) -> Sweeps:
        """The steps, laid by the first propagation."""
        assert self._sweeps is not None
        return self._sweeps

    # ---- forward

    # A trial point of the search may be far off: what overflows is found by its result.
    @np.errstate(all="ignore")
    def propagate(self, z: Array, nodes: Array, order: int = 1) -> RungeKuttaTrajectory:
        """Advance all intervals from ``nodes`` (M, n), scaled states, at z : (nz,)."""
        z, nodes = np.asarray(z, dtype=float), np.asarray(nodes, dtype=float)
        if self._sweeps is None:
            self._begin(z, nodes)
        if order and self._last and np.array_equal(self._last[0], z) and np.array_equal(self._last[1], nodes):
            return self._last[2]
        self._last = None  # a path is large: it goes before the next one is made
        before = self._fineness, self.layout, self._sweeps
        try:
            for _ in range(_LATER if self._evaluated else _ATTEMPTS):
                found = self._attempt(z, nodes, order)
                if isinstance(found, RungeKuttaTrajectory):
                    found = self._eased(z, nodes, order, found)
                    self._evaluated = True
                    self._last = (z.copy(), nodes.copy(), found) if order else None
                    return found
                if found is None:
                    self._lay(Fineness(RADAU, np.ones(self.grid.samples - 1, np.intp)))
                else:
                    self._finer(found)
            raise FloatingPointError("the model's state is not finite here")
        except (FloatingPointError, TimeUp):
            # What no steps can evaluate, such as a root of less than 0, asks for none of the points to come.
            self._fineness, self.layout, self._sweeps = before
            raise

    def _eased(self, z: Array, nodes: Array, order: int, found: RungeKuttaTrajectory) -> RungeKuttaTrajectory:
        """The trajectory with steps made shorter at which Newton's method arrived only step by step: there it takes a
        hundred times as long, at this point and all later ones."""
        assert self._fineness is not None  # laid by `propagate`
        assert self._sweeps is not None
        hard, now, before = self._sweeps.hard, self._fineness, (self._fineness, self.layout, self._sweeps)
        # a trial point of a line search is held against others by steps that are the same
        if not order or not hard.sum() * _LABOUR > len(hard):
            return found
        whole = np.zeros(len(hard) // self.slope.parts, dtype=bool)
        whole[self.layout.number[: len(hard)][hard]] = True
        cell = np.repeat(np.arange(len(now.counts)), now.counts)
        whole &= (1 / now.counts[cell] if now.shares is None else now.shares) > 1 / _EASED
        if not whole.any() or now.counts.sum() + 3 * whole.sum() > _EASED * len(now.counts):
            return found
        self._lay(now.cut(np.where(whole, 4, 1).astype(np.intp)))
        again = self._attempt(z, nodes, order)
        if isinstance(again, RungeKuttaTrajectory):
            return again
        self._fineness, self.layout, self._sweeps = before
        return found

    def _attempt(self, z: Array, nodes: Array, order: int) -> RungeKuttaTrajectory | float | Array | None:
        """The trajectory; or by how much shorter steps have to be for one, None where implicit ones may have one: what
        is not stiff where the intervals begin may be so later, as with a radical of which there is none at first."""
        sweeps, implicit = self._sweeps, self._scheme.implicit
        assert sweeps is not None  # laid by `propagate`
        begun, stages = sweeps.run(z, nodes)
        finite = np.isfinite(begun).all()
        if not finite and implicit:
            return self._lost(begun)
        if not finite and not self._stiff_at(z, nodes):
            if not self._evaluated:
                return None
            raise FloatingPointError("the model's state is not finite here")
        if not finite:
            return 4.0
        if order == 0:
            return self._values(z, begun)
        at_stage, by_x, by_z = sweeps.derivatives(z, begun, stages)
        if not implicit and (fastest := growth(by_x[0])) > _UNSTABLE:
            return min(fastest / (0.4 * _UNSTABLE), 1e3)
        found = self._sensitivities(z, begun, at_stage, by_x, by_z)
        if implicit:
            sweeps.remember(z, begun, at_stage, found.stages)
        return found

    def _lost(self, begun: Array) -> Array:
        """By how much shorter each step has to be where Newton's method did not arrive in some; in order of time."""
        layout = self.layout
        fine = np.asarray(np.isfinite(begun).all(axis=0))
        lost = fine[: layout.steps] & ~fine[layout.after]
        if not lost.any():
            raise FloatingPointError("the model's state is not finite here")
        factor = np.ones(layout.steps // self.slope.parts)
        factor[layout.number[lost]] = 4.0
        return factor

    @property
    def _scheme(self) -> Tableau:
        return RUNGE_KUTTA if self._fineness is None else self._fineness.scheme

    def _stiff_at(self, z: Array, nodes: Array) -> bool:
        """True if an explicit step may be unstable at the intervals' starts."""
        layout, at = self.layout, self.layout.at[0]
        known = self.slope.known(
            layout.low[:, at],
            layout.high[:, at],
            layout.time[at],
            layout.length[at],
            0.0,
            np.zeros(len(nodes)),
        )
        by_x = self.slope.newton(np.ascontiguousarray(nodes.T), known, z)[1]
        return growth(by_x.reshape(self.n, self.n, -1).T[None]) > 0.2

    def _at_samples(self, begun: Array) -> Array:
        """(L+1, n, M) of states (n, K+M) at the steps' starts."""
        return np.ascontiguousarray(begun[:, self.layout.at].transpose(1, 0, 2))

    def _values(self, z: Array, begun: Array) -> RungeKuttaTrajectory:
        x, four, five = self._at_samples(begun), np.zeros((0,) * 4), np.zeros((0,) * 5)
        y = to_rows(self.intervals, self.outputs.values(x, z)[None])
        return RungeKuttaTrajectory(x, begun, four, four, five, five, np.zeros((0, 0, 0)), four, y, four)

    def _sensitivities(
        self, z: Array, begun: Array, at_stage: Array, by_x: Array, by_z: Array
    ) -> RungeKuttaTrajectory:
        n, layout, plan = self.n, self.layout, self.intervals
        slopes, stages = stage_sensitivities(self._scheme, by_x, by_z)
        step = np.ascontiguousarray(step_sensitivities(self._scheme, slopes))
        a, b = np.ascontiguousarray(step[..., :n]), step[..., n:]
        s = np.zeros((layout.steps + plan.m, n, n + self.nz))
        s[layout.at[0], :, :n] = np.eye(n)
        for steps, after in layout:
            ask()
            found = a[steps] @ s[steps]
            found[..., n:] += b[steps]
            s[after] = found
        x = self._at_samples(begun)
        value, out = self.outputs.slopes(x, z)
        full = out[..., :n] @ s[layout.at[: plan.length]]
        full[..., n:] += out[..., n:]
        y = np.concatenate([value[None], full[..., n:].transpose(3, 2, 0, 1)])
        ys = to_rows(plan, full[..., :n].transpose(3, 2, 0, 1)).transpose(1, 2, 3, 0)
        return RungeKuttaTrajectory(
            x, begun, s, a, by_x, stages, at_stage, out, to_rows(plan, y), np.ascontiguousarray(ys)
        )

    # ---- second order

    @np.errstate(over="ignore", invalid="ignore")
    def contraction(
        self, z: Array, path: RungeKuttaTrajectory, rho: Array, lam: Array
    ) -> tuple[Array, Array, Array]:
        """Second derivatives of sum(rho * y) + sum(lam * end): (z, z), (z, start) and (start, start)."""
        z, plan, n, layout = np.asarray(z, dtype=float), self.intervals, self.n, self.layout
        weights = from_rows(plan, rho, self.ny)
        at = layout.at[: plan.length]
        mu = np.zeros((layout.steps + plan.m, n))
        np.add.at(mu, at, np.einsum("pym,pmya->pma", weights, path.out[..., :n]))
        mu[layout.steps :] += lam.T
        for steps, after in reversed(layout):
            mu[steps] += (mu[after][:, None, :] @ path.a[steps])[:, 0]
        total = self.outputs.contracted(path.x, z, weights, path.s[at])
        nu = stage_multipliers(self._scheme, path.by_x, mu[layout.after])
        sweeps, start = self._sweeps, path.s[: layout.steps]
        assert sweeps is not None  # the path was propagated
        bent = np.zeros((layout.steps, n + self.nz, n + self.nz))
        for i in range(self._scheme.stages):
            # stage values to (interval's start, z): through the step's start, and directly
            basis = np.zeros_like(bent)
            basis[:, :n] = path.stages[i][..., :n] @ start
            basis[:, :n, n:] += path.stages[i][..., n:]
            basis[:, n:, n:] = np.eye(self.nz)
            flat = np.ascontiguousarray(nu[i].T)
            inner = self.slope.second(path.at_stage[i], sweeps.known[i][:, : layout.steps], z, flat)
            bent += basis.swapaxes(-1, -2) @ inner.transpose(2, 0, 1) @ basis
        np.add.at(total, layout.interval, bent)
        return (
            total[:, n:, n:].sum(axis=0),
            np.ascontiguousarray(total[:, n:, :n].transpose(1, 2, 0)),
            total[:, :n, :n],
        )
