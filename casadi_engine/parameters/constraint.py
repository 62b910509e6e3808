"""Constraints on expressions of the parameters and on natural frequencies, as data."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from typing import Any

from casadi_engine.errors import ConstraintError, ParameterError
from casadi_engine.parameters.parameter import number


@dataclass(frozen=True, eq=False)
class Constraint:
    """min <= expression <= max.

    label : the user's name of it, or the text of the expression
    expression : SX scalar of the set's symbols
    min, max : in the expression's unit; infinite if there is none; equal for an equality
    names : the parameters it refers to
    text : the expression as the user wrote it, or as an SX is shown
    name : the user's name of it, or None
    readable : True if `text` is what the user wrote
    """

    label: str
    expression: Any
    min: float
    max: float
    names: tuple[str, ...]
    text: str
    name: str | None = None
    readable: bool = True

    def __str__(self) -> str:
        written = between(self.text, self.min, self.max)
        return written if self.name is None else f"{self.name}: {written}"


@dataclass(frozen=True)
class FrequencyConstraint:
    """Bounds of one natural frequency.

    mode : 1, 2, … by rising undamped frequency, the rigid body mode (0 Hz) not counted
    min, max : Hz
    """

    mode: int
    min: float
    max: float

    @property
    def label(self) -> str:
        return f"natural frequency {self.mode}"

    def __str__(self) -> str:
        return between(f"{self.label} [Hz]", self.min, self.max)


def between(text: str, low: float, high: float) -> str:
    """Write ``low <= text <= high`` without the sides that are infinite."""
    if low == high:
        return f"{text} == {low:.6g}"
    left = f"{low:.6g} <= " if math.isfinite(low) else ""
    right = f" <= {high:.6g}" if math.isfinite(high) else ""
    return f"{left}{text}{right}"


def check_bounds(label: str, low: object, high: object) -> tuple[float, float]:
    """Return the two bounds of a constraint as floats, or raise ConstraintError naming `label`."""
    try:
        lower = number("min", low, infinite=-1)
        upper = number("max", high, infinite=1)
    except ParameterError as error:
        raise ConstraintError(
            f"the {error.problem.split()[0]} of the constraint {label} is not acceptable",
            seen=error.seen,
            allowed=error.allowed,
            cure="give one number",
        ) from None
    if lower > upper:
        raise ConstraintError(
            f"the bounds of the constraint {label} are in the wrong order",
            seen=f"min = {lower:.6g}, max = {upper:.6g}",
            allowed="min <= max (equal for an equality)",
            cure="exchange them",
        )
    if math.isinf(lower) and math.isinf(upper):
        raise ConstraintError(
            f"the constraint {label} has no bound",
            seen="min = -inf, max = inf",
            allowed="at least one finite bound",
            cure="give min, max or both",
        )
    return lower, upper


def check_frequency(mode: object, low: object, high: object) -> FrequencyConstraint:
    """Return the constraint on natural frequency number `mode` [Hz], or raise ConstraintError."""
    number = _whole(mode)
    if number is None or number < 1:
        raise ConstraintError(
            "the number of a natural frequency is not acceptable",
            seen=repr(mode),
            allowed="a whole number from 1 on, the rigid body mode (0 Hz) not counted",
            cure="number the modes by rising frequency; print(model.modes(parameters)) lists them",
        )
    lower, upper = check_bounds(f"natural frequency {number}", low, high)
    if upper <= 0 or (lower < 0 and math.isfinite(lower)):
        raise ConstraintError(
            f"the bounds of the constraint natural frequency {number} are not frequencies",
            seen=f"min = {lower:.6g} Hz, max = {upper:.6g} Hz",
            allowed="0 <= min, 0 < max, in Hz",
            cure="give positive frequencies in Hz",
        )
    return FrequencyConstraint(number, lower, upper)


def _whole(number: Any) -> int | None:
    """A whole number of any kind but bool, or None."""
    try:
        return None if isinstance(number, bool) else operator.index(number)
    except TypeError:
        return None
