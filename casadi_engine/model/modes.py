"""Eigenvalues, natural frequencies and mode shapes of a linear core, and their derivatives."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ModelError

Array = NDArray[np.float64]

# The matrix whose eigenvalues LAPACK finds is up to about this many roundings of its norm away from the one given.
_ROUNDINGS = 30.0
# Eigenvalues closer than this share of their modulus count as one: rounding splits a defective pair by 1e-8.
SIMPLE_TOLERANCE = 1e-7


@dataclass(frozen=True, eq=False)
class Modes:
    """The modes of ẋ = A x: one for each real eigenvalue or conjugate pair.

    states : (n,) names of the states
    eigenvalues : (k,) complex [1/s]; of a pair, the one with positive imaginary part. First the aperiodic
        modes (the rigid body mode is one) by rising modulus, then the oscillatory ones
    numbers : (k,) 0 for aperiodic modes; 1, 2, … for oscillatory ones by rising frequency
    shapes : (n, k) complex, columns are eigenvectors, the largest displacement component set to 1
    displacements : (n,) bool, True for the states that are displacements (twists)
    undamped_hz : (j,) natural frequencies without dampers [Hz], rising, the rigid body mode left out
    """

    states: tuple[str, ...]
    eigenvalues: NDArray[np.complex128]
    numbers: tuple[int, ...]
    shapes: NDArray[np.complex128]
    displacements: NDArray[np.bool_]
    undamped_hz: Array

    def __post_init__(self) -> None:
        for values in (self.eigenvalues, self.shapes, self.displacements, self.undamped_hz):
            values.setflags(write=False)

    @property
    def frequencies_hz(self) -> Array:
        """(k,) |λ|/2π [Hz]; for an aperiodic mode its corner frequency."""
        return np.abs(self.eigenvalues) / (2 * math.pi)

    @property
    def damping_ratios(self) -> Array:
        """(k,) −Re λ/|λ|, dimensionless; 1 for a stable aperiodic mode, 0 for λ = 0."""
        size = np.abs(self.eigenvalues)
        return np.divide(-self.eigenvalues.real, size, out=np.zeros_like(size), where=size > 0)

    @property
    def deformations(self) -> Array:
        """(displacements, k) moduli of the displacement components, the largest of each mode 1."""
        return np.abs(self.shapes[self.displacements])

    @property
    def oscillatory(self) -> int:
        """The number of oscillatory modes."""
        return max(self.numbers, default=0)

    def frequency(self, number: int) -> float:
        """Return the natural frequency |λ|/2π [Hz] of oscillatory mode `number`, from 1.

        ModelError if there is no such mode.
        """
        return float(self.frequencies_hz[self.numbers.index(_checked_mode(number, self.oscillatory))])

    def needed(self, up_to_hz: float, *, margin: float = 1.0) -> int:
        """Return the degrees of freedom that a chain of inertias needs to have all resonances up to `up_to_hz`.

        One for the rigid body and one for each oscillatory mode up to margin · up_to_hz [Hz]. This is the
        thesis's count: the 7-DOF crankshaft has no resonance between 21 and 300 Hz, so two inertias have them all.
        It is the least that can do, not a promise of accuracy: a mode above the range yields within it too, so
        that amplitudes near the range's upper end may be far off (by 10 % from a third of the first left-out
        frequency, for this crankshaft). `reduce` decides by that error; margin=3 is the like of it here.
        ModelError for numbers that are not > 0.

        >>> from casadi_engine.model import crankshaft
        >>> crankshaft().modes().needed(300), crankshaft().modes().needed(300, margin=3)
        (2, 4)
        """
        for name, value in (("up_to_hz", up_to_hz), ("margin", margin)):
            if not isinstance(value, Real) or isinstance(value, bool) or not 0 < float(value) < math.inf:
                raise ModelError(
                    f"the option {name} is not acceptable",
                    seen=repr(value),
                    allowed="a finite number > 0",
                    cure="give needed(300, margin=1.5), for instance",
                )
        limit = float(margin) * float(up_to_hz)
        return 1 + sum(self.frequency(k) <= limit for k in range(1, self.oscillatory + 1))

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, ready for JSON."""
        return {
            "states": list(self.states),
            "numbers": list(self.numbers),
            "frequencies_hz": self.frequencies_hz.tolist(),
            "undamped_hz": self.undamped_hz.tolist(),
            "damping_ratios": self.damping_ratios.tolist(),
            "eigenvalues": [[value.real, value.imag] for value in self.eigenvalues.tolist()],
            "shapes": [[[value.real, value.imag] for value in row] for row in self.shapes.tolist()],
        }

    def _rows(self) -> list[list[str]]:
        shown = self.displacements if self.displacements.any() else np.ones_like(self.displacements)
        names = [f"|{name}|" for name, take in zip(self.states, shown, strict=True) if take]
        rows = [["mode", "frequency [Hz]", "undamped [Hz]", "damping ratio", *names]]
        matched = len(self.undamped_hz) == self.oscillatory  # an overdamped pair leaves no partner
        for index, number in enumerate(self.numbers):
            undamped = f"{self.undamped_hz[number - 1]:.4f}" if number and matched else "-"
            rows.append(
                [
                    str(number) if number else "aperiodic",
                    f"{self.frequencies_hz[index]:.4f}",
                    undamped,
                    f"{self.damping_ratios[index]:.4f}",
                    *(f"{value:.4f}" for value in np.abs(self.shapes[shown, index])),
                ]
            )
        return rows

    def __str__(self) -> str:
        rows = self._rows()
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        return "\n".join(
            "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows
        )

    def _repr_html_(self) -> str:
        head, *body = self._rows()
        lines = "".join(
            "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in body
        )
        return (
            "<table><tr>"
            + "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
            + f"</tr>{lines}</table>"
        )


def is_geometric(unit: str) -> bool:
    """True for the unit of a ratio, an angle or a length: no mass and no time in it.

    >>> is_geometric("1"), is_geometric("m/rad"), is_geometric("N m/rad")
    (True, True, False)
    """
    return set(re.findall(r"[^\W\d_]+", unit)) <= {"m", "mm", "cm", "rad", "deg"}


def displacement_states(
    a: Any, geometric: Any = None, rates: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Find the states that are displacements, (n,) bool, from the SX matrix A.

    geometric : SX column of the parameters that are ratios, angles or lengths; none if left out
    rates : (n,) True for states that are rates by their unit, such as rad/s

    A displacement's rate is a sum of speeds with factors of geometry: its row of A holds numbers and geometric
    parameters, not all zero, and none of them at another such row's place. Something must depend on it: an absolute
    angle, whose column is zero, deforms nothing. Rows of numbers go first: in q' = v, v' = -w² q with a w that has
    no unit both could be displacements. Of two others that ask for each other, the one that is no rate by its unit is
    the displacement; without units neither is.
    """
    size = a.size1()
    allowed = {s.element_hash() for s in ca.symvar(geometric)} if geometric is not None else set()
    used = [{s.element_hash() for s in ca.symvar(a[row, :])} for row in range(size)]
    able = np.array(
        [
            used[row] <= allowed
            and not a[row, :].is_zero()
            and a[row, row].is_zero()
            and not a[:, row].is_zero()
            for row in range(size)
        ],
        dtype=bool,
    )
    there = np.zeros((size, size), dtype=bool)
    there[tuple(np.array(part, dtype=int) for part in ca.sparsify(a).sparsity().get_triplet())] = True
    constant = able & np.array([not names for names in used], dtype=bool)
    found: NDArray[np.bool_] = constant & ~np.any(there & constant, axis=1)
    open_ = able & ~constant & ~np.any(there & found, axis=1) & ~np.any(there[found], axis=0)
    for wanted in (open_,) if rates is None else (open_ & ~rates, open_):
        left = wanted & ~np.any(there & found, axis=1) & ~np.any(there[found], axis=0)
        found = found | (left & ~np.any(there & left, axis=1) & ~np.any(there[left], axis=0))
    return found


def modes_of(a: Array, *, states: tuple[str, ...], displacements: NDArray[np.bool_]) -> Modes:
    """Return the modes of the matrix `a` (n, n) [1/s]; see `Modes` for the order and normalisation."""
    values, vectors, limit = _eigen(a)
    real, pairs = _kinds(values, limit)
    order = np.concatenate([part[np.argsort(np.abs(values[part]), kind="stable")] for part in (real, pairs)])
    measured = displacements if displacements.any() else np.ones_like(displacements)
    shapes = vectors[:, order]
    for column in range(shapes.shape[1]):
        within = np.where(measured, np.abs(shapes[:, column]), 0.0)
        if within.max() < 1e-12:  # a mode without deformation is scaled by its speeds
            within = np.abs(shapes[:, column])
        shapes[:, column] /= shapes[int(np.argmax(within)), column]
    return Modes(
        states=tuple(states),
        eigenvalues=values[order],
        numbers=(0,) * len(real) + tuple(range(1, len(pairs) + 1)),
        shapes=shapes,
        displacements=displacements.copy(),
        undamped_hz=_undamped(a, displacements),
    )


def _eigen(a: Array) -> tuple[NDArray[np.complex128], NDArray[np.complex128], Array]:
    """Eigenvalues, right eigenvectors, and how far rounding may have moved each eigenvalue [1/s].

    LAPACK's eigenvalues are those of a matrix a few roundings of the balanced norm away; an eigenvalue moves by that
    times its condition, 1/|yᵀ x| of the unit left and right eigenvectors, and a double one, which has no finite
    condition, by the geometric mean of that and the norm.
    """
    import scipy.linalg

    if not a.size:
        return np.zeros(0, complex), np.zeros((0, 0), complex), np.zeros(0)
    balanced, turn = scipy.linalg.matrix_balance(a)
    found: Any = scipy.linalg.eig(balanced, left=True, right=True)
    values, left, right = found
    overlap = np.abs(np.einsum("ij,ij->j", left.conj(), right))
    norm = np.linalg.norm(balanced)
    moved = _ROUNDINGS * np.finfo(float).eps * norm
    limit = np.minimum(moved / np.maximum(overlap, 1e-300), np.sqrt(moved * norm))
    return values.astype(complex), (turn @ right).astype(complex), limit


def _kinds(values: NDArray[np.complex128], limit: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The real eigenvalues, and of each conjugate pair the one with positive imaginary part.

    A pair that rounding may have split off a double real eigenvalue counts as two real ones.
    """
    real = np.flatnonzero(np.abs(values.imag) <= limit)
    return real, np.flatnonzero(values.imag > limit)


def _undamped(a: Array, displacements: NDArray[np.bool_]) -> Array:
    """Natural frequencies [Hz] with all forces by speeds taken away, rising, without zeros."""
    kinematic = displacements[:, None] != displacements[None, :]
    values, _, limit = _eigen(np.where(kinematic, a, 0.0))
    _, pairs = _kinds(values, limit)
    return np.sort(np.abs(values[pairs])) / (2 * math.pi)


def natural_frequency_derivatives(
    a: Array, da: Array, d2a: Array | None = None, k: int = 1
) -> tuple[float, Array, Array | None]:
    """Return the k-th natural frequency |λ_k|/2π [Hz], its gradient (nz,) and its Hessian (nz, nz).

    a : (n, n)    da : (n, n, nz) ∂A/∂z    d2a : (n, n, nz, nz) ∂²A/∂z², or None for no Hessian
    k : oscillatory modes are numbered from 1 by rising |λ|; aperiodic ones (the rigid body) do not count

    Analytic, from the left and right eigenvectors of a simple eigenvalue (Nelson's bordered system for the
    eigenvector's derivative), so that it holds for an A that is defective elsewhere.
    ModelError if there is no such mode, or its eigenvalue is not simple.
    """
    values, vectors, limit = _eigen(a)
    _, pairs = _kinds(values, limit)
    pairs = pairs[np.argsort(np.abs(values[pairs]), kind="stable")]
    which = pairs[_checked_mode(k, len(pairs)) - 1]
    value, right = values[which], vectors[:, which]
    left = _left_vector(a, value, right)
    slopes = np.einsum("i,ijz,j->z", left, da, right)
    size = abs(value)
    gradient = (np.conj(value) * slopes).real / size
    if d2a is None:
        return size / (2 * math.pi), gradient / (2 * math.pi), None
    turns = _vector_derivatives(a, da, value, right, left, slopes)
    cross = np.einsum("i,ijz,jy->zy", left, da, turns)
    curvature = np.einsum("i,ijzy,j->zy", left, d2a, right) + cross + cross.T
    hessian = (np.outer(np.conj(slopes), slopes) + np.conj(value) * curvature).real / size
    hessian -= np.outer(gradient, gradient) / size
    return size / (2 * math.pi), gradient / (2 * math.pi), (hessian + hessian.T) / (4 * math.pi)


def _left_vector(a: Array, value: complex, right: NDArray[Any]) -> NDArray[Any]:
    """The left eigenvector yᵀ A = λ yᵀ with yᵀ v = 1."""
    values, vectors = np.linalg.eig(a.T)
    distance = np.abs(values - value)
    if np.count_nonzero(distance < SIMPLE_TOLERANCE * abs(value)) > 1:
        raise ModelError(
            "the natural frequency has no derivative, because its eigenvalue is not simple",
            seen=f"lambda = {value:.6g} 1/s",
            allowed="an eigenvalue apart from all others",
            cure="move the parameters off this point, or leave this mode unconstrained",
        )
    left = vectors[:, int(np.argmin(distance))]
    return left / (left @ right)


def _vector_derivatives(
    a: Array, da: Array, value: complex, right: NDArray[Any], left: NDArray[Any], slopes: NDArray[Any]
) -> NDArray[Any]:
    """(n, nz) derivatives of the right eigenvector with yᵀ dv = 0, from the bordered system."""
    size = len(right)
    bordered = np.zeros((size + 1, size + 1), dtype=complex)
    bordered[:size, :size] = value * np.eye(size) - a
    bordered[:size, size] = right
    bordered[size, :size] = left
    rates = np.einsum("ijz,j->iz", da, right) - np.outer(right, slopes)
    return np.linalg.solve(bordered, np.vstack([rates, np.zeros((1, rates.shape[1]))]))[:size]


def _checked_mode(number: int, available: int) -> int:
    real = isinstance(number, Real) and not isinstance(number, bool) and math.isfinite(number)
    if not real or number != int(number) or not 1 <= number <= available:
        raise ModelError(
            "there is no such oscillatory mode",
            seen=repr(number),
            allowed=f"1 to {available}" if available else "none: all modes are aperiodic",
            cure="print(model.modes()) lists them; the rigid body mode and overdamped ones have no number",
        )
    return int(number)


def matrix_derivatives(matrix: Any, z: Any) -> Callable[[Any], tuple[Array, Array, Array]]:
    """Return a function z -> (a, da, d2a) for an SX matrix (n, m) in the SX column z (nz, 1).

    a : (n, m), da : (n, m, nz), d2a : (n, m, nz, nz), as `natural_frequency_derivatives` takes them.
    """
    rows, columns = matrix.shape
    flat = ca.vec(ca.densify(matrix))
    first = ca.jacobian(flat, z)
    second = ca.jacobian(ca.vec(ca.densify(first)), z)
    function = ca.Function("matrix_derivatives", [z], [flat, first, second])
    count = z.numel()

    def evaluate(point: Any) -> tuple[Array, Array, Array]:
        value, slope, curvature = (np.array(part.full()) for part in function(point))
        return (
            value.reshape((rows, columns), order="F"),
            slope.reshape((rows, columns, count), order="F"),
            curvature.reshape((rows, columns, count, count), order="F"),
        )

    return evaluate
