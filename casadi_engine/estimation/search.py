"""The search for an optimum: the problem set up once, run from any start, noise levels settled on the way."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import TimeUp, late, lifted
from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.estimation.first_points import FirstPoints
from casadi_engine.estimation.followed import FOLLOWED
from casadi_engine.estimation.growth import length_for
from casadi_engine.estimation.integration import alike, shorten_steps
from casadi_engine.estimation.ipopt import ONE_STEP, OUT_OF_ITERATIONS, WALL, Solution, Solver
from casadi_engine.estimation.scales import felt_scale, state_factors
from casadi_engine.estimation.spectral_start import HELD, Begun, SpectralStarts, in_full
from casadi_engine.estimation.states_first import states_first
from casadi_engine.estimation.unreachable import unreachable
from casadi_engine.simulation.propagator import fineness_of

Array = NDArray[np.float64]

# Noise levels that are estimated beside priors, several outputs or a robust loss are settled by repeated fits.
_ROUNDS, _LEVEL = 12, 1e-6
# Rounds of shorter integration steps, each with a refit that begins at the optimum.
_SHORTENED = 6
# Iterations from which on a search that did not end was not told to take few.
_ENDLESS = 100
_NOWHERE = "the frequency domain led nowhere"
# Walls that a search is led along, and how near one is, as a share of a state's scale or size.
_WALLS, _BESIDE = 6, 1e-2
# Share of a state's scale or size within which it rests at a bound.
AT_WALL = 1e-3
# Gaps between intervals, in scales of the states, at which a point is one run of each record.
_GAPS = 1e-8
# Points from which values that meet all constraints are looked for, where a search has ended without.
_TRIED = 5


@dataclass
class Attempt:
    """The outcome of one start.

    v : (nv,) coordinates of the parameters; sigma : (ny,) noise levels found; cost : chi-squared + priors at these;
    merit : what starts are compared by, -2 log likelihood but for a constant; start : (nz,) parameters at the start
    searched : what was searched on, in words; begun : where the search in the frequency domain ended, if there was one;
    pending : it has yet to look at all samples; cut : it was ended before its end (see ``cut_short``), and its cost is
    at the levels that it had then; run : no simulation from its first states is known to be another; steps : of the
    integration of each record, at which it was solved
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
    steps: tuple[Any, ...] = ()


def is_near(warm: Any) -> bool:
    """True for a fit that is an optimum, or a step short of one."""
    return bool(getattr(warm, "converged", False)) or ONE_STEP in getattr(warm, "status", "")


class Search(FirstPoints):
    """A fit's problem and solver."""

    solver: Solver

    def __init__(
        self,
        *arguments: Any,
        max_iterations: int,
        tolerance: float,
        progress: Callable[[int, float, float], Any] | None,
        **laid: Any,
    ) -> None:
        """Sets the problem up; the other arguments are those of ``FirstPoints``."""
        self._progress, self.quiet = progress, False  # quiet : show nothing of what is searched now
        self._spectral: SpectralStarts | None = None  # set up once it is wanted
        # entries of first states at the edge of where the model has a value: to which side, and the bound before
        self.walls: dict[int, tuple[float, float]] = {}
        self._before = 0  # iterations in the frequency domain, before those on all samples
        # objective, point (size,) and levels (ny,) of the last solution of a run
        self.reached: tuple[float, Array, Array] | None = None
        super().__init__(*arguments, **laid)
        self._scaled()
        self.solver = Solver(
            self.problem,
            self.coordinates.log,
            max_iterations=max_iterations,
            tolerance=tolerance,
            progress=self._report,
            interrupts=self._interrupts,
        )

    def _scaled(self) -> None:
        """Lay the problem out again where the start says nothing of the scales of parameters or states."""
        z = self._warm_values(self.pmap.start)
        if self.warm is None and in_full(self) is None:
            felt, larger = self.spectral.sizes(z)
        else:
            x = self.first_point()
            felt = felt_scale(self.problem, self.coordinates, z, x)
            larger = state_factors(self.problem, x) if self.predictor.kind == "none" else None
        if felt is not None or larger is not None:
            self._first = self._spectral = None
            self._lay(self.noise, Coordinates(self.pmap, felt), larger)
            self._weigh(self.levels.first(self.warm))

    def run(self, z: Array, *, first: bool = True, beside: Begun | None = None) -> Attempt:
        """Search from z : (nz,), in the parameters' units, but for the last steps on all samples after a search in the
        frequency domain; see ``finished``.

        beside : a lower optimum is looked for than this one in the frequency domain
        """
        self.reached = None
        self.solver.forget()
        z = self._warm_values(z) if first else z
        given, z = z, self._approached(z) if first else z
        self._weigh(beside.sigma if beside else self.levels.first(self.warm if first else None))
        known = {record.experiment.name for record in self.records} <= set(getattr(self.warm, "initial", ()))
        near = first and known and is_near(self.warm)
        why = "it starts at an optimum" if near else in_full(self)
        self._before, begun = 0, None
        if why is None:
            begun = self.spectral.search(z, steps=self.solver.most, beside=beside)
            if begun is not None and begun.stopped:
                return self._stopped(begun, given)
            if begun is not None and not self.constraints.violated(begun.v):
                found = self._unfinished(begun, given)
                return found if begun.converged else self.finished(found)
            why = _NOWHERE if begun is None else HELD
        return self._in_full(z, given, why, first=first, near=near)

    def _in_full(self, z: Array, given: Array, why: str, *, first: bool, near: bool = False) -> Attempt:
        """Search on all samples from z, which the start that was given led to."""
        self._before = 0
        x = self._start(z, first=first)
        if not np.isfinite(self._objective(x)) and self._in_places():
            self._first = None
            x = self._start(z, first=first)
        x = states_first(self, self._checked(x, z))
        if not near:
            x, near = self._rounded(x, z)
        solution = self._solved(x, exact=near)
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
        solution = self._descended(x, exact=exact)
        if solution.status == "interrupted":
            return solution
        simulated = self._simulated(x, resting=self._followed(solution.x) < FOLLOWED)
        if simulated is None and exact and self.problem.at(x).gap < _GAPS:  # it is a simulation itself
            simulated = x
        if simulated is None or not self._lower(simulated, solution.x):
            return solution
        other = self._descended(simulated)
        # an optimum above what the search began at, or came by, is none to end at
        best = other if self._lower(other.x, solution.x) or solution.status != "converged" else solution
        return replace(best, iterations=solution.iterations + other.iterations)

    def _descended(self, x: Array, *, exact: bool = False) -> Solution:
        """The solver's solution from ``x``; where it came upon laws too stiff for the steps that there are, it goes on
        with others."""
        solution = self.solver.solve(x, self.lower, self.upper, exact=exact)
        for _ in range(_WALLS):
            if solution.status == "interrupted":
                break
            if solution.status == "converged":
                again = self._freed(solution.x)
            else:
                again = solution.status.endswith(WALL) and self._bounded_by_walls(solution.x)
                again = again or self._in_places()
            if not again:
                break
            other = self.solver.solve(solution.x, self.lower, self.upper, exact=exact)
            if not np.isfinite(self._objective(other.x)):
                break
            solution = replace(other, iterations=solution.iterations + other.iterations)
        if solution.status == "converged" and self._freed(solution.x):  # it rests on what is no edge
            return replace(solution, status=f"not converged: {WALL}")
        return solution

    def _bounded_by_walls(self, x: Array) -> bool:
        """Make bounds of first states beside which the model has no value; True if there are any such."""
        before = len(self.walls)
        for lay in self.problem.layouts:
            for k in range(lay.at, lay.at + lay.n):
                for side, bound in ((-1.0, self.lower), (1.0, self.upper)):
                    if k not in self.walls and self.lower[k] < self.upper[k] and self._beyond(x, k, side):
                        self.walls[k] = side, float(bound[k])
                        bound[k] = x[k]
        return len(self.walls) > before

    def _beyond(self, x: Array, k: int, side: float) -> bool:
        """True if the model has no value a little to this side of one entry."""
        there = x.copy()
        there[k] += side * _BESIDE * max(1.0, abs(x[k]))
        return not np.isfinite(self._objective(there))

    def _freed(self, x: Array) -> bool:
        """Take away bounds at which first states rest where the model has a value beyond after all, as another state
        has moved; True if there were any."""
        found = [
            k
            for k, (side, _) in self.walls.items()
            if abs(x[k] - (self.lower if side < 0 else self.upper)[k]) < AT_WALL * max(1.0, abs(x[k]))
            and not self._beyond(x, k, side)
        ]
        for k in found:
            side, bound = self.walls.pop(k)
            (self.lower if side < 0 else self.upper)[k] = bound
        return bool(found)

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
            solution = self._descended(solution.x, exact=True)
            iterations += solution.iterations
        return solution, iterations

    def integrated(self, attempt: Attempt) -> Attempt:
        """The attempt with steps of the integration so short that they do not move the estimates."""
        for _ in range(_SHORTENED):
            status = attempt.solution.status
            # beside corners that coarse steps cut there is no slope to end by
            if status != "converged" and not (status == OUT_OF_ITERATIONS and attempt.iterations >= _ENDLESS):
                break
            x = attempt.solution.x
            self._weigh(attempt.sigma)
            try:
                nodes = [lay.take(x) for lay in self.problem.layouts]
                misfit = attempt.cost / max(self.problem.samples, 1)
                # another start may have asked for shorter ones since
                same = attempt.steps == self._steps()
                if not shorten_steps(self.records, x[: self.problem.nv], nodes, misfit) and same:
                    break
                self.problem.forget()
                solution = self._descended(x, exact=True)
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
                if self.too_long(x) is not None:
                    return attempt  # no run is: the intervals, joined to rounding, are the motion
                if last or not math.isfinite(costs[0]):
                    break
                solution, more = self._levelled(self._descended(run, exact=True))
                again = self._outcome(self._blamed(solution), attempt.iterations + more, attempt.start)
                if again.solution.status != "converged":
                    break
                attempt = replace(again, searched=attempt.searched, begun=attempt.begun)
        except (FloatingPointError, np.linalg.LinAlgError, TimeUp):
            pass
        return replace(attempt, run=False)

    def too_long(self, x: Array) -> float | None:
        """The length [s] of records over which a gap between intervals that is rounding stays small, where it grows to
        more than can be left in one of them; None where it does in none."""
        points = self.problem.at(x).records
        found = [length_for(record, point) for record, point in zip(self.records, points, strict=True)]
        return min((one for one in found if one is not None), default=None)

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
        return Attempt(
            solution, solution.x[: self.problem.nv], sigma, cost, merit, iterations, z, steps=self._steps()
        )

    def _steps(self) -> tuple[Any, ...]:
        """How finely each record is integrated now."""
        return tuple(fineness_of(record.propagator) for record in self.records)

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

    def _report(self, iteration: int, objective: float) -> bool:
        shown = self._before and not iteration  # the point that it begins at
        if self._progress is None or self.quiet or shown:
            return False
        iteration += self._before
        chi2 = 2 * objective
        return bool(self._progress(iteration, chi2 * self.problem.samples, self._share(chi2)))

    def _share(self, chi2: float) -> float:
        """Per cent of the outputs' motion that is followed at a chi-squared per sample."""
        if self._fraction is None:
            self._fraction = self.levels.variation()
        return float(100 * (1 - np.sqrt(max(chi2, 0.0) / self._fraction)))

    def _followed(self, x: Array) -> float:
        """Per cent of the outputs' motion that a point (size,) follows."""
        objective = self._objective(x)
        return self._share(2 * objective) if np.isfinite(objective) else -math.inf

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
