"""Second derivatives of the exponential integrator's outputs and ends, contracted with weights, by its adjoint.

With the adjoint r = [mu; eta] of a step's rows and omega of its laws, the second derivative in two directions a, b of
the weighted sum is, added over all steps,

    r P_ab c + r P_a c_b + r P_b c_a + omega w_ab,

c being the step's factors (state, drives, law torques) and w_ab the laws' own curvature along the signals'
sensitivities. All of it is matrix products over runs of intervals.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation import jets
from casadi_engine.simulation.exponential_slopes import Linearised
from casadi_engine.simulation.exponential_step import STAGE_NODES, STAGES
from casadi_engine.simulation.jets import Array

Parts = tuple[Array, Array, Array]

# Numbers that are worked out together.
_PART = 2_000_000


def contracted(made: Linearised, z: Array, maps: Array, chained: Array, weights: Array, lam: Array) -> Parts:
    """(z, z) (nz, nz), (z, start) (nz, n, M) and (start, start) (M, n, n), with matrices of second order.

    maps, chained : see `Linearised.maps` and `chain`; weights : (L, ny, M) of the outputs; lam : (n, M) of the ends
    """
    laid, nz, n = made.laid, made.nz, made.matrices[0].n
    mu = _adjoint(made, maps, weights, lam)
    rows, omega = _adjoint_of_steps(made, mu[laid.layout.after].T)
    total, zz = _along(made, z, chained, rows, omega)
    cross = _crossed_outputs(made, chained, weights)
    total[:, n:] += cross
    total[:, :, n:] += cross.swapaxes(1, 2)
    zz += total[:, n:, n:].sum(axis=0)
    if nz:
        drives = _crossed_drives(made, rows, weights)
        zz += _by_matrices(made, rows) + _by_outputs(made, weights) + drives + drives.T
    return zz, np.ascontiguousarray(total[:, n:, :n].transpose(1, 2, 0)), total[:, :n, :n]


def _adjoint(made: Linearised, maps: Array, weights: Array, lam: Array) -> Array:
    """(K+M, n) what the states at the steps' starts, and at the intervals' ends, are worth."""
    laid, n = made.laid, maps.shape[1]
    layout, c = laid.layout, made.matrices[0].c[0]
    mu = np.zeros((layout.steps + layout.intervals, n))
    mu[layout.at[: laid.plan.length]] = weights.transpose(0, 2, 1) @ c
    mu[layout.steps :] += lam.T
    for own, after, _ in reversed(laid.rows):
        mu[own] += (mu[after][:, None] @ maps[own][:, :, :n])[:, 0]
    return mu


def _adjoint_of_steps(made: Linearised, nu: Array) -> tuple[Array, Array]:
    """What the rows of each step (n + 4 ns, K) and its laws (4 nw, K) are worth; nu : (n, K) that of its end."""
    ns, nw, n = made.laws.size, made.laws.count, len(nu)
    rows, omega = np.empty((n + STAGES * ns, nu.shape[1])), np.empty((STAGES * nw, nu.shape[1]))
    rows[:n] = nu
    for jet, steps in zip(made.matrices, made.laid.groups, strict=True):
        at_law = n + 2 * jet.m
        turn = jet.p[0][:, at_law:].T
        omega[:, steps] = turn[:, :n] @ nu[:, steps]
        for i in range(STAGES - 1, -1, -1):
            worth, behind = slice(i * nw, (i + 1) * nw), slice(n + (i + 1) * ns, None)
            omega[worth, steps] += turn[worth, behind] @ rows[behind, steps]
            eta = np.zeros((ns, omega[worth, steps].shape[1]))
            for entry, (law, signal, _) in enumerate(made.laws.pattern):
                eta[signal] += made.by_signal[i, entry, steps] * omega[i * nw + law, steps]
            rows[n + i * ns : n + (i + 1) * ns, steps] = eta
    return rows, omega


@dataclass(frozen=True)
class _Run:
    """A run of intervals: their steps in order of time, where each interval begins among them, and by step the slopes
    of signals s (k, 4 ns, .) and torques (k, 4 nw, .) by (x, z), and pull (k, nz, n + 4 nw) = r P_z of [x; w]."""

    intervals: slice
    steps: NDArray[np.intp]
    begins: NDArray[np.intp]
    s: Array
    torques: Array
    pull: Array


def _runs(made: Linearised, rows: Array) -> Iterator[_Run]:
    """The record in runs of intervals."""
    laid, jet, nz = made.laid, made.matrices[0], made.nz
    wide, sizes = jet.n + nz, np.bincount(laid.layout.interval[laid.order], minlength=laid.plan.m)
    ends = np.cumsum(sizes)
    signals, laws = STAGES * made.laws.size, STAGES * made.laws.count
    each = (signals + laws) * 2 * wide + nz * (jet.n + laws)
    chosen = np.r_[0 : jet.n, jet.n + 2 * jet.m : jet.p.shape[2]]
    pulls = [
        np.ascontiguousarray(one.p[1 : 1 + nz][:, :, chosen].transpose(1, 0, 2)) for one in made.matrices
    ]
    first = 0
    while first < laid.plan.m:
        begin = ends[first] - sizes[first]
        last = max(first + 1, int(np.searchsorted(ends, begin + _PART // each, side="right")))
        steps = laid.order[begin : ends[last - 1]]
        s, torques = np.empty((len(steps), signals, wide)), np.empty((len(steps), laws, wide))
        pull = np.empty((len(steps), nz, jet.n + laws))
        for level in np.unique(laid.level[steps]).tolist():
            own = np.flatnonzero(laid.level[steps] == level)
            in_s, in_torques, _ = made.part(level, steps[own])
            s[own], torques[own] = in_s.transpose(2, 0, 1), in_torques.transpose(2, 0, 1)
            pull[own] = (rows[:, steps[own]].T @ pulls[level].reshape(len(rows), -1)).reshape(
                len(own), *pull.shape[1:]
            )
        yield _Run(slice(first, last), steps, ends[first:last] - sizes[first:last] - begin, s, torques, pull)
        first = last


def _along(made: Linearised, z: Array, chained: Array, rows: Array, omega: Array) -> tuple[Array, Array]:
    """What the matrices' slopes and the laws' curvature give along the sensitivities: (M, n+nz, n+nz) by (start, z),
    and (nz, nz) by the laws' own z alone."""
    laws, nz, n, ns = made.laws, made.nz, chained.shape[1], made.laws.size
    total, own = np.zeros((made.laid.plan.m, n + nz, n + nz)), np.zeros((nz, nz))
    bends, pairs = _bends(made, z, omega), list(zip(*laws.bends, strict=True))
    for (a, b), bend in zip(pairs, bends, strict=True):
        if a >= ns:
            i, j = laws.active[a - ns], laws.active[b - ns]
            own[i, j] += bend.sum()
            own[j, i] = own[i, j]
    for run in _runs(made, rows):
        here = chained[run.steps]
        along, torques = run.s[:, :, :n] @ here, run.torques[:, :, :n] @ here
        along[:, :, n:] += run.s[:, :, n:]
        torques[:, :, n:] += run.torques[:, :, n:]
        part = total[run.intervals]
        if nz:
            cross = run.pull[:, :, :n] @ here + run.pull[:, :, n:] @ torques
            summed = np.add.reduceat(cross, run.begins, axis=0)
            part[:, n:] += summed
            part[:, :, n:] += summed.swapaxes(1, 2)
        if len(bends):
            _bend(
                part,
                along.reshape(len(here), STAGES, ns, -1),
                bends[:, :, run.steps],
                pairs,
                run.begins,
                n + laws.active,
            )
    return total, own


def _bends(made: Linearised, z: Array, omega: Array) -> Array:
    """(pairs, 4, K) second derivatives of the laws along the record, weighted."""
    laws, laid = made.laws, made.laid
    worth = omega.reshape(STAGES, laws.count, -1)
    found = [
        laws.curvature(made.steps.s[:, i], laid.given[node], z, worth[i])
        for i, node in enumerate(STAGE_NODES)
    ]
    return np.array(found).swapaxes(0, 1)


def _bend(
    total: Array,
    along: Array,
    bends: Array,
    pairs: list[tuple[int, int]],
    begins: NDArray[np.intp],
    places: NDArray[np.intp],
) -> None:
    """Add to total (I, C, C) what the laws' curvature gives in the steps of some intervals.

    along : (k, 4, ns, C) sensitivities of the signals; bends : (pairs, 4, k); places : of the laws' own z among C
    """
    ns, ends = along.shape[2], np.append(begins[1:], len(along))
    for i, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        own = along[begin:end].reshape(-1, ns, along.shape[3])
        for (a, b), bend in zip(pairs, bends[:, :, begin:end].swapaxes(1, 2), strict=True):
            if a >= ns:
                continue
            weight = bend.reshape(-1)
            if b >= ns:
                column = weight @ own[:, a]
                total[i, :, places[b - ns]] += column
                total[i, places[b - ns], :] += column
                continue
            bent = own[:, a].T @ (weight[:, None] * own[:, b])
            total[i] += bent if a == b else bent + bent.T


def _crossed_outputs(made: Linearised, chained: Array, weights: Array) -> Array:
    """(M, nz, n+nz) what slopes of the outputs' matrix give along the states' sensitivities."""
    laid, c, nz = made.laid, made.matrices[0].c, made.nz
    found = np.zeros((laid.plan.m, nz, chained.shape[2]))
    if jets.is_constant(c):
        return found
    for at, weight in zip(laid.layout.at[: laid.plan.length], weights, strict=True):
        found += np.einsum("zyi,ym->mzi", c[1 : 1 + nz], weight) @ chained[at]
    return found


def _crossed_drives(made: Linearised, rows: Array, weights: Array) -> Array:
    """(nz, nz) what slopes of the matrices give along those of the drives."""
    laid, columns, nz = made.laid, made.columns, made.nz
    cross = np.zeros((nz, nz))
    for row, index in enumerate(columns.samples.active):
        for jet, steps in zip(made.matrices, laid.groups, strict=True):
            force = rows[:, steps] @ columns.first[row][:, steps].T
            cross[:, index] += jet.p[1 : 1 + nz, :, jet.n : jet.n + 2 * jet.m].reshape(nz, -1) @ force.ravel()
        force = np.einsum("lym,ilm->yi", weights, laid.at_samples(columns.first[row]))
        cross[:, index] += made.matrices[0].d[1 : 1 + nz].reshape(nz, -1) @ force.ravel()
    return cross


def _by_matrices(made: Linearised, rows: Array) -> Array:
    """What the second derivatives of the step's matrices and of the drives give, (nz, nz)."""
    nz, active = made.nz, made.columns.samples.active
    zz = np.zeros((nz, nz))
    for jet, steps in zip(made.matrices, made.laid.groups, strict=True):
        outer = rows[:, steps] @ made.factors(steps).T
        zz += _square(nz, jet.p[1 + nz :].reshape(len(jet.p) - 1 - nz, -1) @ outer.ravel())
        if len(active):
            force = jet.p[0][:, jet.n : jet.n + 2 * jet.m].T @ rows[:, steps]
            bent = np.einsum("pik,ik->p", made.columns.second[:, :, steps], force)
            zz[np.ix_(active, active)] += _square(len(active), bent)
    return zz


def _square(size: int, pairs: Array) -> Array:
    """The symmetric matrix of its entries (i, j), i <= j."""
    i, j = np.triu_indices(size)
    full = np.zeros((size, size))
    full[i, j] = pairs
    full[j, i] = pairs
    return full


def _by_outputs(made: Linearised, weights: Array) -> Array:
    """What the second derivatives of the outputs' matrices and of the drives in them give, (nz, nz)."""
    nz, laid, columns = made.nz, made.laid, made.columns
    c, d, active = made.matrices[0].c, made.matrices[0].d, columns.samples.active
    zz = np.zeros((nz, nz))
    if c[1 + nz :].any() or d[1 + nz :].any():
        x = made.steps.begun[:, laid.layout.at[: laid.plan.length]]
        v = laid.at_samples(columns.value)
        pairs = np.tensordot(c[1 + nz :], np.einsum("lym,ilm->yi", weights, x))
        zz += _square(nz, pairs + np.tensordot(d[1 + nz :], np.einsum("lym,ilm->yi", weights, v)))
    if d[0].any() and len(active):
        force = np.einsum("yi,lym->ilm", d[0], weights)
        bent = np.array([np.vdot(force, laid.at_samples(part)) for part in columns.second])
        zz[np.ix_(active, active)] += _square(len(active), bent)
    return zz
