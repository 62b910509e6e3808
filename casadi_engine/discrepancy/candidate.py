"""A candidate: one effect at one port with one choice of its nuisance parameters, linearised."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from casadi_engine.simulation.candidate_sensitivities import Direction

Side = Literal[-1, 0, 1]


@dataclass(frozen=True, eq=False)
class Candidate:
    """What is tested: the amplitude psi of ``direction``, zero in the null model.

    effect, port : names; nuisance : name -> value at which the effect was linearised
    side : 1 if psi >= 0, -1 if psi <= 0, 0 if both signs make sense
    group : candidates of one group are tested together too (all cylinders of an engine, say)
    record : the one record in which it can act, or None for all
    """

    effect: str
    port: str
    direction: Direction
    nuisance: Mapping[str, float] = field(default_factory=dict)
    side: Side = 0
    unit: str = "1"
    group: str | None = None
    record: str | None = None

    @property
    def key(self) -> tuple[str, str]:
        """Effect and port: the name under which all points of the nuisance grid are known."""
        return self.effect, self.port

    @property
    def label(self) -> str:
        """``effect at port (nuisance)``."""
        inside = ", ".join(f"{name} {value:.4g}" for name, value in self.nuisance.items())
        where = f" in {self.record}" if self.record is not None else ""
        return f"{self.effect} at {self.port}" + (f" ({inside})" if inside else "") + where
