"""A leak through an orifice: a turbulent flow that grows with the root of the pressure or the level."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from casadi_engine.effects.corners import narrow
from casadi_engine.effects.friction import SPEED_WIDTH
from casadi_engine.effects.protocol import Amplitude, Effect


@dataclass(frozen=True)
class OrificeLeak(Effect):
    """A leak through an orifice, −c sign(p) √|p|, out of a volume or, at a pipe, from one volume into another.

    It is looked for where a pressure or a level is read (Torricelli; Merritt, Hydraulic Control Systems, 1967); a leak
    through a long narrow gap, which is laminar, grows with the pressure itself and is viscous_friction or transfer.

    width : pressure or level over which the root is rounded at 0, in the signal's unit; None takes a small share of its
        magnitude, and in refits what the records can follow

    >>> OrificeLeak().describe("main")
    'a leak at main through an orifice, by the root of what stands there'
    """

    width: float | None = None

    name = "orifice_leak"
    attaches = ("inertia", "pipe")
    kin = ("viscous_friction", "constant_torque", "transfer")
    sentence = "a leak at {port} through an orifice, by the root of what stands there"
    neutral = "a leak at {port} through an orifice, a {effort} by the root of {motion}"
    amplitude = Amplitude("coefficient", unit="N m s0.5/rad0.5", min=0)

    def idle(self, port: Any) -> str:
        """Of a pressure or a level alone."""
        known = port.is_head(_signal(port))
        return "" if known else "no pressure and no level is read there that drives a flow through an orifice"

    def narrowed(self, port: Any, share: float = 1.0) -> Effect:
        """The same with a width by the course of the signal, where none was given."""
        if self.width is not None:
            return self
        wide = SPEED_WIDTH * port.typical(_signal(port))
        return replace(self, width=float(f"{share * narrow(port.courses(_signal(port)), wide):.2g}"))

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """∓c sign(p) √|p|."""
        signal = _signal(port)
        width = self.width
        if width is None:
            width = port.width(float(f"{SPEED_WIDTH * port.typical(signal):.2g}"), unit="rad/s")
        head, side = getattr(port, signal), 1 if port.kind == "pipe" else -1
        return side * p.coefficient * math.sign(head, width=width) * math.sqrt(math.abs(head, width=width))

    def worded(self, port: Any) -> str:
        """The sentence, of a pipe between its ends."""
        text = super().worded(port)
        ends = " and ".join(port.ends)
        return text.replace(f"at {port.name}", f"between {ends}") if ends else text


def _signal(port: Any) -> str:
    """What drives the flow: the level or pressure of a volume, or what two of them differ by."""
    return "difference" if port.kind == "pipe" else "speed"
