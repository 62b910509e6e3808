"""Units of data: any unit is read, and kept in SI until a model asks for another one of the same dimension."""

from __future__ import annotations

import re
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import UnitError

from .unit_parser import RULE, Unit, parse_unit, product_text

FloatArray = NDArray[np.float64]

# Units that are met often; any other product of known symbols is read as well.
SI_UNITS: tuple[str, ...] = (
    "1", "s", "m", "kg", "A", "K", "mol",
    "rad", "rad/s", "rad/s2", "Hz",
    "m/s", "m/s2", "m2", "m3", "m3/s", "kg/s", "kg/m3",
    "N", "N/m", "N s/m", "Pa", "Pa s", "J", "W", "V",
    "N m", "N m/rad", "N m s/rad", "N m/rad3", "N m s2/rad2", "kg m2", "kg m",
)  # fmt: skip
ALLOWED_UNITS: tuple[str, ...] = (*SI_UNITS, "rpm", "deg", "bar", "kPa", "MPa", "N mm", "g m2", "ms")

# Units of records that are taken for one another: those of one dimension.
CONFUSED: tuple[str, ...] = (
    "rad/s", "rpm", "deg/s", "rad", "deg", "mrad", "rad/s2", "deg/s2", "m", "mm", "cm", "m/s", "mm/s", "km/h", "m/min",
    "m/s2", "mm/s2", "Pa", "kPa", "bar", "MPa", "mbar", "N", "kN", "N m", "N mm", "kN m", "A", "mA", "V", "mV",
    "W", "kW", "s", "ms", "min", "h", "kg", "g", "kg/s", "kg/h", "g/s", "m3/s", "L/s", "L/min", "m3/h", "mol", "mmol",
)  # fmt: skip

# The unit of a model's variable of which none was said: its equations are taken to be in SI.
NOT_STATED = "-"

_HEADER = re.compile(r"([^\[\]]*)\[([^\[\]]*)\]")
# What a header most likely means by these letters, which are the coulomb and the farad.
_TEMPERATURES = {"C": ("degC", "A s"), "F": ("degF", "A s/V")}
_DIMENSIONLESS = ("", "-", "none", "dimensionless")


def split_header(header: str) -> tuple[str, str | None]:
    """Split a column header ``name [unit]`` into its name and its unit (None when it has none).

    >>> split_header("p1 [bar]")
    ('p1', 'bar')
    >>> split_header("p1")
    ('p1', None)
    """
    text = header.strip()
    match = _HEADER.fullmatch(text)
    return (match[1].strip(), match[2].strip()) if match else (text, None)


def read_unit(unit: Any, *, where: str = "") -> Unit:
    """The unit of a text: its dimension, factor and offset.

    Raises :class:`UnitError` when it cannot be read, with a caret under the place; ``where`` opens its message.

    >>> read_unit("L/min").dimension
    's-1 m3'
    """
    opening = f"{where}: " if where else ""
    if not isinstance(unit, str) or unit.strip().lower() in _DIMENSIONLESS:
        raise UnitError(
            f"{opening}unknown unit",
            seen=repr(unit),
            allowed=RULE,
            cure="write 1 for a dimensionless quantity" if isinstance(unit, str) else "give the unit as text",
        )
    try:
        return parse_unit(unit)
    except UnitError as error:
        if not where:
            raise
        problem = f"{opening}{error.problem}"
        raise UnitError(problem, seen=error.seen, allowed=error.allowed, cure=error.cure) from None


def unit_product(*factors: tuple[str, Fraction | int]) -> str:
    """The text of a product of units to powers, in the symbols that they are written with.

    >>> unit_product(("m3/s", 1), ("m", -1)), unit_product(("N m", 1), ("rad/s", -2))
    ('m2/s', 'N m s2/rad2')
    """
    found: dict[str, Fraction] = {}
    for unit, power in factors:
        for symbol, own in read_unit(unit).written:
            found[symbol] = found.get(symbol, Fraction(0)) + own * power
    return product_text(found)


def unit_words(unit: str) -> str:
    """A unit in the cell of a table: as it is, or that it is not stated.

    >>> unit_words("N m"), unit_words("-")
    ('N m', 'not stated')
    """
    return "not stated" if unit == NOT_STATED else unit


def read_data_unit(unit: Any, *, where: str = "") -> Unit:
    """The unit of data; as `read_unit`, but C and F alone are refused, for they may be meant as temperatures, and a
    dash is what many write for 1."""
    text = unit.strip() if isinstance(unit, str) else ""
    if text == NOT_STATED:
        return read_unit("1", where=where)
    if text in _TEMPERATURES:
        degree, other = _TEMPERATURES[text]
        raise UnitError(
            f"{where + ': ' if where else ''}{text} may be meant as a temperature or as a unit of electricity",
            seen=repr(text),
            allowed=RULE,
            cure=f"write {degree} for a temperature, {other} otherwise",
        )
    return read_unit(unit, where=where)


def as_recorded(unit: str) -> str:
    """The unit of data as it was given, where its numbers are not those of the SI unit; else "".

    >>> as_recorded("deg"), as_recorded("N m"), as_recorded("-")
    ('deg', '', '')
    """
    return "" if read_data_unit(unit).is_si else unit.strip()


def si_unit(unit: str, *, where: str = "") -> str:
    """SI unit text that ``unit`` is converted to, in the same symbols: N mm becomes N m, not kg m2/s2.

    Raises :class:`UnitError` when the unit is not known; ``where`` opens its message.

    >>> si_unit("rpm"), si_unit("mL/min"), si_unit("N m s/rad")
    ('rad/s', 'm3/s', 'N m s/rad')
    """
    return read_data_unit(unit, where=where).si


def to_si(values: Any, unit: str, *, where: str = "") -> tuple[FloatArray, str]:
    """Convert values to SI and name the SI unit.

    values : array of any shape in ``unit``; a new array is returned, also when nothing is converted.
    unit : any product of known symbols, such as rpm, bar, L/min, mg/L, km/h, degC.
    where : opens the message of an error, for example the file and the column.

    Raises :class:`UnitError` when the unit is not known.

    >>> to_si([1200.0], "rpm")
    (array([125.66370614]), 'rad/s')
    >>> to_si([20.0], "degC")
    (array([293.15]), 'K')
    """
    own = read_data_unit(unit, where=where)
    return _scaled(values, own, parse_unit(own.si)), own.si


def converted(values: Any, unit: str, to: str) -> FloatArray:
    """Values in another unit of the same dimension; a new array.

    Raises :class:`UnitError` for units that cannot be read or are of different dimensions.

    >>> converted([1.0, 2.0], "rad/s", "rpm").round(4)
    array([ 9.5493, 19.0986])
    """
    own, other = read_unit(unit), read_unit(to)
    if not own.compatible(other):
        raise UnitError(
            "the units are of different dimensions",
            seen=f"{unit} ({own.dimension}) and {to} ({other.dimension})",
            allowed="two units of one dimension",
            cure="correct one of the units",
        )
    return _scaled(values, own, other)


def _scaled(values: Any, own: Unit, other: Unit) -> FloatArray:
    times, over, plus = own.steps_to(other)
    array = np.array(values, dtype=float)
    if times != 1.0:
        with np.errstate(over="ignore"):  # an overflow gives inf, which the callers refuse by name
            array *= times
    if over != 1.0:
        array /= over
    if plus:
        array += plus
    return array
