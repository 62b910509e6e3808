"""The values of an exponential integrator's steps: states, signals and torques of all intervals, step by step.

Many intervals advance together by NumPy arrays; a few, or one long simulation, by CasADi's virtual machine, which
needs no Python for a step.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_engine.deadline import ask
from casadi_engine.simulation.exponential_step import STAGE_NODES, STAGES, StepMatrices
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.laws import NODES, Laws

# From this number of intervals on, arrays are the faster way.
WIDE = 12
# Steps of one sweep of the virtual machine.
_SWEEP = 256


@dataclass(frozen=True)
class Steps:
    """Everything of value along the K = L * substeps steps of all intervals M.

    columns : (K, n + 2 m + 4 nw, M) the factors [x; v_0; v_1; w] of each step; end : (n, M)
    s : (K, 4, ns, M) signals of the stages
    """

    columns: Array
    end: Array
    s: Array

    def until(self, last: int, laws: int) -> Steps:
        """The same, standing still after so many steps of the last interval: where the record has ended a model may run
        off (a rocket whose mass is gone), and what it does there is not asked."""
        if last >= len(self.columns):
            return self
        n, torques = len(self.end), self.columns[:, self.columns.shape[1] - STAGES * laws :, -1]
        if last:
            torques[last:], self.s[last:, ..., -1] = torques[last - 1], self.s[last - 1, ..., -1]
        else:  # but its first stage, nothing of it is in the record
            torques[:], self.s[..., -1] = np.tile(torques[0, :laws], STAGES), self.s[0, 0, :, -1]
        self.columns[last + 1 :, :n, -1] = self.columns[last, :n, -1]
        self.end[:, -1] = self.columns[last, :n, -1]
        return self


def by_arrays(matrices: StepMatrices, laws: Laws, given: Array, v: Array, z: Array, nodes: Array) -> Steps:
    """Steps from ``nodes`` (M, n); given : (K, nodes, rows, M) what the laws take from channels; v : (K, 2m, M)."""
    p, n, m = matrices.p[0], matrices.n, matrices.m
    ns, nw, count, at_law = laws.size, laws.count, len(nodes), matrices.n + 2 * matrices.m
    free = np.ascontiguousarray(p[:, :n])
    pushed = np.matmul(p[:, n : n + 2 * m], v)
    turn = np.ascontiguousarray(p[:n, at_law:])
    feeds = [
        np.ascontiguousarray(p[n + i * ns : n + (i + 1) * ns, at_law : at_law + i * nw])
        for i in range(STAGES)
    ]
    columns = np.empty((len(v), p.shape[1], count))
    columns[:, n : n + 2 * m] = v
    signals = np.empty((len(v), STAGES, ns, count))
    torque_of, x = laws.torques(z), nodes.T
    for k in range(len(v)):
        ask(count)
        column, stage = columns[k], signals[k]
        column[:n] = x
        torques = column[at_law:]
        rows = free @ column[:n]
        rows += pushed[k]
        stage[:] = rows[n:].reshape(STAGES, ns, count)
        for i in range(STAGES):
            if i:
                stage[i] += feeds[i] @ torques[: i * nw]
            torques[i * nw : (i + 1) * nw] = torque_of(stage[i], given[k, STAGE_NODES[i]])[0]
        x = rows[:n] + turn @ torques
    return Steps(columns, x, signals)


def by_machine(matrices: StepMatrices, laws: Laws, given: Array, v: Array, z: Array, nodes: Array) -> Steps:
    """The same by one CasADi function for a step, with this point's matrices in it."""
    p, n, m = matrices.p[0], matrices.n, matrices.m
    count, steps, size = len(nodes), len(v), min(_SWEEP, len(v))
    rows = given.shape[2]
    pushed = np.matmul(p[:, n : n + 2 * m], v)
    step = _machine_step(p, n, n + 2 * m, laws, z, rows)
    sweep = step.mapaccum(size)
    if count > 1:
        sweep = sweep.map(count)
    columns = np.empty((steps, p.shape[1], count))
    columns[:, n : n + 2 * m] = v
    signals = np.empty((steps, STAGES, laws.size, count))
    flat = given.reshape(steps, len(NODES) * rows, count)
    x = nodes.T
    for k in range(0, steps, size):
        ask(size * len(nodes))
        # The last sweep steps back over what is done rather than being of another length.
        first = min(k, steps - size)
        if first < k:
            x = columns[first, :n]
        part = slice(first, first + size)
        inputs = [
            np.moveaxis(rows_of[part], 0, -1).reshape(rows_of.shape[1], size * count)
            for rows_of in (pushed, flat)
        ]
        after, s, w = (
            np.asarray(found, dtype=float).reshape(-1, count, size).transpose(2, 0, 1)
            for found in sweep(x, *inputs)
        )
        columns[first, :n] = x
        columns[first + 1 : first + size, :n] = after[:-1]
        columns[part, n + 2 * m :] = w
        signals[part] = s.reshape(size, STAGES, laws.size, count)
        x = after[-1]
    return Steps(columns, np.ascontiguousarray(x), signals)


def _machine_step(p: Array, n: int, at_law: int, laws: Laws, z: Array, rows: int) -> ca.Function:
    """(x, pushed (n + 4 ns), given (nodes * rows)) to (x at the end, signals (4 ns), torques (4 nw))."""
    ns, nw = laws.size, laws.count
    x, pushed = ca.SX.sym("x", n), ca.SX.sym("pushed", len(p))
    given = ca.SX.sym("given", len(NODES) * rows)
    free = ca.mtimes(ca.sparsify(ca.DM(p[:, :n])), x) + pushed
    signals, torques = ca.SX(0, 1), ca.SX(0, 1)
    for i in range(STAGES):
        stage = free[n + i * ns : n + (i + 1) * ns]
        if i:
            feed = ca.DM(p[n + i * ns : n + (i + 1) * ns, at_law : at_law + i * nw])
            stage = stage + ca.mtimes(ca.sparsify(feed), torques)
        node = STAGE_NODES[i] * rows
        signals = ca.vertcat(signals, stage)
        torques = ca.vertcat(torques, laws.expression(stage, given[node : node + rows], z))
    end = free[:n] + ca.mtimes(ca.sparsify(ca.DM(p[:n, at_law:])), torques)
    return ca.Function("step", [x, pushed, given], [end, signals, torques])
