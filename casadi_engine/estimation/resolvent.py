"""(z - F)^-1 at many z by a Schur form, and rows that are made orthonormal: what works for every matrix."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import zgees

from casadi_engine.simulation.exponential import balance

Array = NDArray[np.float64]
Spectrum = NDArray[np.complex128]

# A combination of rows that shows by less than this share of them is held at zero.
_SPRING = 1e-9
# A Cholesky factor with a smaller entry on its diagonal has lost half the digits.
_DIGITS = 1e-6


class Resolvent:
    """(z - F)^-1 at many z (K,), by the complex Schur form of the balanced F (n, n).

    Unlike eigenvectors it exists to the last digit for every matrix: two integrators in a row have but one eigenvector.
    """

    def __init__(self, f: Array, z: Spectrum) -> None:
        turn = balance(f)
        self._turn = np.ones(len(f)) if turn is None else turn
        balanced = f * self._turn / self._turn[:, None]
        self._t, _, poles, self._u, _, info = zgees(lambda _: None, balanced)
        if info:
            raise np.linalg.LinAlgError("the Schur form does not converge")
        self._near = 1.0 / (z - poles[:, None])
        self.radius = float(np.abs(poles).max(initial=0.0))

    def rows(self, c: Array) -> Spectrum:
        """C (z - F)^-1, (ny, n, K), for C (ny, n)."""
        left, near = (c * self._turn) @ self._u, self._near
        found = np.empty((len(near), len(c), near.shape[1]), complex)
        for j in range(len(near)):
            found[j] = left[:, j, None]
            if j:
                found[j] += (self._t[:j, j] @ found[:j].reshape(j, -1)).reshape(found[j].shape)
            found[j] *= near[j]
        back = self._u.conj() / self._turn[:, None]
        return np.asarray((back @ found.reshape(len(near), -1)).reshape(found.shape).swapaxes(0, 1))

    def states(self, drive: Spectrum) -> Spectrum:
        """(z - F)^-1 times the drive (n, K)."""
        found = (self._u.conj().T / self._turn) @ drive
        for j in range(len(found) - 1, -1, -1):
            found[j] += self._t[j, j + 1 :] @ found[j + 1 :]
            found[j] *= self._near[j]
        return np.asarray((self._u * self._turn[:, None]) @ found)


@dataclass(frozen=True)
class Orthonormal:
    """Rows (r, L) that span given ones (n, L); ``back`` (n, r) makes coefficients of these of those of the rows."""

    rows: Array
    back: Array

    @classmethod
    def of(cls, given: Array) -> Orthonormal:
        """By Cholesky factors of the Gram matrix, twice; by Householder reflections where they lose digits."""
        size = np.linalg.norm(given, axis=1)
        known = np.flatnonzero(size > 0)
        back = np.zeros((len(given), len(known)))
        back[known, np.arange(len(known))] = 1 / size[known]
        rows = back.T @ given
        try:
            for _ in range(2):
                factor = np.linalg.cholesky(rows @ rows.T)
                if factor.diagonal().min(initial=1.0) < _DIGITS:
                    raise np.linalg.LinAlgError
                turn = np.linalg.inv(factor)
                rows, back = turn @ rows, back @ turn.T
        except np.linalg.LinAlgError:
            return cls._by_reflections(given, size, known)
        return cls(rows, back)

    @classmethod
    def _by_reflections(cls, given: Array, size: Array, known: NDArray[np.intp]) -> Orthonormal:
        """With a weak spring on every row, for those that are almost combinations of the others."""
        scaled = given[known] / size[known, None]
        q, r = np.linalg.qr(np.vstack([scaled.T, _SPRING * np.eye(len(known))]))
        back = np.zeros((len(given), len(known)))
        back[known] = np.linalg.inv(r) / size[known, None]
        return cls(np.ascontiguousarray(q[: given.shape[1]].T), back)

    def best(self, target: Array) -> Array:
        """Coefficients (n,) of the given rows that make the target (L,) least when added to it."""
        return -self.back @ (self.rows @ target)
