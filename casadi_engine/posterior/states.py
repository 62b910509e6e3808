"""What is known of a record's initial states before it is looked at: they are like any others along the record.

A flat prior does not do. An engine's record begins in the middle of its running, and each of its torsional modes may
start with any amplitude then: a rival model, whose modes are at other frequencies, is free to fit noise by them, mode
by mode and record by record, and wins against the truth far more often than its probability says.

How much further than along the record the states may be at its start is not known: a free oscillation that dies starts
where it is largest. The width is integrated out, flat in its logarithm from that of the motion to ten times as much.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.starts import chained_nodes

Array = NDArray[np.float64]

# Widths of the prior over which is integrated, in those of the states' motion along the record.
WIDTHS = 10.0 ** np.linspace(0, 1, 5)
# Share of a state's own standard deviation, and of its size, that it may differ by itself.
_ALONE, _STILL = 0.1, 1e-3
# With fewer states along the record, each state's size stands for its motion.
_FEWEST = 10


@dataclass(frozen=True)
class StatePrior:
    """A normal density of scaled states: mean (n,), and a lower factor (n, n) of the covariance at width 1.

    width : that searches use
    """

    mean: Array
    factor: Array
    width: float = 1.0

    def of_sum(self) -> StatePrior:
        """That of the sum of two independent states, the first and the last one."""
        return replace(self, mean=2 * self.mean, factor=np.sqrt(2) * self.factor)

    def integral(self, rows: Array, rest: Array, turn: Array | None = None) -> tuple[Array, Array, Array]:
        """Log likelihood (P,) with states and width integrated out, the most probable width (P,), and the mean states
        (P, n) given the data, at P points; NaN where a number is not finite.

        rows : (P, n, L) what a state does to the residual, which is ``rest`` (P, L) with states of zero
        turn : (P, n, n) of the coordinates in which the rows are; without any, those of the prior
        """
        mean, factor = self.mean, self.factor
        if turn is not None:
            mean, factor = turn @ mean, turn @ factor
        left = rest + (np.broadcast_to(mean, rows.shape[:2])[:, None] @ rows)[:, 0]
        known = factor.swapaxes(-1, -2) @ (rows @ rows.swapaxes(-1, -2)) @ factor
        fine = np.isfinite(known).all(axis=(-1, -2))
        sizes, axes = np.linalg.eigh(np.where(fine[:, None, None], known, 0.0))
        pull = (axes.swapaxes(-1, -2) @ (factor.swapaxes(-1, -2) @ (rows @ left[..., None])))[..., 0]
        square = np.square(WIDTHS)[:, None, None]
        grown = 1.0 + square * np.maximum(sizes, 0.0)
        logs = 0.5 * (square * pull**2 / grown - np.log(grown)).sum(axis=-1)
        share = np.exp(logs - logs.max(axis=0))
        total = logs.max(axis=0) + np.log(share.mean(axis=0)) - 0.5 * np.square(left).sum(axis=-1)
        moved = (share[..., None] / share.sum(axis=0)[..., None] * (square * pull / grown)).sum(axis=0)
        states = mean - (factor @ (axes @ moved[..., None]))[..., 0]
        return np.where(fine, total, np.nan), WIDTHS[np.argmax(logs, axis=0)], states

    def best(self, rows: Array, left: Array) -> Array:
        """The states (n,) of the least chi-squared at the width that searches use, the prior included."""
        seen = self.width * (self.factor.T @ rows)
        moved = np.linalg.solve(np.eye(len(seen)) + seen @ seen.T, seen @ left)
        return np.asarray(self.mean - self.width * (self.factor @ moved))

    def without(self, rows: Array, flat: Array) -> Array:
        """What the states at that width take from the products flat @ flat.T of rows (m, L)."""
        seen = self.width * (self.factor.T @ rows)
        cross = seen @ flat.T
        return np.asarray(cross.T @ np.linalg.solve(np.eye(len(seen)) + seen @ seen.T, cross))


def state_prior(record: RecordTerm, v: Array, first: Array) -> StatePrior:
    """From the states along a record, simulated at v (nv,) from ``first`` (n,), scaled."""
    nodes = chained_nodes(record, v, first)
    if not np.isfinite(nodes).all() or len(nodes) < _FEWEST:
        size = np.maximum(np.abs(first), 1.0)
        return StatePrior(np.zeros(len(first)), np.diag(size))
    mean, spread = nodes.mean(axis=0), nodes.std(axis=0)
    own = (_ALONE * spread) ** 2 + (_STILL * np.abs(mean)) ** 2 + 1e-18
    away = nodes - mean
    covariance = away.T @ away / len(nodes) + np.diag(own)
    return StatePrior(mean, np.linalg.cholesky(covariance))
