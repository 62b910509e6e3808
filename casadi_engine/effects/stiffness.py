"""Springs that are not straight lines: hardening couplings, and couplings with play."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from casadi_engine.effects.corners import narrow
from casadi_engine.effects.protocol import Amplitude, Effect, Law

# Torque at the edge of a play, in shares of the coupling's largest one; the width of its corners, likewise; and the
# largest torque where none is known [N m].
_EDGES, _WIDTH, _LARGEST = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0), 1 / 128, 64.0

# The largest gap, as a multiple of the twist's span.
_SPANS = 2.0


@dataclass(frozen=True)
class CubicStiffness(Effect):
    """A spring that hardens (positive) or softens (negative), + k₃ twist³."""

    name = "cubic_stiffness"
    attaches = ("coupling",)
    kin = ("backlash",)
    sentence = "a stiffness of {port} that changes with its deflection"
    neutral = "a response of {port} that grows with the cube of {motion}"
    amplitude = Amplitude("stiffness", unit="N m/rad3")

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """k₃ twist³."""
        del math
        return p.stiffness * port.twist**3


@dataclass(frozen=True)
class GroundSpring(Effect):
    """A spring between what turns or moves and the ground, −k (x − x₀): a return spring, a membrane, a weight that
    hangs, or stands, where k is negative.

    x is the speed of the port added up. Its value where a record begins, counted from where the spring rests, is
    estimated with the other initial states; first : the start value of that

    >>> GroundSpring().describe("door")
    'a spring between door and the ground'
    """

    first: float = 0.0

    rests: ClassVar[bool] = True
    name = "ground_spring"
    attaches = ("inertia",)
    kin = ("constant_torque", "relaxation", "sensor_lag")
    sentence = "a spring between {port} and the ground"
    negative = (
        "a {effort} on {port} that pushes away with its displacement: a negative stiffness, as a weight has"
    )
    amplitude = Amplitude("stiffness", unit="N m/rad")

    def idle(self, port: Any) -> str:
        """Where nothing turns or moves."""
        return "" if port.is_mechanical else "a spring holds what turns or moves"

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same from where the port says that the records begin."""
        del record, values
        places = [port.courses(name) for name in ("angle", "position") if port.has(name)]
        begun = [float(own[0]) for courses in places[:1] for own in courses if np.isfinite(own[:1]).all()]
        return replace(self, first=float(np.mean(begun))) if begun else self

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """−k x."""
        del math
        place = port.state("place")
        return Law(-p.stiffness * place, {"place": (self.first, port.speed)})


@dataclass(frozen=True)
class Backlash(Effect):
    """Play of ±gap in a coupling: its spring acts on the twist less the play, K (dz(twist) − twist).

    The dead-zone model (Nordin and Gutman 2002), with the coupling's damper left in the gap. The amplitude is the
    half-width itself. At gap 0 the law has the one-sided slope −K sign(twist); but a finite play differs from
    this wherever the twist is inside, so that secants at several sizes are tested beside it.

    width : the corners are rounded over it, as a torque of the spring [N m]; None takes 1/128 of the largest of
        `torques`, and in refits what the records can follow
    torques : spring torques at the edge of the play [N m] whose secants are tested; None takes 1/16 to 1 times the
        coupling's largest torque in the record, 64 N m where none is known
    most : the largest gap [rad]; None takes twice the span of the twist in the records: wider plays are never
        crossed, and all alike
    """

    width: float | None = None
    torques: tuple[float, ...] | None = None
    most: float | None = None

    name = "backlash"
    attaches = ("coupling",)
    kin = ("cubic_stiffness", "coulomb_friction")
    sentence = "play of ±gap in {port}"
    neutral = "a dead zone of ±gap in {port}"

    @property
    def amplitude(self) -> Amplitude:  # type: ignore[override]
        """The gap, no wider than ``most``."""
        return Amplitude("gap", unit="rad", min=0, max=math.inf if self.most is None else self.most)

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """K (dz(twist) − twist), written with torques so that the rounding does not depend on K."""
        torque, edge = port.stiffness * port.twist, port.stiffness * p.gap
        given = self.width is not None or self.torques is not None
        width = self._wide if given else port.width(self._wide, unit="N m")
        return math.dead_zone(torque, edge, width=width) - torque

    @property
    def _wide(self) -> float:
        """The width of the corners [N m]; where nothing was given it is where a parameter of the model starts."""
        largest = _LARGEST if self.torques is None else max(self.torques)
        return _WIDTH * largest if self.width is None else self.width

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same with torques, and so a width, by the largest torque of the record, where none were given."""
        del record
        twists = [float(np.abs(course).max()) for course in port.courses("twist")]
        peak = max(twists, default=0.0) * abs(port.number("stiffness", values))
        # in steps of two, so that the grid does not hang on the last digits of a fit
        size = 2.0 ** round(math.log2(peak)) if peak > 0 and math.isfinite(peak) else _LARGEST
        span = max((float(np.ptp(course)) for course in port.courses("twist")), default=0.0)
        most = float(f"{_SPANS * span:.1g}") if 0 < span < math.inf and self.most is None else self.most
        torques = tuple(size * share for share in _EDGES) if self.torques is None else self.torques
        return replace(self, torques=torques, most=most)

    def narrowed(self, port: Any, share: float = 1.0) -> Effect:
        """The same with corners as sharp as the twist passes through its middle."""
        twists, stiffness = port.courses("twist"), port.courses("stiffness")
        if self.width is not None or not twists or not stiffness[0][0] > 0:
            return self
        hard = float(stiffness[0][0])
        found = narrow([twist - np.median(twist) for twist in twists], self._wide / hard)
        return replace(self, width=share * hard * found)

    def sizes(self, port: Any, values: Mapping[str, float]) -> tuple[float, ...]:
        """The gaps whose edge the spring reaches at `torques`."""
        stiffness = port.number("stiffness", values)
        if not stiffness:  # a spring that is none has no play
            return ()
        torques = tuple(_LARGEST * share for share in _EDGES) if self.torques is None else self.torques
        return tuple(torque / stiffness for torque in torques)
