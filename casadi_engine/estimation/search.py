"""The search for an optimum: the problem set up once, run from any start, noise levels settled on the way."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import TimeUp, late, lifted
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.constraints import ParameterConstraints, Priors
from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.estimation.growth import check_growth
from casadi_engine.estimation.innovations import SizedPriors, StableLoop
from casadi_engine.estimation.integration import alike, shorten_steps
from casadi_engine.estimation.interrupts import Interrupts
from casadi_engine.estimation.ipopt import OUT_OF_ITERATIONS, Solution, Solver
from casadi_engine.estimation.levels import NoiseLevels, check_noise, check_samples
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.options import initial_bounds, interval_length
from casadi_engine.estimation.pieces import REACH, SCREENED, approach
from casadi_engine.estimation.predictor import Predictor
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.scales import felt_scale, state_factors
from casadi_engine.estimation.shooting import ShootingProblem
from casadi_engine.estimation.slopes import check_slopes
from casadi_engine.estimation.spectral_start import Begun, SpectralStarts, asked_in_full, complete, in_full
from casadi_engine.estimation.starts import (
    chained_nodes,
    drawn_starts,
    fitted_nodes,
    joined_nodes,
    nodes_from_measurement,
)
from casadi_engine.estimation.unreachable import unreachable
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters, compile
from casadi_engine.problem.noise import Noise
from casadi_engine.simulation.grid import Grid, lay_grid
from casadi_engine.simulation.propagator import switches_with_states
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator
from casadi_engine.simulation.shared_core import Cores

Array = NDArray[np.float64]

# Noise levels that are estimated beside priors, several outputs or a robust loss are settled by repeated fits.
_ROUNDS, _LEVEL = 12, 1e-6
# Rounds of shorter integration steps, each with a refit that begins at the optimum.
_SHORTENED = 6
_NOWHERE = "the frequency domain led nowhere"
# Points from which values that meet all constraints are looked for, where a search has ended without.
_TRIED = 5


@dataclass
class Attempt:
    """The outcome of one start.

    v : (nv,) coordinates of the parameters; sigma : (ny,) noise levels found; cost : chi-squared + priors at these;
    merit : what starts are compared by, -2 log likelihood but for a constant; start : (nz,) parameters at the start
    searched : what was searched on, in words; begun : where the search in the frequency domain ended, if there was one;
    pending : it has yet to look at all samples; cut : it was ended before its end (see ``cut_short``), and its cost is
    at the levels that it had then; run : no simulation from its first states is known to be another
    """

    solution: Solution
    v: Array
    sigma: Array
    cost: float
    merit: float
    iterations: int
    start: Array
    searched: str = "all samples"
    begun: Begun | None = None
    pending: bool = False
    cut: bool = False
    run: bool = True


class Search:
    """A fit's problem and solver."""

    solver: Solver

    def __init__(
        self,
        model: Model,
        data: tuple[Experiment, ...],
        parameters: Parameters,
        noise: Noise | None,
        *,
        interval: Any,
        initial: Any,
        loss: Loss,
        ties: str,
        method: str,
        max_iterations: int,
        tolerance: float,
        warm: Any,
        progress: Callable[[int, float, float], Any] | None,
        interrupts: Interrupts | None = None,
        approach: str = "direct",
    ) -> None:
        noise = check_noise(noise, model)
        self.model, self.data, self.noise, self.loss = model, data, noise, loss
        self.warm, self._progress = _checked_warm(warm), progress
        self._approach, self._interrupts = approach, interrupts or Interrupts()
        names = tuple(record.name for record in data)
        self._grids = {record.name: lay_grid(model, record) for record in data}
        self.predictor = Predictor(noise, model, list(self._grids.values()), parameters)
        wanted = (*model.parameter_names, *self.predictor.names)
        whole = compile(parameters, wanted, names, ties=ties)  # type: ignore[arg-type]
        self.pmap, self._whole_tails = self.predictor.split(whole)
        self.parameters = parameters
        self._initial = [initial_bounds(initial, model, name, names) for name in names]
        self.cut, self._method = interval, method
        self._spectral: SpectralStarts | None = None  # set up once it is wanted
        self._before = 0  # iterations in the frequency domain, before those on all samples
        self._first: tuple[Array, Array] | None = None  # the set's own start and its variables, once laid out
        # objective, point (size,) and levels (ny,) of the last solution of a run
        self.reached: tuple[float, Array, Array] | None = None
        self._lay(noise, Coordinates(self.pmap))
        if self.problem.nv:
            check_samples(noise, self.records, self.free_count, len(self.pmap.priors))
        self._weigh(self.levels.first(self.warm))
        z = self._warm_values(self.pmap.start) if self.warm is not None else self.pmap.start
        if self.warm is None and in_full(self) is None:
            felt, larger = self.spectral.sizes(z)
        else:
            x = self.first_point()
            felt = felt_scale(self.problem, self.coordinates, z, x)
            larger = state_factors(self.problem, x) if self.predictor.kind == "none" else None
        if felt is not None or larger is not None:
            self._first = self._spectral = None
            self._lay(noise, Coordinates(self.pmap, felt), larger)
            self._weigh(self.levels.first(self.warm))
        self.solver = Solver(
            self.problem,
            self.coordinates.log,
            max_iterations=max_iterations,
            tolerance=tolerance,
            progress=self._report,
            interrupts=self._interrupts,
        )

    def _lay(self, noise: Noise, coordinates: Coordinates, larger: Array | None = None) -> None:
        """Set the problem up in these coordinates, the states' scales times ``larger`` (n,)."""
        scale = np.array([state.scale for state in self.model.states])
        self._scale = scale if larger is None else scale * larger
        self.coordinates = coordinates
        self._tails: dict[str, Any] = {}
        self.records, level = self._terms(self._grids, self._whole_tails, self.cut, self._method)
        if getattr(self.warm, "in_places", False):
            for record in self.records:
                record.step_in_places()
        priors: Any = Priors(self.pmap, self.coordinates)
        if level is not None:
            self._check_loss()
            priors = SizedPriors(priors, self.records, level)
            noise = Noise(**dict(zip(self.predictor.outputs, level.tolist(), strict=True)))
        self.constraints = ParameterConstraints(self.model, self.pmap, self.coordinates, self._stable())
        self.problem = ShootingProblem(self.records, self.constraints, priors, self.loss, len(self.pmap.free))
        self._bounds()
        self.sigma = np.zeros(0)
        self.levels = NoiseLevels(noise, self.model, self.records)

    def _terms(
        self, grids: dict[str, Grid], tails: dict[str, Any], interval: Any, method: str
    ) -> tuple[list[RecordTerm], Array | None]:
        """The records' terms, and with noise covariances the levels (ny,) to which innovations are whitened."""
        made: dict[int, Any] = {}
        cores, records = Cores(), []
        level: Array | None = None
        outputs = tuple(out.name for out in self.model.outputs)
        linear = self.model.linear is not None and not self.model.has_slot_laws
        bins = linear and not self.pmap.constraints and asked_in_full(self) is None
        for record in self.data:
            grid, physical = grids[record.name], self.pmap.physical[record.name]
            local = made.setdefault(id(physical), self.coordinates.substitute(physical))
            own = self._tails[record.name] = self.coordinates.substitute(tails[record.name])
            if self.predictor.kind == "process" and level is None:
                start = self.coordinates.of(self.pmap.start)
                level = self.predictor.reference(own, local, self.coordinates.symbol, start, grid)
            term = RecordTerm(
                self.model,
                record,
                self.coordinates.symbol,
                local,
                length=interval_length(
                    interval,
                    grid,
                    whole=switches_with_states(self.model),
                    few=bins and grid.uniform and complete(grid, outputs),
                ),
                gain=self.predictor.plan(own, local, level),
                method=method,
                grid=grid,
                cores=cores,
                scale=self._scale,
            )
            records.append(term)
        return records, level

    def _check_loss(self) -> None:
        """Raise for a robust loss beside noise covariances."""
        if self.loss.robust:
            raise EstimationError(
                "a robust loss does not go with noise covariances: outliers would pass for process noise",
                seen="process= and a robust loss",
                allowed='loss="square" with process=',
                cure='take Noise(omega="innovations"), whose gain is free, or mask the outliers',
            )

    def plain_gain(self, record: RecordTerm) -> Any:
        """The gain of a record whose innovations stay in the outputs' units."""
        return self.predictor.plan(self._tails[record.experiment.name], record.symbols[1])

    def _stable(self) -> list[StableLoop]:
        """For an estimated gain, that every record's predictor forgets; once for records that share it."""
        if self.predictor.kind != "innovations":
            return []
        own = {tuple(r.active.tolist()): r for r in reversed(self.records)}
        size, every = len(self.pmap.free), self.predictor.every
        return [StableLoop(record, every, size, alone=len(own) == 1) for record in own.values()]

    # ---- bounds, noise

    def _bounds(self) -> None:
        pmap, problem = self.pmap, self.problem
        self.lower, self.upper = np.full(problem.size, -np.inf), np.full(problem.size, np.inf)
        nv = problem.nv
        self.lower[:nv], self.upper[:nv] = self.coordinates.of(pmap.lower), self.coordinates.of(pmap.upper)
        for lay, record, (low, high, _) in zip(problem.layouts, self.records, self._initial, strict=True):
            self.lower[lay.at : lay.at + lay.n] = low / record.scale
            self.upper[lay.at : lay.at + lay.n] = high / record.scale

    def _weigh(self, sigma: Array) -> None:
        """Weight all residuals by the levels (ny,)."""
        if np.array_equal(sigma, self.sigma):  # what was evaluated still holds
            return
        self.sigma = sigma
        for record in self.records:
            record.set_sigma(sigma)
        self.problem.forget()
        self._fraction: float | None = None

    def levels_at(self, x: Array) -> Array:
        """Noise levels (ny,) from the residuals at x; known ones as they are."""
        return self.levels.at(self.problem.at(x).records, self.sigma, self.loss, self.free_count)

    @property
    def free_count(self) -> int:
        """Number of free parameters and initial states, less the equalities between them."""
        fixed = sum(int((low == high).sum()) for low, high, _ in self._initial)
        fixed += int((self.constraints.lower == self.constraints.upper).sum())
        return self.problem.nv + sum(record.n for record in self.records) - fixed

    # ---- run

    def _warm_values(self, z: Array) -> Array:
        """The free parameters of a warm start as far as it has them, moved into the bounds."""
        known = self.warm.values
        found = [known.get(name, value) for name, value in zip(self.pmap.free, z, strict=True)]
        values = np.array(found, dtype=float)
        return np.clip(np.where(np.isfinite(values), values, z), self.pmap.lower, self.pmap.upper)

    def _start(self, z: Array, *, first: bool) -> Array:
        if first and self._first is not None and np.array_equal(self._first[0], z):
            return self._first[1].copy()
        x = np.zeros(self.problem.size)
        nv = self.problem.nv
        x[:nv] = self.coordinates.of(z)
        for record, lay, bounds in zip(self.records, self.problem.layouts, self._initial, strict=True):
            nodes = self._warm_nodes(record, x[:nv]) if first else None
            if nodes is None:
                nodes = nodes_from_measurement(record, self.pmap.unpack(z, record.experiment.name))
                if isinstance(record.propagator, RungeKuttaPropagator):
                    nodes = fitted_nodes(record, x[:nv], nodes)
            low, high, given = (part / record.scale for part in bounds)
            nodes[0] = np.clip(np.where(np.isfinite(given), given, nodes[0]), low, high)
            x[lay.at : lay.at + nodes.size] = nodes.ravel()
        simulated = self._simulated(x)
        return x if simulated is None or not self._lower(simulated, x) else simulated

    def first_point(self) -> Array:
        """The point (size,) at which a search from the set's own values begins."""
        z = self._warm_values(self.pmap.start) if self.warm is not None else self.pmap.start
        if self._first is None or not np.array_equal(self._first[0], z):
            self._first = (z, self._start(z, first=True))
        return self._first[1]

    def _lower(self, one: Array, other: Array) -> bool:
        """True if the objective is lower at one point than at another, or is none there."""
        before, after = self._objective(other), self._objective(one)
        return bool(after < before or (np.isfinite(after) and not np.isfinite(before)))

    def _simulated(self, x: Array) -> Array | None:
        """The point with the nodes of one run from its first states; None where no nodes change.

        Measured outputs say little of the states of a model without a linear core.
        """
        found, nv = x.copy(), self.problem.nv
        for record, lay in zip(self.records, self.problem.layouts, strict=True):
            if isinstance(record.propagator, RungeKuttaPropagator) and lay.m > 1:
                try:
                    nodes = joined_nodes(record, x[:nv], lay.take(x))
                except FloatingPointError:
                    return None
                found[lay.at : lay.at + nodes.size] = nodes.ravel()
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

    def run(self, z: Array, *, first: bool = True, beside: Begun | None = None) -> Attempt:
        """Search from z : (nz,), in the parameters' units, but for the last steps on all samples after a search in the
        frequency domain; see ``finished``.

        beside : a lower optimum is looked for than this one in the frequency domain
        """
        self.reached = None
        self.solver.forget()
        z = self._warm_values(z) if first and self.warm is not None else z
        given, z = z, self._approached(z) if first else z
        self._weigh(beside.sigma if beside else self.levels.first(self.warm if first else None))
        known = {record.experiment.name for record in self.records} <= set(getattr(self.warm, "initial", ()))
        near = first and known and bool(getattr(self.warm, "converged", False))
        why = "it starts at an optimum" if near else in_full(self)
        self._before, begun = 0, None
        if why is None:
            begun = self.spectral.search(z, steps=self.solver.most, beside=beside)
            if begun is not None and begun.stopped:
                return self._stopped(begun, given)
            if begun is not None:
                found = self._unfinished(begun, given)
                return found if begun.converged else self.finished(found)
            why = _NOWHERE
        return self._in_full(z, given, why, first=first, near=near)

    def _in_full(self, z: Array, given: Array, why: str, *, first: bool, near: bool = False) -> Attempt:
        """Search on all samples from z, which the start that was given led to."""
        self._before = 0
        solution = self._solved(self._checked(self._start(z, first=first), z), exact=near)
        return replace(self._ended(solution, given), searched=f"all samples: {why}")

    def _ended(self, solution: Solution, given: Array) -> Attempt:
        """The attempt that ends at a solution, its noise levels settled."""
        solution, iterations = self._levelled(solution)
        return self._outcome(self._blamed(solution), iterations, given)

    def _stopped(self, begun: Begun, z: Array) -> Attempt:
        """The attempt where the time was over, or the user ended it, in the frequency domain."""
        with lifted():
            solution, searched = self._on_all_samples(begun)
            if solution is None:
                raise TimeUp
            return replace(self._outcome(solution, begun.steps, z), searched=searched, begun=begun)

    def _unfinished(self, begun: Begun, z: Array) -> Attempt:
        """The attempt at an optimum in the frequency domain, at the noise levels there."""
        nothing = np.zeros(0)
        solution = Solution(begun.v, nothing, nothing, "converged", begun.steps, "")
        cost = 2 * begun.found.minimum.squares.cost
        merit = cost + 2 * float(np.log(begun.sigma) @ self.levels.counts)
        return Attempt(solution, begun.v, begun.sigma, cost, merit, begun.steps, z, "", begun, pending=True)

    def finished(self, attempt: Attempt) -> Attempt:
        """An attempt with its last steps on all samples; itself if it has them."""
        if not attempt.pending:
            return attempt
        self._weigh(attempt.sigma)
        solution, searched = self._on_all_samples(attempt.begun)
        if solution is None:
            first = np.array_equal(attempt.start, self._warm_values(self.pmap.start))
            self._weigh(self.levels.first(self.warm if first else None))
            return self._in_full(attempt.start, attempt.start, _NOWHERE, first=first)
        return replace(self._ended(solution, attempt.start), searched=searched, begun=attempt.begun)

    def _checked(self, x: Array, z: Array) -> Array:
        """The point itself, if the model can be evaluated there."""
        if not np.isfinite(self._objective(x)):
            raise EstimationError(
                "the model cannot be evaluated at the start values",
                seen=", ".join(f"{n}={value:.6g}" for n, value in zip(self.pmap.free, z, strict=True)),
                allowed="values for which the equations give finite numbers",
                cure="change the start values or the bounds",
            )
        check_growth(self.records, self.problem.at(x).records)
        check_slopes(self.records, self.problem.at(x))
        return x

    @property
    def spectral(self) -> SpectralStarts:
        """The search in the frequency domain; set up once it is wanted."""
        if self._spectral is None:
            self._spectral = SpectralStarts(self)
        return self._spectral

    def _on_all_samples(self, begun: Begun | None) -> tuple[Solution | None, str]:
        """The solution from an optimum in the frequency domain, and what was searched on; None where it led nowhere."""
        x = None if begun is None else self.spectral.variables(begun)
        self._spectral = None  # its spectra are as large as the data, and of no use to what follows
        if begun is None or x is None:
            return None, ""
        words, nv = str(begun.found), self.problem.nv
        ended = Solution(x, np.zeros(self.problem.rows), np.zeros(self.problem.size), "", begun.steps, "")
        if begun.stopped:
            return replace(ended, status="interrupted"), words
        if not begun.converged:
            return replace(ended, status=OUT_OF_ITERATIONS), words
        self._before = begun.steps
        solution = self._solved(x, exact=True)
        if solution.status not in ("converged", "interrupted"):
            return None, ""
        moved = solution.x[:nv] - begun.v
        far = float(np.sqrt(np.maximum(moved @ begun.found.information @ moved, 0.0)))
        words += f"; all samples moved the estimates by {far:.1g} standard errors"
        return replace(solution, iterations=begun.steps + solution.iterations), words

    def _solved(self, x: Array, *, exact: bool) -> Solution:
        """The solution from ``x``; from the simulation at the start instead where that explains the data better."""
        solution = self.solver.solve(x, self.lower, self.upper, exact=exact)
        simulated = None if solution.status == "interrupted" else self._simulated(x)
        if simulated is None or not self._lower(simulated, solution.x):
            return solution
        other = self.solver.solve(simulated, self.lower, self.upper)
        better = other.status == "converged" and self._lower(other.x, solution.x)
        best = other if better or solution.status != "converged" else solution
        return replace(best, iterations=solution.iterations + other.iterations)

    def _levelled(self, solution: Solution) -> tuple[Solution, int]:
        """The solution with the noise levels settled, and the iterations that it took in all."""
        iterations = solution.iterations
        for _ in range(_ROUNDS if self.settles else 0):
            if solution.status != "converged":
                break
            if self.solver.best is not None:
                self.reached = self.solver.best[0], solution.x, self.sigma
            weights = self.levels.weights(self.levels_at(solution.x))
            change = np.abs(weights / self.sigma - 1).max()
            self._weigh(weights)
            if change < _LEVEL:
                break
            solution = self.solver.solve(solution.x, self.lower, self.upper, exact=True)
            iterations += solution.iterations
        return solution, iterations

    def integrated(self, attempt: Attempt) -> Attempt:
        """The attempt with steps of the integration so short that they do not move the estimates."""
        for _ in range(_SHORTENED):
            if attempt.solution.status != "converged":
                break
            x = attempt.solution.x
            self._weigh(attempt.sigma)
            try:
                nodes = [lay.take(x) for lay in self.problem.layouts]
                if not shorten_steps(self.records, x[: self.problem.nv], nodes):
                    break
                self.problem.forget()
                solution = self.solver.solve(x, self.lower, self.upper, exact=True)
                solution, more = self._levelled(solution)
                found = self._outcome(self._blamed(solution), attempt.iterations + more, attempt.start)
            except (FloatingPointError, np.linalg.LinAlgError, TimeUp):
                break
            attempt = replace(found, searched=attempt.searched, begun=attempt.begun)
        return self._in_one_run(attempt)

    def _in_one_run(self, attempt: Attempt) -> Attempt:
        """The attempt, solved again from its own simulation where that is told from its intervals: between corners a
        small gap grows. One whose simulation stays another has no ``run``."""
        if attempt.solution.status != "converged" or all(record.linear for record in self.records):
            return attempt
        self._weigh(attempt.sigma)
        try:
            for last in (False, True):
                x = attempt.solution.x
                run = self._chained(x)
                costs = [2 * self.problem.samples * self._objective(point) for point in (run, x)]
                if alike(*costs):
                    return attempt
                if last or not math.isfinite(costs[0]):
                    break
                solution, more = self._levelled(self.solver.solve(run, self.lower, self.upper, exact=True))
                again = self._outcome(self._blamed(solution), attempt.iterations + more, attempt.start)
                if again.solution.status != "converged":
                    break
                attempt = replace(again, searched=attempt.searched, begun=attempt.begun)
        except (FloatingPointError, np.linalg.LinAlgError, TimeUp):
            pass
        return replace(attempt, run=False)

    def _chained(self, x: Array) -> Array:
        """The point with the nodes of one run from its first states."""
        found, nv = x.copy(), self.problem.nv
        for record, lay in zip(self.records, self.problem.layouts, strict=True):
            nodes = joined_nodes(record, x[:nv], lay.take(x))
            found[lay.at : lay.at + nodes.size] = nodes.ravel()
        return found

    def _blamed(self, solution: Solution) -> Solution:
        """The solution with a status that names the constraints no values meet, if they are why there is no optimum."""
        nv, v = self.problem.nv, solution.x[: self.problem.nv]
        if not solution.status.startswith("not converged") or not self.constraints.violated(v):
            return solution
        starts = [v, *(self.coordinates.of(z) for z in self.drawn(_TRIED, 0))]
        found = unreachable(self.constraints, starts, self.lower[:nv], self.upper[:nv])
        if not found:
            return solution
        return replace(solution, status=f"not converged: no values within the bounds meet {'; '.join(found)}")

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

    @property
    def settles(self) -> bool:
        """True if the estimate depends on noise levels that are themselves estimated."""
        estimated = self.levels.estimated
        alone = len(estimated) == 1 and not self.problem.priors.count and not self.loss.robust
        return any(estimated) and not alone

    def _outcome(self, solution: Solution, iterations: int, z: Array) -> Attempt:
        """The attempt with its noise levels; multipliers are those of the objective at these levels."""
        x = solution.x
        before = self._objective(x)
        if any(self.levels.estimated) and np.isfinite(before):
            self.reached = before, x, self.sigma
            self.solver.forget()  # its objective is at these levels
            self._weigh(self.levels_at(x))
        objective = self._objective(x)
        scale = objective / before if before > 0 else 1.0
        solution = replace(solution, lam_g=solution.lam_g * scale, lam_x=solution.lam_x * scale)
        return self.attempt(solution, objective, self.sigma.copy(), iterations, z)

    def attempt(
        self, solution: Solution, objective: float, sigma: Array, iterations: int, z: Array
    ) -> Attempt:
        """The outcome of a start z with this objective at the levels (ny,)."""
        cost = 2 * self.problem.samples * objective
        merit = cost + 2 * float(np.log(sigma) @ self.levels.counts)
        return Attempt(solution, solution.x[: self.problem.nv], sigma, cost, merit, iterations, z)

    def cost_of(self, attempt: Attempt, sigma: Array) -> float:
        """The cost of an attempt at other noise levels (ny,)."""
        if (
            attempt.pending
        ):  # without the nodes that all samples ask for: at its own levels likelihoods compare
            return attempt.merit - 2 * float(np.log(sigma) @ self.levels.counts)
        if attempt.cut:
            return attempt.cost
        self._weigh(sigma)
        return 2 * self.problem.samples * self._objective(attempt.solution.x)

    def _objective(self, x: Array) -> float:
        try:
            return self.problem.at(x).objective
        except (FloatingPointError, np.linalg.LinAlgError):
            return float("nan")

    def _report(self, iteration: int, objective: float) -> bool:
        if self._progress is None or (
            self._before and not iteration
        ):  # the point that it begins at was shown
            return False
        iteration += self._before
        chi2 = 2 * objective
        if self._fraction is None:
            self._fraction = self.levels.variation()
        fit_percent = 100 * (1 - np.sqrt(max(chi2, 0.0) / self._fraction))
        return bool(self._progress(iteration, chi2 * self.problem.samples, float(fit_percent)))

    def watch(self, iteration: int, objective: float) -> bool:
        """Show a point of a search that is not the solver's; True if the user ends it."""
        self._before = 0
        return self._report(iteration, objective) or self._interrupts.stopped or late()

    def tell(self, attempt: Attempt) -> None:
        """Report a search that another process has finished; what the progress asks for comes too late."""
        self._report(0, attempt.cost / (2 * self.problem.samples))

    def mute(self) -> None:
        """Show nothing of the searches to come."""
        self._progress = None

    def close(self) -> None:
        """End the progress display."""
        if hasattr(self._progress, "close"):
            self._progress.close()  # type: ignore[union-attr]


def _checked_warm(warm: Any) -> Any:
    if warm is None or isinstance(getattr(warm, "values", None), Mapping):
        return warm
    raise EstimationError(
        "warm is not a result to start from",
        seen=repr(warm),
        allowed="a Fit, or a result loaded from a file",
        cure="give the fit itself: warm=fit",
    )
