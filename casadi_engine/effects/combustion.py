"""Cylinders that burn otherwise than their recorded pressure says: misfire and imbalance."""

from __future__ import annotations

import math as _math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np

from casadi_engine.effects.protocol import Amplitude, Effect, Grid
from casadi_engine.errors import EffectError
from casadi_engine.model.combustion import Motored, combustion_torque, compresses, fit_motored

# The cycle of a cylinder is counted from this angle before its combustion TDC, where nothing burns [rad].
SEAM = _math.pi
CYCLE = 4 * _math.pi


def pegged_torque(port: Any, motored: Motored | None) -> Any:
    """The torque of combustion at a cylinder's port [N m], with its own motored trace or the port's."""
    if motored is None:
        return port.combustion_torque
    return combustion_torque(port.angle, port.pressure, port.lever, port.rod_ratio, motored)


@dataclass(frozen=True)
class CylinderImbalance(Effect):
    """A cylinder that burns stronger (positive) or weaker than its recorded pressure says, in all cycles alike.

    The torque of combustion, gas torque less that of a motored cylinder, counts 1 + share times.

    motored : the motored trace; None takes the port's, which is that of an unboosted engine at part load.
        `fitted` pegs it on a record.
    """

    motored: Motored | None = None

    name = "cylinder_imbalance"
    attaches = ("cylinder",)
    kin = ("misfire",)
    sentence = "combustion in {port} that is stronger or weaker than its pressure says"
    amplitude = Amplitude("share", unit="1")

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """Share of the combustion torque."""
        del math
        return p.share * pegged_torque(port, self.motored)

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The effect with its motored trace pegged on a record, if that holds the crank angle and pressure."""
        motored = _pegged(port, record, values)
        return self if motored is None else replace(self, motored=motored)


@dataclass(frozen=True)
class Misfire(Effect):
    """Combustion that is lost in the engine cycles `first` to `last`, though the recorded pressure shows it.

    Cycle k of a cylinder holds the combustion at its k-th TDC, counted from theta = 0 of cylinder 1. Tested are
    single cycles, and losses that last to the end of the record. Lost in all cycles it is an imbalance of −1.

    motored : as in `CylinderImbalance`
    by_record : True makes `first` and `last` parameters of the model, so that each record has its own cycles, given
        by ``effects.by_record``; False makes them constants, the same in all records
    """

    motored: Motored | None = None
    by_record: bool = False

    name = "misfire"
    attaches = ("cylinder",)
    kin = ("cylinder_imbalance", "load_step")
    sentence = "combustion in {port} that is lost in some cycles"
    amplitude = Amplitude("lost", unit="1", min=0)

    @property
    def nuisance(self) -> Mapping[str, Grid]:  # type: ignore[override]
        """The first and the last cycle lost."""
        return {
            name: Grid(over="cycle", whole=not self.by_record, description=f"{name} cycle lost")
            for name in ("first", "last")
        }

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """−(lost) times the combustion torque, in the chosen cycles."""
        _ = port.firing_offset  # cycles are counted by one cylinder's own firing, so that it must have one
        if isinstance(p.first, Real) and p.last < p.first:
            raise EffectError(
                "the cycles of a misfire are in the wrong order",
                seen=f"first = {p.first:.0f}, last = {p.last:.0f}",
                allowed="first <= last",
                cure="exchange them",
            )
        begins = math.step(port.angle + SEAM - CYCLE * (p.first - 1), width=0.1)
        ends = math.step(port.angle + SEAM - CYCLE * p.last, width=0.1)
        return -p.lost * (begins - ends) * pegged_torque(port, self.motored)

    def choices(self, port: Any, grids: Mapping[str, tuple[float, ...]]) -> tuple[dict[str, float], ...]:
        """Single cycles, and from each cycle but the first to the end."""
        del port
        cycles: Sequence[float] = sorted(grids["first"])
        single = [{"first": cycle, "last": cycle} for cycle in cycles]
        lasting = [{"first": cycle, "last": cycles[-1]} for cycle in cycles[1:-1]]
        return tuple(single + lasting)

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The effect with its motored trace pegged on a record, if that holds the crank angle and pressure."""
        motored = _pegged(port, record, values)
        return self if motored is None else replace(self, motored=motored)


def _pegged(port: Any, record: Any, values: Mapping[str, float]) -> Motored | None:
    """The motored trace of a record's cylinder; None if the record lacks channels or a compression for it."""
    channel = f"p{port.name.rpartition('_')[2]}"
    if (
        not (port.has("firing_offset") and port.has("rod_ratio"))
        or "theta" not in record
        or channel not in record
    ):
        return None
    theta, pressure = record["theta"], record[channel]
    angle = np.interp(pressure.time[pressure.mask], theta.time, theta.values)
    offset, ratio = port.number("firing_offset", values), port.number("rod_ratio", values)
    if not compresses(angle - offset):
        return None
    return fit_motored(angle - offset, pressure.values[pressure.mask], ratio=ratio)
