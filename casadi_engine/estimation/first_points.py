"""Where searches begin: at the set's values or drawn ones, at states that the measurement gives, along a warm fit."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EstimationError
from casadi_engine.estimation.growth import check_growth
from casadi_engine.estimation.interrupts import Interrupts
from casadi_engine.estimation.laid_problem import LaidProblem
from casadi_engine.estimation.pieces import REACH, SCREENED, approach
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.rounded_start import rounded_refit
from casadi_engine.estimation.slopes import check_slopes, has_slopes
from casadi_engine.estimation.starts import (
    chained_nodes,
    drawn_starts,
    fitted_nodes,
    joined_nodes,
    nodes_from_measurement,
)
from casadi_engine.simulation.propagator import switches_with_states
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator

Array = NDArray[np.float64]


class FirstPoints(LaidProblem):
    """A laid-out problem and the points at which searches on all samples begin."""

    def __init__(
        self, *arguments: Any, approach: str = "direct", interrupts: Interrupts | None = None, **laid: Any
    ) -> None:
        """approach, interrupts : as in ``Search``; the others as in ``LaidProblem``"""
        self._approach, self._interrupts = approach, interrupts or Interrupts()
        self._first: tuple[Array, Array] | None = None  # the set's own start and its variables, once laid out
        super().__init__(*arguments, **laid)

    @property
    def begins(self) -> Array:
        """(nz,) where the search is told to start."""
        return self._warm_values(self.pmap.start)

    def _warm_values(self, z: Array) -> Array:
        """The free parameters of a warm start as far as it has them, moved into the bounds; as they are without one."""
        if self.warm is None:
            return z
        known = self.warm.values
        found = [known.get(name, value) for name, value in zip(self.pmap.free, z, strict=True)]
        values = np.array(found, dtype=float)
        return np.clip(np.where(np.isfinite(values), values, z), self.pmap.lower, self.pmap.upper)

    def _start(self, z: Array, *, first: bool, fitted: bool = True) -> Array:
        """The point at these values; fitted : its nodes are moved to where their intervals explain their samples"""
        if first and self._first is not None and np.array_equal(self._first[0], z):
            return self._first[1].copy()
        x = np.zeros(self.problem.size)
        nv = self.problem.nv
        x[:nv] = self.coordinates.of(z)
        for record, lay, bounds in zip(self.records, self.problem.layouts, self._initial, strict=True):
            nodes = self._warm_nodes(record, x[:nv]) if first else None
            if nodes is None:
                known = np.asarray(bounds[2] / record.scale, dtype=float)
                nodes = nodes_from_measurement(record, self.pmap.unpack(z, record.experiment.name), known)
                if fitted and isinstance(record.propagator, RungeKuttaPropagator):
                    nodes = fitted_nodes(record, x[:nv], nodes)
            low, high, given = (part / record.scale for part in bounds)
            nodes[0] = np.clip(np.where(np.isfinite(given), given, nodes[0]), low, high)
            x[lay.at : lay.at + nodes.size] = nodes.ravel()
        simulated = self._simulated(x)
        return x if simulated is None or not self._lower(simulated, x) else simulated

    def first_point(self) -> Array:
        """The point (size,) at which a search from the set's own values begins."""
        z = self._warm_values(self.pmap.start)
        if self._first is None or not np.array_equal(self._first[0], z):
            self._first = (z, self._start(z, first=True))
        return self._first[1]

    def _simulated(self, x: Array, *, resting: bool = False) -> Array | None:
        """The point with the nodes of one run of each record; None where no nodes change.

        Measured outputs say little of the states of a model without a linear core, and where laws bend, what nodes from
        them lead to may explain less than the start does. resting : a run may also begin where all states rest that no
        output shows, whichever comes nearer to the data: over one interval an unseen state may seem to be far off
        """
        found, nv = x.copy(), self.problem.nv
        z = self.coordinates.values(x[:nv])
        for record, lay, bounds in zip(self.records, self.problem.layouts, self._initial, strict=True):
            if record.linear or lay.m == 1:
                continue
            begins = [lay.take(x)]
            if resting:
                low, high, given = (part / record.scale for part in bounds)
                first = nodes_from_measurement(record, self.pmap.unpack(z, record.experiment.name))[0]
                first = np.clip(np.where(np.isfinite(given), given, first), low, high)
                begins.append(np.concatenate([first[None], begins[0][1:]]))
            best = _nearest_run(record, x[:nv], begins)
            if best is None:
                return None
            found[lay.at : lay.at + best.size] = best.ravel()
        return None if np.array_equal(found, x) else found

    def _warm_nodes(self, record: RecordTerm, v: Array) -> Array | None:
        states = (
            getattr(self.warm, "initial", {}).get(record.experiment.name) if self.warm is not None else None
        )
        if not states:
            return None
        names = [state.name for state in self.model.states]
        if not all(name in states for name in names):
            return None
        # the states of a Fit are estimates, those of a stored result numbers
        first = np.array([float(getattr(states[name], "value", states[name])) for name in names])
        try:
            return chained_nodes(record, v, first / record.scale)
        except FloatingPointError:
            return None

    def _rounded(self, x: Array, z: Array) -> tuple[Array, bool]:
        """Where the equations with rounded corners lead from z, if the objective is lower there than at x, and whether
        it is an optimum."""
        free = all(np.isneginf(low).all() and np.isposinf(high).all() for low, high, _ in self._initial)
        plain = free and self.warm is None and self.predictor.kind == "none" and not self.loss.robust
        if not plain or self.problem.user.count or not self.pmap.free or not switches_with_states(self.model):
            return x, False
        levels = dict(zip((out.name for out in self.model.outputs), self.sigma.tolist(), strict=True))
        start = dict(zip(self.pmap.free, z.tolist(), strict=True))
        found = rounded_refit(self.model, self.data, self.parameters, levels, start)
        if found is None:
            return x, False
        there, names = x.copy(), [state.name for state in self.model.states]
        there[: self.problem.nv] = self.coordinates.of(np.array([found.values[n] for n in self.pmap.free]))
        for record, lay in zip(self.records, self.problem.layouts, strict=True):
            first = np.array([found.initial[record.experiment.name][name] for name in names])
            there[lay.at : lay.at + record.n] = first / record.scale
        return (there, found.converged) if self._lower(there, x) else (x, False)

    def _checked(self, x: Array, z: Array) -> Array:
        """The point itself, or another one of these values where the model cannot be evaluated there: nodes near noisy
        samples may lie where a power has no slope or a mass no inverse, and those of one run need not."""
        for record in self.records:
            record.begin()
        others = (lambda: x, lambda: self._chained(x), lambda: self._start(z, first=False, fitted=False))
        for made in others:
            with suppress(FloatingPointError, np.linalg.LinAlgError):
                if self._is_usable(point := made()):
                    check_growth(self.records, self.problem.at(point).records)
                    return point
        if not np.isfinite(self._objective(x)):
            raise EstimationError(
                "the model cannot be evaluated at the start values",
                seen=", ".join(f"{n}={value:.6g}" for n, value in zip(self.pmap.free, z, strict=True))
                or "no free parameter, and first states as the measurement gives them",
                allowed="values for which the equations give finite numbers",
                cure="change the start values or the bounds, or give first states: initial={...}",
            )
        check_growth(self.records, self.problem.at(x).records)
        check_slopes(self.records, self.problem.at(x))
        return x

    def _chained(self, x: Array) -> Array:
        """The point with the nodes of one run from its first states."""
        found, nv = x.copy(), self.problem.nv
        for record, lay in zip(self.records, self.problem.layouts, strict=True):
            nodes = joined_nodes(record, x[:nv], lay.take(x))
            found[lay.at : lay.at + nodes.size] = nodes.ravel()
        return found

    def _is_usable(self, x: Array) -> bool:
        """True where the objective and its slopes are finite."""
        return bool(np.isfinite(self._objective(x))) and has_slopes(self.problem.at(x))

    def drawn(self, count: int, seed: int) -> list[Array]:
        """Starts of z, the set's own and others around it."""
        return drawn_starts(self.pmap, count, seed, scale=self.coordinates.scale)

    def _approached(self, z: Array) -> Array:
        """The start of the simulation that predictions over short pieces lead to; ``z`` itself without them."""
        if self._approach == "direct" or self.warm is not None or not self.problem.nv:
            return z
        self._weigh(self.levels.first())
        drawn = drawn_starts(replace(self.pmap, start=z), 1 + SCREENED, 0, REACH, self.coordinates.scale)
        v = approach(
            self.records,
            [self.coordinates.of(point) for point in drawn],
            lambda record: nodes_from_measurement(record, self.pmap.unpack(z, record.experiment.name)),
            coordinates=self.coordinates,
            bounds=(self.lower[: self.problem.nv], self.upper[: self.problem.nv]),
            sigma=self.sigma,
            stop=lambda: self._interrupts.stopped,
        )
        found = np.clip(self.coordinates.values(v), self.pmap.lower, self.pmap.upper)
        return found if np.isfinite(found).all() else z


def _nearest_run(record: RecordTerm, v: Array, begins: list[Array]) -> Array | None:
    """Nodes (M, n) of the run from the first of nodes near it, of several the one nearest to the data; None where none
    can be made."""
    runs: list[tuple[float, Array]] = []
    for near in begins:
        try:
            nodes = joined_nodes(record, v, near)
            misfit = float(np.square(record.evaluate(v, nodes).r).sum()) if len(begins) > 1 else 0.0
        except FloatingPointError:
            continue
        runs += [(misfit, nodes)] if np.isfinite(misfit) else []
    return min(runs, key=lambda run: run[0])[1] if runs else None
