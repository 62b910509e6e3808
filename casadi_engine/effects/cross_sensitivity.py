"""Sensors that feel another quantity beside their own: a force that bends them, a temperature, a neighbour's field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from casadi_engine.effects.protocol import Amplitude, Effect, Grid

# Share of the range of the other quantity, 0 included, beyond it in which the sensor may be right, too.
_BEYOND = 0.2


@dataclass(frozen=True)
class CrossSensitivity(Effect):
    """A sensor that feels another quantity too, y + coefficient (z - right_at).

    It acts at a cross, ``z_to_sensor_y``, from another output of the model, or from an input, as the temperature of
    the room or a heater that shines on a thermometer. It is right where z is ``right_at``: at the temperature of its
    calibration, at no load. Of two temperatures, or two concentrations, it takes a share of their difference,
    y + coefficient (z - y): heat that comes to a thermometer along its stem, a stream that passes by the vessel and is
    mixed with what leaves it before the probe.

    span : the least and the largest value at which the sensor may be right; None for those that z has in the records,
        0, and a fifth beyond
    between : True for a share of the difference; None where both are temperatures or both concentrations

    >>> CrossSensitivity().describe("T_oil_to_sensor_torque")
    'a cross-sensitivity of sensor_torque to T_oil'
    """

    span: tuple[float, float] | None = None
    between: bool | None = None

    name = "cross_sensitivity"
    attaches = ("cross",)
    kin = ("sensor_drift", "sensor_offset", "sensor_gain")
    alike = ("span",)
    sentence = "a cross-sensitivity of {port}"
    amplitude = Amplitude("coefficient", unit="N m/rad")
    _steps: ClassVar[int] = 3

    @property
    def nuisance(self) -> Mapping[str, Grid]:  # type: ignore[override]
        """The value of the other quantity at which the sensor is right."""
        if self.between:
            return {}
        words = "value of the other quantity at which the sensor is right"
        if self.span is None:
            return {"right_at": Grid(-10, 10, steps=self._steps, of="input", unit="rad", description=words)}
        return {"right_at": Grid(*self.span, steps=self._steps, unit="rad", description=words)}

    def placed(self, port: Any) -> Effect:
        """The same of a difference, where both are temperatures or both concentrations."""
        if self.between is not None:
            return self
        return replace(self, between=port.has("difference") and port.is_mixed("input"))

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same with the values that the other quantity has, and 0, where none were given."""
        del record, values
        own = self.placed(port)
        courses = [course for course in port.courses("input") if np.isfinite(course).all()]
        if own.between or self.span is not None or not courses:  # type: ignore[attr-defined]
            return own
        low = min(0.0, *(float(course.min()) for course in courses))
        high = max(0.0, *(float(course.max()) for course in courses))
        beyond = _BEYOND * (high - low)
        span = float(f"{low - beyond:.3g}"), float(f"{high + beyond:.3g}")
        return replace(self, between=False, span=span) if low < high else own

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """coefficient (z - right_at), or that of the difference."""
        del math
        return p.coefficient * (port.difference if self.between else port.input - p.right_at)

    def idle(self, port: Any) -> str:
        """What stands still is an offset."""
        courses = [course for course in port.courses("input") if np.isfinite(course).all()]
        spread = max((float(np.ptp(course)) for course in courses), default=1.0)
        return "" if spread > 0 else "what the sensor would feel does not change"

    def _called(self, port: str) -> str:
        """Both ends."""
        other, _, sensor = port.rpartition("_to_sensor_")
        return f"sensor_{sensor} to {other}"
