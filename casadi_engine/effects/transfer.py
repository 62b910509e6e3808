"""What leaves one part of a system and enters another: a slipping connection, a leak, a flow of heat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from casadi_engine.effects.protocol import Amplitude, Effect


@dataclass(frozen=True)
class Transfer(Effect):
    """A flow between two ports that grows with the difference of their signals: what leaves one enters the other.

    Between two shafts it is viscous friction of one on the other, a torque c (ω_a − ω_b); between two tanks a leak,
    between two bodies the heat that passes. It acts at a link: ``a_and_b`` joins the ports a and b of the kind inertia
    whose slots have the same unit, N m or N as in a mechanical model, or the one stated, ``b.port("tank_1", "inertia",
    {"level": h_1}, unit="m3/s")``. Links that a coupling of the model joins are not looked at: there it is
    viscous_friction of the coupling.

    >>> from casadi_engine import Blueprint
    >>> b = Blueprint("tanks")
    >>> for k in (1, 2):
    ...     h = b.state(f"h_{k}", unit="m")
    ...     b.ode(f"h_{k}", b.port(f"tank_{k}", "inertia", {"level": h}, unit="m3/s") / 0.5)
    >>> b.output("level", h, unit="m")
    >>> model = b.model().with_effect(Transfer(), at="tank_1_and_tank_2")
    >>> print(model.equations().splitlines()[0].strip())
    d(h_1)/dt = -2*tank_1_and_tank_2.transfer.coefficient*(h_1 - h_2)
    """

    name = "transfer"
    attaches = ("link",)
    kin = ("viscous_friction",)
    sentence = "a flow between {port}"
    amplitude = Amplitude("coefficient", unit="N m s/rad", min=0)

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """c (signal of the first − signal of the second), out of the first and into the second."""
        del math
        return p.coefficient * port.difference

    def describe(self, port: str) -> str:
        """The sentence, with both ends."""
        return super().describe(port.replace("_and_", " and "))
