"""Where a refit ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from casadi_engine.discrepancy.refit_null import cost_beyond
from casadi_engine.estimation.refit_entry import Refit, RefitProblem

# Of a parameter, how near to its bound it rests there.
_AT_BOUND = 1e-8


@dataclass(frozen=True, eq=False)
class Arrived:
    """Where a refit ended: values and first states, as ``estimate(warm=...)`` reads them.

    cost : chi-squared with priors at the levels of the path, simulated from the first states
    settled : it is an optimum; held : parameters at a bound
    refit, levels : the refit, and the levels of the noise (output -> sigma) by which its residuals were weighted
    lags : output -> seconds by which the samples of late sensors were read earlier
    """

    values: Mapping[str, float]
    initial: Mapping[str, Mapping[str, float]]
    cost: float
    settled: bool
    held: frozenset[str]
    refit: Refit = field(repr=False)
    levels: Mapping[str, float]
    lags: Mapping[str, float] = field(default_factory=dict)

    def rests(self, name: str) -> bool:
        """True if a parameter, in every record where it has a value in each, is at a bound."""
        own = [one for one in self.values if one.partition("@")[0] == name]
        return bool(own) and self.held.issuperset(own)


def arrived_at(
    problem: RefitProblem,
    found: Refit,
    levels: Mapping[str, float],
    lags: Mapping[str, float] = MappingProxyType({}),
) -> Arrived | None:
    """Where a refit ended at these levels of the noise and lags; None where the model has no value there."""
    if not found.initial or not np.isfinite(found.cost):
        return None
    pmap = problem.pmap
    held = set()
    for name, low, high in zip(pmap.free, pmap.lower, pmap.upper, strict=True):
        value = found.values[name]
        near = _AT_BOUND * max(abs(value), 1e-12)
        if value - low <= near or high - value <= near:
            held.add(name)
    return Arrived(
        found.values,
        found.initial,
        found.cost + cost_beyond(problem, found),
        found.converged,
        frozenset(held),
        found,
        dict(levels),
        dict(lags),
    )
