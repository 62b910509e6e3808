"""Heat that a body radiates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from casadi_engine.effects.ambient_loss import AmbientLoss
from casadi_engine.effects.protocol import Amplitude, Effect, Grid


@dataclass(frozen=True)
class Radiation(AmbientLoss):
    """Heat that a body radiates, -coefficient (T^4 - surroundings^4) of temperatures above absolute zero.

    The coefficient is that of emissivity, area and 5.670e-8 W/(m2 K4). The surroundings are what the port shows the
    difference to, T - T_room, or the one temperature that is recorded and acts there; else constant and estimated.

    known : True where the model has the surroundings; None for what the port says

    >>> Radiation().describe("filament")
    'heat that filament radiates, by the fourth power of its temperature'
    """

    known: bool | None = None

    name = "radiation"
    kin = ("viscous_friction", "ambient_loss", "quadratic_drag")
    sentence = "heat that {port} radiates, by the fourth power of its temperature"
    amplitude = Amplitude("coefficient", unit="N m s4/rad4", min=0)

    @property
    def nuisance(self) -> Mapping[str, Grid]:  # type: ignore[override]
        """The temperature of the surroundings, where the model does not say it."""
        return {} if self.known else super().nuisance

    def placed(self, port: Any) -> Effect:
        """The same with what the port says of the surroundings."""
        if self.known is not None:
            return self
        return replace(self, known=port.around("speed") is not None)

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same with the surroundings that the port or the records allow."""
        own = self.placed(port)
        return own if own.known else AmbientLoss.fitted(own, port, record, values)  # type: ignore[attr-defined,arg-type]

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """-coefficient (T^4 - surroundings^4)."""
        del math
        warm, zero = port.stored("speed"), port.absolute_zero("speed")
        around = port.around("speed") if self.known else p.surroundings
        hot, cold = warm - zero, around - zero
        return -p.coefficient * (hot**2 + cold**2) * (hot + cold) * (warm - around)
