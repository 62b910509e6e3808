"""IPOPT through ``nlpsol`` with supplied derivatives: damped Gauss-Newton first, then the exact Hessian.

Gauss-Newton alone is not contractive where the residual is large against weak directions; the exact Hessian far from
the solution leads to other optima. The switch is made in one run, when the objective has settled. To both a share of
the Gauss-Newton diagonal is added (Levenberg 1944), which falls with every full step and grows where the line search
has to shorten steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import TimeUp, late
from casadi_engine.estimation.interrupts import Interrupts
from casadi_engine.estimation.nlp_functions import Supplied, Tried, functions, shapes
from casadi_engine.estimation.shooting import ShootingProblem

Array = NDArray[np.float64]
Progress = Callable[[int, float], bool]

# Share of the Gauss-Newton diagonal that is added at first. It changes by _EASE after a full step, by _HINDER after a
# step that was halved more than once. Below _LEAST it is nothing to the exact Hessian, whose steps then converge
# quadratically.
_DAMPING, _EASE, _HINDER, _LEAST = 0.03, 0.3, 10.0, 1e-4
# Relative change of the objective that counts as settled, largest gap with it, and the iterations that suffice.
_SETTLED, _GAP, _LONG = 1e-4, 1e-2, 25

# A valley is flat, and its points explain the data alike, if so many iterations with the exact Hessian lower
# chi-squared by less than this, a tenth of what a standard error changes it by, with gaps no larger than that.
_VALLEY, _FLAT, _CLOSED = 8, 0.1, 1e-6
# A search that begins at an optimum is there after a full step with the exact Hessian that lowers chi-squared by less
# than this, a hundredth of a standard error, with gaps no larger than that: what is left is of second order in it. At
# a bound, which IPOPT comes to by and by, it is not.
_UNSEEN, _JOINED, _INSIDE = 1e-4, 1e-8, 1e-6

# Share of the range between two bounds by which a start near by is kept from them.
_PUSH = 1e-12
# Roundings of a bound that a distance from it has to be.
_APART = 4.0

# Options of IPOPT that every fit has.
_OPTIONS = {
    "print_level": 0,
    "sb": "yes",
    "mu_init": 1e-8,
    # A second-order correction closes the gaps at the cost of the objective; where the parameters are still wrong, open
    # gaps are what keeps the search out of the valleys of a simulation.
    "max_soc": 0,
    "dual_inf_tol": 1.0,
    "constr_viol_tol": 1e-8,
    # Where the data say much, rounding keeps the gradient above the tolerance: then the objective stands
    # still to its last digits.
    "acceptable_iter": 2,
    "acceptable_tol": 1e-5,
    "acceptable_obj_change_tol": 1e-13,
    "acceptable_constr_viol_tol": 1e-8,
    "acceptable_compl_inf_tol": 1.01e-8,  # that of the barrier that a search begins with, rounded or not
    "acceptable_dual_inf_tol": 1.0,
    "tiny_step_tol": 0.0,  # such steps are judged by that, too
    "bound_relax_factor": 0.0,
    "nlp_scaling_method": "none",
}

# Options by which IPOPT starts at an optimum found before: it stays there, and finds the multipliers itself.
_NEAR = {
    "mu_init": 1e-11,
    "bound_push": _PUSH,
    "bound_frac": _PUSH,
    "bound_mult_init_method": "mu-based",
}

WALL = "the model could not be evaluated at most of the points tried"

_WORDS = {
    "Infeasible_Problem_Detected": "the constraints cannot be met together",
    "Maximum_Iterations_Exceeded": "the iterations ran out; allow more with max_iterations",
    "Restoration_Failed": "no step reduces the violation of the constraints",
    "Diverging_Iterates": "the iterates run away; give bounds to the free parameters",
    "Search_Direction_Becomes_Too_Small": "the steps became too small",
    "Error_In_Step_Computation": "no step can be computed; the slopes are too steep, as those of a root near 0",
    "Invalid_Number_Detected": "the model gave a number that is not finite",
    "NonIpopt_Exception_Thrown": "the model could not be evaluated",
}

# Reasons that tell of the way to an optimum, not of the data: another way may lead there.
BLOCKED = (
    WALL,
    _WORDS["Invalid_Number_Detected"],
    _WORDS["Error_In_Step_Computation"],
    _WORDS["Search_Direction_Becomes_Too_Small"],
)

# How the reason begins why a point is no optimum that is a step short of one.
ONE_STEP = "one more step"
OUT_OF_ITERATIONS = f"not converged: {_WORDS['Maximum_Iterations_Exceeded']}"


@dataclass
class Solution:
    """status : "converged", "interrupted" or "not converged: ..."; x : (size,), iterations done, multipliers."""

    x: Array
    lam_g: Array
    lam_x: Array
    status: str
    iterations: int
    words: str


class Solver:
    """nlpsol set up once for a problem, to be run from several starts; log : (nv,) parameters that are logarithms."""

    def __init__(
        self,
        problem: ShootingProblem,
        log: NDArray[np.bool_],
        *,
        max_iterations: int = 200,
        tolerance: float = 1e-9,
        progress: Progress | None = None,
        interrupts: Interrupts | None = None,
    ) -> None:
        self.problem, self._progress = problem, progress
        self._interrupts = interrupts or Interrupts()
        self._interrupted = False
        self._history: list[float] = []
        self._best: tuple[float, Array] | None = None
        # evaluations up to the last iteration, iterations with the exact Hessian
        self._before, self._bent, self._flat, self._near = 0, 0, False, False
        self._stop: Callable[[float, float], bool] | None = None
        # The solver holds no reference of its own to Python callbacks.
        self._tried = Tried(np.zeros(problem.size))
        self._kept = [*functions(problem, self._tried, log), self._watcher()]
        self._ipopt = {**_OPTIONS, "max_iter": max_iterations, "tol": tolerance}
        self.most = max_iterations
        self._made: dict[bool, Any] = {}

    def _solver(self, near: bool) -> Any:
        """nlpsol for any start, or for one near an optimum; made when first wanted."""
        if near not in self._made:
            options: dict[str, Any] = {
                "grad_f": self._kept[1],
                "jac_g": self._kept[2],
                "hess_lag": self._kept[3],
                "iteration_callback": self._kept[4],
                "no_nlp_grad": True,
                "calc_lam_p": False,
                "print_time": False,
                "error_on_fail": False,
                "show_eval_warnings": False,
                "ipopt": {**self._ipopt, **(_NEAR if near else {})},
            }
            self._made[near] = ca.nlpsol("fit", "ipopt", self._kept[0], options)
        return self._made[near]

    def _watcher(self) -> Supplied:
        """Called once an iteration: shows progress, keeps the best point, chooses the Hessian, stops on Ctrl-C."""
        x, g, none, one = shapes(self.problem)
        inputs = {"x": x, "f": one, "g": g, "lam_x": x, "lam_g": g, "lam_p": none}

        def watch(value: Any, cost: Any, constraints: Any, *_: Any) -> Any:
            gap = float(np.abs(np.asarray(constraints)[self.problem.user.count :]).max(initial=0.0))
            self._last = np.array(value, dtype=float).ravel()
            stop = self._seen(self._last, float(cost), gap) or self._in_valley(gap) or self._at_end(gap)
            self._steer(gap)
            if self._stop is not None:
                self.problem.exact = False
                stop = self._stop(float(cost), gap) or stop
            return [1.0 if stop else 0.0]

        return Supplied("watch", inputs, {"ret": one}, watch)

    def _seen(self, x: Array, cost: float, gap: float) -> bool:
        """Note a point of the search and show it; True to stop."""
        self._history.append(cost)
        if gap < 1e-3 and (self._best is None or cost < self._best[0]):
            self._best = (cost, x)
        self._tried.late = self._tried.late or late()
        stop = self._interrupted = self._interrupted or self._interrupts.stopped
        stop = stop or self._tried.late
        if self._progress is not None and self._progress(len(self._history) - 1, cost):
            self._interrupted = stop = True
        return stop

    def _in_valley(self, gap: float) -> bool:
        """True if the search has come to a flat valley; constraints on parameters may still be open there."""
        self._bent += self.problem.exact
        if self._bent > _VALLEY and gap < _CLOSED and not self.problem.user.count:
            fall = min(self._history[:-_VALLEY]) - min(self._history[-_VALLEY:])
            self._flat = 2 * self.problem.samples * fall < _FLAT
        return self._flat

    def _at_end(self, gap: float) -> bool:
        """True if the search began at an optimum and its last step moved nothing that can be seen."""
        problem = self.problem
        if self._near and problem.exact and not problem.damping and len(self._history) > 1 and gap < _JOINED:
            change = abs(self._history[-2] - self._history[-1])
            full = problem.evaluations <= self._before + 1
            inside = np.minimum(self._last - self._bounds[0], self._bounds[1] - self._last).min() > _INSIDE
            seen = 2 * problem.samples * change >= _UNSEEN
            self._flat = self._flat or bool(full and inside and not seen)
        return self._flat

    def _steer(self, gap: float) -> None:
        """Choose the next Hessian after an iteration."""
        problem = self.problem
        tried, self._before = problem.evaluations - self._before, problem.evaluations
        if len(self._history) > 1:
            if tried <= 1:
                problem.damping *= _EASE
            elif tried > 2:
                problem.damping = max(_HINDER * problem.damping, _LEAST)
        problem.exact = problem.exact or self._settled(gap)
        if problem.exact and problem.damping < _LEAST:
            problem.damping = 0.0

    def _settled(self, gap: float) -> bool:
        if len(self._history) < 3 or len(self._history) > _LONG:
            return len(self._history) > _LONG
        change = abs(self._history[-2] - self._history[-1])
        return gap < _GAP and change < _SETTLED * abs(self._history[-1])

    def solve(self, start: Array, lower: Array, upper: Array, *, exact: bool = False) -> Solution:
        """Run from ``start`` (size,) within bounds (size,); ``exact`` where the start is near an optimum.

        Raises TimeUp once the time is over; ``best`` is what there is then.
        """
        return self._run(start, lower, upper, exact, 0.0 if exact else _DAMPING)

    def forget(self) -> None:
        """Drop the best iteration."""
        self._history, self._best = [], None

    @property
    def iterations(self) -> int:
        """Iterations of the last run."""
        return max(len(self._history) - 1, 0)

    @property
    def best(self) -> tuple[float, Array] | None:
        """Objective and point (size,) of the best iteration of the last run whose intervals nearly join."""
        return self._best

    @property
    def last(self) -> tuple[float, Array] | None:
        """Objective and point (size,) of the last iteration of the last run, whatever its gaps."""
        return (self._history[-1], self._last) if self._history else None

    def gauss_newton(
        self,
        start: Array,
        lower: Array,
        upper: Array,
        *,
        damping: float,
        stop: Callable[[float, float], bool],
    ) -> Array:
        """The point (size,) after Gauss-Newton steps; ``stop`` sees objective and gap of each, True ends the run."""
        self._stop = stop
        try:
            self._run(start, lower, upper, True, damping)
        finally:
            self._stop = None
        return self._last

    def _run(self, start: Array, lower: Array, upper: Array, near: bool, damping: float) -> Solution:
        problem = self.problem
        problem.exact, problem.damping, self._bounds = near and self._stop is None, damping, (lower, upper)
        self._history, self._best, self._interrupted = [], None, False
        self._last = self._tried.last = start
        self._tried.points, self._tried.refused, self._tried.late = 0, 0, False
        self._before, self._bent, self._flat, self._near = problem.evaluations, 0, False, near
        joints = problem.rows - problem.user.count
        low = np.concatenate([problem.user.lower, np.zeros(joints)])
        high = np.concatenate([problem.user.upper, np.zeros(joints)])
        crowded = _crowded(problem.user.lower, problem.user.upper) or _crowded(lower, upper)
        solver = self._solver(near and not crowded)
        answer = solver(x0=start, lbx=lower, ubx=upper, lbg=low, ubg=high)
        for function in self._kept:
            if function.failure is not None:
                failure, function.failure = function.failure, None
                raise failure
        if self._tried.late:
            raise TimeUp
        stats = solver.stats()
        words = str(stats["return_status"])
        x = np.asarray(answer["x"], dtype=float).ravel()
        if self._interrupted:
            status = "interrupted"
            x = self._best[1] if self._best is not None else x
        elif stats["success"] or self._flat:
            status = "converged"
        elif self._tried.wall:
            status = f"not converged: {WALL}"
        else:
            status = f"not converged: {_WORDS.get(words, words.replace('_', ' ').lower())}"
        lam_g, lam_x = (np.asarray(answer[key], dtype=float).ravel() for key in ("lam_g", "lam_x"))
        return Solution(x, lam_g, lam_x, status, self.iterations, words)


def _crowded(low: Array, high: Array) -> bool:
    """True where a start near by would be kept from two bounds by no more than rounding: with a distance of 0 to one
    of them the solver crashes (Ipopt 3.14.19)."""
    finite = np.isfinite(low) & np.isfinite(high) & (low < high)
    size = np.maximum(1.0, np.maximum(np.abs(low[finite]), np.abs(high[finite])))
    return bool((_PUSH * (high - low)[finite] < _APART * np.finfo(float).eps * size).any())
