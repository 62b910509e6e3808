"""The laws of a split model on all samples: torques, their slopes and their curvature, by NumPy arrays.

A law is a function of few signals s = q x of the scaled states, of channels and time, and of the estimated vector z.
What hangs on channels and time alone is worked out once for the record.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.signals import in_signals
from casadi_engine.simulation.tape import ArrayFunction

# Places within a step at which the laws are evaluated.
NODES = (0.0, 0.5, 1.0)


class Laws:
    """Laws w(s, u, t; z) of a record; ``count`` of them, signals ``q`` (ns, n) of the scaled states.

    closed : (nw, 1) SX in the model's (x, u, t, p); groups of slots that act alike are one law, their sum.
    active : entries of z that the laws use by themselves
    ``slopes`` gives the derivatives named by ``entries``: rows (law, signal) sorted by law.
    """

    def __init__(
        self,
        symbols: tuple[ca.SX, ca.SX, ca.SX, ca.SX],
        closed: ca.SX,
        groups: list[tuple[int, ...]],
        z: ca.SX,
        physical: ca.SX,
        scale: Array,
    ) -> None:
        x, u, t, p = symbols
        joined = ca.vertcat(*[ca.sum1(ca.vertcat(*[closed[i] for i in group])) for group in groups])
        rows, combined, value = in_signals(joined, x, ca.vertcat(u, t, p))
        if not len(rows):  # laws of time and channels alone: one signal that none of them depends on
            rows, combined = np.ones((1, x.numel())), ca.SX.sym("none")
        self.count, self.size = len(groups), len(rows)
        # Signals of about 1 at the states' declared sizes.
        self.q = rows * scale
        sizes = np.abs(self.q).max(axis=1)
        self.q = self.q / sizes[:, None]
        s = ca.SX.sym("s", self.size)
        value = ca.substitute(value, combined, ca.DM(sizes) * s)
        if p.numel():
            value = ca.substitute(value, p, physical)
        channels = ca.vertcat(u, t)
        rest, held, known = ca.extract_parametric(value, channels, {})
        bare = [i for i in range(channels.numel()) if ca.depends_on(rest, channels[i])]
        self._given = ArrayFunction([u, t], [ca.vertcat(*[channels[i] for i in bare], *known)])
        given = ca.vertcat(*[channels[i] for i in bare], *held)
        depends = ca.which_depends(rest, z, 1, False) if z.numel() else []
        self.active = np.flatnonzero(depends) if len(depends) else np.zeros(0, np.intp)
        free = ca.vertcat(*[z[int(i)] for i in self.active]) if len(self.active) else ca.SX(0, 1)
        self._symbols = (s, given, z, free, rest)
        self._value = ArrayFunction([s, given, z], [rest])
        slope = ca.jacobian(rest, s)
        if not slope.nnz():
            slope[0, 0] = 0.0
        self.entries = _entries(slope.sparsity())
        picked = ca.vertcat(*[slope[int(i), int(j)] for i, j in zip(*self.entries, strict=True)])
        opens = np.diff(self.entries[0], prepend=-1) > 0
        # laws of channels and time alone
        self.without_signals = np.setdiff1d(np.arange(self.count), self.entries[0])
        # (law, signal, first of its law) of each entry
        self.pattern = [(int(i), int(j), bool(o)) for i, j, o in zip(*self.entries, opens, strict=True)]
        self._slopes = ArrayFunction([s, given, z], [picked, ca.densify(ca.jacobian(rest, free))])
        self._curvature: ArrayFunction | None = None

    def given(self, grid: Grid, plan: Intervals, substeps: int) -> Array:
        """What the laws take from channels and time: (steps, nodes, rows, M)."""
        tail = np.repeat(grid.channels[:, -1:], plan.padded + 1 - grid.samples, axis=1)
        u = np.concatenate([grid.channels, tail], axis=1)
        first = np.array([[hold == "first"] for hold in grid.holds]).reshape(len(u), 1)
        at = (np.arange(plan.length)[:, None] + plan.length * np.arange(plan.m)).ravel()
        low, rise = u[:, at], np.where(first, u[:, np.minimum(at + 1, plan.padded)] - u[:, at], 0.0)
        steps, rows = [], 0
        for part in range(substeps):
            for node in NODES:
                share = (part + node) / substeps
                time = np.asarray(grid.start + grid.step * (at + share), dtype=np.float64)
                found = self._given(low + share * rise, time[None])[0]
                rows = len(found)
                steps.append(found.reshape(rows, plan.length, plan.m))
        made = np.array(steps).reshape(substeps, len(NODES), rows, plan.length, plan.m)
        ordered = made.transpose(3, 0, 1, 2, 4).reshape(plan.length * substeps, len(NODES), rows, plan.m)
        return np.ascontiguousarray(ordered)

    def torques(self, z: Array) -> Callable[..., list[Array]]:
        """The function (signals (ns, N), given (rows, N)) -> [torques (nw, N)] at z, for an inner loop."""
        return self._value.bound(z)

    def expression(self, s: ca.SX, given: ca.SX, z: Array) -> ca.SX:
        """(nw, 1) torques as an expression, z put in."""
        own, known, symbols, _, rest = self._symbols
        return ca.Function("torques", [own, known, symbols], [rest])(s, given, z)

    def slopes(self, s: Array, given: Array, z: Array) -> tuple[Array, Array]:
        """Derivatives by the signals, (entries, N), and by the active entries of z, (active, nw, N)."""
        by_signal, by_z = self._slopes(s, given, z)
        return by_signal, by_z.reshape(len(self.active), self.count, s.shape[1])

    @property
    def bends(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Pairs (a, b), a <= b, of signals, then active entries of z, of which ``curvature`` gives the second
        derivatives."""
        self._bend()
        return self._pairs

    def _bend(self) -> ArrayFunction:
        if self._curvature is None:
            s, given, z, free, rest = self._symbols
            omega = ca.SX.sym("omega", self.count)
            hessian = ca.triu(ca.hessian(ca.dot(omega, rest), ca.vertcat(s, free))[0])
            self._pairs = _entries(hessian.sparsity())
            picked = [hessian[int(i), int(j)] for i, j in zip(*self._pairs, strict=True)]
            column = ca.vertcat(*picked) if picked else ca.SX(0, 1)
            self._curvature = ArrayFunction([s, given, z, omega], [column])
        return self._curvature

    def curvature(self, s: Array, given: Array, z: Array, omega: Array) -> Array:
        """(pairs, N) second derivatives of sum(omega * w), omega : (nw, N)."""
        return self._bend()(s, given, z, omega)[0]


def _entries(pattern: ca.Sparsity) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    rows, columns = pattern.get_triplet()
    order = np.lexsort((columns, rows))
    return np.array(rows, np.intp)[order], np.array(columns, np.intp)[order]
