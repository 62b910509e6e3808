"""Absolute cylinder pressure as an analytic function of the crank angle of that cylinder.

The charge is taken in at a constant pressure, compressed on a polytrope, and expands on the same polytrope:
that is the motored trace.  Combustion adds a pressure that appears along a burn curve and expands on a second
polytrope.  When the exhaust valve opens all of it blows down to a constant back pressure.  Every switch is a
tanh or a double exponential, so that an integrator meets no kink, and the pressure is linear in the burn
strength, so that a mean torque can be met exactly.
"""

from dataclasses import dataclass
from types import ModuleType

import numpy as np

from .geometry import CLEARANCE, CYCLE, Values, volume

DEGREE = np.pi / 180.0

INTAKE = 0.55e5  # pressure in the intake stroke [Pa], part load
EXHAUST = 1.02e5  # pressure in the exhaust stroke [Pa]
MOTORED_EXPONENT = 1.33  # polytrope of compression and of motored expansion
BURNED_EXPONENT = 1.27  # polytrope of the pressure that combustion adds
BURN_ANGLE = 8.0 * DEGREE  # steepest point of the burn curve
BURN_WIDTH = 9.0 * DEGREE  # 10 % to 90 % burned takes 3.1 of these

INTAKE_CLOSES, INTAKE_CLOSES_WIDTH = -140.0 * DEGREE, 8.0 * DEGREE
EXHAUST_OPENS, EXHAUST_OPENS_WIDTH = 160.0 * DEGREE, 10.0 * DEGREE
INTAKE_OPENS, INTAKE_OPENS_WIDTH = -360.0 * DEGREE, 9.0 * DEGREE
CLOSED_IN = volume(INTAKE_CLOSES)  # volume of the charge that is shut in [m3]
SEAM = 270.0 * DEGREE  # one combustion event hands over to the next here, where nothing of it is left


@dataclass(frozen=True)
class Cylinders:
    """What makes cylinders differ, (4,) each: burn strength and intake factors [1], burn delay [rad]."""

    strength: np.ndarray
    intake: np.ndarray
    delay: np.ndarray


def unequal_cylinders() -> Cylinders:
    """Four cylinders that differ by about 3 % in burn strength, 0.5 % in charge and 0.4 degrees in timing."""
    return Cylinders(
        strength=np.array([1.030, 0.970, 1.015, 0.985]),
        intake=np.array([1.005, 0.998, 0.993, 1.004]),
        delay=np.array([0.4, -0.3, -0.2, 0.1]) * DEGREE,
    )


def identical_cylinders() -> Cylinders:
    """Four cylinders that do not differ, for comparison."""
    return Cylinders(strength=np.ones(4), intake=np.ones(4), delay=np.zeros(4))


def event_number(angle: Values) -> Values:
    """Which combustion an angle belongs to: event k has its TDC at 4 pi (k - 1) of that cylinder's angle."""
    return (angle - SEAM) // CYCLE + 2


def burned(angle: Values, delay: Values = 0.0, maths: ModuleType = np) -> Values:
    """Share of the charge that has burned, 0..1: a double exponential, steep at first, with a long tail."""
    return maths.exp(-maths.exp(-(angle - BURN_ANGLE - delay) / BURN_WIDTH))


def pressure(
    angle: Values, strength: Values, intake: Values = 1.0, delay: Values = 0.0, maths: ModuleType = np
) -> Values:
    """Absolute pressure [Pa] at a cylinder's own angle [rad]; `strength` [Pa] is 0 for a motored cylinder.

    The strength is the pressure that a charge burned at once at TDC would add.  `maths` as in geometry.py.
    """
    angle = (angle - SEAM) % CYCLE + SEAM - CYCLE
    room = volume(angle, maths)
    taken_in = INTAKE * intake

    def rise(centre: float, width: float) -> Values:
        return 0.5 * (1.0 + maths.tanh((angle - centre) / width))

    closed = taken_in * (CLOSED_IN / room) ** MOTORED_EXPONENT
    closed = closed + strength * burned(angle, delay, maths) * (CLEARANCE / room) ** BURNED_EXPONENT
    # the ports go back from intake to exhaust pressure behind closed valves, at combustion TDC
    ports = rise(INTAKE_OPENS, INTAKE_OPENS_WIDTH) - rise(0.0, INTAKE_OPENS_WIDTH)
    open_ = EXHAUST + ports * (taken_in - EXHAUST)
    shut = rise(INTAKE_CLOSES, INTAKE_CLOSES_WIDTH) - rise(EXHAUST_OPENS, EXHAUST_OPENS_WIDTH)
    return open_ + shut * (closed - open_)
