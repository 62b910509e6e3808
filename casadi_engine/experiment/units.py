"""Units: everything is kept in SI; a few customary units are converted on the way in."""

from __future__ import annotations

import difflib
import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import UnitError

FloatArray = NDArray[np.float64]

SI_UNITS: tuple[str, ...] = (
    "1", "s", "m", "kg", "A", "K", "mol",
    "rad", "rad/s", "rad/s2", "Hz",
    "m/s", "m/s2", "m2", "m3", "m3/s", "kg/s", "kg/m3",
    "N", "N/m", "N s/m", "Pa", "Pa s", "J", "W", "V",
    "N m", "N m/rad", "N m s/rad", "N m/rad3", "N m s2/rad2", "kg m2", "kg m",
)  # fmt: skip

# unit -> (SI unit, numerator, denominator): two numbers, so that 1 ms is 1/1000 s and not 1 * 0.001 s
CONVERSIONS: dict[str, tuple[str, float, float]] = {
    "rpm": ("rad/s", math.pi / 30.0, 1.0),
    "deg": ("rad", math.pi / 180.0, 1.0),
    "bar": ("Pa", 1e5, 1.0),
    "kPa": ("Pa", 1e3, 1.0),
    "MPa": ("Pa", 1e6, 1.0),
    "N mm": ("N m", 1.0, 1e3),
    "g m2": ("kg m2", 1.0, 1e3),
    "ms": ("s", 1.0, 1e3),
}

ALLOWED_UNITS: tuple[str, ...] = SI_UNITS + tuple(CONVERSIONS)
_HEADER = re.compile(r"([^\[\]]*)\[([^\[\]]*)\]")
_DIMENSIONLESS = ("", "-", "%", "none", "dimensionless")


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


def _conversion(unit: Any, where: str) -> tuple[str, float, float]:
    text = " ".join(unit.split()) if isinstance(unit, str) else unit
    if isinstance(text, str) and text in CONVERSIONS:
        return CONVERSIONS[text]
    if isinstance(text, str) and text in SI_UNITS:
        return text, 1.0, 1.0
    raise UnitError(
        f"{where + ': ' if where else ''}unknown unit",
        seen=unit if isinstance(unit, str) and unit.strip() else repr(unit),
        allowed=", ".join(ALLOWED_UNITS),
        cure=_cure(text),
    )


def _cure(text: Any) -> str:
    if not isinstance(text, str):
        return "give the unit as text"
    if text.lower() in _DIMENSIONLESS:
        return "write 1 for a dimensionless quantity"
    plain = text.replace("*", " ").replace("·", " ").replace("^", "").replace("²", "2").replace("³", "3")
    for unit in ALLOWED_UNITS:
        if unit.replace(" ", "") == plain.replace(" ", ""):
            return f"did you mean {unit!r}?"
    near = difflib.get_close_matches(plain.lower(), [unit.lower() for unit in ALLOWED_UNITS], n=1, cutoff=0.5)
    if near:
        match = next(unit for unit in ALLOWED_UNITS if unit.lower() == near[0])
        return f"did you mean {match!r}? Otherwise convert the data to an SI unit"
    return "convert the data to an SI unit"


def si_unit(unit: str, *, where: str = "") -> str:
    """SI unit text that ``unit`` is converted to.

    Raises :class:`UnitError` when the unit is not known; ``where`` opens its message.

    >>> si_unit("rpm")
    'rad/s'
    """
    return _conversion(unit, where)[0]


def to_si(values: Any, unit: str, *, where: str = "") -> tuple[FloatArray, str]:
    """Convert values to SI and name the SI unit.

    values : array of any shape in ``unit``; a new array is returned, also when nothing is converted.
    unit : one of ``ALLOWED_UNITS`` (SI, rpm, deg, bar, kPa, MPa, N mm, g m2, ms).
    where : opens the message of an error, for example the file and the column.

    Raises :class:`UnitError` when the unit is not known.

    >>> to_si([1200.0], "rpm")
    (array([125.66370614]), 'rad/s')
    """
    target, numerator, denominator = _conversion(unit, where)
    array = np.array(values, dtype=float)
    if numerator != 1.0:
        with np.errstate(over="ignore"):  # an overflow gives inf, which the callers refuse by name
            array *= numerator
    if denominator != 1.0:
        array /= denominator
    return array, target
