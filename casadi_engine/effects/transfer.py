"""What leaves one part of a system and enters another: a slipping connection, a leak, a flow of heat, an overflow."""

from __future__ import annotations

import math as _math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from casadi_engine.effects.protocol import Amplitude, Effect, Grid, Law

# Quantiles of a level along the records at which its edge may be.
_EDGES = (0.5, 0.7, 0.85, 0.95)
# Share of the typical level over which an edge is rounded; what runs over is gone within a share of a sample: faster
# overflows hold the level at the edge, and all alike.
_ROUNDED, _FASTEST = 1e-3, 0.25


@dataclass(frozen=True)
class Transfer(Effect):
    """A flow between two ports that grows with the difference of their signals: what leaves one enters the other.

    Between two shafts it is viscous friction of one on the other, a torque c (ω_a − ω_b); between two tanks a leak,
    between two bodies the heat that passes. It acts at a link or a pipe: ``a_and_b`` joins the ports a and b of the
    kind inertia whose slots have the same unit: N m or N of a mechanical model, or the one that was stated,
    ``b.port("tank_1", "inertia", {"level": h_1}, unit="m3/s")``. Links that a coupling of the model joins are not
    looked at: there it is viscous_friction of the coupling. At a path, ``u_to_a``, it is what a loses to something
    whose temperature, level or speed is the input u: a cellar that was recorded, a base that moves.

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
    attaches = ("link", "pipe", "path")
    kin = ("viscous_friction", "overflow")
    sentence = "viscous friction between {port}"
    neutral = "a {effort} between {port}, proportional to their difference"
    amplitude = Amplitude("coefficient", unit="N m s/rad", min=0)

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """c (signal of the first − signal of the second), out of the first and into the second."""
        del math
        return p.coefficient * port.difference

    def _called(self, port: str) -> str:
        """Both ends."""
        return port.replace("_and_", " and ").replace("_to_", " and ", 1)


@dataclass(frozen=True)
class Overflow(Effect):
    """A vessel that runs over its edge, by rate (level − edge): a share into the other one, the rest is lost.

    It acts at a pipe, as `Transfer` does. The cascaded tanks of Schoukens, Mattsson, Wigren and Noël (2016) do so.

    span : the least and the largest level of an edge; None for those along the records
    most : the largest rate; None takes what empties the larger vessel down to its edge within a quarter of a sample

    >>> Overflow().describe("upper_and_lower")
    'an overflow between upper and lower'
    """

    span: tuple[float, float] | None = None
    most: float | None = None

    name = "overflow"
    attaches = ("pipe",)
    kin = ("transfer",)
    alike = ("most",)
    sentence = "an overflow between {port}"

    @property
    def amplitude(self) -> Amplitude:  # type: ignore[override]
        """The rate, no larger than ``most``."""
        return Amplitude("rate", "N m s/rad", 0.0, _math.inf if self.most is None else self.most)

    @property
    def nuisance(self) -> Mapping[str, Grid]:  # type: ignore[override]
        """The edge, the share that arrives, and which of both ends runs over: 1 or 2."""
        edge = Grid(0.5, 1.5, steps=4, of="first", unit="rad/s", description="level above which it runs over")
        if self.span is not None:
            edge = replace(edge, start=self.span[0], stop=self.span[1], of=None)
        return {
            "edge": edge,
            "share": Grid(0, 1, steps=3, description="share that arrives at the other end"),
            "source": Grid(1, 2, steps=2, whole=True, description="the end that runs over"),
        }

    def idle(self, port: Any) -> str:
        """Of levels, pressures, voltages: what is filled; a temperature has no edge."""
        return "a temperature does not run over an edge" if port.is_temperature("first") else ""

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same with an edge within the levels of the records, and a largest rate, where none was given."""
        most = self.most
        if most is None:
            step = max(float(np.median(np.diff(record[name].time))) for name in record.names)
            # either end may run over: what is too fast for a well is little for the pond beside it
            gains = [port.response(signal, values) for signal in ("first", "second")]
            gain = min((one for one in gains if one > 0), default=0.0)
            most = float(f"{1 / (_FASTEST * step * gain):.1g}") if gain > 0 else None
        levels = [*port.courses("first"), *port.courses("second")]
        if self.span is not None or not levels:
            return replace(self, most=most)
        low, high = (
            float(f"{end:.3g}") for end in (min(c.min() for c in levels), max(c.max() for c in levels))
        )
        return replace(self, most=most, span=(low, high) if low < high else None)

    def choices(self, port: Any, grids: Mapping[str, tuple[float, ...]]) -> tuple[dict[str, float], ...]:
        """All shares of both ends, with edges where the level of the end spends some of its time above."""
        found = []
        for source, signal in ((1.0, "first"), (2.0, "second")):
            levels = port.courses(signal)
            edges = np.quantile(np.concatenate(levels), _EDGES) if levels else grids["edge"]
            distinct = dict.fromkeys(float(f"{edge:.3g}") for edge in edges)
            found += [
                {"edge": edge, "share": share, "source": source}
                for edge in distinct
                for share in grids["share"]
            ]
        return tuple(found)

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """rate (level − edge) where that is positive."""
        one_way = not isinstance(p.source, float) or p.source == 1
        level = port.first if one_way else port.second
        width = port.width(float(f"{_ROUNDED * port.typical('first'):.2g}"), unit="rad/s")
        runs = p.rate * math.positive(level - p.edge, width=width)
        return Law(runs, arrives=p.share * runs) if one_way else Law(-p.share * runs, arrives=-runs)

    def _called(self, port: str) -> str:
        """Both ends."""
        return port.replace("_and_", " and ")
