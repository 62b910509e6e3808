"""The row space of a growing matrix over a prime field, kept in reduced echelon form."""

from __future__ import annotations

import numpy as np

from casadi_engine.identifiability.field import Field, Matrix


class Echelon:
    """Rows taken in one after the other; the form at the end does not depend on their order.

    columns : number of columns
    """

    def __init__(self, field: Field, columns: int) -> None:
        self.field, self.columns = field, columns
        self._rows = np.zeros((columns, columns), dtype=np.int64)
        self.pivots: list[int] = []  # column of the leading one of each row, in the order of arrival

    @property
    def rank(self) -> int:
        """Rows that were independent of those before."""
        return len(self.pivots)

    @property
    def rows(self) -> Matrix:
        """(rank, columns) in reduced echelon form, the rows in the order of their pivots."""
        order = np.argsort(np.array(self.pivots, dtype=np.int64))
        return self._rows[: self.rank][order]

    def add(self, rows: Matrix) -> int:
        """Take in (m, columns); return by how much the rank grew."""
        before = self.rank
        if before and before < self.columns:
            rows = self.reduced(rows)
        for row in rows:
            if self.rank == self.columns:
                break
            if self.rank > before:  # those of this block have not been taken out yet
                row = self.reduced(row[None])[0]
            self._insert(row)
        return self.rank - before

    def reduced(self, rows: Matrix) -> Matrix:
        """What is left of rows when the row space is taken out: zero for those inside."""
        if not self.pivots:
            return rows
        basis = self._rows[: self.rank]
        return self.field.difference(rows, self.field.product(rows[:, self.pivots], basis))

    def contains(self, rows: Matrix) -> list[bool]:
        """For each row (m, columns): is it in the row space?"""
        left = self.reduced(rows)
        return [not row.any() for row in left]

    def null_space(self) -> Matrix:
        """(columns, columns - rank), a basis of the vectors that every row maps to zero."""
        return null_space_of(self.field, self.rows, sorted(self.pivots))

    def _insert(self, row: Matrix) -> None:
        places = np.flatnonzero(row)
        if not places.size:
            return
        pivot, field = int(places[0]), self.field
        row = field.scaled(row, field.inverse(int(row[pivot])))
        rank = self.rank
        column = self._rows[:rank, pivot]
        if column.any():
            hit = np.flatnonzero(column)
            taken = field.product(column[hit, None], row[None])
            self._rows[hit] = field.difference(self._rows[hit], taken)
        self._rows[rank] = row
        self.pivots.append(pivot)


def echelon_of(field: Field, rows: Matrix) -> Echelon:
    """The row space of a matrix."""
    made = Echelon(field, rows.shape[1])
    made.add(rows)
    return made


def null_space_of(field: Field, rows: Matrix, pivots: list[int]) -> Matrix:
    """A basis of the null space of rows in reduced echelon form, (columns, free columns)."""
    columns = rows.shape[1]
    free = [column for column in range(columns) if column not in set(pivots)]
    made = np.zeros((columns, len(free)), dtype=np.int64)
    made[free, range(len(free))] = 1
    if free and pivots:
        made[pivots] = field.difference(np.zeros((len(pivots), len(free)), dtype=np.int64), rows[:, free])
    return made


def null_space(field: Field, rows: Matrix) -> Matrix:
    """A basis of the vectors that a matrix maps to zero, (columns, dimension)."""
    return echelon_of(field, rows).null_space()


def intersection(field: Field, one: Matrix, other: Matrix) -> Matrix:
    """A basis of the intersection of two column spaces (n, a) and (n, b), in reduced column echelon form."""
    opposite = field.difference(np.zeros_like(other), other)
    both = null_space(field, np.hstack([one, opposite]))
    if not both.shape[1]:
        return np.zeros((one.shape[0], 0), dtype=np.int64)
    vectors = field.product(one, both[: one.shape[1]])
    return np.ascontiguousarray(echelon_of(field, np.ascontiguousarray(vectors.T)).rows.T)
