"""Inputs that act as more or less than what is recorded, behind it, or later."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from casadi_engine.effects.protocol import Amplitude, Effect, Grid, Law
from casadi_engine.effects.sensor import SHORTEST, VARIES, SensorGain, SensorOffset, time_constants, time_grid
from casadi_engine.effects.torque import ConstantTorque


@dataclass(frozen=True)
class InputOffset(SensorOffset):
    """An input that acts as u + offset (in its unit): by its calibration, the dead time or the rest of its actuator.

    It is not looked for where a constant at a port does the same, which has that name, nor at the pressures of
    cylinders, whose zero is found on their compression (``Experiment.peg_pressures``).

    >>> InputOffset().describe("input_duty")
    'an offset of input_duty'
    """

    name = "input_offset"
    attaches = ("input",)
    kin = ("constant_torque", "sensor_offset", "input_gain")

    def idle(self, port: Any) -> str:
        """Where a constant does the same."""
        if port.in_engine:
            return "the zero of a pressure is found on its compression, Experiment.peg_pressures"
        place = port.same_constant(ConstantTorque.attaches)  # where it is looked for itself
        return f"constant_torque at {place} does the same" if place else ""


@dataclass(frozen=True)
class InputGain(SensorGain):
    """An input that acts more or less than its channel says, u (1 + gain): by its calibration or its actuator's.

    >>> InputGain().describe("input_valve")
    'a wrong gain of input_valve'
    """

    name = "input_gain"
    attaches = ("input",)
    kin = ("sensor_gain", "wrong_value", "cylinder_imbalance")

    def idle(self, port: Any) -> str:
        """As of a sensor; a crank angle is counted in turns."""
        return "a crank angle is counted in turns" if port.name == "input_theta" else super().idle(port)


# Share of its mean below which the variation of an input is what acts, beside a constant: nearly all that the whole of
# it does would be that constant, which an air pressure is not to be blamed for.
_STEADY = 0.1


@dataclass(frozen=True)
class InputPath(Effect):
    """An input that acts at a further port, in proportion: gain u, as a force of which a part is taken by a neighbour,
    or the sun on a wall that the model has not.

    It acts at a path, ``u_to_a`` from the input u to the port a. Looked at are inputs of the unit of what acts there,
    those that act so at another port, as the sun by an area on the air, and those that no equation uses: who records
    one expects that it matters. Of an input that hardly varies about its
    mean, as an air pressure or a room's temperature in K, it is the variation: gain (u − mean).

    about : what is taken off the input, in its unit; None for the mean of such a one, 0 of any other

    >>> InputPath().describe("sun_to_room")
    'the input sun acts at room'
    """

    about: float | None = None

    name = "input_path"
    attaches = ("path",)
    kin = ("input_gain", "constant_torque", "viscous_friction")
    alike = ("about",)
    sentence = "the input {port}"
    amplitude = Amplitude("gain", unit="N m/rad")

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """gain (u - about)."""
        del math
        return p.gain * (port.input - (self.about or 0.0))

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same about the mean of an input that hardly varies."""
        del values
        name = port.name.partition("_to_")[0]
        if self.about is not None or name not in record:
            return self
        known = record[name].values[record[name].mask]
        mean, spread = (float(np.mean(known)), float(np.std(known))) if len(known) else (0.0, 0.0)
        if not 0 < spread < _STEADY * abs(mean):
            return self
        short = float(f"{mean:.4g}")  # as it is printed
        return replace(self, about=short if abs(short - mean) < spread else mean)

    def _called(self, port: str) -> str:
        """Both ends."""
        return port.replace("_to_", " acts at ", 1)


@dataclass(frozen=True)
class _Behind(Effect):
    """An input of which a share acts behind what is recorded.

    span : the least and the largest time [s]; None for ``shortest`` samples to a quarter of the records
    first : what acts where a record begins, in the input's unit
    """

    span: tuple[float, float] | None = None
    first: float = 0.0

    attaches = ("input",)
    alike = ("span",)
    amplitude = Amplitude("share", unit="1", min=0)
    time: ClassVar[str] = ""
    shortest: ClassVar[float] = SHORTEST

    @property
    def nuisance(self) -> Mapping[str, Grid]:  # type: ignore[override]
        """The time."""
        # the law of a delay is to move no faster than it is integrated; what is read off the record may be any
        return time_grid(self.span, self.time, 1 / (2 * self.shortest) if self.delays else 1.0)

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The same at rest where a record begins, with the times that it can show where none were given."""
        del values
        name = port.name.partition("_")[2]
        if name not in record:
            return self
        known = record[name].values[record[name].mask]
        first = float(known[0]) if len(known) else 0.0
        span = self.span or time_constants(record[name].time, self.shortest)
        if (
            self.span is None and span is not None and self.delays
        ):  # which sensors show that are faster than the input
            steps = [
                float(np.median(np.diff(record[n].time))) for n in record.names if len(record[n].time) > 1
            ]
            span = min(span[0], float(f"{self.shortest * min(steps):.2g}")), span[1]
        return replace(self, first=first, span=span)

    def idle(self, port: Any) -> str:
        """An input that stays as it is comes late to nothing; a pressure and a crank angle are measured where they
        act."""
        if port.in_engine or port.name == "input_theta":
            return "it is measured where it acts"
        courses = [course for course in port.courses("value") if np.isfinite(course).all()]
        constant = courses and all(np.ptp(course) <= VARIES * np.abs(course).max() for course in courses)
        return "it is constant on every record" if constant else ""


@dataclass(frozen=True)
class InputLag(_Behind):
    """An input of which a share acts behind what is recorded, with a time constant τ [s], as through a valve, a heater
    or a motor that its command does not show: with all of it (share 1) the input f acts, by df/dt = (u − f)/τ.

    The answer of a linear model to one input is the same where its only sensor is behind by as much.

    >>> InputLag().describe("input_valve")
    'a lag of input_valve'
    """

    name = "input_lag"
    kin = ("input_delay", "sensor_lag", "input_gain")
    sentence = "a lag of {port}"
    time = "time constant"

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """share (f − u)."""
        del math
        acts = port.state("acts")
        return Law(p.share * (acts - port.value), {"acts": (self.first, (port.value - acts) / p.time)})


@dataclass(frozen=True)
class InputDelay(_Behind):
    """An input of which a share acts a time τ [s] later than recorded, as over a belt, a pipe or a bus: with all of it
    (share 1) u(t − τ).

    What a record holds is read off it (``delays``), by fits and simulations; before its first sample an input is what
    it is there. Searches begin with the Padé approximant of orders 2 and 3, which shows the way from afar:
    x − 2/5 ẋ + ẍ/20 with x + 3/5 ẋ + 3/20 ẍ + (d³x/ds³)/60 = u, in the time s = t/τ; a fit keeps it where that leaves
    less, as what is no delay may look like it.

    Where the states do not know the time, all outputs are the same where every sensor is late by as much.

    >>> InputDelay().describe("input_feed")
    'a delay of input_feed'
    """

    name = "input_delay"
    kin = ("input_lag", "sensor_delay")
    sentence = "a delay of {port}"
    time = "delay"
    delays = "time"
    shortest = 2.0  # the approximant's own motion is five times as fast

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """share (x − 2/5 ẋ + ẍ/20 − u)."""
        del math
        x, rate, bend = (port.state(name) for name in ("passes", "rate", "bend"))
        third = 60 * (port.value - x) - 36 * rate - 9 * bend
        states = {
            "passes": (self.first, rate / p.time),
            "rate": (0.0, bend / p.time),
            "bend": (0.0, third / p.time),
        }
        return Law(p.share * (x - 2 / 5 * rate + bend / 20 - port.value), states)
