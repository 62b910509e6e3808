"""A candidate: one effect at one port with one choice of its nuisance parameters, linearised."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from casadi_engine.discrepancy.clocks import clock_of
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.errors import EffectError
from casadi_engine.model.term import NotApplicable
from casadi_engine.simulation.candidate_sensitivities import Direction

Side = Literal[-1, 0, 1]

# Sensitivities whose squares add up to a number.
_LARGEST = 1e140


@dataclass(frozen=True, eq=False)
class Candidate:
    """What is tested: the amplitude psi of ``direction``, zero in the null model.

    effect, port : names; direction : the linearised term, or record -> term where constants are read off records;
    in a record that is not among them the candidate does not act
    nuisance : name -> value at which the effect was linearised
    side : 1 if psi >= 0, -1 if psi <= 0, 0 if both signs make sense
    group : candidates of one group are tested together too (all cylinders of an engine, say)
    size : None for the slope at psi = 0, or the psi whose secant the direction is
    source : what it was made of, for those who add the effect to the model
    """

    effect: str
    port: str
    direction: Direction | Mapping[str, Direction]
    nuisance: Mapping[str, float] = field(default_factory=dict)
    side: Side = 0
    unit: str = "1"
    group: str | None = None
    size: float | None = None
    source: Any = None

    @property
    def key(self) -> tuple[str, str]:
        """Effect and port: the name under which all points of the nuisance grid are known."""
        return self.effect, self.port

    def at(self, record: str) -> Direction | None:
        """The direction in a record, or None if the candidate does not act there."""
        return self.direction if isinstance(self.direction, Direction) else self.direction.get(record)

    @property
    def label(self) -> str:
        """``effect at port (nuisance)``."""
        inside = [f"{name} {self._told(name, value)}" for name, value in self.nuisance.items()]
        inside += [] if self.size is None else [f"size {self.size:.4g}"]
        return f"{self.effect} at {self.port}" + (f" ({', '.join(inside)})" if inside else "")

    def _told(self, name: str, value: float) -> str:
        """A value of the grid; times in the model's own unit where that is none of seconds."""
        grid = None if self.source is None else self.source.effect.nuisance.get(name)
        if grid is None or grid.over != "time" or self.source.model.time_unit == "s":
            return f"{value:.4g}"
        clock = clock_of(self.source.model)
        return f"{clock.of(value):.4g} {clock.unit}"


def with_finite_columns(
    candidates: list[Candidate], columns: dict[str, dict[str, Array]]
) -> tuple[list[Candidate], dict[str, dict[str, Array]], list[NotApplicable]]:
    """The candidates whose sensitivity is a number everywhere in the data, and so are its squares, their columns, and
    notes for the effects of which none is.

    Raises EffectError where none is left.
    """
    wrong: dict[int, str] = {}
    for record, outputs in columns.items():
        for values in outputs.values():
            wrong |= dict.fromkeys(np.flatnonzero(~(np.abs(values) < _LARGEST).all(axis=0)).tolist(), record)
    if not wrong:
        return candidates, columns, []
    why = {k: f"its law has no finite derivative along record {record}" for k, record in wrong.items()}
    if len(wrong) == len(candidates):
        first = min(wrong)
        raise EffectError(
            f"the law of {candidates[first].label} has no finite derivative along record {wrong[first]}",
            seen="a change of an output with its amplitude that is infinite or not a number",
            allowed="a law that is smooth for all values that its signals take in the data",
            cure="take functions of math, the last argument of law, not those of Python's own module; keep "
            "roots and divisions away from zero",
        )
    kept = [k for k in range(len(candidates)) if k not in wrong]
    columns = {
        record: {name: values[:, kept] for name, values in outputs.items()}
        for record, outputs in columns.items()
    }
    left = {candidates[k].key for k in kept}  # as of a delay with other times
    notes = [
        NotApplicable(candidates[k].effect, candidates[k].port, (), (), words)
        for k, words in why.items()
        if candidates[k].key not in left
    ]
    return [candidates[k] for k in kept], columns, notes
