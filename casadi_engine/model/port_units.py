"""The units of what acts at a port and of its signals, and the words that go with them.

They are read off the units that a model declares. A quantity has a unit if it grows by the right power when every
symbol is scaled as a change of that unit asks; so no walk through its expression is needed. Where a unit is missing, or
the equations do not go with the declared ones, nothing is said.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np

from casadi_engine.experiment.units import NOT_STATED, read_unit, unit_product

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
        return [None for _ in expressions]
    rng = np.random.default_rng(0)
    at = rng.uniform(0.5, 1.5, (symbols.numel(), 2))
    base = np.array(function(at), dtype=float)
    found: list[dict[str, Fraction] | None] = [
        None if unknown.numel() and ca.depends_on(one, unknown) else {} for one in expressions
    ]
    for name in dict.fromkeys(name for _, own in known for name in own):
        powers = np.array([float(own.get(name, 0)) for _, own in known])
        moved = np.array(function(at * _SCALED ** powers[:, None]), dtype=float)
        with np.errstate(all="ignore"):
            exponents = np.log(moved / base) / np.log(_SCALED)
        for made, row in zip(found, exponents, strict=True):
            if made is None:
                continue
            power = Fraction(round(_HALVES * row[0]), _HALVES) if np.isfinite(row).all() else Fraction(0)
            if np.isfinite(row).all() and np.abs(row - float(power)).max() < _NEAR:
                made[name] = power
            elif read_unit(name).dimension != "rad":  # an angle may stand in a sine
                made["?"] = Fraction(1)
    return [None if made is None or "?" in made else _text(made) for made in found]


def with_units(
    ports: Mapping[str, Any],
    units: Sequence[tuple[Any, str]],
    odes: Sequence[tuple[str, Any]],
    *,
    stated: Collection[str],
    per: str,
) -> dict[str, Any]:
    """Ports by name with the units of their signals, and of their slots where these were not stated.

    units : pairs of an SX symbol and its unit; odes : of each state its unit and its rate by the unit of time ``per``
    """
    signals = [(name, key) for name, port in ports.items() for key in port.signals]
    found = units_of([ports[name].signals[key] for name, key in signals], units)
    own: dict[str, dict[str, str]] = {name: {} for name in ports}
    for (name, key), unit in zip(signals, found, strict=True):
        if unit is not None:
            own[name][key] = unit
    slots = ca.vertcat(ca.SX(0, 1), *[port.slot for port in ports.values() if port.slot is not None])
    made = {}
    for name, port in ports.items():
        asks = port.slot is not None and name not in stated
        unit = _unit_by_odes(port.slot, slots, units, odes, per) if asks else None
        made[name] = replace(port, units=own[name], unit=port.unit if unit is None else unit)
    return made


def _unit_by_odes(
    slot: Any, slots: Any, units: Sequence[tuple[Any, str]], odes: Sequence[tuple[str, Any]], per: str
) -> str | None:
    """The unit of one of the slots by the odes that it enters, None where they do not tell, or tell of several."""
    plain = ca.vertcat(*[symbol for symbol, unit in units if unit == "1"])
    found: set[str | None] = set()
    for rate, ode in odes:
        slope = ca.jacobian(ode, slot)
        if slope.nnz() and rate == NOT_STATED:
            found.add(None)
        elif slope.nnz():
            wanted = unit_product((rate, 1), (per, -1))
            rest = units_of([ca.substitute(ode, slots, ca.SX.zeros(slots.shape))], units)[0]
            # a parameter of unit 1 may be one whose unit was left out, and a number may stand for a mass
            vague = plain.numel() and ca.depends_on(slope, plain)
            if not ca.symvar(slope):
                vague = abs(float(slope)) != 1 or rest is None or not _goes_with(rest, wanted)
            elif rest is not None and _of_one_kind(rest, wanted):
                # numbers may convert units, as in 1e3 (F + slot)/m for mm/s2: what is added to a slot shows it
                wanted = rest
            found.add(None if vague else slot_unit(wanted, units_of([slope], units)[0]))
    return found.pop() if len(found) == 1 else None


def _text(powers: Mapping[str, Fraction]) -> str:
    return unit_product(*[(name, power) for name, power in powers.items() if power])


def named(unit: str) -> str:
    """A unit by its own symbol where it has one.

    >>> named("rad kg m2/s2"), named("J/s"), named("m3/s")
    ('N m', 'W', 'm3/s')
    """
    return next((name for name in _NAMED if _alike(unit, name)), unit)


def quantity(unit: str) -> str:
    """What has this unit, in one word or two: "rate" for any other, "term" where it was not stated.

    >>> quantity("kN"), quantity("L/min"), quantity("mg/(L h)"), quantity("-")
    ('force', 'volume flow', 'rate', 'term')
    """
    if unit == NOT_STATED:
        return "term"
    own = _dimension(unit)
    return next((words for name, words in _QUANTITIES.items() if _dimension(name) == own), "rate")


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


def _dimension(unit: str) -> tuple[tuple[str, Fraction], ...]:
    """The dimension without angles, but for that of an angle by time alone."""
    powers = dict(read_unit(unit).exponents)
    if set(powers) - {"s", "rad"}:
        powers.pop("rad", None)
    return tuple(powers.items())


def _alike(unit: str, other: str) -> bool:
    own, its = read_unit(unit), read_unit(other)
    return own.factor == its.factor and not own.pi and _dimension(unit) == _dimension(other)


def slot_unit(rate: str, slope: str | None) -> str | None:
    """The unit of a slot that enters an ode with this slope; None where it cannot be known.

    rate : unit of the ode; slope : unit of the slope

    >>> slot_unit("rad/s2", "1/(kg m2)"), slot_unit("K/s", "K/J"), slot_unit("mg/(L h)", "1")
    ('N m', 'W', 'mg/(L h)')
    """
    return None if slope is None else named(unit_product((rate, 1), (slope, -1)))


def _goes_with(unit: str, other: str) -> bool:
    """True for units of one dimension, angles left out, and of one size."""
    return _of_one_kind(unit, other) and read_unit(unit).factor == read_unit(other).factor


def _of_one_kind(unit: str, other: str) -> bool:
    own, its = ({k: v for k, v in read_unit(one).exponents if k != "rad"} for one in (unit, other))
    return own == its
