"""What a refit is: numbers, residuals in order of time and their slopes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.record import RecordTerm

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RefitRecord:
    """One record of a refit.

    time : output -> (N,) s of its valid samples; residual : output -> (N,) (simulated - measured) / level, in order of
    time; jacobian : output -> (N, nz + n) its derivatives by the free parameters and the record's initial states, in
    their units; states : (M, n) at the starts of the shooting intervals, over the first horizon, in their units
    """

    time: Mapping[str, Array]
    residual: Mapping[str, Array]
    jacobian: Mapping[str, Array]
    states: Array


@dataclass(frozen=True, eq=False)
class Refit:
    """Where a refit ended.

    free : names of the free parameters z (nz); values : name -> value of these; initial : record -> state -> value
    cost : chi-squared at the given levels, priors included; prior_cost : the priors' part
    prior_information : (nz, nz) of the priors; widths : of corners that were made sharper by the motion
    status : "converged", or why not; steps : evaluations of the model
    fineness, nodes : of the integration, and (M, n) where the intervals begin at the end, for what goes on from here
    """

    free: tuple[str, ...]
    values: Mapping[str, float]
    initial: Mapping[str, Mapping[str, float]]
    cost: float
    prior_cost: float
    prior_information: Array
    records: Mapping[str, RefitRecord]
    status: str
    steps: int
    widths: Mapping[str, float] = field(default_factory=dict)
    fineness: Mapping[str, Any] = field(default_factory=dict, repr=False)
    nodes: tuple[Array, ...] = field(default=(), repr=False)

    @property
    def converged(self) -> bool:
        """True at an optimum: one more step would lower chi-squared by 0.001 at most."""
        return self.status == "converged"

    @cached_property
    def information(self) -> Array:
        """(nz + R n, nz + R n) of the free parameters, then of each record's initial states, in their units."""
        nz, each = len(self.free), [list(one.jacobian.values()) for one in self.records.values()]
        n = len(next(iter(self.initial.values())))
        found = np.zeros((nz + n * len(each),) * 2)
        found[:nz, :nz] = self.prior_information
        for k, jacobians in enumerate(each):
            at = np.r_[0:nz, nz + k * n : nz + (k + 1) * n]
            for jacobian in jacobians:
                found[np.ix_(at, at)] += jacobian.T @ jacobian
        return found


@dataclass(frozen=True, eq=False)
class Windowed:
    """Where a search over windows ended that are shorter than the records.

    values : name -> value of the free parameters; nodes, begun : (M, n) scaled states at which each record's intervals
    begin, and those over the first horizon; cost : chi-squared, no more than that of whole records near by, as the
    first states of all windows are free; converged : it is an optimum
    """

    values: Mapping[str, float]
    nodes: tuple[Array, ...]
    begun: tuple[Array, ...]
    cost: float
    converged: bool = True


def in_time(record: RecordTerm, slopes: Array, scale: Array, states: Array) -> RefitRecord:
    """A record's residuals and their derivatives in order of time; slopes : as in ``Condensed`` of one window."""
    n, nz, observation = record.n, len(scale), record.observation
    time, residual, jacobian = {}, {}, {}
    columns = slopes.transpose(2, 1, 0)  # (n + nz + 1, K, M)
    for name, sample in record.grid.measured.items():
        rows = np.zeros((len(sample.values), nz + n))
        for k, entry in enumerate(record.active):
            rows[:, entry] = observation.series(columns[n + k], name) / scale[entry]
        for k in range(n):
            rows[:, nz + k] = observation.series(columns[k], name) / record.scale[k]
        time[name], residual[name], jacobian[name] = sample.time, observation.series(columns[-1], name), rows
    return RefitRecord(time, residual, jacobian, states * record.scale)
