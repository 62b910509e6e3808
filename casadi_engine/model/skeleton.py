"""The torsional skeleton of a model: its inertias, couplings and dampers, read off the linear core."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ModelError
from casadi_engine.model.model import Model

# Coefficients below this share of the largest one of a sum are rounding of what cancels.
_NOTHING = 1e-9


@dataclass(frozen=True)
class Sum:
    """A quantity that is affine in parameters: Σ coefficient · parameter + constant.

    >>> str(Sum({"J1": 1.0, "J2": 2.0}))
    'J1 + 2*J2'
    """

    terms: Mapping[str, float]
    constant: float = 0.0

    def __add__(self, other: Sum) -> Sum:
        terms = dict(self.terms)
        for name, factor in other.terms.items():
            terms[name] = terms.get(name, 0.0) + factor
        return Sum({name: factor for name, factor in terms.items() if factor}, self.constant + other.constant)

    def __str__(self) -> str:
        parts = [name if factor == 1 else f"{factor:.12g}*{name}" for name, factor in self.terms.items()]
        parts += [f"{self.constant:.12g}"] if self.constant or not parts else []
        return " + ".join(parts).replace("+ -", "- ")

    @property
    def single(self) -> str | None:
        """The parameter that this is, or None if it is more than one or a multiple."""
        only = len(self.terms) == 1 and not self.constant and list(self.terms.values()) == [1.0]
        return next(iter(self.terms)) if only else None

    def value(self, values: Mapping[str, float]) -> float:
        """Its number for the parameters' values."""
        return self.constant + sum(factor * values[name] for name, factor in self.terms.items())


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Inertias and couplings of a model, in the order of its ports.

    inertias, couplings : names of the ports
    speeds, twists : the states' indices
    near, far : for each coupling the indices of the inertias on its first and second side
    inertia : J [kg m2], absolute : damper to the ground [N m s/rad], for each inertia
    stiffness : K [N m/rad], damping : C [N m s/rad], for each coupling
    """

    inertias: tuple[str, ...]
    couplings: tuple[str, ...]
    speeds: tuple[int, ...]
    twists: tuple[int, ...]
    near: tuple[int, ...]
    far: tuple[int, ...]
    inertia: tuple[Sum, ...]
    absolute: tuple[Sum, ...]
    stiffness: tuple[Sum, ...]
    damping: tuple[Sum, ...]


def skeleton_of(model: Model) -> Skeleton:
    """Read the inertias and couplings of a model that is a chain or tree of them (`declare_chain`).

    ModelError if it is not: no linear core, couplings whose twist is no state, loops, or quantities that are
    not sums of parameters.
    """
    core = model.linear
    if core is None:
        raise _no_chain(model, "a model without linear core")
    index = {model.x[i].element_hash(): i for i in range(model.x.numel())}
    slot = {port.name: k for k, port in enumerate(model.ports.with_slot)}
    bodies = [
        port for port in model.ports if port.kind == "inertia" and _state(port, "speed", index) is not None
    ]
    joints = [port for port in model.ports if port.kind == "coupling"]
    speeds = [index[port.signals["speed"].element_hash()] for port in bodies]
    found = [_state(port, "twist", index) for port in joints]
    if not bodies or len(joints) != len(bodies) - 1 or None in found:
        raise _no_chain(model, f"{len(bodies)} inertias, {len(joints)} couplings with a state twist")
    twists = [int(each) for each in found if each is not None]
    near, far = _sides(model, twists, speeds)
    j = [1 / core.G[row, slot[port.name]] for row, port in zip(speeds, bodies, strict=True)]
    a = core.A
    stiff = [j[side] * a[speeds[side], twist] for side, twist in zip(near, twists, strict=True)]
    damp = [j[one] * a[speeds[one], speeds[two]] for one, two in zip(near, far, strict=True)]
    ground = [-body * a[row, row] for body, row in zip(j, speeds, strict=True)]
    for coupling, (one, two) in enumerate(zip(near, far, strict=True)):
        ground[one] -= damp[coupling]
        ground[two] -= damp[coupling]
    size, links = len(bodies), len(joints)
    scales = (
        [None] * size + [body * a[row, row] for body, row in zip(j, speeds, strict=True)] + [None] * 2 * links
    )
    sums = sums_of(model, [*j, *ground, *stiff, *damp], scales)
    if None in sums:
        raise _no_chain(model, "an inertia, stiffness or damper that is no sum of parameters")
    made: list[Sum] = [each for each in sums if each is not None]
    ends = np.cumsum([0, size, size, links, links])
    inertia, absolute, stiffness, damping = (tuple(made[i:j]) for i, j in pairwise(ends))
    skeleton = Skeleton(
        inertias=tuple(port.name for port in bodies),
        couplings=tuple(port.name for port in joints),
        speeds=tuple(speeds),
        twists=tuple(twists),
        near=tuple(near),
        far=tuple(far),
        inertia=inertia,
        absolute=absolute,
        stiffness=stiffness,
        damping=damping,
    )
    _check_complete(model, skeleton)
    return skeleton


def sums_of(model: Model, expressions: list[Any], scales: list[Any] | None = None) -> list[Sum | None]:
    """For each SX expression of the parameters the Sum that it is, or None if it is not affine in them.

    Found by values and gradients at three points: CasADi does not cancel J·(K/J) by itself.
    scales : for each expression one of the size of what cancels in it, or None for its own size
    """
    column = ca.vertcat(*expressions)
    sizes = ca.vertcat(
        *(each if s is None else s for each, s in zip(expressions, scales or expressions, strict=True))
    )
    function = ca.Function(
        "sums", [model.p], [ca.densify(column), ca.densify(ca.jacobian(column, model.p)), sizes]
    )
    base = np.abs(model.parameter_vector())
    base[base == 0] = 1.0
    points = [base * factor for factor in np.random.default_rng(0).uniform(0.5, 2.0, (3, len(base)))]
    results = [tuple(np.array(part.full()) for part in function(point)) for point in points]
    made: list[Sum | None] = []
    for row in range(len(expressions)):
        slopes = np.array([jacobian[row] * points[0] for _, jacobian, _ in results])
        rests = np.array(
            [
                value[row, 0] - jacobian[row] @ point
                for (value, jacobian, _), point in zip(results, points, strict=True)
            ]
        )
        size = max(abs(result[2][row, 0]) for result in results)
        alike = (
            np.ptp(slopes, axis=0).max(initial=0.0) <= _NOTHING * size and np.ptp(rests) <= _NOTHING * size
        )
        made.append(_sum(model, slopes[0] / points[0], slopes[0], rests[0], size) if alike else None)
    return made


def _sum(model: Model, factors: NDArray[Any], parts: NDArray[Any], rest: float, size: float) -> Sum:
    terms = {
        name: _rounded(factor)
        for name, factor, part in zip(model.parameter_names, factors, parts, strict=True)
        if abs(part) > _NOTHING * size
    }
    return Sum(terms, _rounded(rest) if abs(rest) > _NOTHING * size else 0.0)


def _rounded(number: float) -> float:
    """The short number that this is but for rounding, or the number itself."""
    short = float(f"{number:.9g}")
    return short if abs(short - number) <= 1e-13 * abs(number) else float(number)


def _state(port: Any, signal: str, index: Mapping[int, int]) -> int | None:
    """The index of the state that is this signal of a port, or None."""
    expression = port.signals.get(signal)
    if expression is None or not expression.is_symbolic():
        return None
    return index.get(expression.element_hash())


def _sides(model: Model, twists: list[int], speeds: list[int]) -> tuple[list[int], list[int]]:
    """The inertias on both sides of each coupling: its twist grows with the speed of the second one."""
    near, far = [], []
    for twist in twists:
        row = model.linear.A[twist, :]  # type: ignore[union-attr]
        rates = np.array(ca.DM(ca.densify(row))).ravel() if row.is_constant() else np.zeros(0)
        ends = {float(rates[state]): k for k, state in enumerate(speeds) if rates.size and rates[state]}
        if set(ends) != {-1.0, 1.0} or np.count_nonzero(rates) != 2 or ends[-1.0] >= ends[1.0]:
            raise _no_chain(
                model, f"d({model.states[twist].name})/dt is no difference of a later and an earlier speed"
            )
        near.append(ends[-1.0])
        far.append(ends[1.0])
    if sorted(far) != list(range(1, len(speeds))):
        raise _no_chain(model, "couplings that make a loop")
    return near, far


def _check_complete(model: Model, skeleton: Skeleton) -> None:
    """The skeleton must explain all of A between speeds and twists, or the model has more than it."""
    values = dict(zip(model.parameter_names, model.parameter_vector(), strict=True))
    matrix = ca.Function("a", [model.p], [ca.densify(model.linear.A)])(model.parameter_vector()).full()  # type: ignore[union-attr]
    size = len(skeleton.inertias)
    differences = np.zeros((len(skeleton.couplings), size))
    rows = np.arange(len(skeleton.couplings))
    differences[rows, list(skeleton.near)], differences[rows, list(skeleton.far)] = -1.0, 1.0
    j, ground, stiff, damp = (
        np.array([each.value(values) for each in part])
        for part in (skeleton.inertia, skeleton.absolute, skeleton.stiffness, skeleton.damping)
    )
    speeds, twists = list(skeleton.speeds), list(skeleton.twists)
    among = -(differences.T @ (damp[:, None] * differences) + np.diag(ground)) / j[:, None]
    pulled = -(differences * stiff[:, None]).T / j[:, None]
    for found, expected in (
        (matrix[np.ix_(speeds, speeds)], among),
        (matrix[np.ix_(speeds, twists)], pulled),
    ):
        if not np.allclose(found, expected, rtol=1e-7, atol=1e-9 * np.abs(found).max(initial=0.0)):
            raise _no_chain(model, "dampers or springs that belong to no coupling port")


def _no_chain(model: Model, seen: str) -> ModelError:
    return ModelError(
        f"the model {model.name} cannot be read as inertias joined by couplings",
        seen=seen,
        allowed="a chain or tree of inertias and couplings with constant J, K, C that are sums of parameters",
        cure="build it by crankshaft(...), two_mass(...) or declare_chain(...)",
    )
