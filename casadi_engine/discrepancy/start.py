"""A point to start a refit from, as ``estimate(warm=...)`` reads it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from casadi_engine.estimation import Fit
from casadi_engine.estimation.search import is_near


@dataclass(frozen=True, eq=False)
class Start:
    """Values to start from, and initial states, or none: the measurement gives them.

    converged : an optimum is to be near; in_places : laws are so sharp that steps are short in places alone
    fineness : record -> how finely the integration is to be, as it was before
    """

    values: Mapping[str, float]
    initial: Mapping[str, Any] = field(default_factory=dict)
    noise: Mapping[str, tuple[float, bool]] = field(default_factory=dict)
    converged: bool = False
    in_places: bool = False
    fineness: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, fit: Fit, *, near: bool = True) -> Start:
        """A fit as a start; near : an optimum is to be near."""
        return cls(fit.values, fit.initial, fit.noise, near and is_near(fit), fineness=fit.fineness)
