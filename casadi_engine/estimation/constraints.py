"""Constraints and priors on the parameters, with exact first and second derivatives in the scaled vector v."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ConstraintError
from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.model import Model, matrix_derivatives, natural_frequency_derivatives
from casadi_engine.parameters.compiled import ParameterMap

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Frequency:
    """A bound on the k-th natural frequency of the model's linear core."""

    label: str
    mode: int
    matrices: Callable[[Array], tuple[Array, Array, Array]]


class Supplied(Protocol):
    """A constraint min <= g(v) <= max that brings its own derivatives."""

    label: str
    min: float
    max: float

    def evaluate(self, v: Array) -> tuple[float, Array]:
        """Value and gradient (nv,)."""
        ...

    def hessian(self, v: Array) -> Array:
        """(nv, nv)."""
        ...


class ParameterConstraints:
    """All constraints g(v) of a fit: lower <= g <= upper, each divided by its magnitude at the start.

    supplied : constraints beside those of the parameter set
    labels : (nc,) names for messages; values, jacobian (nc, nv), and the Hessian of lam @ g.
    """

    def __init__(
        self, model: Model, pmap: ParameterMap, coordinates: Coordinates, supplied: Sequence[Supplied] = ()
    ) -> None:
        v = coordinates.symbol
        compiled, self._supplied = pmap.constraints, tuple(supplied)
        self.v = v
        self._expression = ca.vertcat(ca.SX(0, 1), *[coordinates.substitute(c.expression) for c in compiled])
        self._frequencies = _frequencies(model, pmap, coordinates)
        bounds = [(c.min, c.max) for c in compiled]
        bounds += [(f.min, f.max) for f in pmap.frequency_constraints for _ in _records(pmap)]
        bounds += [(own.min, own.max) for own in self._supplied]
        self.labels = [c.label for c in compiled] + [f.label for f in self._frequencies]
        self.labels += [own.label for own in self._supplied]
        self.count = len(self.labels)
        jacobian = ca.jacobian(self._expression, v)
        self._first = ca.Function("constraints", [v], [self._expression, ca.densify(jacobian)])
        lam = ca.SX.sym("lam", self._expression.numel())
        hessian = ca.hessian(ca.dot(lam, self._expression), v)[0] if v.numel() else ca.SX(0, 0)
        self._second = ca.Function("constraints_second", [v, lam], [ca.densify(hessian)])
        self.scale = np.ones(self.count)
        start = np.abs(self.evaluate(coordinates.of(pmap.start))[0]) if self.count else np.zeros(0)
        limits = np.array([[abs(b) if np.isfinite(b) else 0.0 for b in pair] for pair in bounds]).reshape(
            -1, 2
        )
        size = np.maximum(start, limits.max(axis=1, initial=0.0))
        self.scale = np.where((size > 0) & np.isfinite(size), size, 1.0)
        self.lower = np.array([b[0] for b in bounds]) / self.scale
        self.upper = np.array([b[1] for b in bounds]) / self.scale

    def evaluate(self, v: Array) -> tuple[Array, Array]:
        """Values (nc,) and Jacobian (nc, nv)."""
        value, jacobian = self._first(v)
        rows = [np.asarray(value).reshape(-1)]
        slopes = [np.asarray(jacobian).reshape(len(rows[0]), len(v))]
        for frequency in self._frequencies:
            found, slope, _ = natural_frequency_derivatives(*frequency.matrices(v), frequency.mode)
            rows.append(np.array([found]))
            slopes.append(np.asarray(slope)[None])
        for own in self._supplied:
            found, slope = own.evaluate(v)
            rows.append(np.array([found]))
            slopes.append(slope[None])
        return np.concatenate(rows) / self.scale, np.concatenate(slopes) / self.scale[:, None]

    def hessian(self, v: Array, lam: Array) -> Array:
        """Hessian of lam @ g, (nv, nv)."""
        weight = lam / self.scale
        plain = self._expression.numel()
        total = np.asarray(self._second(v, weight[:plain])).reshape(len(v), len(v))
        for k, frequency in enumerate(self._frequencies):
            second = natural_frequency_derivatives(*frequency.matrices(v), frequency.mode)[2]
            total = total + weight[plain + k] * np.asarray(second)
        for own, factor in zip(reversed(self._supplied), reversed(weight), strict=False):
            if factor:
                total = total + factor * own.hessian(v)
        return total

    def violated(self, v: Array, tolerance: float = 1e-6) -> list[str]:
        """Labels of the constraints that v does not meet."""
        if not self.count:
            return []
        value = self.evaluate(v)[0]
        bad = (value < self.lower - tolerance) | (value > self.upper + tolerance)
        return [label for label, wrong in zip(self.labels, bad, strict=True) if wrong]


def _records(pmap: ParameterMap) -> tuple[str, ...]:
    """One record for each different set of physical parameters."""
    varies = any("@" in name for name in pmap.free)
    return pmap.records if varies else pmap.records[:1]


def _frequencies(model: Model, pmap: ParameterMap, coordinates: Coordinates) -> list[Frequency]:
    found: list[Frequency] = []
    if not pmap.frequency_constraints:
        return found
    if model.linear is None:
        raise ConstraintError(
            "a natural frequency is bounded, but the model has no linear core",
            seen=model.name,
            allowed="a model with natural frequencies",
            cure="leave constrain_frequency out",
        )
    for constraint in pmap.frequency_constraints:
        for record in _records(pmap):
            physical = coordinates.substitute(pmap.physical[record])
            matrix = ca.substitute(model.linear.A, model.p, physical)
            at = f" in {record}" if len(_records(pmap)) > 1 else ""
            found.append(
                Frequency(
                    constraint.label + at, constraint.mode, matrix_derivatives(matrix, coordinates.symbol)
                )
            )
    return found


# Share of a prior's variance by which data have to know its quantity better, to say anything of it.
_TOLD = 1e-6


class Priors:
    """Normal priors: half the sum of ((g - mean)/sigma)^2, with exact derivatives."""

    def __init__(self, pmap: ParameterMap, coordinates: Coordinates) -> None:
        v = coordinates.symbol
        rows = [(coordinates.substitute(p.expression) - p.mean) / p.sigma for p in pmap.priors]
        self.count = len(rows)
        residual = ca.vertcat(ca.SX(0, 1), *rows)
        cost = 0.5 * ca.dot(residual, residual) if rows else ca.SX(0)
        hessian, gradient = ca.hessian(cost, v) if v.numel() else (ca.SX(0, 0), ca.SX(0, 1))
        jacobian = ca.jacobian(residual, v)
        self._residuals = ca.Function("apart", [v], [ca.densify(residual), ca.densify(jacobian)])
        self._function = ca.Function(
            "priors", [v], [cost, ca.densify(gradient), ca.densify(hessian), ca.densify(jacobian)]
        )

    def apart(self, v: Array, covariance: Array) -> Array:
        """(count,) standard errors by which each prior and all else that the fit knows are apart, nan where that says
        nothing: by how much the estimate has left the mean, which a prior that agrees lets it do within the root of
        what it knows less than the fit. covariance : (nv, nv) of the fit"""
        if not self.count:
            return np.zeros(0)
        left, rows = (np.asarray(part) for part in self._residuals(v))
        told = 1.0 - np.einsum("ka,ab,kb->k", rows, covariance, rows)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(told > _TOLD, left.ravel() / np.sqrt(told), np.nan)

    def evaluate(self, v: Array) -> tuple[float, Array, Array, Array]:
        """Cost, gradient (nv,), Hessian (nv, nv) and Gauss-Newton Hessian (nv, nv)."""
        if not self.count:
            none = np.zeros((len(v), len(v)))
            return 0.0, np.zeros(len(v)), none, none
        cost, gradient, hessian, jacobian = self._function(v)
        rows = np.asarray(jacobian).reshape(self.count, len(v))
        with np.errstate(over="ignore"):  # far out; what looks at it refuses a value that is not finite
            return float(cost), np.asarray(gradient).ravel(), np.asarray(hessian), rows.T @ rows
