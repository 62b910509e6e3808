"""The units of what acts at a port and of its signals, and the words that go with them.

They are read off the units that a model declares. A quantity has a unit if it grows by the right power when every
symbol is scaled as a change of that unit asks; so no walk through its expression is needed. Where a unit is missing, or
the equations do not go with the declared ones, nothing is said.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from casadi_engine.experiment.units import CONFUSED, NOT_STATED, read_unit, unit_product

# What acts, by its unit: dimensions without angles.
_QUANTITIES = {
    "N m": "torque", "N": "force", "rad/s2": "angular acceleration", "m/s2": "acceleration", "W": "power",
    "m3/s": "volume flow", "kg/s": "mass flow", "mol/s": "molar flow", "A": "current", "V": "voltage", "Pa": "pressure",
}  # fmt: skip
MECHANICAL = ("torque", "force", "angular acceleration", "acceleration")
# Units that are written by their own symbol, whatever products they come from: J/K times K/s is W.
_NAMED = ("N m", "N", "W", "A", "V", "Pa")
_SCALED, _NEAR, _HALVES = 1.7, 1e-6, 2


def units_of(expressions: Sequence[Any], units: Sequence[tuple[Any, str]]) -> list[str | None]:
    """The unit of each SX scalar, None where that is not known or where its terms do not go together.

    units : pairs of an SX symbol and its unit, "-" where it was not stated
    """
    if not expressions:
        return []
    column = ca.vertcat(*expressions)
    known = [(symbol, {} if unit == NOT_STATED else dict(read_unit(unit).written)) for symbol, unit in units]
    unknown = ca.vertcat(*[symbol for symbol, unit in units if unit == NOT_STATED])
    symbols = ca.vertcat(*[symbol for symbol, _ in units])
    function = ca.Function("units", [symbols], [ca.densify(column)], {"allow_free": True})
    if function.get_free():
        bound = [not _is_free(one, symbols) for one in expressions]
        some = iter(
            units_of([one for one, is_bound in zip(expressions, bound, strict=True) if is_bound], units)
        )
        return [next(some) if is_bound else None for is_bound in bound]
    names = list(dict.fromkeys(name for _, own in known for name in own))
    powers = np.array([[0.0, *(float(own.get(name, 0)) for name in names)] for _, own in known])
    at = np.random.default_rng(0).uniform(0.5, 1.5, (symbols.numel(), 2))
    # one call: the symbols as they are, and scaled as a change of each unit asks
    wide = (at[:, None, :] * _SCALED ** powers[:, :, None]).reshape(len(at), -1)
    values = np.array(function(wide), dtype=float).reshape(-1, len(names) + 1, 2)
    with np.errstate(all="ignore"):
        exponents = np.log(values[:, 1:] / values[:, :1]) / np.log(_SCALED)
    found: list[dict[str, Fraction] | None] = [
        None if unknown.numel() and ca.depends_on(one, unknown) else {} for one in expressions
    ]
    finite = np.isfinite(exponents).all(axis=2)
    halves = np.round(_HALVES * np.where(finite, exponents[:, :, 0], 0.0))
    with np.errstate(invalid="ignore"):
        whole = finite & (np.abs(exponents - halves[:, :, None] / _HALVES).max(axis=2) < _NEAR)
    for k, name in enumerate(names):
        angle = read_unit(name).dimension == "rad"  # may stand in a sine
        for j, made in enumerate(found):
            if made is None:
                continue
            if whole[j, k]:
                made[name] = Fraction(int(halves[j, k]), _HALVES)
            elif not angle:
                made["?"] = Fraction(1)
    told = [None if made is None or "?" in made else _text(made) for made in found]
    return [_converted(one, text, units) for one, text in zip(expressions, told, strict=True)]


def _converted(expression: Any, unit: str | None, units: Sequence[tuple[Any, str]]) -> str | None:
    """The unit of an expression that is a number times one symbol, where that number is the ratio of two units: pi/180
    times a speed in deg/s is one in rad/s."""
    symbols = ca.symvar(ca.SX(expression))
    own = next(
        (u for s, u in units if len(symbols) == 1 and s.element_hash() == symbols[0].element_hash()), unit
    )
    if unit is None or own in (None, NOT_STATED, "1") or len(symbols) != 1:
        return unit
    values = np.array(ca.Function("multiple", symbols, [expression])(np.array([[0.0, 1.0, 2.0]]))).ravel()
    factor = float(values[1])
    if values[0] != 0 or values[2] != 2 * factor or not 0 < factor < math.inf or factor == 1:
        return unit
    wanted = _size(own) / factor
    for other in CONFUSED:
        if read_unit(other).dimension == read_unit(own).dimension and math.isclose(_size(other), wanted):
            return other
    return unit


def _size(unit: str) -> float:
    known = read_unit(unit)
    return float(known.factor) * math.pi ** float(known.pi)


def _is_free(expression: Any, symbols: ca.SX) -> bool:
    """True if an expression has symbols beside these."""
    return bool(ca.Function("free", [symbols], [expression], {"allow_free": True}).get_free())


def _text(powers: Mapping[str, Fraction]) -> str:
    return unit_product(*[(name, power) for name, power in powers.items() if power])


@lru_cache(maxsize=1024)
def named(unit: str) -> str:
    """A unit by its own symbol where it has one.

    >>> named("rad kg m2/s2"), named("J/s"), named("m3/s")
    ('N m', 'W', 'm3/s')
    """
    return next((name for name in _NAMED if _alike(unit, name)), unit)


@lru_cache(maxsize=1024)
def quantity(unit: str) -> str:
    """What has this unit, in one word or two: "rate" for any other that is by time, else "term", as where it was not
    stated.

    >>> quantity("kN"), quantity("L/min"), quantity("mg/(L h)"), quantity("-"), quantity("m")
    ('force', 'volume flow', 'rate', 'term', 'term')
    """
    if unit == NOT_STATED:
        return "term"
    own = _dimension(unit)
    by_time = any(power == -1 and read_unit(name).si == "s" for name, power in read_unit(unit).written)
    other = "rate" if by_time or dict(own).get("s") == -1 else "term"
    return next((words for name, words in _QUANTITIES.items() if _dimension(name) == own), other)


def follows_port(unit: str) -> bool:
    """True for a unit of torques, angles and seconds alone, by which effects say what is in the units of their port.

    >>> [follows_port(unit) for unit in ("N m s/rad", "rad/s", "s", "N/m", "mm", "N m/deg")]
    [True, True, True, False, False, False]
    """
    powers = dict(read_unit(unit).written)
    return set(powers) <= {"N", "m", "rad", "s"} and powers.get("N", 0) == powers.get("m", 0)


def is_speed(unit: str) -> bool:
    """True for a unit of speed: that of a length or an angle by time."""
    return unit != NOT_STATED and (read_unit(unit).dimension in ("s-1 rad", "s-1 m"))


@lru_cache(maxsize=1024)
def _dimension(unit: str) -> tuple[tuple[str, Fraction], ...]:
    """The dimension without angles, but for that of an angle by time alone."""
    powers = dict(read_unit(unit).exponents)
    if set(powers) - {"s", "rad"}:
        powers.pop("rad", None)
    return tuple(powers.items())


def _alike(unit: str, other: str) -> bool:
    own, its = read_unit(unit), read_unit(other)
    return own.factor == its.factor and not own.pi and _dimension(unit) == _dimension(other)
