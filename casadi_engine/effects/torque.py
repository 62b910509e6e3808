"""Torques from outside on an inertia: a constant one, and a load that comes or goes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from casadi_engine.model.effect import Amplitude, Effect, Grid


@dataclass(frozen=True)
class ConstantTorque(Effect):
    """A torque that no channel tells of; positive accelerates."""

    name = "constant_torque"
    attaches = ("inertia",)
    kin = ("coulomb_friction", "load_step")
    sentence = "a constant torque on {port}"
    amplitude = Amplitude("torque", unit="N m")

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """T."""
        del port, math
        return p.torque


@dataclass(frozen=True)
class LoadStep(Effect):
    """A load that is switched on (positive) or off (negative) within the record; it brakes.

    width : the switch is rounded over it in fits [s]
    """

    width: float = 1e-3

    name = "load_step"
    attaches = ("inertia",)
    kin = ("constant_torque", "misfire")
    sentence = "a load at {port} that comes or goes during the record"
    amplitude = Amplitude("torque", unit="N m")
    nuisance = {"time": Grid(0.02, 0.98, steps=49, unit="s", over="time")}  # noqa: RUF012 (read only)

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """−T for t > t_0."""
        return -p.torque * math.step(port.time - p.time, width=self.width)
