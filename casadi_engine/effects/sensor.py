"""Sensors that do not show what is there, by an offset, a drift, a delay, a lag or a gain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from casadi_engine.effects.protocol import Amplitude, Effect, Grid, Law

# Share of its mean by which an output varies at least, that a gain acts otherwise than an offset: one of a tenth moves
# what varies by a ten-thousandth of the mean then, which is below what sensors resolve. Whether the data tell one from
# the other where it varies more, their likelihood says.
VARIES = 1e-3
# Least time constant of a lag, in samples, and the largest one, as a share of a record.
SHORTEST, _LONGEST = 0.5, 0.25


def time_constants(
    time: Any, shortest: float = SHORTEST, most: float = _LONGEST
) -> tuple[float, float] | None:
    """The least and the largest one [s] that a record of these times (N,) can show; None of too few samples.

    shortest : in samples; most : as a share of the record
    """
    step, length = float(np.median(np.diff(time))), float(time[-1] - time[0])
    low, high = float(f"{shortest * step:.2g}"), float(f"{most * length:.2g}")
    return (low, high) if low < high else None


def time_grid(
    span: tuple[float, float] | None, description: str = "time constant", least: float = 1.0
) -> Mapping[str, Grid]:
    """The grid of a time [s] over a span; a wide one where none is known. least : share of its start below which the
    time does not go"""
    low, high = span or (1e-3, 1e3)
    grid = Grid(low, high, steps=6, unit="s", log=True, least=least * low, description=description)
    return {"time": grid}


@dataclass(frozen=True)
class SensorOffset(Effect):
    """A sensor whose zero is off, y + offset (in the output's unit)."""

    name = "sensor_offset"
    attaches = ("sensor",)
    kin: ClassVar[tuple[str, ...]] = ("sensor_delay",)
    sentence = "an offset of {port}"
    amplitude = Amplitude("offset", unit=None)

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """The offset."""
        del port, math
        return p.offset


@dataclass(frozen=True)
class SensorDrift(Effect):
    """A sensor whose zero wanders evenly, y + drift (t - first)/span (in the output's unit): by warming up, ageing, a
    charge that leaks.

    span : time [s] in which it is off by the drift; None takes the length of the record, 1 s where none is known
    first : time [s] at which it is right: where the record begins, of several the first one, so that a drift goes on in
        a later part of one log; start the times of records that were begun anew at the same number

    >>> SensorDrift().describe("sensor_pressure")
    'a drift of sensor_pressure by its amount within a record'
    """

    span: float | None = None
    first: float = 0.0

    name = "sensor_drift"
    attaches = ("sensor",)
    kin = ("sensor_offset", "sensor_gain", "constant_torque")
    alike = ("span", "first")
    sentence = "a drift of {port} by its amount within a record"
    amplitude = Amplitude("drift", unit=None)

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same over the length of a record, where no span was given."""
        del values
        name = port.name.partition("_")[2]
        if self.span is not None or name not in record:
            return self
        time = record[name].time
        length = float(f"{float(time[-1] - time[0]):.4g}")
        return replace(self, span=length, first=float(time[0])) if length > 0 else self

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """drift (t − first)/span."""
        del math
        return p.drift * (port.time - self.first) / (1.0 if self.span is None else self.span)


@dataclass(frozen=True)
class SensorDelay(Effect):
    """A sensor that is late by a delay τ [s], or early.

    A law at one instant cannot hold the past: it is y(t − τ) to the second order, y − τ dy/dt + τ² d²y/dt² / 2 by the
    ode; to the first order where dy/dt shows a channel at once, or jumps. Fits and simulations leave only a part of a
    sample to it: whole samples are read off the sensor's times (``retards``), which holds any delay exactly.
    """

    name = "sensor_delay"
    attaches = ("sensor",)
    kin = ("sensor_offset", "sensor_lag")
    sentence = "a delay of {port}"
    retards = True
    amplitude = Amplitude("delay", unit="s")

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """−τ dy/dt + τ² d²y/dt² / 2."""
        del math
        bend = port.bend if port.has("bend") else 0.0
        return -p.delay * port.rate + 0.5 * p.delay**2 * bend


@dataclass(frozen=True)
class SensorLag(Effect):
    """A sensor of which a share follows with a time constant τ [s], as behind a filter or in a well: with all of it
    (share 1) y − τ d(shown)/dt.

    What it is behind by, e, goes by de/dt = −dy/dt − e/τ; it shows y + share e. Where y jumps, or shows an input or
    what acts at a port at once, e is s − y with ds/dt = (y − s)/τ. A delay as long does nearly the same to motion that
    is slow beside it.

    span : the least and the largest time constant [s]; None for half a sample to a quarter of the records
    first : s where a record begins, in the unit of the output; None takes what the record shows first, 0 without one

    >>> SensorLag().describe("sensor_T_out")
    'a lag of sensor_T_out'
    """

    span: tuple[float, float] | None = None
    first: float | None = None

    name = "sensor_lag"
    attaches = ("sensor",)
    kin = ("sensor_delay", "sensor_gain")
    alike = ("span",)
    sentence = "a lag of {port}"
    amplitude = Amplitude("share", unit="1", min=0)

    @property
    def nuisance(self) -> Mapping[str, Grid]:  # type: ignore[override]
        """The time constant."""
        return time_grid(self.span)

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same from what a record shows first, with the time constants that it can show where none were given."""
        del values
        name = port.name.partition("_")[2]
        if name not in record:
            return self
        seen = record[name].values[record[name].mask]
        shown = float(seen[0]) if len(seen) else 0.0
        first = shown if self.first is None else self.first
        return replace(self, first=first, span=self.span or time_constants(record[name].time))

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """share e."""
        del math
        behind = port.state("behind")
        if port.shows_at_once or not port.has("rate"):
            return Law(
                p.share * (behind - port.value),
                {"behind": (self.first or 0.0, (port.value - behind) / p.time)},
            )
        return Law(p.share * behind, {"behind": (0.0, -port.rate - behind / p.time)})


@dataclass(frozen=True)
class SensorGain(Effect):
    """A sensor that shows too much or too little, y (1 + gain): by its calibration, or as its unit is another one.

    It is not looked for where the output is all but constant: an offset does the same there.

    >>> SensorGain().describe("sensor_speed")
    'a wrong gain of sensor_speed'
    """

    name = "sensor_gain"
    attaches = ("sensor",)
    kin = ("sensor_offset", "input_gain", "wrong_value")
    sentence = "a wrong gain of {port}"
    amplitude = Amplitude("gain", unit="1")

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """The gain's share of the output."""
        del math
        return p.gain * port.value

    def idle(self, port: Any) -> str:
        """An output that does nearly the same all the time has an offset."""
        courses = [course for course in port.courses("value") if np.isfinite(course).all()]
        if not courses:
            return ""
        values = np.concatenate(courses)
        return "an offset does the same here" if values.std() < VARIES * abs(values.mean()) else ""
