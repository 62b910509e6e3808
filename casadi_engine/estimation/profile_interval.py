"""Intervals by profile likelihood on the problem that a search has set up: each end by a few refits.

A parameter is held beside its estimate, all others and the initial states are searched again from where the quadratic
has them, and the place is sought where chi-squared has risen by the threshold. ``ce.profile`` draws the whole course.
"""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import Deadline, TimeUp, ask
from casadi_engine.distributions import chi2_isf, f_isf
from casadi_engine.errors import ModelError
from casadi_engine.estimation.few_samples import freedom_of
from casadi_engine.estimation.limited_ends import Limits
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.standard_errors import Uncertainty
from casadi_engine.estimation.starts import chained_nodes

Array = NDArray[np.float64]

LEVEL = 0.95
# Refits on one side; the share of the root of the threshold within which an end counts as found; and how much further
# than the quadratic has it an end is looked for.
_MOST, _CLOSE, _FAR = 12, 0.03, 4.0
# Share of half an interval between two places around its end that tell it.
_BRACKET = 0.2
# Errors of a logarithm from which no ends are looked for: a factor of a million.
_ENDLESS = 14.0
# Evaluations of the problem that a refit takes at least.
_EVALUATIONS = 4
# A refit that is this much below the optimum has found another one.
_LOWER = 1e-2


class LowerOptimumError(Exception):
    """A refit ended below the optimum of the fit, at ``x`` (size,)."""

    def __init__(self, x: Array) -> None:
        super().__init__()
        self.x = x


def root_of(search: Search, errors: Uncertainty) -> float:
    """Standard errors to either side that a 95 % interval goes, by Student's t where a noise level is estimated."""
    freedom = freedom_of(search, errors)
    estimated = any(search.levels.estimated) and freedom > 0
    return float(np.sqrt(f_isf(1 - LEVEL, 1, freedom) if estimated else chi2_isf(1 - LEVEL, 1)))


class Profiles:
    """Intervals of the free parameters around an optimum.

    seconds : of processor time that may be spent; stretch : (nv,) by how much the errors of the parameters are larger
    than the likelihood says, so that chi-squared may rise by as much more
    """

    def __init__(
        self, search: Search, best: Attempt, errors: Uncertainty, *, seconds: float, stretch: Array
    ) -> None:
        self.search, self.best, self.errors = search, best, errors
        search.mute()
        search.problem.forget()
        begun = time.process_time()
        self.base = self._cost(best.solution.x)
        self._least = _EVALUATIONS * (time.process_time() - begun)
        self.root, self.limits = root_of(search, errors), Limits.of(search, errors)
        self.stretch = stretch
        self.seconds, self._spent, self._done = seconds, 0.0, 0
        self._left, self._ended = 0, 0  # sides of a parameter that are to be found, and of all that were

    def intervals(self, names: list[str]) -> dict[str, tuple[float, float]]:
        """Name -> ends in the parameter's unit, bounds where there are none within; without those that were not found.

        What effects bring comes first; no further ones are looked for once the next would take too long.
        Raises LowerOptimumError.
        """
        found: dict[str, tuple[float, float]] = {}
        for name in sorted(names, key=lambda name: "." not in name):
            k = self.search.pmap.free.index(name)
            ends = []
            for self._left in (2, 1):
                if self._late():
                    return found
                end = self._end(k, -1.0 if self._left == 2 else 1.0)
                if end is None:
                    break
                ends.append(self.value(k, end))
                self._ended += 1
            if len(ends) == 2:
                found[name] = (ends[0], ends[1])
        return found

    def _late(self) -> bool:
        """True if the sides of a parameter that are left would take too long: as many refits each as those so far, or
        three, and as long ones."""
        each = self._spent / self._done if self._done else self._least
        refits = self._done / (self._ended + 1) if self._ended else 3.0
        return self._spent + self._left * refits * each > self.seconds

    def _end(self, k: int, sign: float) -> float | None:
        """Where the profile of entry k reaches the threshold on one side, or its bound; None where it does not."""
        errors, search = self.errors, self.search
        size, root = float(np.sqrt(errors.covariance.matrix[k, k])), self.root * float(self.stretch[k])
        limit = float(search.lower[k] if sign < 0 else search.upper[k])
        x, here, height, inner = self.best.solution.x, float(errors.v[k]), 0.0, float(errors.v[k])
        there = here + sign * size * self.limits.end(k, sign, root)[0]
        if search.coordinates.log[k] and root * size > _ENDLESS:
            return None  # the data do not determine it
        outer: tuple[float, float] | None = None
        width = np.inf
        for _ in range(_MOST):
            there = min(there, limit) if sign > 0 else max(there, limit)
            refit = self._refit(k, there, x)
            if self._late() or (refit is None and not search.constraints.count):
                return None
            if refit is None:  # no values of the others may meet the constraints there
                outer = (there, np.inf)
                there = 0.5 * (inner + there)
                continue
            risen = float(np.sqrt(refit[1]))
            if abs(risen - root) < _CLOSE * root:
                end = there + (root - risen) * (there - inner) / max(risen - height, 1e-9)
                return min(end, limit) if sign > 0 else max(end, limit)
            if risen < root:
                if there == limit:
                    return limit
                slope = (risen - height) / (there - inner) if risen > height else 0.0
                x, inner, height = refit[0], there, risen
                reach = sign * _FAR * root * size
                if abs(there - here) > abs(reach):
                    return None  # open: the data set no limit here
                there = inner + (root - height) / slope if slope else inner + 0.5 * reach
                there = sign * min(sign * there, sign * (inner + reach))
                if outer is not None and sign * there >= sign * outer[0]:
                    there = 0.5 * (inner + outer[0])
            else:
                outer = (there, risen)
                there = inner + (there - inner) * (root - height) / (risen - height)
            if outer is not None:  # where one side is far steeper than the other, secants hardly move
                width, before = abs(outer[0] - inner), width
                there = 0.5 * (inner + outer[0]) if width > 0.5 * before else there
        # what bends at a limit of another is not met by a few secants, but it is between two places that are close
        near = (
            outer is not None
            and np.isfinite(outer[1])
            and abs(outer[0] - inner) < _BRACKET * abs(there - here)
        )
        return there if near else None

    def _refit(self, k: int, value: float, x: Array) -> tuple[Array, float] | None:
        """Variables and rise of chi-squared with entry k held, from the variables of a point near by."""
        begun = time.process_time()
        try:
            start = self._foreseen(k, value, x)
            lower, upper = self.search.lower.copy(), self.search.upper.copy()
            lower[k] = upper[k] = value
            with Deadline(max(self.seconds - self._spent, 0.0), clock=time.process_time):
                found = self.search.solver.solve(start, lower, upper, exact=True)
            if found.status != "converged":
                return None
            rise = self._cost(found.x) - self.base
        except (FloatingPointError, np.linalg.LinAlgError, ModelError):
            return None
        except TimeUp:
            ask()  # all of the time, or what profiles may take
            return None
        finally:
            self._spent, self._done = self._spent + time.process_time() - begun, self._done + 1
        if rise < -_LOWER:
            raise LowerOptimumError(found.x)
        return found.x, max(rise, 0.0)

    def _foreseen(self, k: int, value: float, x: Array) -> Array:
        """The variables (size,) of the simulation from where the quadratic moves a point with entry k."""
        search, nv = self.search, self.search.problem.nv
        matrix, layouts = self.errors.covariance.matrix, search.problem.layouts
        move = matrix[:, k] / matrix[k, k] * (value - x[k])
        found = np.clip(x, search.lower, search.upper)
        found[:nv] = np.clip(x[:nv] + move[:nv], search.lower[:nv], search.upper[:nv])
        found[k], at = value, nv
        for record, lay in zip(search.records, layouts, strict=True):
            start = lay.take(x)[0] + move[at : at + record.n]
            start = np.clip(
                start, search.lower[lay.at : lay.at + lay.n], search.upper[lay.at : lay.at + lay.n]
            )
            nodes = chained_nodes(record, found[:nv], start)
            found[lay.at : lay.at + nodes.size] = nodes.ravel()
            at += record.n
        return found

    def _cost(self, x: Array) -> float:
        return 2 * self.search.problem.samples * self.search.problem.at(x).objective

    def value(self, k: int, entry: float) -> float:
        """Entry k as it is printed, the others at the optimum."""
        v = self.errors.v.copy()
        v[k] = entry
        z = self.search.coordinates.values(v)[k]
        return float(np.clip(z, self.search.pmap.lower[k], self.search.pmap.upper[k]))
