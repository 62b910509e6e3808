"""Springs that are not straight lines: hardening couplings, and couplings with play."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from casadi_engine.model.effect import Amplitude, Effect


@dataclass(frozen=True)
class CubicStiffness(Effect):
    """A spring that hardens (positive) or softens (negative), + k₃ twist³."""

    name = "cubic_stiffness"
    attaches = ("coupling",)
    kin = ("backlash",)
    sentence = "a stiffness of {port} that changes with its twist"
    amplitude = Amplitude("stiffness", unit="N m/rad3")

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """k₃ twist³."""
        del math
        return p.stiffness * port.twist**3


@dataclass(frozen=True)
class Backlash(Effect):
    """Play of ±gap in a coupling: its spring acts on the twist less the play, K (dz(twist) − twist).

    The dead-zone model (Nordin and Gutman 2002), with the coupling's damper left in the gap. The amplitude is the
    half-width itself. At gap 0 the law has the one-sided slope −K sign(twist); but a finite play differs from
    this wherever the twist is inside, so that secants at several sizes are tested beside it.

    width : the corners are rounded over it in fits, as a torque of the spring [N m]
    torques : spring torques at the edge of the play [N m] whose secants are tested
    """

    width: float = 0.5
    torques: tuple[float, ...] = (4.0, 8.0, 16.0, 32.0, 64.0)

    name = "backlash"
    attaches = ("coupling",)
    needs = ("stiffness",)
    kin = ("cubic_stiffness", "coulomb_friction")
    sentence = "play in {port}"
    amplitude = Amplitude("gap", unit="rad", min=0)

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """K (dz(twist) − twist), written with torques so that the rounding does not depend on K."""
        torque, edge = port.stiffness * port.twist, port.stiffness * p.gap
        return math.dead_zone(torque, edge, width=self.width) - torque

    def sizes(self, port: Any, values: Mapping[str, float]) -> tuple[float, ...]:
        """The gaps whose edge the spring reaches at `torques`."""
        stiffness = port.number("stiffness", values)
        return tuple(torque / stiffness for torque in self.torques)
