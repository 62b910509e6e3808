"""Numbers of physics that no rig has another value of."""

from __future__ import annotations

import math

from casadi_engine.errors import UnitError
from casadi_engine.experiment.units import NOT_STATED, read_unit

# In SI units, CODATA 2018: gravity, as 10 too, gas, Stefan-Boltzmann, Faraday, Avogadro, Boltzmann, light, Planck,
# elementary charge, electric and magnetic constants, gravitation.
_KNOWN = (
    ("m/s2", 9.80665), ("m/s2", 10.0), ("J/(mol K)", 8.314462618), ("W/(m2 K4)", 5.670374419e-8),
    ("A s/mol", 96485.33212), ("1/mol", 6.02214076e23), ("J/K", 1.380649e-23), ("m/s", 299792458.0),
    ("J s", 6.62607015e-34), ("A s", 1.602176634e-19), ("A s/(V m)", 8.8541878128e-12),
    ("V s/(A m)", 1.25663706212e-6), ("m3/(kg s2)", 6.6743e-11),
)  # fmt: skip
# How far numbers are rounded, and gravity differs from place to place.
_ROUNDED = 5e-3
# Names of gravity and the gas constant where no unit is stated.
_NAMES = {"g": 9.80665, "g0": 9.80665, "gravity": 9.80665, "R_gas": 8.314462618}


def is_constant_of_nature(name: str, value: float, unit: str) -> bool:
    """True of a number with the value and unit of a constant of physics; where no unit is stated, with its name.

    >>> is_constant_of_nature("g", 9.81, "m/s2"), is_constant_of_nature("m", 9.81, "kg")
    (True, False)
    """
    if unit in ("1", NOT_STATED):
        known = _NAMES.get(name)
        return known is not None and abs(value - known) <= _ROUNDED * known
    try:
        own = read_unit(unit)
    except UnitError:
        return False
    number = value * float(own.factor) * math.pi ** float(own.pi)
    return any(
        abs(number - known) <= _ROUNDED * known and own.compatible(read_unit(of)) for of, known in _KNOWN
    )
