"""What takes up and gives back beside what a model has: a wall, a jacket or a dead volume, a spring that yields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from casadi_engine.effects.protocol import Amplitude, Effect, Grid, Law
from casadi_engine.effects.sensor import time_constants, time_grid


@dataclass(frozen=True)
class _Storage(Effect):
    """What follows a signal s of its port with a time constant τ, dz/dt = (s − z)/τ, and acts back by s − z.

    span : the least and the largest time constant [s]; None for half a sample to all of the records, as what is slower
        takes up and does not give back
    first : z where a record begins; it is estimated with the other initial states
    reach : how far from there it may well begin: what the signal spans in all records, as z follows it; 0 where that is
        not known
    """

    span: tuple[float, float] | None = None
    first: float = 0.0
    reach: float = 0.0

    alike = ("span",)
    signal: ClassVar[str] = ""
    stored: ClassVar[bool] = False

    @property
    def nuisance(self) -> Mapping[str, Grid]:  # type: ignore[override]
        """The time constant."""
        return time_grid(self.span)

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same at rest where the records begin, with the time constants that they can show."""
        del values
        courses = port.courses(self.signal, stored=self.stored)
        begun = [float(course[0]) for course in courses if np.isfinite(course[:1]).all()]
        longest = max((record[name].time for name in record.names), key=len)
        span = self.span or time_constants(longest, most=1.0)
        if not begun:
            return replace(self, span=span)
        seen = np.concatenate([course[np.isfinite(course)] for course in courses])
        return replace(self, span=span, first=float(np.mean(begun)), reach=float(np.ptp(seen)))

    def _behind(self, port: Any, p: Any) -> tuple[Any, dict[str, tuple[float, Any]]]:
        """s − z, and the state z."""
        signal = port.stored(self.signal) if self.stored else getattr(port, self.signal)
        behind = signal - port.state("stored")
        return behind, {"stored": (self.first, behind / p.time)}


@dataclass(frozen=True)
class HiddenStorage(_Storage):
    """A storage that the model does not have, behind what is: −G (s − z) with dz/dt = (s − z)/τ.

    The heat that a wall, a jacket or an insulation takes up and gives back, the charge behind a resistance, a vessel
    behind a narrow neck; s is what is stored at the port: its ``speed`` without what that is measured from, as a wall
    follows the temperature of a body, not how far this is above an ambient that moves. Its capacity is G τ. It is not
    looked for on a shaft or a mass, where a mass behind a damper would do that.

    >>> HiddenStorage().describe("water")
    'a storage behind water that takes up and gives back'
    """

    name = "hidden_storage"
    attaches = ("inertia",)
    kin = ("viscous_friction", "input_lag", "sensor_lag")
    sentence = "a storage behind {port} that takes up and gives back"
    amplitude = Amplitude("conductance", unit="N m s/rad", min=0)
    signal = "speed"
    stored = True

    def idle(self, port: Any) -> str:
        """At shafts and masses."""
        return "no shaft or mass has a storage of that kind" if port.is_mechanical else ""

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """−G (s − z)."""
        del math
        behind, states = self._behind(port, p)
        return Law(-p.conductance * behind, states)


@dataclass(frozen=True)
class Relaxation(_Storage):
    """A coupling that yields: beside its spring one in series with a damper (Maxwell 1867), + k (twist − z) with
    dz/dt = (twist − z)/τ, as rubber, a belt or a hose with air in it.

    >>> Relaxation().describe("shaft")
    'a yielding spring beside shaft'
    """

    name = "relaxation"
    attaches = ("coupling",)
    kin = ("viscous_friction", "cubic_stiffness")
    sentence = "a yielding spring beside {port}"
    amplitude = Amplitude("stiffness", unit="N m/rad", min=0)
    signal = "twist"

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """K (twist − z)."""
        del math
        behind, states = self._behind(port, p)
        return Law(p.stiffness * behind, states)
