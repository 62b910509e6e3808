"""Heat that a body loses to surroundings of which the model says nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from casadi_engine.effects.protocol import Amplitude, Effect, Grid

# How far the surroundings may be below and above what the body's temperature is along the records, in its range there.
_BELOW, _ABOVE = 3.0, 1.0


@dataclass(frozen=True)
class AmbientLoss(Effect):
    """A loss to surroundings of a constant temperature, -coefficient (T - surroundings), T what is stored at the port.

    Where the model knows what is around the body, T - T_room at its port, viscous_friction is a loss to that; this one
    goes to something else, or stands for both numbers where the port shows T alone. It is looked for at temperatures.

    span : the least and the largest temperature of the surroundings, in the port's unit; None for three times the range
        of T along the records below it to once that above it

    >>> AmbientLoss().describe("vessel")
    'a loss of vessel to surroundings of a constant temperature'
    """

    span: tuple[float, float] | None = None

    name = "ambient_loss"
    attaches = ("inertia",)
    kin = ("viscous_friction", "constant_torque", "wrong_value")
    alike = ("span",)
    sentence = "a loss of {port} to surroundings of a constant temperature"
    amplitude = Amplitude("coefficient", unit="N m s/rad", min=0)
    _steps: ClassVar[int] = 4

    @property
    def nuisance(self) -> Mapping[str, Grid]:  # type: ignore[override]
        """The temperature of the surroundings."""
        words = "temperature of the surroundings"
        if self.span is None:
            grid = Grid(-10, 10, steps=self._steps, of="speed", unit="rad/s", description=words)
        else:
            grid = Grid(*self.span, steps=self._steps, unit="rad/s", description=words)
        return {"surroundings": grid}

    def idle(self, port: Any) -> str:
        """What is no temperature has no surroundings."""
        return "" if port.is_temperature("speed") else "what is no temperature loses no heat"

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same with the surroundings that the records allow."""
        del record, values
        courses = [one for one in port.courses("speed", stored=True) if np.isfinite(one).all()]
        if self.span is not None or not courses:
            return self
        low, high = min(float(one.min()) for one in courses), max(float(one.max()) for one in courses)
        wide = high - low
        if not wide > 0:
            return self
        return replace(self, span=(float(f"{low - _BELOW * wide:.4g}"), float(f"{high + _ABOVE * wide:.4g}")))

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """-coefficient (T - surroundings)."""
        del math
        return -p.coefficient * (port.stored("speed") - p.surroundings)
