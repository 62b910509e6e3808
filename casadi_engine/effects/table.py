"""The library as a table: every law is written down by calling it with symbols, nothing is copied by hand."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import casadi as ca

from casadi_engine.effects.functions import Sharp
from casadi_engine.effects.library import library
from casadi_engine.effects.protocol import Effect, Law, check_effect
from casadi_engine.model.port_view import Values
from casadi_engine.model.printing import write_expressions

UNITS = "Units follow the port: N s/mm, W/K or N m s/deg for N m s/rad."
HEADER = ("effect", "adds at its port", "port", "reads", "amplitude", "looks like")


@dataclass(frozen=True)
class Row:
    """One effect at one kind of port; `formula` is in the names of its parameters and of the signals that it reads."""

    effect: str
    formula: str
    port: str
    signals: tuple[str, ...]
    amplitude: str
    kin: tuple[str, ...]

    @property
    def cells(self) -> tuple[str, ...]:
        """The texts of the row."""
        signals, kin = (", ".join(names) or "-" for names in (self.signals, self.kin))
        return self.effect, self.formula, self.port, signals, self.amplitude, kin


def table(effects: Iterable[Effect] | None = None) -> str:
    """Return a table of effects as text: formula, kind of port, signals that the law reads, amplitude, kin.

    effects : None for the library
    The formulas are those of the laws themselves, without rounding; t is time. EffectError for what is no effect.

    >>> print(table(library("load_step", "viscous_friction")))
    effect            adds at its port          port      reads       amplitude                looks like
    load_step         -torque*step(t - time)    inertia   -           torque [N m]             constant_torque, misfire
    viscous_friction  -coefficient*speed        inertia   speed       coefficient [N m s/rad]  quadratic_drag, ...
    viscous_friction  coefficient*twist_rate    coupling  twist_rate  coefficient [N m s/rad]  quadratic_drag, ...
    Units follow the port: N s/mm, W/K or N m s/deg for N m s/rad.
    """
    cells = [
        HEADER,
        *(row.cells for effect in (library() if effects is None else effects) for row in rows_of(effect)),
    ]
    widths = [max(len(row[k]) for row in cells) for k in range(len(HEADER))]
    lines = ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) for row in cells]
    return "\n".join(line.rstrip() for line in [*lines, UNITS])


def rows_of(effect: Effect) -> tuple[Row, ...]:
    """The rows of one effect, one for each kind of port."""
    check_effect(effect)
    return tuple(_row(effect, kind) for kind in effect.attaches)


def _row(effect: Effect, kind: str) -> Row:
    """A row from a call of the law with symbols."""
    port, amplitude = _Blank(kind), effect.amplitude
    values = {name: ca.SX.sym(name) for name in (amplitude.name, *effect.nuisance)}
    try:
        law = effect.law(port, Values(effect.name, values), _Words)
        law = law if isinstance(law, Law) else Law(law)
        parts = {"": law.value} | ({} if law.arrives is None else {"arriving ": law.arrives})
        parts |= {f"d({name})/dt = ": rate for name, (_, rate) in law.states.items()}
        written = write_expressions([ca.SX(part) for part in parts.values()], shared_operations=10**6).texts
        formula = "; ".join(name + text for name, text in zip(parts, written, strict=True))
    except Exception as fault:  # noqa: BLE001 (a law of the user's own may do anything)
        formula = f"(cannot be written: {type(fault).__name__}: {fault})"
    unit = "unit of its port" if amplitude.unit is None else amplitude.unit
    return Row(effect.name, formula, kind, tuple(port.read), f"{amplitude.name} [{unit}]", tuple(effect.kin))


class _Blank:
    """A port that has every signal, as a symbol of that name, and notes those that are read."""

    def __init__(self, kind: str):
        self.name, self.kind, self.time, self.declaration = "port", kind, ca.SX.sym("t"), None
        self.read: dict[str, Any] = {}
        self.shows_at_once = False

    def __getattr__(self, signal: str) -> Any:
        if signal.startswith("__"):
            raise AttributeError(signal)
        return self.read.setdefault(signal, ca.SX.sym(signal))

    def has(self, signal: str) -> bool:
        del signal
        return True

    def typical(self, signal: str) -> float:
        del signal
        return 1.0

    def width(self, default: float, *, unit: str = "1") -> float:
        del unit
        return default

    def state(self, name: str) -> Any:
        return ca.SX.sym(name)

    @property
    def place(self) -> Any:
        self.read.setdefault("speed", ca.SX.sym("speed"))
        return ca.SX.sym("place")

    def size(self, expression: Any) -> float:
        del expression
        return 1.0

    def absolute_zero(self, signal: str) -> float:
        del signal
        return 0.0

    def stored(self, signal: str) -> Any:
        return getattr(self, signal)

    def courses(self, signal: str, *, stored: bool = False) -> tuple[()]:
        del signal, stored
        return ()


def _called(name: str, *arguments: Any) -> Any:
    texts = write_expressions([ca.SX(argument) for argument in arguments], shared_operations=10**6).texts
    return ca.SX.sym(f"{name}({', '.join(texts)})")


class _Words(Sharp):
    """The functions of laws, without rounding, as they are called."""

    @staticmethod
    def sign(x: Any, width: Any = None) -> Any:
        del width
        return _called("sign", x)

    @staticmethod
    def step(x: Any, width: Any = None) -> Any:
        del width
        return _called("step", x)

    @staticmethod
    def positive(x: Any, width: Any = None) -> Any:
        del width
        return _called("positive", x)

    @staticmethod
    def dead_zone(x: Any, half: Any, width: Any = None) -> Any:
        del width
        return _called("dead_zone", x, half)
