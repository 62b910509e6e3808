"""Sparse matrices of the multiple-shooting problem: fixed patterns, values filled by one permutation."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class Pattern:
    """A compressed-column pattern; ``matrix(raw)`` sorts raw block values into it."""

    def __init__(self, rows: Index, columns: Index, shape: tuple[int, int]) -> None:
        self.order = np.lexsort((rows, columns))
        counts = np.bincount(columns, minlength=shape[1])
        starts = np.concatenate([[0], np.cumsum(counts)])
        self.sparsity = ca.Sparsity(*shape, starts.tolist(), rows[self.order].tolist())

    def matrix(self, raw: Array) -> ca.DM:
        """The matrix with the block values ``raw``, in the order of the pattern's rows and columns."""
        return ca.DM(self.sparsity, raw[self.order])


class NodeLayout:
    """Where the nodes of one record stand: variables ``at`` + i*n + a, continuity rows ``row`` + i*n + a."""

    def __init__(self, at: int, row: int, intervals: int, states: int, active: Index) -> None:
        self.at, self.row, self.m, self.n, self.active = at, row, intervals, states, active

    def take(self, x: Array) -> Array:
        """(M, n) nodes out of the full vector."""
        return x[self.at : self.at + self.m * self.n].reshape(self.m, self.n)


def jacobian_pattern(nz: int, constraints: int, layouts: list[NodeLayout], shape: tuple[int, int]) -> Pattern:
    """Constraint Jacobian: parameter constraints (dense in z), then the continuity of every record."""
    user = np.indices((constraints, nz))
    rows, columns = [user[0].ravel()], [user[1].ravel()]
    for lay in layouts:
        joints = lay.m - 1
        i, a = np.indices((joints, lay.n))
        row = lay.row + i * lay.n + a
        rows.append(np.broadcast_to(row, (len(lay.active), joints, lay.n)).ravel())
        columns.append(np.repeat(lay.active, joints * lay.n))
        i, a, c = np.indices((joints, lay.n, lay.n))
        rows.append((lay.row + i * lay.n + a).ravel())
        columns.append((lay.at + i * lay.n + c).ravel())
        rows.append(row.ravel())
        columns.append((lay.at + lay.n + row - lay.row).ravel())
    return Pattern(np.concatenate(rows).astype(np.intp), np.concatenate(columns).astype(np.intp), shape)


def jacobian_values(user: Array, layouts: list[NodeLayout], ends: list[tuple[Array, Array]]) -> Array:
    """Raw values for ``jacobian_pattern``; ends: (end_z (nz, n, M), end_s (1 or M, n, n)) for each record."""
    parts = [user.ravel()]
    for lay, (end_z, end_s) in zip(layouts, ends, strict=True):
        joints = lay.m - 1
        parts.append(end_z[:, :, :joints].transpose(0, 2, 1).ravel())
        starts = end_s[:joints] if len(end_s) > 1 else end_s
        parts.append(np.broadcast_to(starts, (joints, lay.n, lay.n)).ravel())
        parts.append(np.full(joints * lay.n, -1.0))
    return np.concatenate(parts)


def hessian_pattern(nz: int, layouts: list[NodeLayout], size: int) -> Pattern:
    """Upper triangle: (z, z), then for every record (z, node) and (node, node)."""
    i, j = np.triu_indices(nz)
    rows, columns = [i], [j]
    for lay in layouts:
        k, a, m = np.indices((len(lay.active), lay.n, lay.m))
        rows.append(lay.active[k].ravel())
        columns.append((lay.at + m * lay.n + a).ravel())
        p, q = np.triu_indices(lay.n)
        base = lay.at + np.arange(lay.m)[:, None] * lay.n
        rows.append((base + p).ravel())
        columns.append((base + q).ravel())
    return Pattern(
        np.concatenate(rows).astype(np.intp), np.concatenate(columns).astype(np.intp), (size, size)
    )


def hessian_values(zz: Array, blocks: list[tuple[Array, Array]]) -> Array:
    """Raw values for ``hessian_pattern``; blocks: (zs (nz, n, M), ss (M, n, n)) for each record."""
    parts = [zz[np.triu_indices(len(zz))]]
    for zs, ss in blocks:
        p, q = np.triu_indices(ss.shape[1])
        parts += [zs.ravel(), ss[:, p, q].ravel()]
    return np.concatenate(parts)
