"""Sizes that the data give: of parameters whose start says nothing, such as a start of 0, and of states."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ModelError

if TYPE_CHECKING:
    from casadi_engine.estimation.coordinates import Coordinates
    from casadi_engine.estimation.shooting import ShootingProblem
    from casadi_engine.parameters.compiled import ParameterMap

Array = NDArray[np.float64]

# A start is the size of its parameter unless the misfit asks for a change a million times as large.
_NO_SIZE = 1e-6
# And beyond so many times, the slope itself says nothing.
_NO_SLOPE = 1e15
# A state's scale is of no use where the state is so many times as large.
_LARGE = 1e3


def state_factors(problem: ShootingProblem, x: Array) -> Array | None:
    """(n,) factors on the states' scales where the start of the search is far larger than these; None without any.

    The solver joins its intervals to a share of the scale: rounding forbids it for a state of 1e8 with the scale 1.
    """
    return size_factors([lay.take(x) for lay in problem.layouts])


def size_factors(nodes: list[Array]) -> Array | None:
    """The same from the records' nodes (M, n)."""
    sizes = [np.abs(one).max(axis=0) for one in nodes if one.size]
    if not sizes or not np.isfinite(largest := np.max(sizes, axis=0)).all():
        return None
    return np.where(largest > _LARGE, largest, 1.0) if (largest > _LARGE).any() else None


def sized(pmap: ParameterMap, warm: Any) -> ParameterMap:
    """The parameters with the scales of a warm start where that is larger than the set's own: beside a start of 1e-22,
    a value of 0.01 would be 1e20 of its scale, and no number that a solver can move.

    warm : with ``values``; None without one
    """
    if warm is None or not len(pmap.free):
        return pmap
    known = [warm.values.get(name, 0.0) for name in pmap.free]
    sizes = np.abs(np.array(known, dtype=float))
    return replace(pmap, scale=np.where(np.isfinite(sizes), np.maximum(pmap.scale, sizes), pmap.scale))


def felt_scale(problem: ShootingProblem, coordinates: Coordinates, z: Array, x: Array) -> Array | None:
    """(nz,) sizes of the parameters at the start z, NaN where the start itself is one; None if it is for all.

    The size is the change of the parameter that moves all weighted residuals (and priors) together by as much as
    they are, by one standard deviation at least: about as far as the data can ask it to go, and never less than its
    standard error. It comes from the first evaluation of the search and knows nothing of bounds. Without any slope at
    the start it is 1.

    x : (size,) variables of the problem at z. Where the model cannot be evaluated there the answer is None.
    """
    if not len(z):
        return None
    try:
        point = problem.at(x)
        square = 2 * point.objective * problem.samples
        slope = np.diag(problem.priors.evaluate(x[: problem.nv])[3]).copy()
    except (FloatingPointError, np.linalg.LinAlgError, ModelError):
        return None
    for record, lay, found in zip(problem.records, problem.layouts, point.records, strict=True):
        slope[lay.active] += np.diag(record.gauss_newton(found).zz)
    return felt_sizes(square, slope, coordinates, z)


def felt_sizes(square: float, slope: Array, coordinates: Coordinates, z: Array) -> Array | None:
    """The same from the summed squares at z and those of their slopes in v (nv,)."""
    slope = slope / coordinates.slope(coordinates.of(z)) ** 2
    if not (np.isfinite(square) and np.isfinite(slope).all()):
        return None
    with np.errstate(divide="ignore"):
        felt = np.where(slope > 0, np.sqrt(max(square, 1.0) / np.where(slope > 0, slope, 1.0)), 1.0)
    blind = np.abs(z) < _NO_SIZE * felt
    # a slope that asks for more than the digits of a number is what is left of an underflow: it says nothing
    blind &= np.where(z == 0, True, (slope > 0) & (felt < _NO_SLOPE * np.abs(z)))
    return np.where(blind, felt, np.nan) if blind.any() else None
