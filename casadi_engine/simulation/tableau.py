"""Runge-Kutta schemes by their tableaus, and the derivatives of a step that follow from those of its stages.

A step x -> x1 with slopes φ_i = h f(X_i) at the stages is X_i = x + sum_j a_ij φ_j, x1 = x + sum_j b_j φ_j. All
that is needed of the model is φ with its first derivatives, and the Hessian of a weighted sum of its rows: the implicit
function theorem gives those of the step, for explicit and implicit schemes alike (Hairer, Nørsett & Wanner, Solving
Ordinary Differential Equations I, section II.6, and II, section IV.8).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import ask
from casadi_engine.simulation.jets import Array

# Rows of matrices up to which products of many of them are formed entry by entry.
_FEW = 4
# Steps of which the sensitivities are made at once: beyond, what waits for an end is asked in between.
_MANY = 65536
# A norm that bounds the eigenvalues closely enough, and of how many matrices these are found where norms are larger.
_SMALL, _WORST = 0.2, 16


@dataclass(frozen=True, eq=False)
class Tableau:
    """a : (S, S); b : (S,); c : (S,) nodes; order of the scheme; name in words."""

    name: str
    a: Array
    b: Array
    c: Array
    order: int

    @property
    def implicit(self) -> bool:
        """True if a stage needs its own slope or later ones."""
        return bool(np.triu(self.a).any())

    @property
    def stages(self) -> int:
        """Number of stages."""
        return len(self.b)

    @property
    def richardson(self) -> float:
        """The error of a step is this many times its difference from two steps of half the length."""
        power = 2.0**self.order
        return power / (power - 1)


RUNGE_KUTTA = Tableau(
    "Runge-Kutta steps of order 4",
    np.array([[0, 0, 0, 0], [0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 1.0, 0]]),
    np.array([1, 2, 2, 1]) / 6,
    np.array([0, 0.5, 0.5, 1.0]),
    4,
)


def _radau() -> Tableau:
    """Radau IIA with three stages: order 5, L-stable, its last stage is the step's end (Hairer & Wanner II, IV.5)."""
    r = np.sqrt(6.0)
    a = [
        [(88 - 7 * r) / 360, (296 - 169 * r) / 1800, (-2 + 3 * r) / 225],
        [(296 + 169 * r) / 1800, (88 + 7 * r) / 360, (-2 - 3 * r) / 225],
        [(16 - r) / 36, (16 + r) / 36, 1 / 9],
    ]
    return Tableau(
        "implicit Radau steps of order 5",
        np.array(a),
        np.array(a[2]),
        np.array([(4 - r) / 10, (4 + r) / 10, 1.0]),
        5,
    )


RADAU = _radau()


def stage_sensitivities(scheme: Tableau, by_x: Array, by_z: Array) -> tuple[Array, Array]:
    """Derivatives to (x, z) of the slopes and of the stage values, each (S, ..., n, n + nz).

    by_x : (S, ..., n, n) and by_z : (S, ..., n, nz) derivatives of φ at the stages
    """
    if by_x.ndim == 4 and by_x.shape[1] > _MANY:
        parts = [
            stage_sensitivities(scheme, by_x[:, k : k + _MANY], by_z[:, k : k + _MANY])
            for k in range(0, by_x.shape[1], _MANY)
        ]
        slopes, values = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
        return slopes, values
    ask()
    n = by_x.shape[-1]
    wide = n + by_z.shape[-1]
    identity = np.zeros((n, wide))
    identity[:, :n] = np.eye(n)
    if scheme.implicit:
        right = np.concatenate([by_x, by_z], axis=-1)
        try:
            solved = np.linalg.solve(_coupling(scheme, by_x), _stacked(right))
        except np.linalg.LinAlgError as fault:  # as where the states themselves are no numbers
            raise FloatingPointError("the stages of an implicit step have no slopes") from fault
        slopes = _unstacked(solved, scheme.stages)
    else:
        slopes = _empty_like(by_x, wide)
        for i in range(scheme.stages):
            inner = identity + _summed(scheme.a[i, :i], slopes)
            slopes[i] = products(by_x[i], inner)
            slopes[i, ..., n:] += by_z[i]
    values = _empty_like(by_x, wide)
    for i in range(scheme.stages):
        values[i] = identity + _summed(scheme.a[i], slopes)
    return slopes, values


def products(a: Array, b: Array) -> Array:
    """The products (..., n, k) of many small matrices a (..., n, n) and b (..., n, k).

    Few rows are multiplied entry by entry, all matrices at once: a product of BLAS costs a call for each.
    """
    n = a.shape[-1]
    if n > _FEW:
        return np.asarray(a @ b)
    left, right = np.moveaxis(a, (-2, -1), (0, 1)), np.moveaxis(b, (-2, -1), (0, 1))
    found = np.empty((n, *right.shape[1:2], *left.shape[2:]))
    for i in range(n):
        np.multiply(left[i, 0], right[0], out=found[i])
        for j in range(1, n):
            found[i] += left[i, j] * right[j]
    return np.moveaxis(found, (0, 1), (-2, -1))


def growth(by_x: Array) -> float:
    """The largest |eigenvalue| of h df/dx at the steps' starts (..., n, n), from those with the largest norms; where
    all norms are small the largest of these. Matrices that are not finite have none."""
    norms = np.abs(by_x).sum(axis=-1).max(axis=-1).ravel()
    finite = np.isfinite(norms)
    norms = np.where(finite, norms, 0.0)
    largest = float(norms.max(initial=0.0))
    if largest <= _SMALL:
        return largest
    worst = np.argsort(norms)[-_WORST:]
    worst = worst[finite[worst]]
    return float(np.abs(np.linalg.eigvals(by_x.reshape(-1, *by_x.shape[-2:])[worst])).max())


def _empty_like(by_x: Array, wide: int) -> Array:
    """(stages, ..., n, wide) without values, what many matrices have in common side by side in memory."""
    size, *batch, n, _ = by_x.shape
    return np.moveaxis(np.empty((size, n, wide, *batch)), (1, 2), (-2, -1))


def step_sensitivities(scheme: Tableau, slopes: Array) -> Array:
    """(..., n, n + nz) derivative of the step's end to (x, z)."""
    found = _summed(scheme.b, slopes)
    n = found.shape[-2]
    found[..., range(n), range(n)] += 1.0
    return found


def stage_multipliers(scheme: Tableau, by_x: Array, mu: Array) -> Array:
    """(S, ..., n) multipliers ν_i of the slopes φ_i for multipliers μ (..., n) of the step's end.

    ν_j = b_j μ + sum_i a_ij J_i' ν_i; second derivatives of μ·x1 are those of sum_j ν_j·φ_j at the stage values.
    """
    if scheme.implicit:
        right = np.stack([weight * mu for weight in scheme.b])[..., None]
        # rows: ν_j - sum_i a_ij J_i' ν_i
        size, n = scheme.stages, by_x.shape[-1]
        matrix = np.zeros((*by_x.shape[1:-2], size * n, size * n))
        for j in range(size):
            for i in range(size):
                block = -scheme.a[i, j] * by_x[i].swapaxes(-1, -2)
                matrix[..., j * n : (j + 1) * n, i * n : (i + 1) * n] = block
        matrix += np.eye(size * n)
        return _unstacked(np.linalg.solve(matrix, _stacked(right)), size)[..., 0]
    found = np.empty((scheme.stages, *mu.shape))
    for j in range(scheme.stages - 1, -1, -1):
        found[j] = scheme.b[j] * mu
        for i in range(j + 1, scheme.stages):
            if scheme.a[i, j]:
                found[j] += scheme.a[i, j] * (found[i][..., None, :] @ by_x[i])[..., 0, :]
    return found


def newton_step(scheme: Tableau, by_x: Array, residual: Array) -> Array:
    """The change (S, K, n) of the stage values of K steps that Newton's method asks for; residual : (S, K, n) of
    X_i - x - sum_j a_ij φ_j, by_x : (S, K, n, n)."""
    size, count, n = residual.shape
    # rows (s, i), columns (t, j) of every step at once: this is done some hundred thousand times for one fit
    parts = np.empty((count, size, n, size, n))
    np.multiply(-scheme.a[:, None, :, None], by_x.transpose(1, 2, 0, 3)[:, None], out=parts)
    parts.reshape(count, (size * n) ** 2)[:, :: size * n + 1] += 1.0
    right = residual.transpose(1, 0, 2).reshape(count, size * n, 1)
    made = -np.linalg.solve(parts.reshape(count, size * n, size * n), right)
    return np.asarray(made.reshape(count, size, n).transpose(1, 0, 2), dtype=np.float64)


def _coupling(scheme: Tableau, by_x: Array) -> Array:
    """The matrix of the slopes' derivatives: K_i - sum_j a_ij J_i K_j."""
    size, n = scheme.stages, by_x.shape[-1]
    matrix = np.zeros((*by_x.shape[1:-2], size * n, size * n))
    for i in range(size):
        for j in range(size):
            matrix[..., i * n : (i + 1) * n, j * n : (j + 1) * n] = -scheme.a[i, j] * by_x[i]
    matrix += np.eye(size * n)
    return matrix


def _summed(weights: Array, parts: Array) -> Array:
    """sum_j weights_j parts_j, leaving out what counts nothing."""
    total: Array | None = None
    for weight, part in zip(weights, parts, strict=False):
        if weight:
            total = weight * part if total is None else total + weight * part
    return np.zeros(parts.shape[1:]) if total is None else total


def _stacked(parts: Array) -> Array:
    """(S, ..., n, k) to (..., S n, k)."""
    moved = np.moveaxis(parts, 0, -3)
    return moved.reshape(*moved.shape[:-3], moved.shape[-3] * moved.shape[-2], moved.shape[-1])


def _unstacked(rows: NDArray[np.floating], stages: int) -> Array:
    """The reverse of ``_stacked``."""
    split = rows.reshape(*rows.shape[:-2], stages, rows.shape[-2] // stages, rows.shape[-1])
    return np.ascontiguousarray(np.moveaxis(split, -3, 0), dtype=np.float64)
