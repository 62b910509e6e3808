"""The first phase of a search: condensed Newton steps on the multiple-shooting problem, before IPOPT takes over.

Where parameters are subject to bounds alone, a step of the problem with hundreds of nodes is one in the parameters
and initial states (see ``condensing``), solved densely. The matrix is Gauss-Newton's with a share of its diagonal
added (Levenberg 1944); once the objective has settled it is the exact Hessian of the Lagrangian, which may be
indefinite where the data say little, within a trust region (Moré & Sorensen 1983). IPOPT starts from the point
found, judges it, and does what is left; where this phase gets stuck it starts from the beginning.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ModelError
from casadi_engine.estimation.condensing import Condensed, condense, joint_multipliers
from casadi_engine.estimation.reduced import Reduced, trust_step
from casadi_engine.estimation.shooting import Point, ShootingProblem

Array = NDArray[np.float64]

# Relative change of the objective that counts as settled, and the steps after which it counts as such anyway.
_SETTLED, _LONG = 3e-2, 25
# Fall of the summed loss that says nothing, and the share of it that is rounding; gap that counts as closed.
_FALL, _ROUNDING, _CLOSED = 1e-9, 1e-13, 1e-9
# Longest step of a scaled parameter or of a logarithm: beyond it the linearised problem says nothing.
_LONGEST = 1.0
# A valley is flat if so many exact steps lower chi-squared by less than this: its points explain the data alike.
_VALLEY, _FLAT = 8, 0.1
# Halvings of a Gauss-Newton step that raises both the objective and the gaps; rejections of an exact one.
_HALVINGS, _REJECTIONS = 5, 12
# Share of the foretold closing of the gaps that a Gauss-Newton step must bring if the objective rises.
_CLOSING = 0.1
# First radius of the trust region, in the same units; least share of the foretold fall that a step must bring.
_RADIUS, _SHARE = 0.5, 1e-3


@dataclass
class Descent:
    """Where the first phase ended: x (size,), steps done; ``settled`` at an optimum, or ``flat`` in a flat valley."""

    x: Array
    steps: int
    settled: bool
    stopped: bool = False
    flat: bool = False


@dataclass(frozen=True)
class _Quadratic:
    """The problem to second order about a point: records condensed, the parameters' own part, the multipliers."""

    reduced: Reduced
    shares: list[Condensed]
    joints: list[Array | None]


def gap_of(point: Point, users: int) -> float:
    """Largest violation of the continuity."""
    return float(np.abs(point.constraints[users:]).max(initial=0.0))


class Descender:
    """Condensed Newton steps on a problem whose parameters have bounds but no further constraints."""

    def __init__(self, problem: ShootingProblem, lower: Array, upper: Array) -> None:
        self.problem, self.lower, self.upper = problem, lower, upper
        heads = [np.arange(problem.nv)] + [np.arange(lay.at, lay.at + lay.n) for lay in problem.layouts]
        self._entries = np.concatenate(heads)
        self._radius = _RADIUS

    def run(
        self, start: Array, watch: Callable[[Point], bool], limit: int, *, exact: bool = False
    ) -> Descent:
        """Steps from ``start`` (size,); ``watch`` sees every point and returns True to stop."""
        problem = self.problem
        problem.exact, self._radius = exact, _RADIUS
        point = self._evaluate(np.clip(start, self.lower, self.upper))
        if point is None:
            return Descent(start, 0, settled=False)
        history: list[float] = []
        bent = 0
        for count in range(limit):
            history.append(point.objective)
            if watch(point):
                return Descent(point.x, count, settled=False, stopped=True)
            problem.exact = problem.exact or self._settled(history, point)
            bent += problem.exact
            if bent > _VALLEY and self._flat(history, point):
                return Descent(point.x, count, settled=False, flat=True)
            try:
                found = self._newton(point) if problem.exact else self._gauss_newton(point)
            except np.linalg.LinAlgError:  # the states grow beyond floating point over the record
                found = None
            if found is None:
                return Descent(point.x, count, settled=False)
            point, settled = found
            if settled:
                return Descent(point.x, count + 1, settled=True)
        return Descent(point.x, limit, settled=False)

    def _settled(self, history: list[float], point: Point) -> bool:
        if len(history) < 3 or len(history) > _LONG:
            return len(history) > _LONG
        change = abs(history[-2] - history[-1])
        return gap_of(point, self.problem.user.count) < 1e-2 and change < _SETTLED * abs(history[-1])

    def _flat(self, history: list[float], point: Point) -> bool:
        closed = gap_of(point, self.problem.user.count) < _CLOSED**0.5
        return (
            closed and 2 * self.problem.samples * (min(history[:-_VALLEY]) - min(history[-_VALLEY:])) < _FLAT
        )

    def _evaluate(self, x: Array) -> Point | None:
        """The point at x, or None where the model cannot be evaluated."""
        try:
            found = self.problem.at(x)
        except (FloatingPointError, np.linalg.LinAlgError, ModelError):
            return None
        return found if np.isfinite(found.objective) and np.isfinite(found.gradient).all() else None

    # ---- the quadratic problem

    def _multipliers(self, point: Point) -> list[Array | None]:
        """Multipliers of the continuity of every record at a point."""
        found: list[Array | None] = []
        for lay, part in zip(self.problem.layouts, point.records, strict=True):
            slope = lay.take(point.gradient)
            found.append(joint_multipliers(part.path.end_s, slope) if lay.m > 1 else None)
        return found

    def _quadratic(self, point: Point) -> _Quadratic:
        problem = self.problem
        joints = self._multipliers(point)
        zz, blocks = problem.curvature(point.x, 1.0, np.zeros(problem.user.count), joints)
        gradient = point.gradient[: problem.nv].copy()
        shares: list[Condensed] = []
        row = problem.user.count
        for lay, part, block in zip(problem.layouts, point.records, blocks, strict=True):
            gap = point.constraints[row : row + (lay.m - 1) * lay.n].reshape(-1, lay.n)
            row += gap.size
            path = part.path
            share = condense(path.end_z, path.end_s, gap, block, lay.take(point.gradient))
            na = len(lay.active)
            zz[np.ix_(lay.active, lay.active)] += share.hessian[:na, :na]
            gradient[lay.active] += share.gradient[:na]
            shares.append(share)
        slope = np.concatenate(
            [gradient, *(s.gradient[len(y.active) :] for s, y in zip(shares, problem.layouts, strict=True))]
        )
        at = point.x[self._entries]
        low, high = self.lower[self._entries], self.upper[self._entries]
        held = (at <= low) & (slope >= 0) | (at >= high) & (slope <= 0)
        actives = [lay.active for lay in problem.layouts]
        return _Quadratic(Reduced.of(zz, slope, shares, actives, held), shares, joints)

    def _spread(self, point: Point, w: Array, shares: list[Condensed]) -> Array:
        """The step of all variables from that of the parameters and initial states, cut at the bounds."""
        at = point.x[self._entries]
        w = np.clip(at + w, self.lower[self._entries], self.upper[self._entries]) - at
        nv, begin = self.problem.nv, self.problem.nv
        dx = np.empty(self.problem.size)
        dx[:nv] = w[:nv]
        for share, lay in zip(shares, self.problem.layouts, strict=True):
            own = np.concatenate([w[:nv][lay.active], w[begin : begin + lay.n]])
            begin += lay.n
            dx[lay.at : lay.at + lay.m * lay.n] = share.nodes(own).ravel()
        return dx

    # ---- steps

    def _gauss_newton(self, point: Point) -> tuple[Point, bool] | None:
        """The point after a damped Gauss-Newton step, shortened until the objective or the gaps fall."""
        quadratic, users = self._quadratic(point), self.problem.user.count
        w = quadratic.reduced.newton()
        if w is None:
            return None
        dx = self._spread(point, w, quadratic.shares)
        gap = gap_of(point, users)
        share = min(1.0, _LONGEST / max(float(np.abs(dx[: self.problem.nv]).max(initial=0.0)), 1e-300))
        for _ in range(_HALVINGS + 1):
            found = self._evaluate(point.x + share * dx)
            if found is not None:
                lower = found.objective <= point.objective * (1 + 1e-9)
                if lower or gap_of(found, users) < max((1 - _CLOSING * share) * gap, _CLOSED):
                    return found, False
            share *= 0.5
            del found  # before the next is made: a point of a long record is large
        return None

    def _newton(self, point: Point) -> tuple[Point, bool] | None:
        """The point after a step with the exact Hessian, and whether the next one would be rounding."""
        quadratic, users = self._quadratic(point), self.problem.user.count
        lam = np.concatenate([np.zeros(0), *(j.T.ravel() for j in quadratic.joints if j is not None)])
        weight = float(np.abs(lam).max(initial=0.0))

        def merit(found: Point) -> float:
            # The augmented Lagrangian: gaps of second order, which the step foresees, do not count against it.
            gaps = found.constraints[users:]
            return found.objective + float(lam @ gaps) + 0.5 * weight * float(gaps @ gaps)

        before = merit(point)
        rounding = _ROUNDING * abs(before)
        for _ in range(_REJECTIONS):
            found = trust_step(quadratic.reduced, self._radius)
            if found is None:
                return None
            w, fall, inside = found
            length = float(np.linalg.norm(w[: self.problem.nv]))
            after = self._evaluate(point.x + self._spread(point, w, quadratic.shares))
            # what the model foretells of the merit: its own fall and the gaps closed
            foretold = fall + before - point.objective
            if after is not None:
                gained = before - merit(after)
                small = foretold < _FALL / self.problem.samples + rounding
                if inside and small and gap_of(after, users) < _CLOSED:
                    return after, True
                closed = gap_of(after, users) < max(0.2 * gap_of(point, users), _CLOSED) and inside
                if gained > _SHARE * foretold or closed:
                    if gained > 0.75 * foretold and not inside:
                        self._radius = min(2 * self._radius, 4 * _RADIUS)
                    elif gained < 0.25 * foretold and not closed:
                        self._radius = max(0.5 * length, 1e-12)
                    return after, False
            self._radius = 0.25 * min(length, self._radius)
            del after  # as above
        return None
