"""Crank-slider geometry and the torque of one cylinder, thesis (3.1)-(3.6), with p_cyl absolute.

Angles are crank angles theta* of a cylinder: 0 at its combustion TDC [rad].  The same formulas serve arrays
(`maths` is numpy) and single angles (`maths` is Python's own math, much faster inside an integrator).
"""

from types import ModuleType
from typing import Any

import numpy as np

RADIUS = 0.043  # r, crank radius [m]
ROD = 0.145  # L, rod length [m]
PISTON_AREA = 0.0058  # A_p [m2]
MASS = 0.7  # m_eq, equivalent reciprocating mass [kg]
CRANKCASE = 1.0e5  # p_crank [Pa]
COMPRESSION_RATIO = 10.0
CLEARANCE = 2.0 * RADIUS * PISTON_AREA / (COMPRESSION_RATIO - 1.0)  # volume left at TDC [m3]
RATIO = RADIUS / ROD

Values = Any  # a number, or an array of any shape

CYCLE = 4.0 * np.pi  # crank angle of one four-stroke cycle [rad]
FIRING_ORDER = (1, 3, 4, 2)


def tdc_angles() -> np.ndarray:
    """Angle of the combustion TDC of cylinders 1..4 : (4,) rad, even firing in the order 1-3-4-2."""
    angles = np.empty(4)
    for place, cylinder in enumerate(FIRING_ORDER):
        angles[cylinder - 1] = place * CYCLE / 4.0
    return angles


def volume(angle: Values, maths: ModuleType = np) -> Values:
    """Cylinder volume [m3]: clearance plus piston area times the travel from TDC."""
    root = maths.sqrt(1.0 - (RATIO * maths.sin(angle)) ** 2)
    return CLEARANCE + PISTON_AREA * (RADIUS * (1.0 - maths.cos(angle)) + ROD * (1.0 - root))


def slider(angle: Values, maths: ModuleType = np) -> tuple[Values, Values]:
    """f and df/dtheta of (3.2), both [1]: the piston moves by r f per radian."""
    sine, cosine = maths.sin(angle), maths.cos(angle)
    root = maths.sqrt(1.0 - (RATIO * sine) ** 2)
    factor = sine + RATIO * sine * cosine / root
    # d/dtheta (sin cos / root) = (cos^2 - sin^2) / root + (r/L)^2 sin^2 cos^2 / root^3
    slope = cosine + RATIO * (cosine**2 - sine**2) / root + RATIO**3 * (sine * cosine) ** 2 / root**3
    return factor, slope


def cylinder_torque(angle: Values, speed: Values, pressure: Values, maths: ModuleType = np) -> Values:
    """Indicated plus reciprocating torque [N m], (3.6); the theta'' term is left out as in (3.5)."""
    factor, slope = slider(angle, maths)
    indicated = (pressure - CRANKCASE) * PISTON_AREA * RADIUS * factor
    reciprocating = -MASS * RADIUS**2 * factor * slope * speed**2
    return indicated + reciprocating
