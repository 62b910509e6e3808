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

from casadi_engine.simulation import jets
from casadi_engine.simulation.exponential_step import STAGES
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.sample_rows import from_rows

if TYPE_CHECKING:
    from casadi_engine.simulation.exponential_runge_kutta import ExponentialPropagator, ExponentialTrajectory

Parts = tuple[Array, Array, Array]


def contracted(
    made: ExponentialPropagator, z: Array, path: ExponentialTrajectory, rho: Array, lam: Array
) -> Parts:
    """(z, z) (nz, nz), (z, start) (nz, n, M) and (start, start) (M, n, n) at a path of second order.

    rho : (R*ny, b, M) weights of the outputs; lam : (n, M) weights of the ends
    """
    weights = np.ascontiguousarray(from_rows(made.intervals, rho, made.ny).transpose(0, 2, 1))
    rows, omega = _adjoint(made, path, weights, lam)
    zz, zs = _by_matrices(made, z, path, rows)
    total, own = _by_laws(made, z, path, omega)
    out_zz, out_zs = _by_outputs(made, z, path, weights)
    n = made.n
    zz += own + out_zz + total[:, n:, n:].sum(axis=0)
    zs += out_zs + total[:, n:, :n]
    return zz, np.ascontiguousarray(zs.transpose(1, 2, 0)), total[:, :n, :n]


def _adjoint(
    made: ExponentialPropagator, path: ExponentialTrajectory, weights: Array, lam: Array
) -> tuple[Array, Array]:
    """The adjoint of each step's rows, (K, M, n + 4 ns), and of the stages' laws, (K, 4, M, nw)."""
    n, m, ns, nw, sub = made.n, path.matrices.m, made.laws.size, made.laws.count, made.substeps
    p, c = path.matrices.p[0], path.matrices.c[0]
    at_law = n + 2 * m
    free, turn = np.ascontiguousarray(p[:, :n]), np.ascontiguousarray(p[:n, at_law:])
    feeds = [
        np.ascontiguousarray(p[n + (i + 1) * ns :, at_law + i * nw : at_law + (i + 1) * nw])
        for i in range(STAGES - 1)
    ]
    slopes = path.slopes[0]
    entries = list(zip(*made.laws.entries, strict=True))
    rows = np.zeros((made.steps, made.intervals.m, len(p)))
    omega = np.empty((made.steps, STAGES, made.intervals.m, nw))
    mu = np.array(lam.T)
    if made.intervals.points > made.intervals.length:
        mu += weights[-1] @ c
    for k in range(made.steps - 1, -1, -1):
        row = rows[k]
        row[:, :n] = mu
        pull = mu @ turn
        for i in range(STAGES - 1, -1, -1):
            torque = pull[:, i * nw : (i + 1) * nw]
            if i < STAGES - 1:
                torque = torque + row[:, n + (i + 1) * ns :] @ feeds[i]
            omega[k, i] = torque
            eta = row[:, n + i * ns : n + (i + 1) * ns]
            for entry, (law, signal) in enumerate(entries):
                eta[:, signal] += slopes[k, i, :, entry] * torque[:, law]
        mu = row @ free
        if k % sub == 0:
            mu += weights[k // sub] @ c
    return rows, omega


def _by_matrices(
    made: ExponentialPropagator, z: Array, path: ExponentialTrajectory, rows: Array
) -> tuple[Array, Array]:
    """What the step's matrices and drives give: (nz, nz) and (M, nz, n)."""
    n, nz, count = made.n, made.nz, made.intervals.m
    zz, zs = np.zeros((nz, nz)), np.zeros((count, nz, n))
    if nz == 0:
        return zz, zs
    p, m = path.matrices.p, path.matrices.m
    samples, _, first, second = made.drive_columns(z)
    flat, columns = rows.reshape(-1, rows.shape[2]), path.steps.columns
    outer = flat.T @ columns.reshape(-1, columns.shape[2])
    i, j = jets.pairs(nz)
    zz[i, j] = p[1 + nz :].reshape(len(i), -1) @ outer.ravel()
    zz[j, i] = zz[i, j]
    chosen = np.r_[0:n, n + 2 * m : p.shape[2]]
    pulled = np.zeros((count, nz, made.steps + 1, len(chosen)))
    by_interval = np.ascontiguousarray(rows.transpose(1, 0, 2))
    for a in range(nz):
        part = p[1 + a][:, chosen]
        if part.any():
            np.matmul(by_interval, part, out=pulled[:, a, :-1])
    inner = path.inner.reshape(count, -1, n + nz)
    crossed = pulled.reshape(count, nz, -1) @ inner
    cross = crossed[:, :, n:].sum(axis=0)
    active = len(samples.active)
    for row in range(active):
        force = flat.T @ first[row].reshape(-1, 2 * m)
        cross[:, samples.active[row]] += p[1 : 1 + nz, :, n : n + 2 * m].reshape(nz, -1) @ force.ravel()
    zz += cross + cross.T
    if active:
        push = flat @ p[0][:, n : n + 2 * m]
        zz[np.ix_(samples.active, samples.active)] += _square(
            active, second.reshape(len(second), -1) @ push.ravel()
        )
    return zz, crossed[:, :, :n].copy()


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
    multipliers = np.ascontiguousarray(omega.transpose(3, 0, 1, 2)).reshape(laws.count, -1)
    bends = laws.curvature(s, given, z, multipliers)
    if not len(bends):
        return total, own
    bends = np.ascontiguousarray(
        bends.reshape(len(bends), made.steps, STAGES, count).transpose(0, 3, 1, 2)
    ).reshape(len(bends), count, -1)
    along = path.ds.reshape(count, -1, ns, wide)
    bent = np.zeros_like(along) if ns > 1 else None
    for (a, b), bend in zip(zip(*laws.bends, strict=True), bends, strict=True):
        if b < ns:
            if bent is None:
                bent = bend[:, :, None, None] * along
                continue
            bent[:, :, a] += bend[:, :, None] * along[:, :, b]
            if a != b:
                bent[:, :, b] += bend[:, :, None] * along[:, :, a]
        elif a < ns:
            column = (bend[:, None, :] @ along[:, :, a])[:, 0]
            total[:, :, n + laws.active[b - ns]] += column
            total[:, n + laws.active[b - ns], :] += column
        else:
            i, j = laws.active[a - ns], laws.active[b - ns]
            own[i, j] += bend.sum()
            own[j, i] = own[i, j]
    if bent is not None:
        flat = along.reshape(count, -1, wide)
        total += flat.transpose(0, 2, 1) @ bent.reshape(count, -1, wide)
    return total, own


def _by_outputs(
    made: ExponentialPropagator, z: Array, path: ExponentialTrajectory, weights: Array
) -> tuple[Array, Array]:
    """What parameters in the outputs give: (nz, nz) and (M, nz, n)."""
    n, nz, sub = made.n, made.nz, made.substeps
    c, d = path.matrices.c, path.matrices.d
    zz, zs = np.zeros((nz, nz)), np.zeros((made.intervals.m, nz, n))
    samples, _, first, second = made.drive_columns(z)
    through = d.any() and len(samples.active) > 0
    if nz == 0 or (jets.is_constant(c) and jets.is_constant(d) and not through):
        return zz, zs
    x, v = made.at_samples(path.steps, z)
    i, j = jets.pairs(nz)
    pairs = np.tensordot(c[1 + nz :], np.einsum("pmy,pmi->yi", weights, x))
    pairs += np.tensordot(d[1 + nz :], np.einsum("pmy,pmi->yi", weights, v))
    zz[i, j] = pairs
    zz[j, i] = pairs
    along = path.inner[:, ::sub, :n][:, : len(x)]
    pulled = np.einsum("pmy,zyi->mpiz", weights, c[1 : 1 + nz])
    crossed = np.einsum("mpiz,mpic->mzc", pulled, along, optimize=True)
    cross = crossed[:, :, n:].sum(axis=0)
    for row, index in enumerate(samples.active):
        slope = made.slope_samples(first[row])
        cross[:, index] += np.tensordot(d[1 : 1 + nz], np.einsum("pmy,pmi->yi", weights, slope))
    zz += cross + cross.T
    if through:
        bent = [np.vdot(weights @ d[0], made.slope_samples(part)) for part in second]
        zz[np.ix_(samples.active, samples.active)] += _square(len(samples.active), np.array(bent))
    return zz, crossed[:, :, :n].copy()
