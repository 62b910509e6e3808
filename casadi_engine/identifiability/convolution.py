"""Sums Σ_j J_j S_{k-j} of matrix series over a prime field, online: S_{k+1} is known only after order k."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from casadi_engine.identifiability.field import Field, Limbs, Matrix

_ROOM = 32  # orders that there is room for at first


class Convolution:
    """The product of the series of a sparse matrix (m, n) and of dense matrices S_k (n, columns).

    places : (row, column) of the structural nonzeros. changes : whether each changes in time
    coefficient : (number of the nonzero, order) -> its coefficient
    """

    def __init__(
        self,
        field: Field,
        shape: tuple[int, int],
        columns: int,
        places: Sequence[tuple[int, int]],
        changes: Sequence[bool],
        coefficient: Callable[[int, int], int],
    ) -> None:
        self.field, self.columns, self._coefficient = field, columns, coefficient
        self._shape, self._places = shape, places
        self._moving = [q for q, moves in enumerate(changes) if moves]
        still = np.zeros(shape, dtype=np.int64)
        for q, (row, column) in enumerate(places):
            if not changes[q]:
                still[row, column] = coefficient(q, 0)
        self._still: Limbs = field.split(still)
        self._rows = sorted({places[q][0] for q in self._moving})
        self._inner = sorted({places[q][1] for q in self._moving})
        to_row = {row: i for i, row in enumerate(self._rows)}
        to_inner = {column: j for j, column in enumerate(self._inner)}
        self._at = [(to_row[places[q][0]], to_inner[places[q][1]]) for q in self._moving]
        self._room = 0
        self._history: Limbs = np.zeros((0, 0, 0, 0))
        self._matrices: Limbs = np.zeros((0, 0, 0, 0))
        self._allocate(_ROOM)

    @property
    def still(self) -> bool:
        """True if the matrix does not change in time: then S_k may as well be k! times what it is."""
        return not self._moving

    def next(self, k: int, latest: Matrix) -> Matrix:
        """Σ_j J_j S_{k-j}, (m, columns), where `latest` is S_k; to be called for k = 0, 1, 2, …"""
        field = self.field
        limbs = field.split(latest)
        total = field.product_of_limbs(self._still, limbs)
        if not self._moving:
            return total
        if k >= self._room:
            self._allocate(2 * self._room)
        self._history[:, k] = limbs[:, self._inner]
        now = np.zeros((len(self._rows), len(self._inner)), dtype=np.int64)
        for q, (row, column) in zip(self._moving, self._at, strict=True):
            now[row, column] = self._coefficient(q, k)
        # newest first, so that orders j and k - j meet
        self._matrices[:, :, self._room - 1 - k] = field.split(now)
        terms = (k + 1) * len(self._inner)
        left = self._matrices[:, :, self._room - 1 - k :].reshape(3, -1, terms)
        right = self._history[:, : k + 1].reshape(3, terms, -1)
        total[self._rows] = field.sum(total[self._rows], field.product_of_limbs(left, right))
        return total

    def _allocate(self, room: int) -> None:
        rows, inner = len(self._rows), len(self._inner)
        history = np.zeros((3, room, inner, self.columns))
        matrices = np.zeros((3, rows, room, inner))
        if self._room:
            history[:, : self._room] = self._history
            matrices[:, :, room - self._room :] = self._matrices
        self._room, self._history, self._matrices = room, history, matrices
