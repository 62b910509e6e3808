"""Torques from outside on an inertia: a constant one, a load that comes or goes, and an impulse."""

from __future__ import annotations

import math as _math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from casadi_engine.effects.protocol import Amplitude, Effect, Grid

# Width of an event in samples of the record, and of an impulse where no record is known [s].
_SAMPLES, _SHORT = 1.0, 0.01


@dataclass(frozen=True)
class ConstantTorque(Effect):
    """A torque that no channel tells of; positive accelerates. In a pipe it flows from the first end to the second.

    >>> from casadi_engine import two_mass
    >>> ConstantTorque().worded(two_mass().ports["load"])
    'a constant torque on load'
    """

    name = "constant_torque"
    attaches = ("inertia", "pipe")
    kin = ("coulomb_friction", "load_step")
    sentence = "a constant {effort} on {port}"
    neutral = "a constant {effort} into {port}"
    neutral_negative = "a constant {effort} out of {port}, a negative amount into it"
    amplitude = Amplitude("torque", unit="N m")

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """T."""
        del port, math
        return p.torque

    def worded(self, port: Any) -> str:
        """The clause; in a pipe with both ends."""
        if not port.ends:
            return super().worded(port)
        first, second = port.ends
        return f"a constant {port.quantity} from {first} to {second}"


@dataclass(frozen=True)
class LoadStep(Effect):
    """A load that is switched on (positive) or off (negative) within the record; it brakes.

    ``effects.by_record`` gives it a time of its own in each of several records. At zero torque nothing depends on its
    time: start a fit at a torque near the right one.

    width : over which it is switched in fits [s]; None is at once. A repair takes one sample of the record: the impulse
        is the same, the time moves the simulation smoothly, and a linear model stays one
    """

    width: float | None = None

    name = "load_step"
    attaches = ("inertia",)
    kin = ("constant_torque", "misfire")
    limit, limit_at = "constant_torque", "time"  # one that begins with the record was there all along
    sentence = "a load at {port} that comes or goes during the record"
    neutral = "a {effort} out of {port} that begins or ends during the record"
    neutral_negative = (
        "a {effort} into {port} that begins or ends during the record, a negative amount out of it"
    )
    amplitude = Amplitude("torque", unit="N m")
    nuisance = {"time": Grid(0.02, 0.98, steps=49, unit="s", over="time")}  # noqa: RUF012 (read only)

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The effect with a width of one sample of the record, where none was given."""
        del port, values
        return self if self.width is not None else replace(self, width=_one_sample(record))

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """−T for t > t_0."""
        since = port.time - p.time
        if math.sharp or not self.width:
            return -p.torque * math.step(since, width=0.0)
        return -0.5 * p.torque * (1 + math.tanh(since / self.width))


@dataclass(frozen=True)
class Impulse(Effect):
    """A blow: a torque of known short duration at one time of the record, of which the data show the impulse alone.

    The torque is ∫T dt · exp(−((t − t_0)/w)²) / (w √π). ``effects.by_record`` gives it a time in each record.

    width : w [s]; None takes one sample of the record, 0.01 s where none is known

    >>> from casadi_engine import two_mass
    >>> two_mass().with_effect(Impulse(), at="load").parameter_names[-2:]
    ('load.impulse.impulse', 'load.impulse.time')
    """

    width: float | None = None

    name = "impulse"
    attaches = ("inertia",)
    kin = ("load_step",)
    sentence = "a blow on {port}"
    neutral = "a short pulse of {effort} into {port}"
    amplitude = Amplitude("impulse", unit="N m s")
    nuisance = {"time": Grid(0.02, 0.98, steps=97, unit="s", over="time")}  # noqa: RUF012 (read only)

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The effect with a width of one sample of the record, where none was given."""
        del port, values
        return self if self.width is not None else replace(self, width=_one_sample(record))

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """The impulse, spread over the width."""
        width = _SHORT if self.width is None else self.width
        away = (port.time - p.time) / width
        return p.impulse * math.exp(-(away**2)) / (width * _math.sqrt(_math.pi))


def _one_sample(record: Any) -> float:
    """The width of an event [s]: a sample of the fastest channel of the record, which shows how sharp it is."""
    gaps = [np.median(np.diff(record[name].time)) for name in record.names if len(record[name].time) > 1]
    gap = float(min(gaps, default=_SHORT))
    return float(f"{_SAMPLES * gap:.3g}")
