"""Propagation of a linear core with nonlinear laws over all shooting intervals at once, by an exponential integrator.

dx/dt = A x + B v + G w(s, u, t; z), s = q x: the core is integrated exactly, whatever its fastest mode, and the laws
by Krogstad's scheme of fourth order (see ``exponential_step``). Where a law passes a corner or feeds back strongly the
cells of the grid are cut into more steps, and only there. States advance step by step; the derivatives of all steps
are then worked out at once, and chained by batched products.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import SimulationError
from casadi_engine.model import Model
from casadi_engine.simulation import jets
from casadi_engine.simulation.drives import Drives
from casadi_engine.simulation.exponential_curvature import contracted
from casadi_engine.simulation.exponential_slopes import Columns, Linearised, chain, law_slopes
from casadi_engine.simulation.exponential_step import StepCore
from casadi_engine.simulation.exponential_values import WIDE, Machine, by_arrays, single_steps
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.laws import Laws
from casadi_engine.simulation.local_steps import LocalSteps, Substeps
from casadi_engine.simulation.sample_rows import from_rows, to_rows
from casadi_engine.simulation.split import Split
from casadi_engine.simulation.step_errors import carried_errors, errors_by_cell, shares

# Steps to a sample at most: on average, and in one place.
MOST_SUBSTEPS, MOST_IN_PLACES = 64, 2048
# Feedback h |dw/ds q G| of a step above which an explicit scheme loses its accuracy, and soon its stability; and one
# below which steps four times as long are tried at the next point. A trial point of a search that is far off may ask
# for the shortest steps there are, and would else have all later ones pay for it.
_STRONGEST, _EASY, _LONGER, _WASTE = 1.0, 0.2, 4, 1.5
# Into how many parts a step is cut at once at most: by its feedback, and by its error.
_FINER, _MUCH_FINER, _NEARLY = 4, 16, 0.2
# A point that asks for more than so many times the steps of the point before it is not worth them: it is refused, and
# the search comes nearer by a shorter step.
_JUMP = 16
# Of a scheme of fourth order: its error is this many times its difference from half the step.
_RICHARDSON = 16 / 15


@dataclass
class ExponentialTrajectory:
    """States, outputs and sensitivities; shapes as in ``RungeKuttaTrajectory``.

    made : the steps and what their derivatives are made of; maps : (K, n, n+nz) derivatives of the steps' ends;
    chained : (K+M, n, n+nz) of the states where steps begin and intervals end, by (start, z)
    """

    made: Linearised
    maps: Array
    chained: Array
    y: Array
    ys: Array

    @property
    def substeps(self) -> int:
        """Most steps of a cell."""
        return self.made.laid.most

    @property
    def x(self) -> Array:
        """(L+1, n, M) states at the samples."""
        return np.ascontiguousarray(self.made.steps.begun[:, self.made.laid.layout.at].transpose(1, 0, 2))

    @property
    def end(self) -> Array:
        """(n, M)."""
        return self.made.steps.begun[:, self.made.laid.steps :]

    @property
    def end_z(self) -> Array:
        """(nz, n, M)."""
        n = self.chained.shape[1]
        return np.ascontiguousarray(self.chained[self.made.laid.steps :, :, n:].transpose(2, 1, 0))

    @property
    def end_s(self) -> Array:
        """(M, n, n)."""
        return self.chained[self.made.laid.steps :, :, : self.chained.shape[1]]


class ExponentialPropagator:
    """A split model over one record; arguments as in ``RungeKuttaPropagator``.

    substeps : least steps to a sample, everywhere or in each cell of the grid; there are more where the laws' feedback
        asks for them, and fewer again later
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
        substeps: int | Substeps = 1,
    ) -> None:
        if not isinstance(substeps, Substeps):
            substeps = _everywhere(substeps, grid)
        inner = parts.model
        self.intervals, self.nz, self.n = intervals, int(z.numel()), len(scale)
        self.ny, self.grid = len(model.outputs), grid
        self._own_drives = len(model.drives)
        self._drives = Drives(inner, grid, z, physical)
        self.core = StepCore(parts.core, inner, z, physical, hold=self._drives.holds, scale=scale)
        symbols = (inner.x, inner.u, inner.t, inner.p)
        self.laws = Laws(symbols, parts.laws, self.core.groups, z, physical, scale)
        self._machine = Machine(self.laws, self.nz)
        self._begin(substeps)

    # ---- how finely

    def _begin(self, fineness: Substeps) -> None:
        """Steps that nothing was integrated by yet."""
        self._least, self._next = fineness.counts, fineness.counts
        self._begun = False
        self._lay(fineness.counts)

    def _lay(self, counts: NDArray[np.intp]) -> None:
        self._laid: LocalSteps | None = None
        self._columns: Columns | None = None
        self.fineness = Substeps(counts)

    @property
    def laid(self) -> LocalSteps:
        """The steps as they are now."""
        if self._laid is None:
            self._laid = LocalSteps(self.grid, self.intervals, self.laws, self.fineness.counts)
        return self._laid

    @property
    def substeps(self) -> int:
        """Most steps from one sample to the next."""
        return self.fineness.most

    def refined(self, fineness: int | Substeps) -> ExponentialPropagator:
        """The same propagator with other steps, in each cell or as many everywhere."""
        other = object.__new__(ExponentialPropagator)
        other.__dict__.update(self.__dict__)
        other._begin(fineness if isinstance(fineness, Substeps) else _everywhere(fineness, self.grid))
        return other

    def finer(self, factor: int) -> ExponentialPropagator:
        """The same propagator with every step cut into ``factor`` steps."""
        return self.refined(Substeps(self.fineness.counts * factor))

    def adapted(self, errors: Array, ratio: float) -> ExponentialPropagator:
        """The same propagator with shorter steps where most of the error arises, for an error ``ratio`` times smaller.

        errors : (N-1,) that arise in the cells of the grid, see `arising`
        Raises FloatingPointError where that are more steps than there may be.
        """
        counts = self.fineness.counts
        factor = (shares(errors) * ratio) ** 0.25
        # the next power of two, or the one before where that is nearly enough
        wanted = 2 ** np.ceil(np.log2(np.clip(factor, 1.0, _MUCH_FINER)) - _NEARLY).astype(np.intp)
        finer = np.where(counts < MOST_IN_PLACES, counts * wanted, counts)
        finer = _with_neighbours(finer)
        if _total(finer) > MOST_SUBSTEPS * len(counts) or (finer == counts).all():
            raise FloatingPointError("the laws ask for more integration steps than are allowed")
        return self.refined(Substeps(finer))

    # ---- drives

    def drives_at(self, z: Array) -> Array:
        """(m, N) drives of the model on the grid."""
        return self._drives.at(z).value[: self._own_drives]

    def _merged(self, drives: Array, constant: float) -> Array:
        """(..., m, N) columns of the core from the drives of the model."""
        merged = np.zeros((*drives.shape[:-2], self.core.m, drives.shape[-1]))
        for column, group in enumerate(self.core.drives):
            merged[..., column, :] = drives[..., list(group), :].sum(axis=-2)
        if self.core.constant:
            merged[..., -1, :] = constant
        return merged

    def drive_columns(self, z: Array) -> Columns:
        """Drives at the starts and ends of the steps."""
        samples, laid, first = self._drives.at(z), self.laid, self.core.first
        if self._columns is None or self._columns.samples is not samples:
            value = laid.columns(self._merged(samples.value, 1.0), first)
            none = np.zeros((0, *value.shape))
            slopes = [
                laid.columns(self._merged(part, 0.0), first) if len(samples.active) else none
                for part in (samples.first, samples.second)
            ]
            self._columns = Columns(samples, value, *slopes)
        return self._columns

    # ---- forward

    # A trial point of the search may be far off: what overflows is found by its result.
    @np.errstate(all="ignore")
    def propagate(self, z: Array, nodes: Array, order: int = 1) -> ExponentialTrajectory:
        """Advance all intervals from ``nodes`` (M, n), scaled states, at z : (nz,)."""
        z, nodes = np.asarray(z, dtype=float), np.asarray(nodes, dtype=float)
        if self._next is not self.fineness.counts:
            self._lay(self._next)
        while True:
            made = self._stepped(z, nodes, order)
            feedback = self._feedback(made)
            finer = self._finer(feedback)
            if finer is None:
                break
            self._lay(finer)
        self._begun = True
        counts = self.fineness.counts
        eased = np.where(feedback < _EASY, np.maximum(self._least, counts // _LONGER), counts)
        # steps that change from point to point trouble a search: as long as they are not many too many they stay
        self._next = eased if _WASTE * _total(eased) < _total(counts) else counts
        value = self._outputs(made)
        if not (np.isfinite(made.steps.begun).all() and np.isfinite(value).all()):
            raise FloatingPointError("the model's state is not finite here")
        rows = to_rows(self.intervals, value[None])
        if order == 0:
            none = np.zeros((0, self.n, self.n))
            return ExponentialTrajectory(made, none, none, rows, none[None])
        return self._sensitivities(made, rows)

    def _stepped(self, z: Array, nodes: Array, order: int) -> Linearised:
        """The states, signals and torques of all steps, and the laws' slopes."""
        laid, columns = self.laid, self.drive_columns(z)
        matrices = self.core.at(z, order, self.grid.step, self.laws.q, laid.levels.tolist())
        if laid.width >= WIDE:
            steps = by_arrays(laid, matrices, self.laws, columns.value, z, nodes)
        else:
            steps = self._machine.run(laid, matrices, columns.value, z, nodes)
        slopes = law_slopes(laid, self.laws, steps, z)
        return Linearised(laid, self.laws, matrices, steps, columns, *slopes, self.nz if order else 0)

    def _feedback(self, made: Linearised) -> Array:
        """(N-1,) the largest h |q G dw/ds| of any stage in each cell; 0 where it is not a number, which the caller
        finds by itself."""
        laid, laws, found = made.laid, self.laws, np.zeros(made.laid.steps)
        size = np.abs(made.by_signal).max(axis=0)
        for jet, steps in zip(made.matrices, laid.groups, strict=True):
            at = jet.n + 2 * jet.m + 2 * laws.count
            last = np.abs(jet.p[0][jet.n + 3 * laws.size :, at : at + laws.count])
            own = size[:, steps]
            loop = np.zeros((laws.size, laws.size, own.shape[1]))
            for entry, (law, signal, _) in enumerate(laws.pattern):
                loop[:, signal] += last[:, law, None] * own[entry]
            most = loop.sum(axis=1).max(axis=0)  # no eigenvalue is larger
            strong = np.flatnonzero(np.isfinite(most) & (most > _EASY)) if laws.size > 1 else []
            if len(strong):
                most[strong] = np.abs(np.linalg.eigvals(loop[:, :, strong].transpose(2, 0, 1))).max(axis=1)
            found[steps] = np.where(np.isfinite(most), most, 0.0)
        return laid.by_cell(found)[: len(self.fineness.counts)]

    def _finer(self, feedback: Array) -> NDArray[np.intp] | None:
        """Shorter steps where the feedback is too strong; None where it is not, or steps are the shortest there are."""
        counts = self.fineness.counts
        strong = (feedback > _STRONGEST) & (counts < MOST_IN_PLACES)
        if not strong.any():
            return None
        needed = np.where(strong, counts * feedback / _STRONGEST, counts)
        if self._begun and needed.sum() > _JUMP * _total(self._next):
            raise FloatingPointError("the laws are far stiffer here than at the point before")
        finer = np.where(strong, counts * np.where(feedback > 2 * _STRONGEST, _FINER, 2), counts)
        finer = _with_neighbours(finer)
        return finer if _total(finer) <= MOST_SUBSTEPS * len(counts) else None

    def _outputs(self, made: Linearised) -> Array:
        """(ny, L, M) outputs."""
        laid, c, d = made.laid, made.matrices[0].c[0], made.matrices[0].d[0]
        y = np.tensordot(c, made.steps.begun[:, laid.layout.at[: self.intervals.length]], axes=1)
        if d.any():
            y += np.einsum("yi,ilm->ylm", d, laid.at_samples(made.columns.value))
        return np.asarray(y)

    def _sensitivities(self, made: Linearised, value: Array) -> ExponentialTrajectory:
        """The first derivatives to (start, z)."""
        maps = made.maps()
        chained = chain(made.laid, maps)
        found = self._observed(made, chained)
        y = np.concatenate([value, to_rows(self.intervals, found[:, :, :, self.n :].transpose(3, 0, 1, 2))])
        ys = to_rows(self.intervals, found[:, :, :, : self.n].transpose(3, 0, 1, 2)).transpose(1, 2, 3, 0)
        return ExponentialTrajectory(made, maps, chained, y, np.ascontiguousarray(ys))

    def _observed(self, made: Linearised, chained: Array) -> Array:
        """(ny, L, M, n+nz) slopes of the outputs."""
        laid, n, nz = made.laid, self.n, self.nz
        c, d, at = made.matrices[0].c, made.matrices[0].d, made.laid.layout.at[: self.intervals.length]
        found = np.zeros((self.ny, *at.shape, n + nz))
        for row, factors in enumerate(c[0]):
            for state in np.flatnonzero(factors):
                found[row] += factors[state] * chained[at, state]
        if not jets.is_constant(c):
            found[..., n:] += np.einsum("zyi,ilm->ylmz", c[1 : 1 + nz], made.steps.begun[:, at])
        if not jets.is_constant(d):
            found[..., n:] += np.einsum("zyi,ilm->ylmz", d[1 : 1 + nz], laid.at_samples(made.columns.value))
        if d[0].any():
            for row, index in enumerate(made.columns.samples.active):
                found[..., n + index] += np.einsum(
                    "yi,ilm->ylm", d[0], laid.at_samples(made.columns.first[row])
                )
        return found

    # ---- error

    def arising(self, z: Array, path: ExponentialTrajectory) -> tuple[Array, Array]:
        """What the steps of a path are off by: of the outputs (R*ny, b, M), carried along, and by cells (N-1,)."""
        layout, n = path.made.laid.layout, self.n
        own = self._own_errors(z, path)
        states = carried_errors(
            layout, self.intervals, own, layout.after, path.maps[:, :, :n], path.chained[:, :, :n]
        )
        off = np.einsum("yi,lmi->ylm", path.made.matrices[0].c[0], states)
        return to_rows(self.intervals, off[None])[0], self._by_cell(path, own)

    def errors_by_cell(self, z: Array, path: ExponentialTrajectory) -> Array:
        """(N-1,) what arises in each cell of the grid, relative to the largest state; of a path of any order."""
        return self._by_cell(path, self._own_errors(z, path))

    def _by_cell(self, path: ExponentialTrajectory, own: Array) -> Array:
        cells = errors_by_cell(path.made.laid.layout, own, path.made.steps.begun)
        return cells[: len(self.fineness.counts)]

    @np.errstate(all="ignore")
    def _own_errors(self, z: Array, path: ExponentialTrajectory) -> Array:
        """(K, n) what each step is off by: its difference from two of half the length."""
        made, laid, (n, m) = path.made, path.made.laid, (self.n, self.core.m)
        halves = self.core.at(z, 0, self.grid.step, self.laws.q, (2 * laid.levels).tolist())
        given, value = self.laws.given(laid.layout, (0.0, 0.25, 0.5, 0.75, 1.0)), made.columns.value
        middle, own = 0.5 * (value[:m] + value[m:]), np.empty((laid.steps, n))
        for jet, steps in zip(halves, laid.groups, strict=True):
            x = made.steps.begun[:, : laid.steps][:, steps]
            for first, v in ((0, (value[:m], middle)), (2, (middle, value[m:]))):
                drive = np.concatenate([part[:, steps] for part in v])
                known = given[first : first + 3][:, :, steps]
                x = single_steps(jet.p[0], n, m, self.laws, z, x, drive, known)
            own[steps] = _RICHARDSON * (x - made.steps.begun[:, laid.layout.after[steps]]).T
        return own

    # ---- second order

    @np.errstate(all="ignore")
    def contraction(
        self, z: Array, path: ExponentialTrajectory, rho: Array, lam: Array
    ) -> tuple[Array, Array, Array]:
        """Second derivatives of sum(rho * y) + sum(lam * end): (z, z), (z, start) and (start, start)."""
        z, made = np.asarray(z, dtype=float), path.made
        if made.matrices[0].order < 2 and self.nz:
            levels = made.laid.levels.tolist()
            made = replace(made, matrices=self.core.at(z, 2, self.grid.step, self.laws.q, levels))
            path.made = made
        weights = from_rows(self.intervals, rho, self.ny)
        return contracted(made, z, path.maps, path.chained, weights, lam)


def _with_neighbours(counts: NDArray[np.intp]) -> NDArray[np.intp]:
    """Steps of cells with at least half those of the cells beside: a corner that moves a little still finds short ones."""
    wide = counts.copy()
    wide[1:] = np.maximum(wide[1:], counts[:-1] // 2)
    wide[:-1] = np.maximum(wide[:-1], counts[1:] // 2)
    return wide


def _total(counts: NDArray[np.intp]) -> int:
    return int(counts.sum())


def _everywhere(substeps: int, grid: Grid) -> Substeps:
    """As many steps in every cell of a grid."""
    if isinstance(substeps, bool) or substeps != int(substeps) or not 1 <= substeps <= MOST_SUBSTEPS:
        raise SimulationError(
            "the number of integration steps to a sample is not acceptable",
            seen=repr(substeps),
            allowed=f"a whole number from 1 to {MOST_SUBSTEPS}",
            cure="leave it out, or give substeps=4, for instance",
        )
    return Substeps(np.full(grid.samples - 1, int(substeps)))
