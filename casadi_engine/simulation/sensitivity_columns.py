"""What acts on the sensitivities of many terms: their expressions' columns on points, and states of their own."""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.null_path import NullPath, Points
from casadi_engine.simulation.tape import ArrayFunction

# Steps of one sweep of the virtual machine.
_SWEEP = 256


class Columns:
    """The structurally non-zero entries of K expression columns (rows, 1), evaluated on points."""

    def __init__(self, path: NullPath, columns: list[ca.SX], xi: ca.SX, rows: int) -> None:
        matrix = ca.horzcat(ca.SX(rows, 0), *[ca.SX(c) for c in columns])
        matrix = ca.sparsify(ca.simplify(matrix)) if matrix.nnz() else matrix
        row, column = matrix.sparsity().get_triplet()
        self.shape = (rows, len(columns))
        self.rows, self.columns = np.array(row, dtype=np.intp), np.array(column, dtype=np.intp)
        self._at = self.rows * len(columns) + self.columns
        self._function: ArrayFunction | None = None
        if len(row):
            self._function = path.function([matrix.nz[:]], xi)

    @cached_property
    def alike(self) -> list[tuple[tuple[int, ...], NDArray[np.intp], NDArray[np.intp]]]:
        """Columns that have entries in the same rows: these rows, the columns (E,), and their entries (rows, E)."""
        own: dict[int, list[int]] = {column: [] for column in range(self.shape[1])}
        for entry in np.lexsort((self.rows, self.columns)):
            own[int(self.columns[entry])].append(int(entry))
        found: dict[tuple[int, ...], list[int]] = {}
        for column, entries in own.items():
            found.setdefault(tuple(int(self.rows[e]) for e in entries), []).append(column)
        return [
            (
                rows,
                np.array(columns),
                np.array([own[c] for c in columns], dtype=np.intp).reshape(len(columns), -1).T,
            )
            for rows, columns in found.items()
        ]

    def values(self, points: Points, xi: Array) -> Array:
        """The entries (nnz, T) in ``rows`` and ``columns``."""
        count = points.t.shape[1]
        if self._function is None:
            return np.zeros((0, count))
        return np.broadcast_to(self._function(*points.arguments, xi)[0], (len(self.rows), count))

    def at(self, points: Points, xi: Array) -> Array:
        """(T, rows, K)."""
        count = points.t.shape[1]
        out = np.zeros((count, self.shape[0] * self.shape[1]))
        out[:, self._at] = self.values(points, xi).T
        return out.reshape(count, *self.shape)


class OwnStates:
    """The states ``xi`` of the terms themselves from ``start`` on, driven by the null path: one Runge-Kutta sweep in
    CasADi's machine."""

    def __init__(self, path: NullPath, start: Array, rates: ca.SX, xi: ca.SX, substeps: int) -> None:
        self.path, self.substeps, self.start = path, substeps, start
        model = path.model
        drives = model.d if len(path.d) else ca.SX(0, 1)
        if model.w.numel():
            rates = ca.substitute(rates, model.w, model.slot_laws)
        if model.d.numel() and not len(path.d):
            rates = ca.substitute(rates, model.d, model.drive_expressions)
        if model.p.numel():
            rates = ca.substitute(rates, model.p, ca.SX(ca.DM(path.p)))
        given = ca.vertcat(model.x, model.u, drives, model.t)
        rate = ca.Function("rate", [xi, given], [rates])
        q = given.numel()
        state, around = ca.SX.sym("xi", xi.numel()), ca.SX.sym("around", 3 * q + 1)
        low, middle, high, h = around[:q], around[q : 2 * q], around[2 * q : -1], around[-1]
        k1 = rate(state, low)
        k2 = rate(state + h / 2 * k1, middle)
        k3 = rate(state + h / 2 * k2, middle)
        k4 = rate(state + h * k3, high)
        after = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        # the cubic through both ends gives the middle
        half = (state + after) / 2 + h / 8 * (k1 - rate(after, high))
        self._step = ca.Function("own", [state, around], [after, half])

    def run(self) -> list[Array]:
        """For each half substep of a sample, start to end, the states (ne, N-1)."""
        path, parts = self.path, self.substeps
        steps = path.grid.samples - 1
        stacked = []
        for k in range(parts):
            sides = [path.between((2 * k + j) / (2 * parts)) for j in range(3)]
            length = np.broadcast_to(path.lengths / parts, (1, steps))
            stacked.append(np.concatenate([*[np.concatenate(p.arguments) for p in sides], length]))
        given = np.stack(stacked, axis=2).reshape(len(stacked[0]), steps * parts)
        after, half = (every.reshape(len(self.start), steps, parts) for every in self._swept(given))
        before = np.concatenate([self.start[:, None], after[:, :, -1][:, :-1]], axis=1)
        out = [before]
        for k in range(parts):
            out += [half[:, :, k], after[:, :, k]]
        return out

    def _swept(self, given: Array) -> tuple[Array, Array]:
        """The states (ne, K) at the ends of steps and in their middle; given : (rows, K). In pieces of one length: to
        lay out a run takes far longer than to make it."""
        count = given.shape[1]
        size = min(_SWEEP, count)
        sweep = self._step.mapaccum(size)
        after, half = np.empty((2, len(self.start), count))
        state = self.start
        for k in range(0, count, size):
            # the last piece steps back over what is done
            first = min(k, count - size)
            state = state if first == k else after[:, first - 1] if first else self.start
            here = slice(first, first + size)
            after[:, here], half[:, here] = sweep(state, given[:, here])
            state = after[:, first + size - 1]
        return after, half
