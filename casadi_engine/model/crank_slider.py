"""Crank-slider kinematics and the torque of one cylinder, equations (3.1) to (3.6) of the thesis.

All functions take numbers, numpy arrays or CasADi expressions. Angles are in rad, 0 at the cylinder's
combustion top dead centre (TDC); `ratio` is r/L, crank radius over rod length, 0 <= ratio < 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from numbers import Real
from typing import Any

import casadi as ca
import numpy as np

from casadi_engine.errors import ModelError
from casadi_engine.parameters import near_matches


@dataclass(frozen=True)
class Geometry:
    """Crank-slider geometry of a cylinder; the defaults are Table 4.2 of the thesis.

    r : crank radius [m], half of the stroke        L : rod length [m], > r
    A_p : piston area [m2]                          m_eq : equivalent reciprocating mass [kg], >= 0
    p_crank : crankcase pressure [Pa], absolute; with a relative pressure sensor it holds the sensor's offset

    The fields may be CasADi symbols. ModelError if a number is not acceptable.
    """

    r: Any = 0.043
    L: Any = 0.145
    A_p: Any = 0.0058
    m_eq: Any = 0.7
    p_crank: Any = 1.0e5

    def __post_init__(self) -> None:
        for name, value in asdict(self).items() if self.is_numeric else ():
            least = {"p_crank": -math.inf, "m_eq": 0.0}.get(name)
            good = math.isfinite(value) and (value > 0 if least is None else value >= least)
            if not good:
                raise ModelError(
                    f"the geometry's {name} is not acceptable",
                    seen=value,
                    allowed="a finite number" + {"p_crank": "", "m_eq": " >= 0"}.get(name, " > 0"),
                    cure="give lengths in m, areas in m2, masses in kg, pressures in Pa",
                )
        if self.is_numeric and not self.r < self.L:
            raise ModelError(
                "the rod is not longer than the crank radius",
                seen=f"r = {self.r}, L = {self.L}",
                allowed="r < L",
                cure="give r as half of the stroke, both in m",
            )

    @property
    def is_numeric(self) -> bool:
        """True if all fields are numbers."""
        return all(isinstance(value, Real) for value in vars(self).values())

    @property
    def ratio(self) -> Any:
        """r/L."""
        return self.r / self.L

    @staticmethod
    def from_bore(bore: float, *, stroke: float, rod: float, mass: float, p_crank: float = 1.0e5) -> Geometry:
        """Return the geometry for a bore, stroke and rod length in m and a reciprocating mass in kg.

        >>> Geometry.from_bore(0.0677, stroke=0.055, rod=0.0842, mass=0.25).r
        0.0275
        """
        return Geometry(r=stroke / 2, L=rod, A_p=math.pi * bore**2 / 4, m_eq=mass, p_crank=p_crank)

    @staticmethod
    def read(geometry: Geometry | Mapping[str, float] | None) -> Geometry:
        """Return a Geometry from one, from a mapping of some of its fields, or from None (the defaults)."""
        if isinstance(geometry, Geometry):
            return geometry
        if geometry is not None and not isinstance(geometry, Mapping):
            raise ModelError(
                "the geometry is of the wrong kind",
                seen=type(geometry).__name__,
                allowed="a Geometry, a mapping of some of its fields, or None",
                cure='write geometry={"r": 0.043, "L": 0.145}, for instance',
            )
        given = dict(geometry or {})
        fields = tuple(asdict(Geometry()))
        for name in given:
            if name not in fields:
                raise ModelError(
                    "the geometry has no such quantity",
                    seen=repr(name),
                    allowed=near_matches(name, fields),
                    cure="give r, L [m], A_p [m2], m_eq [kg], p_crank [Pa]; Geometry.from_bore helps",
                )
        return Geometry(**given)


def torque_factor(angle: Any, ratio: Any) -> Any:
    """Return f of ds/dθ = r f(θ), dimensionless, from the angle [rad] and r/L (3.2)."""
    sine, cosine, root = _parts(angle, ratio)
    return sine + ratio * sine * cosine / root


def torque_factor_slope(angle: Any, ratio: Any) -> Any:
    """Return df/dθ [1/rad] of `torque_factor`."""
    sine, cosine, root = _parts(angle, ratio)
    rod = ratio * sine * cosine / root  # what the rod's tilt adds to f
    return cosine + ratio * (cosine**2 - sine**2 + rod**2) / root


def piston_travel(angle: Any, ratio: Any) -> Any:
    """Return s/r, the piston's way from TDC over the crank radius (0 at TDC, 2 at the bottom)."""
    _, cosine, root = _parts(angle, ratio)
    # (1 − root)/ratio written so that it holds at ratio = 0, and near it without loss of digits.
    return 1 - cosine + ratio * _sin(angle) ** 2 / (1 + root)


def mean_square_factor(ratio: Any) -> Any:
    """Return the mean of f² over a revolution, 1/(1 + sqrt(1 − (r/L)²)): the mean reciprocating inertia is
    m_eq r² times this.

    >>> round(float(0.7 * 0.043**2 * mean_square_factor(0.043 / 0.145)), 6)
    0.000662
    """
    return 1 / (1 + _sqrt(1 - ratio**2))


def indicated_torque(pressure: Any, angle: Any, geometry: Any) -> Any:
    """Return the torque of the gas [N m] from the absolute pressure [Pa] and the angle [rad] (3.1)."""
    lever = geometry.r * torque_factor(angle, geometry.ratio)
    return (pressure - geometry.p_crank) * geometry.A_p * lever


def inertia_force(angle: Any, speed: Any, acceleration: Any, geometry: Any) -> Any:
    """Return the force of the reciprocating mass [N] from angle, speed [rad/s], acceleration [rad/s2]
    (3.3, 3.4); positive pushes the piston away from TDC."""
    f = torque_factor(angle, geometry.ratio)
    slope = torque_factor_slope(angle, geometry.ratio)
    return -geometry.m_eq * geometry.r * (f * acceleration + slope * speed**2)


def reciprocating_torque(angle: Any, speed: Any, geometry: Any) -> Any:
    """Return the torque [N m] of the reciprocating mass at constant speed [rad/s] (3.5)."""
    f = torque_factor(angle, geometry.ratio)
    slope = torque_factor_slope(angle, geometry.ratio)
    return -geometry.m_eq * geometry.r**2 * f * slope * speed**2


def cylinder_torque(pressure: Any, angle: Any, speed: Any, geometry: Any) -> Any:
    """Return the total torque of a cylinder [N m]: indicated plus reciprocating (3.6)."""
    return indicated_torque(pressure, angle, geometry) + reciprocating_torque(angle, speed, geometry)


def _is_symbolic(*values: Any) -> bool:
    return any(isinstance(value, ca.SX | ca.MX | ca.DM) for value in values)


def _sin(angle: Any) -> Any:
    return ca.sin(angle) if _is_symbolic(angle) else np.sin(angle)


def _sqrt(value: Any) -> Any:
    return ca.sqrt(value) if _is_symbolic(value) else np.sqrt(value)


def _parts(angle: Any, ratio: Any) -> tuple[Any, Any, Any]:
    """sin θ, cos θ and sqrt(1 − (r/L)² sin² θ)."""
    sine = _sin(angle)
    cosine = ca.cos(angle) if _is_symbolic(angle) else np.cos(angle)
    return sine, cosine, _sqrt(1 - (ratio * sine) ** 2)
