"""What acts beyond an edge alone: an end stop, a relief valve, a weir."""

from __future__ import annotations

import math as _math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from casadi_engine.effects.protocol import Amplitude, Effect, Grid
from casadi_engine.errors import EffectError

# Quantiles of a level or a place along the records at which its edge may be.
_EDGES = (0.5, 0.7, 0.85, 0.95)
# Share of the range over which an edge is rounded at least, and of what is moved by from one sample to the next; what
# comes back within a share of a sample is as hard as any.
_ROUNDED, _SHARE, _FASTEST = 1e-3, 0.5, 0.25
# Times that a stop is harder at the largest speed, at most; width of the corner where it lets go.
_LOST, _SMALL = 4.0, 1e-3


@dataclass(frozen=True)
class _Beyond(Effect):
    """A law of what is beyond an edge.

    span : the least and the largest value of an edge; None for those along the records
    most : the largest amplitude; None takes what brings back within a quarter of a sample
    width : width over which the edge is rounded, in the signal's unit; None takes a thousandth of its magnitude, and
        in refits what the records can follow
    """

    span: tuple[float, float] | None = None
    most: float | None = None
    width: float | None = None

    attaches = ("inertia",)
    alike: ClassVar[tuple[str, ...]] = ("span", "most")
    _order: ClassVar[int] = 1
    _side: ClassVar[int] = 1
    _unit: ClassVar[str] = "rad/s"

    @property
    def nuisance(self) -> Mapping[str, Grid]:  # type: ignore[override]
        """The edge."""
        words = "edge beyond which it acts"
        if self.span is None:
            return {"edge": Grid(-1.0, 1.0, steps=4, of="speed", unit=self._unit, description=words)}
        return {"edge": Grid(*self.span, steps=4, unit=self._unit, description=words)}

    def _of(self, port: Any) -> Any:
        """What has the edge."""
        return port.speed

    def _courses(self, port: Any) -> list[NDArray[np.float64]]:
        """The same along the records."""
        return [one for one in port.along(self._of(port)) if np.isfinite(one).all()]

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same with an edge within what the records show, where none was given."""
        courses = self._courses(port)
        if self.span is not None or not courses:
            return self
        low, high = min(float(one.min()) for one in courses), max(float(one.max()) for one in courses)
        step = max(float(np.median(np.diff(record[name].time))) for name in record.names)
        gain = port.response("speed", values)
        most = 1 / ((_FASTEST * step) ** self._order * gain) if gain > 0 else _math.inf
        ends = float(f"{low:.4g}"), float(f"{high:.4g}")
        if not ends[0] < ends[1]:
            return self
        return replace(self, span=ends, most=float(f"{most:.2g}"))

    def narrowed(self, port: Any, share: float = 1.0) -> Effect:
        """As wide as what the signal moves by in half a sample, where no width was given."""
        courses = [one for one in self._courses(port) if len(one) > 1]
        if self.width is not None or not courses:
            return self
        moved = float(np.median(np.concatenate([np.abs(np.diff(one)) for one in courses])))
        wide = max(_SHARE * moved, _ROUNDED * max(float(np.ptp(one)) for one in courses))
        return replace(self, width=float(f"{share * wide:.2g}")) if wide > 0 else self

    def choices(self, port: Any, grids: Mapping[str, tuple[float, ...]]) -> tuple[dict[str, float], ...]:
        """Edges that the records spend some of their time beyond."""
        courses = [] if self.span is None else self._courses(port)
        if not courses:
            return tuple({"edge": edge} for edge in grids["edge"])
        at = [one if self._side > 0 else 1 - one for one in _EDGES]
        edges = np.quantile(np.concatenate(courses), at)
        return tuple({"edge": edge} for edge in dict.fromkeys(float(f"{one:.4g}") for one in edges))

    def _corner(self, port: Any) -> Any:
        wide = self.width
        if wide is None:
            wide = float(f"{_ROUNDED * port.size(self._of(port)):.2g}")
        return port.width(wide, unit=self._unit)


@dataclass(frozen=True)
class Relief(_Beyond):
    """What runs off above an edge, rate (level − edge): over a weir, through a relief valve, past a kidney's threshold.

    It is looked for where a pressure, a level or a concentration is read; what runs over into another vessel is an
    overflow.

    >>> Relief().describe("tank")
    'what runs off at tank above an edge, as over a weir or through a relief valve'
    """

    name = "relief"
    kin = ("overflow", "orifice_leak", "viscous_friction")
    sentence = "what runs off at {port} above an edge, as over a weir or through a relief valve"

    @property
    def amplitude(self) -> Amplitude:  # type: ignore[override]
        """The rate, no larger than ``most``."""
        return Amplitude("rate", "N m s/rad", 0.0, _math.inf if self.most is None else self.most)

    def idle(self, port: Any) -> str:
        """Of a pressure, a level or a concentration alone."""
        known = port.is_head("speed") or port.is_concentration("speed")
        return (
            "" if known else "no pressure, level or concentration is read there that could be above an edge"
        )

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """−rate (level − edge) where that is positive."""
        return -p.rate * math.positive(port.speed - p.edge, width=self._corner(port))


@dataclass(frozen=True)
class EndStop(_Beyond):
    """A stop at the upper end of the way, −k (x − edge) (1 + d v) beyond it (Hunt and Crossley 1975).

    It is looked for where the port shows its place, by a signal angle or position or as the state that its speed moves.

    fast : the largest speed of the records, by which the range of d is told; ``fitted`` sets it

    >>> EndStop().describe("gate")
    'an end stop at gate'
    """

    fast: float | None = None

    name = "end_stop"
    alike: ClassVar[tuple[str, ...]] = ("span", "most", "fast")
    kin = ("cubic_stiffness", "ground_spring", "backlash", "lower_end_stop")
    sentence = "an end stop at {port}"
    _order: ClassVar[int] = 2
    _unit: ClassVar[str] = "rad"
    _side: ClassVar[int] = 1

    @property
    def amplitude(self) -> Amplitude:  # type: ignore[override]
        """The stiffness, no larger than ``most``."""
        return Amplitude("stiffness", "N m/rad", 0.0, _math.inf if self.most is None else self.most)

    def __post_init__(self) -> None:
        if self.fast is not None and not 0 < self.fast < _math.inf:
            raise EffectError(
                "the largest speed at which a stop is met is not acceptable",
                seen=f"fast={self.fast!r}",
                allowed="a finite number above 0, in the unit of the port's speed",
                cure="leave it out: the records tell it",
            )

    @property
    def nuisance(self) -> Mapping[str, Grid]:  # type: ignore[override]
        """The edge, and how much harder the stop is where it is met at speed: what is lost there."""
        most = 1.0 if self.fast is None else float(f"{_LOST / self.fast:.2g}")
        words = "share per speed by which it is harder on the way in"
        return {**super().nuisance, "damping": Grid(0.0, most, steps=2, unit="s/rad", description=words)}

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same with the speeds of the records, too."""
        found = super().fitted(port, record, values)
        speeds = [one for one in port.courses("speed") if np.isfinite(one).all()]
        fast = max((float(np.abs(one).max()) for one in speeds), default=0.0)
        known = self.fast is not None or not fast > 0
        return found if known else replace(found, fast=float(f"{fast:.2g}"))  # type: ignore[type-var]

    def choices(self, port: Any, grids: Mapping[str, tuple[float, ...]]) -> tuple[dict[str, float], ...]:
        """Edges that the records spend some of their time beyond, with and without losses."""
        edges = super().choices(port, grids)
        return tuple({**one, "damping": damping} for one in edges for damping in grids["damping"])

    def idle(self, port: Any) -> str:
        """What moves to and fro meets a stop."""
        if not port.is_mechanical:
            return "what does not move meets no stop"
        speeds = port.courses("speed")
        onward = bool(speeds) and not min(one.min() for one in speeds) < 0 < max(one.max() for one in speeds)
        return "what moves in one direction alone meets no stop" if onward else ""

    def _of(self, port: Any) -> Any:
        return port.place

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """∓k |x − edge| (1 + d v) beyond the edge, v on the way in; nothing holds what leaves."""
        beyond = math.positive(self._side * (port.place - p.edge), width=self._corner(port))
        harder = math.positive(1 + self._side * p.damping * port.speed, width=_SMALL)
        return -self._side * p.stiffness * beyond * harder


@dataclass(frozen=True)
class LowerEndStop(EndStop):
    """The same at the lower end of the way, k (edge − x) below it.

    >>> LowerEndStop().describe("gate")
    'an end stop at the lower end of the way of gate'
    """

    name = "lower_end_stop"
    kin = ("cubic_stiffness", "ground_spring", "backlash", "end_stop")
    sentence = "an end stop at the lower end of the way of {port}"
    _side: ClassVar[int] = -1
