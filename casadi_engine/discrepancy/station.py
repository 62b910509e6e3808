"""A model on the way to the repaired one."""

from __future__ import annotations

from dataclasses import dataclass

from casadi_engine.discrepancy.refit import Addition
from casadi_engine.discrepancy.repaired import Member
from casadi_engine.discrepancy.screening import Screened
from casadi_engine.estimation import Fit


@dataclass(frozen=True, eq=False)
class Station:
    """A model on the way: its fit, its effects, what was screened against it, and how it was reached.

    lead : the candidate, of those screened at the station before, that was added last; members : its class;
    drop : of chi-squared by it; frequency : share of half-samples in which it scored best
    """

    fit: Fit
    effects: tuple[Addition, ...]
    screened: Screened
    lead: int | None = None
    members: tuple[Member, ...] = ()
    drop: float = 0.0
    frequency: float | None = None
