"""The multiple-shooting problem: one point in, objective, constraints and all derivatives out.

Variables x = [v; nodes of record 1; nodes of record 2; ...] with v the scaled free parameters and the states at the
starts of the shooting intervals, scaled. Objective: (summed loss + priors) / N. Constraints: those on parameters,
then the continuity end(i) - start(i+1) = 0 of every record.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation import assembly
from casadi_engine.estimation.constraints import ParameterConstraints, Priors
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.record import RecordPoint, RecordTerm

Array = NDArray[np.float64]


@dataclass
class Point:
    """Everything of first order at one x."""

    x: Array
    records: list[RecordPoint]
    objective: float
    gradient: Array
    constraints: Array
    user_jacobian: Array

    @property
    def gap(self) -> float:
        """Largest violation of the continuity."""
        return float(np.abs(self.constraints[len(self.user_jacobian) :]).max(initial=0.0))


class ShootingProblem:
    """Objective, constraints and derivatives of several records that share parameters.

    nv : free parameters; size : variables; rows : constraints; ``exact`` chooses the Hessian of the Lagrangian in
    place of the Gauss-Newton matrix, ``damping`` the share of the latter's diagonal that is added to either;
    evaluations : points that were evaluated
    """

    def __init__(
        self,
        records: list[RecordTerm],
        constraints: ParameterConstraints,
        priors: Priors,
        loss: Loss,
        nv: int,
    ) -> None:
        self.records, self.user, self.priors, self.loss, self.nv = records, constraints, priors, loss, nv
        self.samples = sum(record.count for record in records)
        at, row = nv, constraints.count
        self.layouts: list[assembly.NodeLayout] = []
        for record in records:
            lay = assembly.NodeLayout(at, row, record.plan.m, record.n, record.active)
            self.layouts.append(lay)
            at += record.plan.m * record.n
            row += (record.plan.m - 1) * record.n
        self.size, self.rows = at, row
        self.jacobian_pattern = assembly.jacobian_pattern(nv, constraints.count, self.layouts, (row, at))
        self.hessian_pattern = assembly.hessian_pattern(nv, self.layouts, at)
        self.exact, self.damping = False, 0.0
        self.evaluations = 0
        self._point: Point | None = None
        self._jacobian: tuple[Point, Array] | None = None

    def forget(self) -> None:
        """Drop the stored point, after weights have changed."""
        self._point = self._jacobian = None

    def at(self, x: Array) -> Point:
        """Evaluate at x, once for all that is asked of the same x."""
        if self._point is not None and np.array_equal(self._point.x, x):
            return self._point
        self.evaluations += 1
        self._point = None  # a point of a long record is large: the last one goes before the next is made
        v = x[: self.nv]
        gradient = np.zeros(self.size)
        cost, prior_gradient, _, _ = self.priors.evaluate(v)
        gradient[: self.nv] = prior_gradient
        values, user_jacobian = (
            self.user.evaluate(v) if self.user.count else (np.zeros(0), np.zeros((0, self.nv)))
        )
        rows, points = [values], []
        for record, lay in zip(self.records, self.layouts, strict=True):
            nodes = lay.take(x)
            point = record.evaluate(v, nodes)
            in_z, in_nodes = record.gradient(point, self.loss)
            gradient[lay.active] += in_z
            gradient[lay.at : lay.at + in_nodes.size] = in_nodes.ravel()
            cost += self.loss.value(point.r)
            rows.append((point.path.end[:, :-1].T - nodes[1:]).ravel())
            points.append(point)
        found = Point(
            x.copy(),
            points,
            cost / self.samples,
            gradient / self.samples,
            np.concatenate(rows),
            user_jacobian,
        )
        self._point = found
        return found

    def jacobian(self, x: Array) -> Array:
        """Raw values of the constraint Jacobian."""
        point = self.at(x)
        ends = [(p.path.end_z, p.path.end_s) for p in point.records]
        return assembly.jacobian_values(point.user_jacobian, self.layouts, ends)

    @np.errstate(over="ignore", invalid="ignore")  # the solver refuses a value that is not finite
    def hessian(self, x: Array, factor: float, lam: Array) -> Array:
        """Raw values of the Hessian of factor * objective + lam * constraints, or of what stands in for it."""
        point = self.at(x)
        v, scale = x[: self.nv], factor / self.samples
        _, _, prior_hessian, prior_gn = self.priors.evaluate(v)
        zz = scale * (prior_hessian if self.exact else prior_gn)
        if self.exact and self.user.count:
            zz = zz + self.user.hessian(v, lam[: self.user.count])
        blocks = []
        for record, lay, found in zip(self.records, self.layouts, point.records, strict=True):
            bend = self.loss.curvature(found.r) if self.exact else self.loss.secant(found.r)
            gn = record.gauss_newton(found, bend)
            own, zs, ss = scale * gn.zz, scale * gn.zs, scale * gn.ss
            if self.damping:
                index = np.arange(lay.n)
                own = own + self.damping * np.diag(np.abs(np.diag(own)))
                ss = ss.copy()
                ss[:, index, index] += self.damping * np.abs(ss[:, index, index])
            if self.exact:
                ends = np.zeros((lay.n, lay.m))
                ends[:, :-1] = lam[lay.row : lay.row + (lay.m - 1) * lay.n].reshape(-1, lay.n).T
                bent = record.curvature(v, found, self.loss, scale, ends)
                own, zs, ss = own + bent.zz, zs + bent.zs, ss + bent.ss
            zz[np.ix_(lay.active, lay.active)] += own
            blocks.append((zs, ss))
        return assembly.hessian_values(zz, blocks)
