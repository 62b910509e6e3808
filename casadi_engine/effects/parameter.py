"""Parameters that were fixed at a wrong value: a mass, a length, a ratio, a timing, a reference pressure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from casadi_engine.effects.protocol import Amplitude, Effect
from casadi_engine.errors import EffectError


@dataclass(frozen=True)
class WrongValue(Effect):
    """A fixed parameter whose true value is another one: value (1 + share), or 0 + shift where the value is 0.

    It acts at ``parameter_NAME``, a port that every parameter of a model has. The amplitude is bounded so that the
    parameter stays within its declared bounds.

    absolute : True for the shift in the parameter's unit, False for the share; None takes the share of a declared value
        other than 0
    low, high : bounds of the amplitude; None takes those that the declared ones of the parameter leave

    >>> from casadi_engine import two_mass
    >>> model = two_mass().with_effect(WrongValue(), at="parameter_m_eq")
    >>> model.parameter_names[-1], model.parameters()["parameter_m_eq.wrong_value.share"].min
    ('parameter_m_eq.wrong_value.share', -1.0)
    >>> WrongValue().describe("parameter_m_eq")
    'the value of m_eq is wrong'
    """

    absolute: bool | None = None
    low: float | None = None
    high: float | None = None

    name = "wrong_value"
    attaches = ("parameter",)
    kin = ("cylinder_imbalance",)
    sentence = "the value of {port} is wrong"
    fixed_only = True

    @property
    def amplitude(self) -> Amplitude:  # type: ignore[override]
        """The share of the value, or the shift in its unit."""
        low = -math.inf if self.low is None else self.low
        high = math.inf if self.high is None else self.high
        return Amplitude("shift", None, low, high) if self.absolute else Amplitude("share", "1", low, high)

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """Share times the value, or the shift."""
        del math
        return p.shift if self.absolute else p.share * port.value

    def placed(self, port: Any) -> Effect:
        """The effect for the declared value and bounds of its parameter."""
        declared = port.declaration
        return self if declared is None else self._at(declared.value, declared.min, declared.max)

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The effect for the value at which the parameter was fixed."""
        del record
        declared, value = port.declaration, port.number("value", values)
        return self._at(value, declared.min, declared.max)

    def idle(self, port: Any) -> str:
        """No rig has another value of a constant of physics."""
        declared = port.declaration
        known = declared is not None and declared.is_constant_of_nature
        return "no rig has another value of a constant of physics" if known else ""

    def _at(self, value: float, least: float, most: float) -> WrongValue:
        absolute = value == 0 if self.absolute is None else self.absolute
        if value == 0 and not absolute:
            raise EffectError(
                "a parameter of value 0 has no share that could be wrong",
                seen="absolute=False",
                allowed="absolute=True, the shift in the parameter's unit",
                cure="leave `absolute` out: a value of 0 is shifted",
            )
        ends = (least - value, most - value) if absolute else sorted((least / value - 1, most / value - 1))
        low = min(ends[0], 0.0) if self.low is None else self.low
        high = max(ends[1], 0.0) if self.high is None else self.high
        return replace(self, absolute=absolute, low=low, high=high)

    def _called(self, port: str) -> str:
        """The name of the parameter."""
        return port.removeprefix("parameter_")
