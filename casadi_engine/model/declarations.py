"""What a model is made of besides its equations: variables, parameter declarations and ports."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from itertools import combinations
from numbers import Real
from types import MappingProxyType
from typing import Any, overload

import casadi as ca

from casadi_engine.effects.protocol import PORT_KINDS
from casadi_engine.errors import ModelError, UnitError
from casadi_engine.experiment.units import NOT_STATED, read_unit, unit_product, unit_words
from casadi_engine.model.constants_of_nature import is_constant_of_nature
from casadi_engine.model.port_units import MECHANICAL, follows_port, is_speed, quantity
from casadi_engine.parameters import Parameter, near_matches


def check_unit(name: str, unit: str) -> None:
    """Raise ModelError with a caret for a declared unit that cannot be read."""
    if unit == NOT_STATED:
        return
    try:
        read_unit(unit)
    except UnitError as error:
        raise ModelError(
            f"the unit of {name} cannot be read: {error.problem}",
            seen=error.seen,
            allowed=error.allowed,
            cure=f'{error.cure}; it is the unit=... of the declaration of "{name}" in the Blueprint',
        ) from None


@dataclass(frozen=True)
class Variable:
    """A state, input, drive or output of a model.

    name : identifier
    unit : of its numbers: any unit, "1" if dimensionless; "-" if it was not stated, and then its data come in SI
    description : one clause for tables
    scale : typical magnitude in `unit`, > 0; the solver divides by it
    """

    name: str
    unit: str = NOT_STATED
    description: str = ""
    scale: float = 1.0

    def __post_init__(self) -> None:
        for key, text in (("unit", self.unit), ("description", self.description)):
            if not isinstance(text, str) or (key == "unit" and not text.strip()):
                raise ModelError(
                    f"the {key} of {self.name} is not acceptable",
                    seen=repr(text),
                    allowed="text, such as rad/s; 1 if dimensionless" if key == "unit" else "text",
                    cure="write it in quotes",
                )
        check_unit(self.name, self.unit)
        number = isinstance(self.scale, Real) and not isinstance(self.scale, bool)
        if not (number and 0 < self.scale <= sys.float_info.max):
            raise ModelError(
                f"the scale of {self.name} is not acceptable",
                seen=repr(self.scale),
                allowed="a finite number > 0",
                cure="give the typical magnitude of the quantity in its unit",
            )


@dataclass(frozen=True)
class ParameterDeclaration:
    """A parameter as the model declares it; `Model.parameters()` makes the user's set from these."""

    name: str
    value: float
    unit: str = "1"
    min: float = -math.inf
    max: float = math.inf
    vary: bool = True
    description: str = ""

    def __post_init__(self) -> None:
        self.parameter()  # the checks of names, numbers and bounds live there
        check_unit(self.name, self.unit)

    @property
    def is_constant_of_nature(self) -> bool:
        """True of a fixed one with the value and unit of gravity, the gas constant or another one of physics."""
        return not self.vary and is_constant_of_nature(self.name, self.value, self.unit)

    def parameter(self) -> Parameter:
        """Return a fresh Parameter; ParameterError if name, value or bounds are not acceptable."""
        return Parameter(
            self.name,
            self.value,
            unit=self.unit,
            min=self.min,
            max=self.max,
            vary=self.vary,
            description=self.description,
        )


# An expression of so many characters is read in a sentence.
_SHORT = 24
# Operations down to which expressions are compared.
_DEEP = 10


@dataclass(frozen=True, eq=False)
class Port:
    """A place of a model where something can be attached.

    name : identifier, unique in the model
    kind : one of inertia, coupling, cylinder, internal, input, sensor, parameter, link, pipe
    description : one clause for tables
    signals : the quantities known there, as scalar SX expressions of the model's symbols
    slot : scalar SX, the torque [N m] that a law may add there, or None; a force [N] on what moves in metres.
        Positive accelerates an inertia or the crank (kinds inertia, cylinder, internal); at a coupling it acts on the
        first side, and its opposite on the other.
    unit : of the slot
    ends : names of the two ports that a link or pipe joins; what an effect adds there leaves the first and enters the
        second; of a path the port at which it acts, of a cross the sensor
    units : signal -> its unit, of those whose unit is known
    why_no_unit : why the unit of the slot is not stated, where the equations leave it open
    """

    name: str
    kind: str
    description: str = ""
    signals: Mapping[str, Any] = field(default_factory=dict)
    slot: Any = None
    unit: str = "N m"
    ends: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    why_no_unit: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.kind, str) or self.kind not in PORT_KINDS:
            raise ModelError(
                f"the kind of port {self.name} is not known",
                seen=repr(self.kind),
                allowed=near_matches(self.kind, PORT_KINDS),
                cure="choose the kind by what is attached there",
            )
        if self.kind in ("link", "pipe") and len(self.ends) != 2:
            raise ModelError(
                f"the port {self.name} is a {self.kind} without ends",
                seen=f"ends = {self.ends!r}",
                allowed="links and pipes that the model makes of its inertias by itself",
                cure="declare both inertias; what joins them is called a_and_b",
            )
        if self.kind in ("path", "cross") and len(self.ends) != 1:
            raise ModelError(
                f"the port {self.name} is a {self.kind} without an end",
                seen=f"ends = {self.ends!r}",
                allowed="paths and crosses that the model makes of its inputs, inertias and outputs by itself",
                cure="declare the input u and the inertia a; the path is called u_to_a",
            )
        object.__setattr__(self, "signals", MappingProxyType(dict(self.signals)))

    @property
    def unit_cure(self) -> str:
        """What to do about the unit of the slot where the equations leave it open; "" where nothing is to be done."""
        if not self.why_no_unit:
            return ""
        return (
            f"the unit of what acts at {self.name} is not stated: {self.why_no_unit}; say it where the port is "
            f'declared, b.port("{self.name}", ..., unit="...")'
        )

    @property
    def parameter(self) -> str:
        """Name of the parameter at a port of that kind; "" at others."""
        return self.name.removeprefix("parameter_") if self.kind == "parameter" else ""

    @property
    def is_own(self) -> bool:
        """True for an internal port with signals: unknown functions of them may act there, no effect of the library."""
        return self.kind == "internal" and self.slot is not None and bool(self.signals)

    def in_its_unit(self, text: str) -> str:
        """A unit of torques and angles as it reads at this port, "-" where that is not known; any other unit as it is.

        >>> Port("mass", "inertia", unit="N", units={"speed": "m/s"}).in_its_unit("N m s2/rad2")
        'N s2/m2'
        >>> Port("joint", "inertia", unit="N m", units={"speed": "deg/s"}).in_its_unit("N m s/rad")
        'N m s/deg'
        >>> Port("room", "inertia", unit="W", units={"speed": "K"}).in_its_unit("N m s/rad")
        'W/K'
        """
        if not follows_port(text):
            return text
        powers = dict(read_unit(text).written)
        acting, angle, time = (powers.get(symbol, Fraction(0)) for symbol in ("N", "rad", "s"))
        if not (acting or angle):
            return text
        if (
            self.kind in ("path", "cross")
            and self.units.get("input", NOT_STATED) == NOT_STATED
            and "difference" not in self.signals
        ):
            return self.unit if acting else NOT_STATED  # for one of the input, whatever that is
        place = None if self._place is None or time else self._place
        motion = self._motion if place is None else place
        if (acting and self.unit == NOT_STATED) or (angle and motion is None):
            return NOT_STATED
        factors = [(self.unit, acting)] if acting else []
        factors += [(motion, angle)] if angle and motion is not None else []
        # in N m s/rad the second belongs to the motion, in N m s it stands for itself
        factors += [("s", time + angle if angle and place is None else time)]
        return unit_product(*factors)

    def contradicts(self, text: str) -> str:
        """The unit that this port's numbers have where `text` is of the same dimension and another size; "" if none.

        Compared are the units of the slot, of the motion and of the place, and of the slot by powers of these.

        >>> slide = Port("slide", "coupling", unit="N", units={"twist": "mm", "twist_rate": "mm/s"})
        >>> slide.contradicts("N/m"), slide.contradicts("kN/m"), slide.contradicts("N m/rad"), slide.contradicts("kg")
        ('N/mm', '', '', '')
        """
        if text == NOT_STATED or follows_port(text) or self.kind in ("input", "sensor", "cross", "parameter"):
            return ""
        signals = [unit for unit in (self._place, self._motion) if self.units and unit is not None]
        made = [unit_product((signal, 1)) for signal in signals]
        if self.unit != NOT_STATED:
            made += [self.unit]
            made += [
                unit_product((self.unit, 1), (signal, -power)) for signal in signals for power in (1, 2, 3)
            ]
        own = read_unit(text)
        alike = [one for one in made if read_unit(one).exponents == own.exponents]
        same = [one for one in alike if read_unit(one).steps_to(own)[:2] == (1.0, 1.0)]
        return alike[0] if alike and not same else ""

    @property
    def _motion(self) -> str | None:
        """The unit of what an effect reads as speed."""
        own = next((self.units[n] for n in ("speed", "twist_rate", "difference") if n in self.units), None)
        by_place = None if self._place is None else unit_product((self._place, 1), ("s", -1))
        known = own if own is not None else by_place
        return {"N": "m/s", "N m": "rad/s"}.get(self.unit) if known is None else known

    @property
    def _place(self) -> str | None:
        """The unit of what an effect reads as twist, or at a path."""
        return next((self.units[n] for n in ("twist", "angle", "input") if n in self.units), None)

    @property
    def quantity(self) -> str:
        """What acts there: torque, force, volume flow ..., else a "rate" or, not by time, a "term"."""
        return quantity(self.unit)

    @property
    def motion(self) -> str:
        """What an effect reads there, in words: speed, or the expression of the signal."""
        own = next((n for n in ("speed", "twist_rate", "twist", "difference") if n in self.signals), "")
        return "speed" if self.is_mechanical or not own else self.called(own)

    def called(self, signal: str) -> str:
        """A signal in words: its name where a torque or force acts, else its expression where that is short."""
        written = str(self.signals.get(signal, ""))
        plain = signal.replace("_", " ")
        if self.is_mechanical or not 0 < len(written) <= _SHORT or "@" in written or written.count("(") > 1:
            return plain
        written = written.removeprefix("(").removesuffix(")")
        return re.sub(r"(?<=[A-Za-z_)])([-+])(?=[A-Za-z_(])", r" \1 ", written)

    @property
    def is_mechanical(self) -> bool:
        """True where a torque or a force acts, or a speed is read."""
        known = self.quantity in MECHANICAL
        return known or (self.unit == NOT_STATED and is_speed(self._motion or NOT_STATED))

    def __str__(self) -> str:
        return f"{self.name} ({self.kind}): {', '.join(self.signals)}"


def _above(value: Any, unit: str | None, port: Port) -> tuple[dict[str, Any], dict[str, str]]:
    """By how much a value is above the first signal of a port, and its unit; nothing where that is of another unit or
    counted from it already."""
    first = next(iter(port.signals), "")
    if unit is None or port.units.get(first) != unit:
        return {}, {}
    own = port.signals[first]
    if any(ca.depends_on(own, symbol) for symbol in ca.symvar(value)):
        return {}, {}
    return {"difference": value - _above_zero(port, first)}, {"difference": unit}


def _of_one_unit(a: Port, b: Port, signal: str) -> bool:
    """False where two ports have a signal of which no difference is to be had, as a voltage and a charge, or where that
    is not known, as one of them has no unit."""
    return a.units.get(signal) == b.units.get(signal)


def _above_zero(port: Port, name: str) -> Any:
    """A signal; of a temperature above others, such as T - T_out, the one that is counted from them."""
    signal, unit = port.signals[name], port.units.get(name)
    if unit is None or read_unit(unit).dimension != "K":
        return signal
    symbols = ca.symvar(signal)
    slopes = [ca.jacobian(signal, one) for one in symbols]
    if not all(slope.is_constant() for slope in slopes):
        return signal
    own = [one for one, slope in zip(symbols, slopes, strict=True) if float(slope) == 1.0]
    return own[0] if len(own) == 1 else signal


class Ports(Sequence[Port]):
    """The ports of a model, by position or by name; printing lists them."""

    def __init__(self, ports: Iterable[Port]):
        self._ports = tuple(ports)
        self._by_name = {port.name: port for port in self._ports}

    @property
    def names(self) -> tuple[str, ...]:
        """Names in model order."""
        return tuple(self._by_name)

    @property
    def with_slot(self) -> tuple[Port, ...]:
        """The ports that can take a torque, in the order of the model's slot vector w."""
        return tuple(port for port in self._ports if port.slot is not None)

    @property
    def unit_cures(self) -> tuple[str, ...]:
        """Of each port whose unit the equations leave open, why, and what to do."""
        return tuple(port.unit_cure for port in self._ports if port.unit_cure)

    @cached_property
    def links(self) -> tuple[Port, ...]:
        """A link ``a_and_b`` for every two inertias whose slots have the same known unit and that have a signal of one
        name and of one unit; a pipe, where that unit is neither of a torque nor of a force.

        Its signals ``first`` and ``second`` are the first such signal of a and of b, ``difference`` is a's less b's. A
        temperature less that of what is around the body is there the body's own: two bodies need not have one
        surrounding.
        Links are found by name, ``ports["a_and_b"]``, and are not listed among the ports.
        """
        able = [port for port in self.with_slot if port.kind == "inertia" and port.unit != "-"]
        pairs = [(a, b) for a, b in combinations(able, 2) if a.unit == b.unit]
        found = []
        for a, b in pairs:
            shared = [n for n in a.signals if n in b.signals and n != "angle" and _of_one_unit(a, b, n)]
            if shared:
                first, second = (_above_zero(port, shared[0]) for port in (a, b))
                signals = {"difference": first - second, "first": first, "second": second}
                words = f"{shared[0]} of {a.name} less that of {b.name}"
                ends = (a.name, b.name)
                kind = "link" if a.is_mechanical else "pipe"
                unit = a.units.get(shared[0])
                units = {} if unit is None else dict.fromkeys(signals, unit)
                found.append(Port("_and_".join(ends), kind, words, signals, None, a.unit, ends, units))
        return tuple(found)

    @cached_property
    def paths(self) -> tuple[Port, ...]:
        """A path ``u_to_a`` from every input u to every inertia a, with the signal ``input``, which is u, and, where a
        has a first signal of its unit that is not counted from it, ``difference``, by which u is above that. Paths are
        found by name, as links are, and are not listed among the ports."""
        able = [port for port in self.with_slot if port.kind == "inertia"]
        found = []
        for one in self._ports:
            if one.kind == "input" and "value" in one.signals:
                name = one.name.removeprefix("input_")
                signals, known = {"input": one.signals["value"]}, one.units.get("value")
                units = {} if known is None else {"input": known}
                for a in able:
                    words, end = f"{name} acts at {a.name}", (a.name,)
                    more, wide = _above(signals["input"], known, a)
                    own, every = signals | more, units | wide
                    found.append(Port(f"{name}_to_{a.name}", "path", words, own, None, a.unit, end, every))
        return tuple(found)

    @cached_property
    def crosses(self) -> tuple[Port, ...]:
        """A cross ``y_to_sensor_z`` from every output y, and every input y that is none, to the sensor of every other
        output z, with the signal ``input``, which is y, and, where both have one unit, ``difference``, by which y is
        above z. Crosses are found by name, as links are, and are not listed among the ports."""
        shown = [one for one in self._ports if one.kind == "sensor" and "value" in one.signals]
        known = {one.name.removeprefix("sensor_") for one in shown}
        others = [one for one in self._ports if one.kind == "input" and "value" in one.signals]
        others = [one for one in others if one.name.removeprefix("input_") not in known]
        found = []
        for one in (*shown, *others):
            name, unit = one.name.partition("_")[2], one.units.get("value")
            for z in shown:
                if z is one or ca.is_equal(z.signals["value"], one.signals["value"], _DEEP):
                    continue
                own, own_unit = {"input": one.signals["value"]}, z.units.get("value", NOT_STATED)
                units = {} if unit is None else {"input": unit}
                if unit is not None and unit == own_unit:
                    own["difference"] = own["input"] - z.signals["value"]
                    units["difference"] = unit
                words, end = f"{name} acts on {z.name}", (z.name,)
                found.append(Port(f"{name}_to_{z.name}", "cross", words, own, None, own_unit, end, units))
        return tuple(found)

    @property
    def unlisted(self) -> tuple[Port, ...]:
        """Links, paths and crosses."""
        return (*self.links, *self.paths, *self.crosses)

    @overload
    def __getitem__(self, key: int | str) -> Port: ...
    @overload
    def __getitem__(self, key: slice) -> tuple[Port, ...]: ...
    def __getitem__(self, key: int | str | slice) -> Port | tuple[Port, ...]:
        if isinstance(key, int | slice):
            return self._ports[key]
        if key not in self._by_name:
            found = next((port for port in self.unlisted if port.name == key), None)
            if found is not None:
                return found
            raise ModelError(
                "the model has no such port",
                seen=repr(key),
                allowed=near_matches(key, self.names),
                cure="print(model.ports) lists them",
            )
        return self._by_name[key]

    def __len__(self) -> int:
        return len(self._ports)

    def __iter__(self) -> Iterator[Port]:
        return iter(self._ports)

    def __contains__(self, item: object) -> bool:
        return item in self._by_name or any(item is port for port in self._ports)

    def __str__(self) -> str:
        rows = [("port", "kind", "slot", "signals")]
        for port in self._ports:
            slot = "-" if port.slot is None else unit_words(port.unit)
            rows.append((port.name, port.kind, slot, ", ".join(port.signals)))
        widths = [max(len(row[column]) for row in rows) for column in range(3)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=False)) + "  " + row[3]
            for row in rows
        ]
        return "\n".join([*lines, *self.unit_cures])

    def __repr__(self) -> str:
        return f"Ports({', '.join(self.names)})"
