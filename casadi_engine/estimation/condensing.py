"""Condensing: the shooting nodes of a record eliminated from a Newton step through its linearised continuity.

With ends e(i) and their slopes E(i) in the node and Z(i) in the parameters, continuity to first order is
ds(i+1) = E(i) ds(i) + Z(i) dv + e(i) - s(i+1): every node's step is affine in w = [dv; ds(0)], and the step of the
whole record is that of a problem in w alone (Bock & Plitt 1984, section 4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Condensed:
    """A record's share of the step in w = [dv (na); ds(0) (n)], and the way back to the nodes.

    turn : (M, n, na+n) and shift (M, n) give ds(i) = turn[i] w + shift[i];
    hessian : (na+n, na+n), without the parameters' own block; gradient : (na+n,), without the parameters' own part
    """

    turn: Array
    shift: Array
    hessian: Array
    gradient: Array

    def nodes(self, w: Array) -> Array:
        """(M, n) steps of the nodes."""
        return self.turn @ w + self.shift


def condense(end_z: Array, end_s: Array, gap: Array, blocks: tuple[Array, Array], slope: Array) -> Condensed:
    """Condense one record.

    end_z : (na, n, M); end_s : (1 or M, n, n); gap : (M-1, n) of continuity; blocks : zs (na, n, M) and ss (M, n, n)
    of the Hessian; slope : (M, n) gradient in the nodes
    """
    na, n, m = end_z.shape
    push = np.zeros((m, n, na + n + 1))
    push[:, :, :na] = end_z.transpose(2, 1, 0)
    push[: m - 1, :, -1] = gap
    path = np.zeros((m, n, na + n + 1))
    path[0, :, na : na + n] = np.eye(n)
    common = end_s[0] if len(end_s) == 1 else None
    for i in range(m - 1):
        np.matmul(end_s[i] if common is None else common, path[i], out=path[i + 1])
        path[i + 1] += push[i]
    turn, shift = path[:, :, :-1], path[:, :, -1]
    zs, ss = blocks
    bent = ss @ path  # (M, n, na+n+1)
    flat = np.ascontiguousarray(turn).reshape(m * n, na + n)
    total = flat.T @ bent.reshape(m * n, na + n + 1)
    cross = zs.transpose(0, 2, 1).reshape(na, m * n) @ path.reshape(m * n, na + n + 1)
    hessian, gradient = total[:, :-1].copy(), total[:, -1] + flat.T @ slope.ravel()
    hessian[:na] += cross[:, :-1]
    hessian[:, :na] += cross[:, :-1].T
    gradient[:na] += cross[:, -1]
    return Condensed(turn, shift, hessian, gradient)


def joint_multipliers(end_s: Array, slope: Array) -> Array:
    """Multipliers (n, M-1) of continuity from the gradient (M, n) in the nodes, by one backward sweep."""
    m, n = slope.shape
    lam = np.empty((max(m - 1, 0), n))
    common = np.ascontiguousarray(end_s[0].T) if len(end_s) == 1 else None
    total = np.zeros(n)
    for i in range(m - 1, 0, -1):
        total = slope[i] + (end_s[i].T if common is None else common) @ total
        lam[i - 1] = total
    return lam.T
