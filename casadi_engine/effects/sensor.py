"""Sensors that do not show what is there: an offset, and a delay."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from casadi_engine.effects.protocol import Amplitude, Effect


@dataclass(frozen=True)
class SensorOffset(Effect):
    """A sensor whose zero is off, y + offset (in the output's unit)."""

    name = "sensor_offset"
    attaches = ("sensor",)
    kin = ("sensor_delay",)
    sentence = "an offset of {port}"
    amplitude = Amplitude("offset", unit=None)

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """The offset."""
        del port, math
        return p.offset


@dataclass(frozen=True)
class SensorDelay(Effect):
    """A sensor that is late by a delay τ [s], or early: y(t − τ) to the first order, y − τ dy/dt by the ode.

    What is left out is τ² d²y/dt² / 2: at 40 Hz and 0.1 ms a 1/3000 of y's ripple. A law at one instant cannot
    hold the past, so this form stands for the sharp one too.
    """

    name = "sensor_delay"
    attaches = ("sensor",)
    kin = ("sensor_offset",)
    sentence = "a delay of {port}"
    amplitude = Amplitude("delay", unit="s")

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """−τ dy/dt."""
        del math
        return -p.delay * port.rate
