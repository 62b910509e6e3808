"""What is known of a record's initial states before it is looked at: they are like any others along the record.

A flat prior does not do. An engine's record begins in the middle of its running, and each of its torsional modes may
start with any amplitude then: a rival model, whose modes are at other frequencies, is free to fit noise by them, mode
by mode and record by record, and wins against the truth far more often than its probability says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotrs

from casadi_engine.estimation.options import interval_length
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.starts import chained_nodes

Array = NDArray[np.float64]

# The prior is so many times as wide as the states' motion along the record.
WIDE = 1.5
# Share of a state's own standard deviation, and of its size, that it may differ by itself.
_ALONE, _STILL = 0.1, 1e-3
# With fewer states along the record, each state's size stands for its motion.
_FEWEST = 10


@dataclass(frozen=True)
class StatePrior:
    """A normal density of scaled states: mean (n,), and a lower factor (n, n) of the covariance."""

    mean: Array
    factor: Array

    def of_sum(self) -> StatePrior:
        """That of the sum of two independent states, the first and the last one."""
        return StatePrior(2 * self.mean, np.sqrt(2) * self.factor)

    def marginal(self, rows: Array, rest: Array) -> tuple[float, float]:
        """Chi-squared at the best states, these included, and the log determinant that their integral leaves.

        rows : (n, L) what a state does to the residual, whose value without any is rest (L,)
        Raises FloatingPointError where a number is not finite.
        """
        left = rest + self.mean @ rows
        seen = self.factor.T @ rows
        known = seen @ seen.T
        known.flat[:: len(known) + 1] += 1.0
        factor, failed = dpotrf(known, lower=1)
        if failed or not np.isfinite(factor).all():
            raise FloatingPointError("the states' share is not finite")
        pull = seen @ left
        squares = float(left @ left - pull @ dpotrs(factor, pull, lower=1)[0])
        return squares, 2 * float(np.log(np.diag(factor)).sum())

    def best(self, rows: Array, rest: Array) -> Array:
        """The states (n,) of the least chi-squared, these included."""
        seen = self.factor.T @ rows
        pull = seen @ (rest + self.mean @ rows)
        return np.asarray(self.mean - self.factor @ np.linalg.solve(np.eye(len(seen)) + seen @ seen.T, pull))


def state_prior(record: RecordTerm, v: Array, first: Array) -> StatePrior:
    """From the states along a record, simulated at v (nv,) from ``first`` (n,), scaled."""
    if record.linear and record.plan.m > _FEWEST:  # a fit may have cut it into few intervals
        record = record.again(gain=record.gain, length=interval_length("auto", record.grid))
    nodes = chained_nodes(record, v, first)
    if not np.isfinite(nodes).all() or len(nodes) < _FEWEST:
        size = np.maximum(np.abs(first), 1.0)
        return StatePrior(np.zeros(len(first)), np.diag(WIDE * size))
    mean, spread = nodes.mean(axis=0), nodes.std(axis=0)
    own = (_ALONE * spread) ** 2 + (_STILL * np.abs(mean)) ** 2 + 1e-18
    away = nodes - mean
    covariance = away.T @ away / len(nodes) + np.diag(own)
    return StatePrior(mean, WIDE * np.linalg.cholesky(covariance))
