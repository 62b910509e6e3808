"""The first phase of a search: condensed Newton steps on the multiple-shooting problem, before IPOPT takes over.

Where parameters are subject to bounds alone, a step of the problem with hundreds of nodes is one in the parameters
and initial states (see ``condensing``), solved densely. The matrix is Gauss-Newton's with a share of its diagonal
added (Levenberg 1944), then, once the objective has settled, the exact Hessian of the Lagrangian. IPOPT starts from
the point found, judges it, and does what is left; where this phase gets stuck it starts from the beginning.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from casadi_engine.errors import ModelError
from casadi_engine.estimation.condensing import Condensed, condense, joint_multipliers
from casadi_engine.estimation.shooting import Point, ShootingProblem

Array = NDArray[np.float64]

# Relative change of the objective that counts as settled, and the steps after which it counts as such anyway.
_SETTLED, _LONG = 3e-2, 25
# Fall of the summed loss that says nothing, and the share of it that is rounding; gap that counts as closed.
_FALL, _ROUNDING, _CLOSED = 1e-9, 1e-13, 1e-9
# Longest step of a scaled parameter or of a logarithm: beyond it the linearised problem says nothing.
_LONGEST = 1.0
# Halvings of a step that raises both the objective and the gaps.
_HALVINGS = 5


@dataclass
class Descent:
    """Where the first phase ended: x (size,), steps done; ``settled`` at an optimum."""

    x: Array
    steps: int
    settled: bool
    stopped: bool = False


def gap_of(point: Point, users: int) -> float:
    """Largest violation of the continuity."""
    return float(np.abs(point.constraints[users:]).max(initial=0.0))


class Descender:
    """Condensed Newton steps on a problem whose parameters have bounds but no further constraints."""

    def __init__(self, problem: ShootingProblem, lower: Array, upper: Array) -> None:
        self.problem, self.lower, self.upper = problem, lower, upper
        nv = problem.nv
        heads = [np.arange(nv)] + [np.arange(lay.at, lay.at + lay.n) for lay in problem.layouts]
        self._entries = np.concatenate(heads)

    def run(
        self, start: Array, watch: Callable[[Point], bool], limit: int, *, exact: bool = False
    ) -> Descent:
        """Steps from ``start`` (size,); ``watch`` sees every point and returns True to stop."""
        problem = self.problem
        problem.exact = exact
        point = self.evaluate(np.clip(start, self.lower, self.upper))
        if point is None:
            return Descent(start, 0, settled=False)
        history: list[float] = []
        for count in range(limit):
            history.append(point.objective)
            if watch(point):
                return Descent(point.x, count, settled=False, stopped=True)
            problem.exact = problem.exact or self._settled(history, point)
            found = self._next(point)
            if found is None:
                break
            point, fall = found
            if problem.exact and self._optimal(point, fall):
                return Descent(point.x, count + 1, settled=True)
        return Descent(point.x, len(history), settled=False)

    def _settled(self, history: list[float], point: Point) -> bool:
        if len(history) < 3 or len(history) > _LONG:
            return len(history) > _LONG
        change = abs(history[-2] - history[-1])
        return gap_of(point, self.problem.user.count) < 1e-2 and change < _SETTLED * abs(history[-1])

    def _optimal(self, point: Point, fall: float) -> bool:
        """True if an exact step foretold a fall so small that the next, for it squares, would be rounding."""
        least = _FALL + _ROUNDING * abs(point.objective) * self.problem.samples
        return fall < least and gap_of(point, self.problem.user.count) < _CLOSED

    def _next(self, point: Point) -> tuple[Point, float] | None:
        """The next point and the fall that was predicted: by the exact Hessian if it can be, else by Gauss-Newton."""
        wanted = self.problem.exact
        for exact in (True, False) if wanted else (False,):
            self.problem.exact = exact
            found = self.step(point)
            if found is None:
                continue
            after = self.advance(point, found[0])
            if after is not None:
                return after, found[1]
        return None

    def evaluate(self, x: Array) -> Point | None:
        """The point at x, or None where the model cannot be evaluated."""
        try:
            found = self.problem.at(x)
        except (FloatingPointError, np.linalg.LinAlgError, ModelError):
            return None
        return found if np.isfinite(found.objective) and np.isfinite(found.gradient).all() else None

    def _held(self, x: Array, gradient: Array) -> NDArray[np.bool_]:
        """Entries [v; initial states] at a bound that the gradient pushes them against, and fixed ones."""
        at = x[self._entries]
        low, high = self.lower[self._entries], self.upper[self._entries]
        return (at <= low) & (gradient >= 0) | (at >= high) & (gradient <= 0)

    def multipliers(self, point: Point) -> list[Array | None]:
        """Multipliers of the continuity of every record at a point."""
        found: list[Array | None] = []
        for lay, part in zip(self.problem.layouts, point.records, strict=True):
            slope = lay.take(point.gradient)
            found.append(joint_multipliers(part.path.end_s, slope) if lay.m > 1 else None)
        return found

    def step(self, point: Point) -> tuple[Array, float] | None:
        """Newton step (size,) and the fall of the summed loss it predicts; None if the matrix is not positive."""
        problem = self.problem
        joints = (
            self.multipliers(point) if problem.exact else list[Array | None]([None] * len(problem.layouts))
        )
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
        slopes = [gradient] + [
            s.gradient[len(lay.active) :] for s, lay in zip(shares, problem.layouts, strict=True)
        ]
        held = self._held(point.x, np.concatenate(slopes))
        try:
            w = self._solve(zz, gradient, shares, held)
        except np.linalg.LinAlgError:
            return None
        fall = -0.5 * float(np.concatenate(slopes) @ w) * problem.samples
        at = point.x[self._entries]
        w = np.clip(at + w, self.lower[self._entries], self.upper[self._entries]) - at
        return self._spread(w, shares), fall

    def _solve(self, zz: Array, gradient: Array, shares: list[Condensed], held: NDArray[np.bool_]) -> Array:
        """w = [dv; ds(0) of every record], the initial states eliminated record by record."""
        nv = self.problem.nv
        matrix, right = zz.copy(), -gradient
        kept, at = [], nv
        for share, lay in zip(shares, self.problem.layouts, strict=True):
            na = len(lay.active)
            free = ~held[at : at + lay.n]
            at += lay.n
            factor = cho_factor(share.hessian[na:, na:][np.ix_(free, free)]) if free.any() else None
            cross = share.hessian[na:, :na][free]
            own = -share.gradient[na:][free]
            kept.append((free, factor, cross, own))
            if factor is not None:
                both = cho_solve(factor, np.column_stack([cross, own]))
                matrix[np.ix_(lay.active, lay.active)] -= cross.T @ both[:, :-1]
                right[lay.active] -= cross.T @ both[:, -1]
        open_ = ~held[:nv]
        dv = np.zeros(nv)
        if open_.any():
            dv[open_] = cho_solve(cho_factor(matrix[np.ix_(open_, open_)]), right[open_])
        parts = [dv]
        for (free, factor, cross, own), lay in zip(kept, self.problem.layouts, strict=True):
            ds = np.zeros(lay.n)
            if factor is not None:
                ds[free] = cho_solve(factor, own - cross @ dv[lay.active])
            parts.append(ds)
        return np.concatenate(parts)

    def _spread(self, w: Array, shares: list[Condensed]) -> Array:
        """The step of all variables from that of the parameters and initial states."""
        nv, at = self.problem.nv, self.problem.nv
        dx = np.empty(self.problem.size)
        dx[:nv] = w[:nv]
        for share, lay in zip(shares, self.problem.layouts, strict=True):
            own = np.concatenate([w[:nv][lay.active], w[at : at + lay.n]])
            at += lay.n
            dx[lay.at : lay.at + lay.m * lay.n] = share.nodes(own).ravel()
        return dx

    def advance(self, point: Point, dx: Array) -> Point | None:
        """The point after the step, shortened until the objective or the gaps fall; None if none does."""
        users = self.problem.user.count
        gap = gap_of(point, users)
        share = min(1.0, _LONGEST / max(float(np.abs(dx[: self.problem.nv]).max(initial=0.0)), 1e-300))
        for _ in range(_HALVINGS + 1):
            found = self.evaluate(point.x + share * dx)
            if found is not None:
                now = gap_of(found, users)
                small = 1e-9 * abs(point.objective)
                if found.objective <= point.objective + small or now < max(0.9 * gap, _CLOSED):
                    return found
            share *= 0.5
        return None
