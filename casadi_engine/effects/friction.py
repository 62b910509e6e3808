"""Friction: torques against a motion that grow with speed or follow its sign."""

from __future__ import annotations

import math as _math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from casadi_engine.effects.corners import narrow
from casadi_engine.effects.protocol import Amplitude, Effect, Grid

# Share of the typical speed over which a sign is rounded: half a rad/s for a shaft of 100 rad/s, and 0.02 rad/s
# for the twist rate of a coupling, whose typical magnitude is that of the two speeds.
SPEED_WIDTH = 5e-3
RATE_WIDTH = 1.4e-4
# Beyond so many times its fading speed a ten-thousandth of the friction is left, and within a third of it nine tenths.
_REACH = 3.03
# Share of a scale below which a motion has another size than the scale says.
_OTHER_SIZE = 0.1
# The least fading speed that is looked for, as a share of the largest speed: what fades sooner acts in an instant.
_SLOWEST = 1 / 100
_FADING = Grid(0.25, 2.5, steps=8, log=True, of="speed", unit="rad/s", description="fading speed")


def motion(port: Any) -> tuple[str, int]:
    """The signal that friction at a port opposes, and the sign of a torque that opposes it.

    At a coupling a positive torque pulls the first side on and the second back: it opposes a positive rate.
    """
    return ("twist_rate", 1) if port.kind == "coupling" else ("speed", -1)


def rounding(port: Any, width: float | None) -> Any:
    """The width over which a sign of the motion is rounded, in the motion's unit: a number that was given, else a
    parameter of the model that starts at a small share of the motion's magnitude."""
    if width is not None:
        return width
    signal, _ = motion(port)
    share = RATE_WIDTH if signal == "twist_rate" else SPEED_WIDTH
    return port.width(float(f"{share * port.typical(signal):.2g}"), unit="rad/s")


class Rounded(Effect):
    """Friction whose sign is rounded over ``width``; in refits over what the data can follow."""

    width: float | None

    def narrowed(self, port: Any, share: float = 1.0) -> Effect:
        """The same with a width by the motion of these records, where none was given."""
        if self.width is not None:
            return self
        signal, _ = motion(port)
        # by the motion alone: a spring to the ground moves as the mass on it does
        courses = port.courses(signal)
        found = narrow(courses, _math.inf)
        passed = found < _math.inf
        # scales are what a user took them for: a motion that is larger counts
        moved = max((float(np.abs(course).max()) for course in courses), default=0.0)
        # what keeps its sign is far from the corner, however small it is in its unit
        near = SPEED_WIDTH * moved if 0 < moved < _OTHER_SIZE * port.typical(signal) else rounding(port, None)
        found = share * (min(found, SPEED_WIDTH * max(port.typical(signal), moved)) if passed else near)
        return replace(self, width=float(f"{found:.2g}"))  # type: ignore[type-var]


@dataclass(frozen=True)
class CoulombFriction(Rounded):
    """Dry friction: a constant torque against the motion, −T sign(ω).

    width : the sign is rounded over it, in the motion's unit; None takes a small share of its magnitude, and in
        refits what the records can follow
    """

    width: float | None = None

    name = "coulomb_friction"
    slides = True
    attaches = ("inertia", "coupling")
    kin = ("stribeck_friction", "constant_torque", "viscous_friction")
    sentence = "dry friction at {port}"
    neutral = "a constant loss at {port} that follows the sign of {motion}"
    amplitude = Amplitude("torque", unit="N m", min=0)

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """∓T sign(ω)."""
        signal, side = motion(port)
        return side * p.torque * math.sign(getattr(port, signal), width=rounding(port, self.width))


@dataclass(frozen=True)
class AsymmetricFriction(Rounded):
    """Dry friction that differs by direction: T (1 + a) against a positive motion, T (1 − a) against a negative one.

    T is the mean of both levels, the asymmetry a between −1 and 1. It is dry friction and a constant torque −T a
    together. So it is not looked for on a motion in one direction alone or where the model has a free constant torque:
    there dry friction does all; nor at a coupling, where a constant torque is a twist that no speed shows.

    width : as in `CoulombFriction`

    >>> from casadi_engine import two_mass
    >>> two_mass().with_effect(AsymmetricFriction(width=0.1), at="load").parameter_names[-2:]
    ('load.asymmetric_friction.torque', 'load.asymmetric_friction.asymmetry')
    """

    width: float | None = None

    name = "asymmetric_friction"
    slides = True
    attaches = ("inertia",)
    kin = ("coulomb_friction", "constant_torque", "stribeck_friction")
    limit = "coulomb_friction"
    sentence = (
        "dry friction at {port} that differs by direction, or beside a constant {effort}: one and the same"
    )
    neutral = "a constant loss at {port} that differs with the sign of {motion}"
    amplitude = Amplitude("torque", unit="N m", min=0)
    # an even number of values: without asymmetry it is dry friction
    nuisance = {"asymmetry": Grid(-1, 1, steps=6, description="share by which the directions differ")}  # noqa: RUF012

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """−T (sign(ω) + a sign(ω)²)."""
        sign = math.sign(port.speed, width=rounding(port, self.width))
        return -p.torque * sign * (1 + p.asymmetry * sign)

    def parts(self, values: Mapping[str, float]) -> Mapping[str, float]:
        """Dry friction and a constant torque, which may be larger than the dry friction."""
        size = values["torque"]
        return {"coulomb_friction": size, "constant_torque": -size * values["asymmetry"]}

    def idle(self, port: Any) -> str:
        """It is dry friction alone on a motion in one direction, and beside a constant torque that is estimated."""
        courses = port.courses("speed")
        if courses and not min(c.min() for c in courses) < 0 < max(c.max() for c in courses):
            return "the simulation of the records moves in one direction alone"
        return "a constant torque there is estimated already" if port.has_free_constant else ""


@dataclass(frozen=True)
class ViscousFriction(Effect):
    """Viscous friction: a torque against the motion that grows with it, −c ω."""

    name = "viscous_friction"
    attaches = ("inertia", "coupling")
    kin = ("quadratic_drag", "coulomb_friction")
    sentence = "viscous friction at {port}, a {effort} proportional to {motion}"
    neutral = "a loss at {port} proportional to {motion}"
    amplitude = Amplitude("coefficient", unit="N m s/rad", min=0)

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """∓c ω."""
        del math
        signal, side = motion(port)
        return side * p.coefficient * getattr(port, signal)


@dataclass(frozen=True)
class QuadraticDrag(Rounded):
    """Drag of a fan, of air or of oil, or of a damper with an orifice: a torque against the motion that grows with its
    square, −c ω |ω|."""

    width: float | None = None

    name = "quadratic_drag"
    attaches = ("inertia", "coupling")
    kin = ("viscous_friction", "coulomb_friction")
    sentence = "drag at {port} that grows with the square of {motion}"
    neutral = "a loss at {port} that grows with the square of {motion}"
    amplitude = Amplitude("coefficient", unit="N m s2/rad2", min=0)

    def narrowed(self, port: Any, share: float = 1.0) -> Effect:
        """As wide as the motion asks for: what has a kink alone is not felt any sharper."""
        del share
        return super().narrowed(port)

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """∓c ω |ω|."""
        signal, side = motion(port)
        rate = getattr(port, signal)
        return side * p.coefficient * rate * math.abs(rate, width=rounding(port, self.width))


@dataclass(frozen=True)
class StribeckFriction(Rounded):
    """The part of dry friction that fades with speed, −T exp(−(ω/ω_s)²) sign(ω) (Armstrong-Hélouvry 1994).

    Fading speeds are tested that a record comes within reach of (at three times that speed 1e-4 is left), and at which
    it fades there: what keeps nine tenths up to the largest speed is dry friction.

    span : the least and the largest fading speed [rad/s]; None for what the speed's magnitude and the records say
    fastest : the largest speed of the records [rad/s], which ``fitted`` sets where no span was given. With a fading
        speed beyond it this is dry friction less a part that grows with speed: no more is seen of the fading
    """

    width: float | None = None
    span: tuple[float, float] | None = None
    fastest: float = _math.inf

    name = "stribeck_friction"
    slides = True
    attaches = ("inertia",)
    kin = ("coulomb_friction", "constant_torque", "viscous_friction")
    limit, limit_at, limit_end = "coulomb_friction", "fading", "max"
    sentence = "friction at {port} that fades with {motion}"
    neutral = "a loss at {port} that fades as {motion} grows"
    amplitude = Amplitude("torque", unit="N m", min=0)

    @property
    def nuisance(self) -> Mapping[str, Grid]:  # type: ignore[override]
        """The fading speed."""
        if self.span is None:
            return {"fading": _FADING}
        return {"fading": replace(_FADING, start=self.span[0], stop=self.span[1], of=None)}

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same with the fading speeds that the motion on the records can show, where none were given."""
        del record, values
        speeds = [np.abs(course) for course in port.courses("speed")]
        fastest = max((float(speed.max()) for speed in speeds), default=_math.inf)
        if self.span is not None or not 0 < fastest < _math.inf:
            return self
        slowest = min(float(speed.min()) for speed in speeds)
        # in steps, so that the grid does not hang on the last digits of a fit
        span = max(fastest * _SLOWEST, slowest / _REACH), _REACH * fastest
        low, high, top = (float(f"{end:.2g}") for end in (*span, fastest))
        return replace(self, span=(low, high), fastest=top)

    def idle(self, port: Any) -> str:
        """Where what acts is known to be no torque and no force: heat, charge and what flows have no such friction."""
        if port.is_mechanical or port.quantity in ("term", "rate"):
            return ""
        return f"a {port.quantity} has no friction that fades"

    def beyond(self, values: Mapping[str, float]) -> bool:
        """True where it fades beyond all speeds of the records."""
        return values.get("fading", 0.0) > self.fastest

    def choices(self, port: Any, grids: Mapping[str, tuple[float, ...]]) -> tuple[dict[str, float], ...]:
        """All fading speeds that the motion comes within reach of."""
        courses = port.courses("speed")
        slowest = min((float(np.abs(course).min()) for course in courses), default=0.0)
        every = super().choices(port, grids)
        return tuple(one for one in every if slowest <= _REACH * one.get("fading", _math.inf))

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """−T exp(−(ω/ω_s)²) sign(ω)."""
        sign = math.sign(port.speed, width=rounding(port, self.width))
        return -p.torque * math.exp(-((port.speed / p.fading) ** 2)) * sign
