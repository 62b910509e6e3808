"""Second derivatives of the exponential integrator's outputs and ends, contracted with weights, by its adjoint.

With the adjoint r = [mu; eta] of a step's rows and omega of its laws, the second derivative in two directions a, b of
the weighted sum is, added over all steps,

    r P_ab c + r P_a c_b + r P_b c_a + omega w_ab,

c being the step's factors (state, drives, law torques) and w_ab the laws' own curvature along the signals'
sensitivities. All of it is matrix products over the whole record.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import ask
from casadi_engine.simulation import jets
from casadi_engine.simulation.exponential_pushes import Pushes
from casadi_engine.simulation.exponential_step import STAGES
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.sample_rows import from_rows

if TYPE_CHECKING:
    from casadi_engine.simulation.exponential_runge_kutta import ExponentialPropagator, ExponentialTrajectory

Parts = tuple[Array, Array, Array]

# Stages whose curvature is worked out together: their sensitivities then stay in the cache.
_PART = 24


def contracted(
    made: ExponentialPropagator, z: Array, path: ExponentialTrajectory, rho: Array, lam: Array
) -> Parts:
    """(z, z) (nz, nz), (z, start) (nz, n, M) and (start, start) (M, n, n) at a path of second order.

    rho : (R*ny, b, M) weights of the outputs; lam : (n, M) weights of the ends
    """
    n, weights = made.n, from_rows(made.intervals, rho, made.ny)
    rows, omega = _adjoint(made, path, weights, lam)
    total, zz = _by_laws(made, z, path, omega)
    zz += total[:, n:, n:].sum(axis=0)
    zs = np.ascontiguousarray(total[:, n:, :n].transpose(1, 2, 0))
    if made.nz:
        cross, crossed = _crossed(made, z, path, rows, weights)
        zz += _by_matrices(made, z, path, rows) + _by_outputs(made, z, path, weights) + cross + cross.T
        zs += crossed
    return zz, zs, total[:, :n, :n]


class _Backward:
    """One step of the adjoint: from what is wanted of its rows to what its state and laws are worth."""

    def __init__(self, made: ExponentialPropagator, path: ExponentialTrajectory) -> None:
        p, n, ns, nw = path.matrices.p[0], made.n, made.laws.size, made.laws.count
        at_law = n + 2 * path.matrices.m
        self.n, self.ns, self.nw = n, ns, nw
        self.free = np.ascontiguousarray(p[:, :n].T)
        self.turn = np.ascontiguousarray(p[:n, at_law:].T)
        self.feeds = [
            np.ascontiguousarray(p[n + (i + 1) * ns :, at_law + i * nw : at_law + (i + 1) * nw].T)
            for i in range(STAGES - 1)
        ]
        self.slopes, self.pattern = path.slopes[0], made.laws.pattern

    def laws(self, k: int, rows: Array, torques: Array) -> None:
        """Fill the stages' parts of rows (n + 4 ns, ., M), of which the first n are given, and add to the torques
        (4 nw, ., M) of what the laws are worth what the rows after them say."""
        n, ns, nw = self.n, self.ns, self.nw
        for i in range(STAGES - 1, -1, -1):
            torque, eta = torques[i * nw : (i + 1) * nw], rows[n + i * ns : n + (i + 1) * ns]
            if i < STAGES - 1:
                behind = rows[n + (i + 1) * ns :]
                torque += (self.feeds[i] @ behind.reshape(len(behind), -1)).reshape(torque.shape)
            eta[:] = 0.0
            for entry, (law, signal, _) in enumerate(self.pattern):
                eta[signal] += self.slopes[k, i, entry] * torque[law]


def _adjoint(
    made: ExponentialPropagator, path: ExponentialTrajectory, weights: Array, lam: Array
) -> tuple[Array, Array]:
    """The adjoint of each step's rows, (K, n + 4 ns, M), and of the stages' laws, (K, 4, nw, M)."""
    n, nw, count, sub = made.n, made.laws.count, made.intervals.m, made.substeps
    c, back = np.ascontiguousarray(path.matrices.c[0].T), _Backward(made, path)
    rows = np.empty((made.steps, path.matrices.p.shape[1], count))
    omega = np.empty((made.steps, STAGES * nw, count))
    mu = np.array(lam)
    for k in range(made.steps - 1, -1, -1):
        ask()
        row, torques = rows[k], omega[k]
        row[:n] = mu
        np.matmul(back.turn, mu, out=torques)
        back.laws(k, row, torques)
        mu = back.free @ row
        if k % sub == 0:
            mu += c @ weights[k // sub]
    return rows, omega.reshape(made.steps, STAGES, nw, count)


def _crossed(
    made: ExponentialPropagator, z: Array, path: ExponentialTrajectory, rows: Array, weights: Array
) -> tuple[Array, Array]:
    """Sums of r P_a c_b over all steps: for b in z, (nz, nz) with a down, and for b in the starts, (nz, n, M).

    The steps' own sensitivities c_b are not needed: a second adjoint carries r P_a back to what moves them.
    """
    n, m, nz, nw, count = made.n, path.matrices.m, made.nz, made.laws.count, made.intervals.m
    p, c = path.matrices.p, path.matrices.c
    samples, _, first, _ = made.drive_columns(z)
    pushes, back = Pushes(made, path.steps, path.matrices, z), _Backward(made, path)
    span, outputs = pushes.span(), None if jets.is_constant(c) else c[1 : 1 + nz]
    if outputs is not None:
        span = slice(0, nz)
    chosen = np.r_[0:n, n + 2 * m : p.shape[2]]
    picked = p[1 : 1 + nz][span][:, :, chosen]
    pull = np.ascontiguousarray(picked.transpose(2, 0, 1)).reshape(-1, p.shape[1])
    size = len(picked)
    nu = np.zeros((n, size, count))
    moved, direct = (
        np.zeros((p.shape[1], size, pushes.high - pushes.low)),
        np.zeros((size, len(made.laws.active))),
    )
    own = np.empty((p.shape[1], size, count))
    pulled = np.empty((len(chosen), size, count))
    by_z = path.slopes[1].reshape(made.steps, STAGES, len(made.laws.active), nw, count)
    for k in range(made.steps - 1, -1, -1):
        ask()
        np.matmul(pull, rows[k], out=pulled.reshape(len(pull), count))
        own[:n] = nu
        torques = pulled[n:]
        torques += (back.turn @ nu.reshape(n, -1)).reshape(torques.shape)
        back.laws(k, own, torques)
        moved += own @ pushes.at(k).transpose(0, 2, 1)
        if len(made.laws.active):
            worth = torques.reshape(STAGES, nw, size, count)
            direct += np.einsum("iwzm,iawm->za", worth, by_z[k])
        nu = (back.free @ own.reshape(len(own), -1)).reshape(n, size, count)
        nu += pulled[:n]
        if outputs is not None and k % made.substeps == 0:
            nu += np.einsum("zyi,ym->izm", outputs, weights[k // made.substeps])
    cross, crossed = np.zeros((nz, nz)), np.zeros((nz, n, count))
    cross[span, pushes.span()] = moved.sum(axis=0)
    cross[span, made.laws.active] += direct
    crossed[span] = nu.transpose(1, 0, 2)
    for row, index in enumerate(samples.active):
        force = np.matmul(rows, first[row].transpose(0, 2, 1)).sum(axis=0)
        cross[:, index] += p[1 : 1 + nz, :, n : n + 2 * m].reshape(nz, -1) @ force.ravel()
        slope = made.drive_samples(first[row])
        force = np.matmul(weights, slope.transpose(0, 2, 1)).sum(axis=0)
        cross[:, index] += path.matrices.d[1 : 1 + nz].reshape(nz, -1) @ force.ravel()
    return cross, crossed


def _by_matrices(made: ExponentialPropagator, z: Array, path: ExponentialTrajectory, rows: Array) -> Array:
    """What the second derivatives of the step's matrices and of the drives give, (nz, nz)."""
    n, nz, p, m = made.n, made.nz, path.matrices.p, path.matrices.m
    samples, _, _, second = made.drive_columns(z)
    outer = np.matmul(rows, path.steps.columns.transpose(0, 2, 1)).sum(axis=0)
    i, _ = jets.pairs(nz)
    zz = _square(nz, p[1 + nz :].reshape(len(i), -1) @ outer.ravel())
    if len(samples.active):
        force = p[0][:, n : n + 2 * m].T @ rows
        bent = second.reshape(len(second), -1) @ force.ravel()
        zz[np.ix_(samples.active, samples.active)] += _square(len(samples.active), bent)
    return zz


def _square(size: int, pairs: Array) -> Array:
    """The symmetric matrix of its entries (i, j), i <= j."""
    i, j = np.triu_indices(size)
    full = np.zeros((size, size))
    full[i, j] = pairs
    full[j, i] = pairs
    return full


def _by_laws(
    made: ExponentialPropagator, z: Array, path: ExponentialTrajectory, omega: Array
) -> tuple[Array, Array]:
    """What the laws' curvature gives: (M, n+nz, n+nz) along the sensitivities, and (nz, nz) by z alone."""
    n, nz, ns, count, laws = made.n, made.nz, made.laws.size, made.intervals.m, made.laws
    wide, own = n + nz, np.zeros((nz, nz))
    total = np.zeros((count, wide, wide))
    s, given = made.law_columns(path.steps)
    multipliers = np.ascontiguousarray(omega.transpose(2, 0, 1, 3)).reshape(laws.count, -1)
    bends = laws.curvature(s, given, z, multipliers)
    if not len(bends):
        return total, own
    bends = bends.reshape(len(bends), made.steps * STAGES, count)
    pairs = list(zip(*laws.bends, strict=True))
    for (a, b), bend in zip(pairs, bends, strict=True):
        if a >= ns:
            i, j = laws.active[a - ns], laws.active[b - ns]
            own[i, j] += bend.sum()
            own[j, i] = own[i, j]
    along = path.ds.reshape(-1, ns, wide, count)
    for first in range(0, len(along), _PART):
        part = slice(first, first + _PART)
        _bend(total, along[part], bends[:, part].transpose(0, 2, 1), pairs, n + laws.active)
    return total, own


def _bend(
    total: Array, along: Array, bends: Array, pairs: list[tuple[int, int]], places: NDArray[np.intp]
) -> None:
    """Add to total (M, C, C) what the laws' curvature gives at some of the stages.

    along : (stages, ns, C, M) sensitivities of the signals; bends : (pairs, M, stages)
    """
    ns = along.shape[1]
    # One contiguous (M, stages, C) for each signal.
    sides = [np.ascontiguousarray(along[:, a].transpose(2, 0, 1)) for a in range(ns)]
    bent: list[Array | None] = [None] * ns
    for (a, b), bend in zip(pairs, bends, strict=True):
        if a >= ns:
            continue
        if b >= ns:
            column = (bend[:, None, :] @ sides[a])[:, 0]
            total[:, :, places[b - ns]] += column
            total[:, places[b - ns], :] += column
            continue
        for one, other in {(a, b), (b, a)}:
            more = bend[:, :, None] * sides[other]
            before = bent[one]
            bent[one] = more if before is None else np.add(before, more, out=before)
    for side, weighted in zip(sides, bent, strict=True):
        if weighted is not None:
            total += side.transpose(0, 2, 1) @ weighted


def _by_outputs(made: ExponentialPropagator, z: Array, path: ExponentialTrajectory, weights: Array) -> Array:
    """What the second derivatives of the outputs' matrices and of the drives in them give, (nz, nz)."""
    nz, c, d = made.nz, path.matrices.c, path.matrices.d
    samples, _, _, second = made.drive_columns(z)
    x, v = made.at_samples(path.steps, z)
    zz = np.zeros((nz, nz))
    if c[1 + nz :].any() or d[1 + nz :].any():
        pairs = np.tensordot(c[1 + nz :], np.einsum("pym,pim->yi", weights, x))
        zz += _square(nz, pairs + np.tensordot(d[1 + nz :], np.einsum("pym,pim->yi", weights, v)))
    if d[0].any() and len(samples.active):
        force = d[0].T @ weights
        bent = np.array([np.vdot(force, made.drive_samples(part)) for part in second])
        zz[np.ix_(samples.active, samples.active)] += _square(len(samples.active), bent)
    return zz
