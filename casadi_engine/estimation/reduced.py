"""The condensed step's small dense problem: initial states eliminated record by record, then the parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.condensing import Condensed

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Share of the largest curvature below which an initial state's is raised to it: it is not determined.
_FLAT = 1e-14


@dataclass(frozen=True)
class _Start:
    """A record's initial states in the elimination: ds = turn dv + shift for the free ones."""

    free: NDArray[np.bool_]
    active: Index
    turn: Array
    shift: Array


@dataclass(frozen=True)
class Reduced:
    """The quadratic problem in the free parameters alone, and the way back to [dv; ds(0) of every record].

    matrix : (k, k), gradient : (k,) over the ``open`` parameters; slope : (nw,) of the whole problem;
    settled : fall of the objective that the initial states bring by themselves
    """

    matrix: Array
    gradient: Array
    open: NDArray[np.bool_]
    starts: tuple[_Start, ...]
    settled: float
    bent: bool

    @classmethod
    def of(
        cls,
        zz: Array,
        slope: Array,
        shares: list[Condensed],
        actives: list[Index],
        held: NDArray[np.bool_],
    ) -> Reduced:
        """From the parameters' Hessian (nv, nv), the gradient (nw,), the records' shares and the entries held."""
        nv = len(zz)
        matrix, gradient = zz.copy(), slope[:nv].copy()
        starts, at, settled, bent = [], nv, 0.0, False
        for share, active in zip(shares, actives, strict=True):
            na = len(active)
            n = len(share.gradient) - na
            free = ~held[at : at + n]
            at += n
            inverse, positive = _inverse(share.hessian[na:, na:][np.ix_(free, free)])
            bent |= not positive
            cross, own = share.hessian[na:, :na][free], share.gradient[na:][free]
            turn, shift = -inverse @ cross, -inverse @ own
            matrix[np.ix_(active, active)] += cross.T @ turn
            gradient[active] += cross.T @ shift
            settled -= 0.5 * float(own @ shift)
            starts.append(_Start(free, active, turn, shift))
        open_ = ~held[:nv]
        return cls(matrix[np.ix_(open_, open_)], gradient[open_], open_, tuple(starts), settled, bent)

    def whole(self, step: Array) -> Array:
        """[dv; ds(0) of every record] from the step of the open parameters."""
        dv = np.zeros(len(self.open))
        dv[self.open] = step
        parts = [dv]
        for start in self.starts:
            ds = np.zeros(len(start.free))
            ds[start.free] = start.turn @ dv[start.active] + start.shift
            parts.append(ds)
        return np.concatenate(parts)

    def newton(self) -> Array | None:
        """The Newton step (nw,), or None if the matrix is not positive definite."""
        if not len(self.gradient):
            return self.whole(self.gradient)
        try:
            lower = np.linalg.cholesky(self.matrix)
        except np.linalg.LinAlgError:
            return None
        return self.whole(-np.linalg.solve(lower.T, np.linalg.solve(lower, self.gradient)))


def _inverse(matrix: Array) -> tuple[Array, bool]:
    """Inverse of a symmetric matrix with its eigenvalues made positive, and whether they were."""
    if not len(matrix):
        return matrix, True
    values, vectors = np.linalg.eigh(matrix)
    least = max(_FLAT * float(np.abs(values).max()), 1e-300)
    return (vectors / np.maximum(np.abs(values), least)) @ vectors.T, bool(values[0] > 0)


def trust_step(problem: Reduced, radius: float) -> tuple[Array, float, bool] | None:
    """The step (nw,) that lowers the quadratic most within ``radius`` in the open parameters, the fall it foretells,
    and whether it is Newton's own, inside a positive definite problem; None if the numbers are not finite."""
    if not (np.isfinite(problem.matrix).all() and np.isfinite(problem.gradient).all()):
        return None
    if not len(problem.gradient):
        return problem.whole(problem.gradient), problem.settled, not problem.bent
    values, vectors = np.linalg.eigh(problem.matrix)
    along = vectors.T @ problem.gradient
    floor = max(_FLAT * float(np.abs(values).max()), 1e-300)
    # What the data do not tell stays where it is.
    dead = (np.abs(values) <= floor) & (np.abs(along) <= 1e-7 * float(np.abs(along).max(initial=0.0)))
    values, along = np.where(dead, 1.0, values), np.where(dead, 0.0, along)
    shift, inside = 0.0, bool(values.min() > floor)
    if not inside or float(np.linalg.norm(along / values)) > radius:
        inside = False
        shift = _shift(values, along, radius, floor)
    step = -along / (values + shift)
    missing = radius**2 - float(step @ step)
    if values.min() < -floor and missing > 0.19 * radius**2:
        # The hard case: the gradient says nothing of the direction of the strongest bend down, either way is as good.
        step[np.argmin(values)] += np.sqrt(missing)
    fall = -float(along @ step) - 0.5 * float(values @ step**2)
    return problem.whole(vectors @ step), fall + problem.settled, inside and not problem.bent


def _shift(values: Array, along: Array, radius: float, floor: float) -> float:
    """The shift of the eigenvalues with which the step has the length ``radius``, by Newton on 1/length."""
    least = float(values.min())
    low = max(0.0, -least) + floor
    high = max(low * 2, float(np.linalg.norm(along)) / max(radius, 1e-300) - least + low)
    shift = low
    for _ in range(60):
        size = float(np.linalg.norm(along / (values + shift)))
        if size < radius and shift == low:
            return shift
        if abs(size - radius) < 0.05 * radius:
            return shift
        low, high = (shift, high) if size > radius else (low, shift)
        slope = -float((along**2 / (values + shift) ** 3).sum()) / size
        guess = shift - (size / radius - 1) * size / slope
        shift = guess if low < guess < high else 0.5 * (low + high)
    return shift
