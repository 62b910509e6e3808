"""The values of an exponential integrator's steps: states, signals and torques of all intervals, step by step.

Many intervals advance together by NumPy arrays; a few, or one long simulation, by CasADi's virtual machine, which
needs no Python for a step.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.exponential_step import STAGE_NODES, STAGES, StepMatrices
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.laws import Laws
from casadi_engine.simulation.local_steps import LocalSteps

# From this number of intervals on, arrays are the faster way.
WIDE = 40
# Steps of one sweep of the virtual machine.
_SWEEP = 256


@dataclass(frozen=True)
class Steps:
    """Everything of value along K steps of M intervals.

    begun : (n, K+M) states where steps begin, and behind them where intervals end; torques : (4 nw, K) of the laws;
    s : (ns, 4, K) signals of the stages
    """

    begun: Array
    torques: Array
    s: Array


def pushed(laid: LocalSteps, matrices: list[StepMatrices], v: Array) -> Array:
    """(n + 4 ns, K) what drives v (2m, K) do to each step."""
    n, m = matrices[0].n, matrices[0].m
    found = np.empty((matrices[0].p.shape[1], v.shape[1]))
    for one, group in zip(matrices, laid.groups, strict=True):
        found[:, group] = one.p[0][:, n : n + 2 * m] @ v[:, group]
    return found


def by_arrays(
    laid: LocalSteps, matrices: list[StepMatrices], laws: Laws, v: Array, z: Array, nodes: Array
) -> Steps:
    """Steps from ``nodes`` (M, n); matrices of each level; v : (2m, K) drives."""
    n, ns, nw = matrices[0].n, laws.size, laws.count
    p = np.array([one.p[0] for one in matrices])
    at_law = n + 2 * matrices[0].m
    free, turn = np.ascontiguousarray(p[:, :, :n]), np.ascontiguousarray(p[:, :n, at_law:])
    feeds = [
        np.ascontiguousarray(p[:, n + i * ns : n + (i + 1) * ns, at_law : at_law + i * nw])
        for i in range(STAGES)
    ]
    begun = np.empty((n, laid.steps + len(nodes)))
    torques, signals = np.empty((STAGES * nw, laid.steps)), np.empty((ns, STAGES, laid.steps))
    torque_of, drive = laws.torques(z), pushed(laid, matrices, v)
    begun[:, laid.layout.at[0]] = nodes.T
    for own, after, level in laid.rows:
        rows = _times(free, level, begun[:, own])
        rows += drive[:, own]
        stage, torque = signals[:, :, own], torques[:, own]
        for i in range(STAGES):
            s = rows[n + i * ns : n + (i + 1) * ns]
            if i:
                s += _times(feeds[i], level, torque[: i * nw])
            stage[:, i] = s
            torque[i * nw : (i + 1) * nw] = torque_of(s, laid.given[STAGE_NODES[i], :, own])[0]
        begun[:, after] = rows[:n] + _times(turn, level, torque)
    return Steps(begun, torques, signals)


def _times(matrices: Array, level: int | NDArray[np.intp], columns: Array) -> Array:
    """Columns (c, k), each times the matrix (r, c) of its level."""
    if isinstance(level, int):
        return np.asarray(matrices[level] @ columns)
    return np.einsum("kij,jk->ik", matrices[level], columns)


class Machine:
    """The same by one CasADi function for a step, one interval after the other; made once for all points."""

    def __init__(self, laws: Laws, nz: int) -> None:
        self._laws, self._nz = laws, nz
        self._made: tuple[tuple[bytes, int], _Sweep] | None = None

    def run(self, laid: LocalSteps, matrices: list[StepMatrices], v: Array, z: Array, nodes: Array) -> Steps:
        """See `by_arrays`."""
        laws, n, order, layout = self._laws, matrices[0].n, laid.order, laid.layout
        p, at_law = np.array([one.p[0] for one in matrices]), n + 2 * matrices[0].m
        p = np.concatenate([p[:, :, :n], p[:, :, at_law:]], axis=2)
        pattern, size = p.any(axis=0), min(_SWEEP, laid.steps)
        entries = p.transpose(0, 2, 1)[:, pattern.T]  # as CasADi has them, by columns
        sweep = self._sweep(pattern, n, laid.given.shape[1], size)
        drive, flat = pushed(laid, matrices, v), laid.given.reshape(-1, laid.steps)
        begun = np.zeros((n, laid.steps + len(nodes)))
        torques = np.empty((STAGES * laws.count, laid.steps))
        signals = np.empty((laws.size, STAGES, laid.steps))
        begun[:, layout.at[0]], begins = nodes.T, np.zeros(laid.steps)
        begins[layout.at[0]] = 1.0
        for k in range(0, laid.steps, size):
            # The last sweep steps back over what is done rather than being of another length.
            first = min(k, laid.steps - size)
            own = order[first : first + size]
            known = (
                drive[:, own].T,
                flat[:, own].T,
                entries[laid.level[own]],
                begins[own, None],
                begun[:, own].T,
            )
            ends, s, w = sweep(begun[:, own[0]], *known, np.broadcast_to(z, (size, len(z))))
            begun[:, layout.after[own]] = ends.T
            signals[:, :, own] = s.T.reshape(STAGES, laws.size, size).swapaxes(0, 1)
            torques[:, own] = w.T
        return Steps(begun, torques, signals)

    def _sweep(self, pattern: NDArray[np.bool_], n: int, rows: int, size: int) -> _Sweep:
        key = (pattern.tobytes(), size)
        if self._made is None or self._made[0] != key:
            self._made = key, _Sweep(self._step(pattern, n, rows), size)
        return self._made[1]

    def _step(self, pattern: NDArray[np.bool_], n: int, rows: int) -> ca.Function:
        """(x, [pushed (n + 4 ns), given (nodes * rows), entries of the matrices, 1 where an interval begins, its first
        state, z]) to (x at the end, signals (4 ns), torques (4 nw))."""
        ns, nw = self._laws.size, self._laws.count
        before, drive, z = ca.SX.sym("x", n), ca.SX.sym("pushed", len(pattern)), ca.SX.sym("z", self._nz)
        given, first = ca.SX.sym("given", (max(STAGE_NODES) + 1) * rows), ca.SX.sym("first")
        start, entries = ca.SX.sym("start", n), ca.SX.sym("entries", int(pattern.sum()))
        sparse = ca.Sparsity.triplet(*pattern.shape, *[place.tolist() for place in np.nonzero(pattern)])
        p = ca.SX(sparse, entries)
        x = ca.if_else(first, start, before)
        free = ca.mtimes(p[:, :n], x) + drive
        signals, torques = ca.SX(0, 1), ca.SX(0, 1)
        for i in range(STAGES):
            stage = free[n + i * ns : n + (i + 1) * ns]
            if i:
                stage = stage + ca.mtimes(p[n + i * ns : n + (i + 1) * ns, n : n + i * nw], torques)
            node = STAGE_NODES[i] * rows
            signals = ca.vertcat(signals, stage)
            torques = ca.vertcat(torques, self._laws.expression(stage, given[node : node + rows], z))
        end = free[:n] + ca.mtimes(p[:n, n:], torques)
        inputs = [before, drive, given, entries, first, start, z]
        return ca.Function("step", inputs, [ca.densify(part) for part in (end, signals, torques)])


class _Sweep:
    """A function of a state and more, repeated ``size`` times, without CasADi's matrices between: arrays (size, .) of
    each input and output."""

    def __init__(self, step: ca.Function, size: int) -> None:
        self._function = step.mapaccum(size)
        self._buffer, self._run = self._function.buffer()
        self._inputs = [np.zeros((size, step.numel_in(i))) for i in range(step.n_in())]
        self._inputs[0] = np.zeros((1, step.numel_in(0)))
        self._outputs = [np.zeros((size, step.numel_out(i))) for i in range(step.n_out())]
        for i, array in enumerate(self._inputs):
            if array.size:
                self._buffer.set_arg(i, memoryview(array.reshape(-1)))
        for i, array in enumerate(self._outputs):
            if array.size:
                self._buffer.set_res(i, memoryview(array.reshape(-1)))

    def __call__(self, *arguments: Array) -> list[Array]:
        for own, given in zip(self._inputs, arguments, strict=True):
            own[:] = given
        self._run()
        return self._outputs


def single_steps(p: Array, n: int, m: int, laws: Laws, z: Array, x: Array, v: Array, given: Array) -> Array:
    """Ends (n, k) of single steps of one length from x (n, k); v : (2m, k) drives; given : (3, rows, k)."""
    ns, nw, at_law = laws.size, laws.count, n + 2 * m
    rows = p[:, :n] @ x + p[:, n:at_law] @ v
    torques = np.empty((STAGES * nw, x.shape[1]))
    torque_of = laws.torques(z)
    for i in range(STAGES):
        stage = rows[n + i * ns : n + (i + 1) * ns]
        stage += p[n + i * ns : n + (i + 1) * ns, at_law : at_law + i * nw] @ torques[: i * nw]
        torques[i * nw : (i + 1) * nw] = torque_of(stage, given[STAGE_NODES[i]])[0]
    return np.asarray(rows[:n] + p[:n, at_law:] @ torques)
