"""The cylinders of an engine: channels, drives, ports and torques, from crank angle and pressures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, Literal

import casadi as ca

from casadi_engine.errors import ModelError
from casadi_engine.model.blueprint import Blueprint
from casadi_engine.model.crank_slider import (
    Geometry,
    indicated_torque,
    mean_square_factor,
    reciprocating_torque,
    torque_factor,
    torque_factor_slope,
)
from casadi_engine.model.firing import firing_offsets

ReciprocatingSpeed = Literal["model", "measured"]
ReciprocatingInertia = Literal["mean", "variable"]

TORQUE_SCALE = 100.0
FORCE_SCALE = 1.0e4
PRESSURE_SCALE = 1.0e6

_UNITS = {"r": "m", "L": "m", "A_p": "m2", "m_eq": "kg", "p_crank": "Pa"}
_WORDS = {
    "r": "crank radius",
    "L": "rod length",
    "A_p": "piston area",
    "m_eq": "equivalent reciprocating mass",
    "p_crank": "crankcase pressure",
}


@dataclass(frozen=True)
class CylinderOptions:
    """How the cylinders of an engine are modelled; checked when made.

    cylinders, firing_order, firing_offsets : see `firing_offsets`; offsets in rad
    geometry : Geometry, a mapping of some of its fields, or None for Table 4.2
    reciprocating_speed : "model", the model's own speed in (3.5), by a law of each cylinder's port; or
        "measured", the channel omega, which leaves the model linear
    reciprocating_inertia : "mean", the inertia of the reciprocating parts counts by its mean within J; or
        "variable", the θ̈ term of (3.3) less its mean is added, so that J stays the total mean inertia
    """

    cylinders: int
    firing_order: Sequence[int] | None = None
    firing_offsets: Sequence[float] | None = None
    geometry: Geometry | Mapping[str, float] | None = None
    reciprocating_speed: ReciprocatingSpeed = "model"
    reciprocating_inertia: ReciprocatingInertia = "mean"

    def __post_init__(self) -> None:
        check_option("reciprocating_speed", self.reciprocating_speed, ("model", "measured"))
        check_option("reciprocating_inertia", self.reciprocating_inertia, ("mean", "variable"))
        if self.reciprocating_inertia == "variable" and self.reciprocating_speed == "measured":
            raise ModelError(
                "the variable reciprocating inertia needs the model's own speed",
                seen='reciprocating_speed="measured", reciprocating_inertia="variable"',
                allowed='"variable" with reciprocating_speed="model"',
                cure='set reciprocating_speed="model", or reciprocating_inertia="mean"',
            )


@dataclass(frozen=True, eq=False)
class Cylinders:
    """Cylinders declared in a blueprint.

    drives, slots : for each cylinder its two torques on the crank [N m]; a drive that is no torque counts 0
    common : slot symbol of the port `cylinders` [N m], which acts on the crank as a whole
    inertia_change : for each cylinder m_eq r² (f² − ⟨f²⟩) [kg m2] at its angle
    """

    drives: tuple[Any, ...]
    slots: tuple[Any, ...]
    common: Any
    inertia_change: tuple[Any, ...]

    @property
    def torque(self) -> Any:
        """All of their torques together [N m]."""
        return sum(self.drives) + sum(self.slots) + self.common


def check_option(name: str, value: object, allowed: Sequence[str]) -> None:
    """Raise ModelError unless `value` is one of the words `allowed`."""
    if value not in allowed:
        raise ModelError(
            f"the option {name} is not known",
            seen=repr(value),
            allowed=" or ".join(f'"{word}"' for word in allowed),
            cure=f'give {name}="{allowed[0]}", for instance',
        )


def declare_geometry(b: Blueprint, geometry: Geometry) -> Geometry:
    """Declare r, L, A_p, m_eq, p_crank as parameters, fixed by default; return the geometry of symbols."""
    symbols = {}
    for field in fields(Geometry):
        name = field.name
        least = {"p_crank": float("-inf"), "m_eq": 0.0}.get(name, 1e-9)
        symbols[name] = b.parameter(
            name, getattr(geometry, name), unit=_UNITS[name], min=least, vary=False, description=_WORDS[name]
        )
    return Geometry(**symbols)


def declare_cylinders(
    b: Blueprint,
    options: CylinderOptions,
    *,
    theta: Any,
    speeds: Sequence[Any],
    angles: Sequence[Any] | None = None,
) -> Cylinders:
    """Declare channels p1…pN (and omega), drives T_1…T_N, ports cylinder_1…N and cylinders, and their laws.

    theta : SX symbol of the channel crank angle [rad], 0 at the combustion TDC of cylinder 1; None if there is
        no such channel: then the drives are the gas forces F_1…F_N [N], and laws make torques of them
    speeds : for each cylinder the speed of its inertia [rad/s]
    angles : for each cylinder the crank angle at its inertia [rad], an expression of states; None: theta.
        Drives use channels alone, so what an angle differs from theta enters by the law of the cylinder's port
    """
    offsets = firing_offsets(options.cylinders, order=options.firing_order, offsets=options.firing_offsets)
    numbers = range(1, options.cylinders + 1)
    pressures = [
        b.input(f"p{k}", unit="Pa", scale=PRESSURE_SCALE, description=f"pressure in cylinder {k}")
        for k in numbers
    ]
    if options.reciprocating_speed == "measured":
        omega = b.input("omega", unit="rad/s", scale=100.0, description="measured crank speed")
        speeds = [omega] * options.cylinders
    geometry = declare_geometry(b, Geometry.read(options.geometry))
    turned = [theta] * options.cylinders if angles is None else list(angles)
    drives, slots, gas_torques, changes = [], [], [], []
    for k, pressure, offset, speed, crank in zip(numbers, pressures, offsets, speeds, turned, strict=True):
        angle = crank - offset
        gas, mass, factor, slope, change = _one_cylinder()(angle, pressure, speed, *vars(geometry).values())
        known = None if theta is None else theta - offset
        signals = {
            "angle": angle,
            "speed": speed,
            "pressure": pressure,
            "gas_torque": gas,
            "torque_factor": factor,
            "torque_factor_slope": slope,
        }
        slot = b.port(f"cylinder_{k}", "cylinder", signals, description=f"cylinder {k}")
        if options.reciprocating_speed == "measured":
            drives.append(_torque_drive(b, k, gas + mass, "total"))
        elif known is None:
            force = b.drive(
                f"F_{k}",
                (pressure - geometry.p_crank) * geometry.A_p,
                unit="N",
                scale=FORCE_SCALE,
                description=f"gas force on piston {k}",
            )
            b.law(f"cylinder_{k}", force * geometry.r * factor + mass)
            drives.append(ca.SX(0))
        elif angles is None:
            drives.append(_torque_drive(b, k, gas, "indicated"))
            b.law(f"cylinder_{k}", mass)
        else:
            at_theta = _one_cylinder()(known, pressure, speed, *vars(geometry).values())[0]
            drives.append(_torque_drive(b, k, at_theta, "indicated"))
            b.law(f"cylinder_{k}", gas - at_theta + mass)
        slots.append(slot)
        gas_torques.append(gas)
        changes.append(change)
    signals = {"angle": turned[0], "speed": speeds[0], "gas_torque": sum(gas_torques)}
    common = b.port("cylinders", "cylinder", signals, description="all cylinders together")
    return Cylinders(tuple(drives), tuple(slots), common, tuple(changes))


def _torque_drive(b: Blueprint, number: int, torque: Any, word: str) -> Any:
    return b.drive(
        f"T_{number}", torque, scale=TORQUE_SCALE, description=f"{word} torque of cylinder {number}"
    )


@cache
def _one_cylinder() -> Any:
    """CasADi function of one cylinder: torques (3.1) and (3.5), f, df/dθ and m_eq r² (f² − ⟨f²⟩).

    Made once and called with the symbols of each cylinder, many times faster than writing it anew.
    """
    angle, pressure, speed = (ca.SX.sym(name) for name in ("angle", "pressure", "speed"))
    geometry = Geometry(*(ca.SX.sym(field.name) for field in fields(Geometry)))
    factor = torque_factor(angle, geometry.ratio)
    results = [
        indicated_torque(pressure, angle, geometry),
        reciprocating_torque(angle, speed, geometry),
        factor,
        torque_factor_slope(angle, geometry.ratio),
        geometry.m_eq * geometry.r**2 * (factor**2 - mean_square_factor(geometry.ratio)),
    ]
    return ca.Function("cylinder", [angle, pressure, speed, *vars(geometry).values()], results)


def vary_inertia(
    b: Blueprint, *, change: Any, inertia: Any, torque: Any, port: str = "variable_inertia"
) -> Any:
    """Add the inertia `change` of the reciprocating parts [kg m2] to `inertia` [kg m2] by a law.

    (J + ΔJ) θ̈ = T is written as J θ̈ = T + w with w = −ΔJ T/(J + ΔJ), so that the linear core keeps the
    constant J. `torque` is all of T, slots included: further laws are then divided by the true inertia too.
    Returns the slot symbol w, to be added to the torque. The port is internal: effects do not attach there.
    """
    slot = b.port(port, "internal", description="inertia of the reciprocating parts")
    b.law(port, -change * torque / (inertia + change))
    return slot
