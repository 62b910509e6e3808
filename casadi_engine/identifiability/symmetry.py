"""Symmetries in readable form: what can be scaled or shifted together without any trace in the outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import lcm

import numpy as np

from casadi_engine.identifiability.draw import Drawn
from casadi_engine.identifiability.echelon import intersection
from casadi_engine.identifiability.field import Matrix


@dataclass(frozen=True)
class Symmetry:
    """A change of several unknowns at once that no output shows.

    kind : "scaling", each is multiplied by s**exponent; or "shift", exponent·s is added to each
    exponents : name -> exponent, without zeros
    """

    kind: str
    exponents: tuple[tuple[str, Fraction], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """What changes."""
        return tuple(name for name, _ in self.exponents)

    def __str__(self) -> str:
        if self.kind == "shift":
            parts = [
                f"{name} {'+' if power > 0 else '-'} {_times(abs(power))}s" for name, power in self.exponents
            ]
            return f"{', '.join(parts)} for any s"
        groups: dict[Fraction, list[str]] = {}
        for name, power in self.exponents:
            groups.setdefault(power, []).append(name)
        parts = [
            f"{', '.join(names)} {'times' if power > 0 else 'over'} s{_power(abs(power))}"
            for power, names in sorted(groups.items(), key=lambda item: (item[0] < 0, abs(item[0])))
        ]
        return f"{'; '.join(parts)}, for any s > 0"


def symmetries(drawings: Sequence[Drawn], names: Sequence[str]) -> tuple[Symmetry, ...]:
    """The scalings and shifts that are symmetries at every one of the random points.

    A direction that is v at one point and v' at another is no scaling unless v/point = v'/point' with small
    rational entries: so the invisible directions at two points are intersected, in relative and in absolute terms.
    names : of the columns
    """
    found: list[Symmetry] = []
    if drawings[0].rank == len(names):
        return ()
    for kind in ("scaling", "shift"):
        spaces = [_relative(drawn) if kind == "scaling" else drawn.null_space for drawn in drawings]
        common = spaces[0]
        for other in spaces[1:]:
            common = intersection(drawings[0].field, common, other)
        if len(spaces) == 1:
            common = intersection(drawings[0].field, common, common)
        for vector in common.T:
            read = [drawings[0].field.small_fraction(int(entry), 100) for entry in vector]
            if all(entry is not None for entry in read):
                whole = lcm(*(entry.denominator for entry in read if entry))
                exponents = [(name, entry * whole) for name, entry in zip(names, read, strict=True) if entry]
                if len(exponents) > 1 or kind == "scaling":
                    found.append(Symmetry(kind, tuple(exponents)))
    return tuple(_without_repeats(found))


def _relative(drawn: Drawn) -> Matrix:
    """The null space with every row divided by the value at the point; rows of zeros stay."""
    field, space = drawn.field, drawn.null_space
    moved = np.flatnonzero(space.any(axis=1))
    if any(drawn.point[row] == 0 for row in moved):
        return np.zeros((space.shape[0], 0), dtype=np.int64)
    made = space.copy()
    for row in moved:
        made[row] = field.scaled(space[row], field.inverse(drawn.point[row]))
    return made


def _without_repeats(found: list[Symmetry]) -> list[Symmetry]:
    """A parameter that no output shows at all is both a scaling and a shift of its own: one line will do."""
    alone = {one.names for one in found if one.kind == "scaling" and len(one.names) == 1}
    return [one for one in found if one.kind == "scaling" or one.names not in alone]


def _times(power: Fraction) -> str:
    return "" if power == 1 else f"{power} "


def _power(power: Fraction) -> str:
    return "" if power == 1 else f"**{power}" if power.denominator == 1 else f"**({power})"
