"""What is asked: how each drive behaves, what is known of the start, and which outputs are measured."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from numbers import Real
from typing import Any

from casadi_engine.errors import IdentifiabilityError
from casadi_engine.identifiability.equations import Equations, unknown_name
from casadi_engine.identifiability.tape import exact

INPUT_CLASSES = (
    "generic", "constant", "zero", "unknown constant", "unknown polynomial", "unknown arbitrary",
)  # fmt: skip
STARTS = ("free", "known", "rest")
# Degree of an unknown polynomial when none is said: value, slope and curvature.
DEGREE = 2
OTHERS = "*"


@dataclass(frozen=True)
class InputClass:
    """How a drive behaves: known and generic, constant or zero; or unknown, of a degree (None: arbitrary)."""

    word: str
    known: bool = True
    degree: int | None = None

    @property
    def still(self) -> bool:
        """True if it does not change in time."""
        return self.word in ("constant", "zero") or self.degree == 0

    def __str__(self) -> str:
        return (
            self.word if self.word != "unknown polynomial" else f"unknown polynomial of degree {self.degree}"
        )


@dataclass(frozen=True)
class Start:
    """What is known of an initial state: nothing ("free"), a generic value, a number, or an expression."""

    word: str
    number: Fraction | None = None
    text: str | None = None

    @property
    def special(self) -> bool:
        """True if it is known, so that it may be a point at which derivatives are silent for a while."""
        return self.word != "free"

    def __str__(self) -> str:
        if self.number is not None and self.word == "number":
            return f"{float(self.number):g}"
        return self.text or self.word


@dataclass(frozen=True)
class Setting:
    """One experiment. inputs : drive -> InputClass; start : state -> Start; outputs : names of sensors."""

    name: str
    inputs: Mapping[str, InputClass]
    start: Mapping[str, Start]
    outputs: tuple[str, ...]

    @property
    def unknown(self) -> tuple[str, ...]:
        """The drives that are not known."""
        return tuple(name for name, one in self.inputs.items() if not one.known)

    @property
    def arbitrary(self) -> bool:
        """True if a drive is unknown and of no form."""
        return any(one.word == "unknown arbitrary" for one in self.inputs.values())

    @property
    def special(self) -> bool:
        """True if some initial state is known."""
        return any(one.special for one in self.start.values())

    @property
    def free_states(self) -> tuple[str, ...]:
        """The states whose start is free."""
        return tuple(name for name, one in self.start.items() if not one.special)


def read_setting(
    equations: Equations, *, name: str, inputs: Any, start: Any, outputs: Sequence[str] | None
) -> Setting:
    """Check the words of one experiment; IdentifiabilityError names what does not fit."""
    return Setting(name, _inputs(equations, inputs), _start(equations, start), _outputs(equations, outputs))


def _inputs(equations: Equations, inputs: Any) -> dict[str, InputClass]:
    drives = {variable.name for variable in equations.model.drives}
    channels = {variable.name for variable in equations.model.inputs}
    if not isinstance(inputs, Mapping):
        one = read_class(inputs)
        # A channel that a law reads (the crank angle) is no drive: it stays generic unless it is named.
        return {name: one if name in drives else read_class("generic") for name in equations.driven}
    others = read_class(inputs.get(OTHERS, "generic"))
    for name in inputs:
        if name in equations.opened:
            raise IdentifiabilityError(
                f"the drive {name} has a free parameter in it, so it is no known function of time",
                seen=f"{name}={inputs[name]!r}",
                allowed="the channels " + ", ".join(one for one in equations.driven if one in channels),
                cure="name the class of its channels instead, or fix the parameter",
            )
        if name != OTHERS and name not in drives | channels:
            known = [*equations.driven, OTHERS]
            raise unknown_name(
                "the model has no such drive", name, known, 'name a drive, or "*" for all that are not named'
            )
    given = {name: read_class(one) for name, one in inputs.items()}
    return {
        name: given.get(name, others if name in drives else read_class("generic"))
        for name in equations.driven
    }


def read_class(word: Any) -> InputClass:
    """The class of a drive from a word, or from ("unknown polynomial", degree).

    >>> str(read_class(("unknown polynomial", 3))), str(read_class("unknown"))
    ('unknown polynomial of degree 3', 'unknown arbitrary')
    """
    degree: Any = None
    given = word
    if isinstance(word, tuple) and len(word) == 2:
        word, degree = word
    if isinstance(word, str):
        *front, last = word.replace("_", " ").split() or [""]
        if front and last.isdigit():
            word, degree = " ".join(front), int(last)
        else:
            word = " ".join([*front, last])
        if word == "unknown":
            word = "unknown arbitrary"
    fits = degree is None or (word == "unknown polynomial" and type(degree) is int and 0 <= degree <= 50)
    if word not in INPUT_CLASSES or not fits:
        raise IdentifiabilityError(
            "the class of a drive is not known",
            seen=repr(given),
            allowed=", ".join(INPUT_CLASSES) + '; "unknown polynomial 3" gives its degree (0 to 50)',
            cure="choose by what the experiment does to the drive",
        )
    degrees = {"unknown constant": 0, "unknown polynomial": DEGREE if degree is None else degree}
    return InputClass(word, not word.startswith("unknown"), degrees.get(word))


def _start(equations: Equations, start: Any) -> dict[str, Start]:
    if not isinstance(start, Mapping):
        one = _read_start(start)
        if one.text is not None or one.word == "number":
            raise _bad_start(start)
        return dict.fromkeys(equations.states, one)
    for name in start:
        if name != OTHERS and name not in equations.states:
            raise unknown_name(
                "the model has no such state", name, equations.states, "name a state of the model"
            )
    others = _read_start(start.get(OTHERS, "free"))
    return {name: _read_start(start[name]) if name in start else others for name in equations.states}


def _read_start(start: Any) -> Start:
    if isinstance(start, str):
        if start == "rest":
            return Start("rest", Fraction(0))
        return Start(start) if start in STARTS else Start("expression", text=start)
    if isinstance(start, Real) and not isinstance(start, bool) and abs(float(start)) < float("inf"):
        return Start("number", exact(float(start)))
    raise _bad_start(start)


def _bad_start(seen: object) -> IdentifiabilityError:
    return IdentifiabilityError(
        "the start is not acceptable",
        seen=repr(seen),
        allowed='"free", "known", "rest"; or for each state one of these, a number, or an expression of parameters',
        cure='write start="free", or start={"speed": 0.0}',
    )


def _outputs(equations: Equations, outputs: Sequence[str] | None) -> tuple[str, ...]:
    measured = tuple(variable.name for variable in equations.model.outputs)
    if outputs is None:
        chosen = measured
    elif not _are_names(outputs):
        raise IdentifiabilityError(
            "the outputs are not acceptable",
            seen=repr(outputs),
            allowed="a sequence of one or more names of outputs or states",
            cure=f"give outputs={measured!r}, for instance",
        )
    else:
        chosen = tuple(dict.fromkeys(outputs))
    for name in chosen:
        if name not in equations.h:
            raise unknown_name(
                "the model has no such output or state", name, equations.sensors, "name what is measured"
            )
    return chosen


def _are_names(outputs: Any) -> bool:
    names = list(outputs) if isinstance(outputs, Collection) and not isinstance(outputs, str) else []
    return len(names) > 0 and all(isinstance(one, str) for one in names)
