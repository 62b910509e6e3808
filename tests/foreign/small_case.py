"""One small model as a new user would write it, with its record; and its truth by SciPy, written apart.

All truths are in SI; a record is in the units that its user has. States keep the unit of the model.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from small_truth import Pieces, solve

import casadi_engine as ce

Array = NDArray[np.float64]
Values = dict[str, Any]

# Unit of a record -> (factor, offset) to SI.
TO_SI: dict[str, tuple[float, float]] = {
    "rpm": (np.pi / 30, 0.0), "deg": (np.pi / 180, 0.0), "deg/s": (np.pi / 180, 0.0), "bar": (1e5, 0.0),
    "degC": (1.0, 273.15), "mm": (1e-3, 0.0), "ms": (1e-3, 0.0), "L/min": (1e-3 / 60, 0.0), "h": (3600.0, 0.0),
    "mg/L": (1e-3, 0.0), "km/h": (1 / 3.6, 0.0), "mA": (1e-3, 0.0), "kN": (1e3, 0.0), "min": (60.0, 0.0),
    "mg/s": (1e-6, 0.0), "mg": (1e-6, 0.0), "cm": (1e-2, 0.0), "mol/L": (1e3, 0.0), "mV": (1e-3, 0.0),
}  # fmt: skip


def to_si(values: Any, unit: str) -> Array:
    """Numbers of a record in SI."""
    factor, offset = TO_SI.get(unit, (1.0, 0.0))
    return np.asarray(values, dtype=float) * factor + offset


def from_si(values: Any, unit: str) -> Array:
    """SI numbers in a record's unit."""
    factor, offset = TO_SI.get(unit, (1.0, 0.0))
    return (np.asarray(values, dtype=float) - offset) / factor


@dataclass(frozen=True, eq=False)
class Case:
    """One model, one record, one parameter.

    build : the model from the parameters' values. rates : dx/dt (t, x, p, u) or, with `switch`, (t, x, p, u, s), for
    SciPy. outputs : name -> SI values from (t, x, p, u). start : state -> value at the first time.
    units : channel (and "time", if not s) -> unit of the record. time : (N,) s, of the outputs.
    inputs : name -> (time [s], values in the record's unit). hold : of the inputs.
    breaks : instants at which the rates jump or bend, from p. switch : the function g(x, p) whose sign is s in `rates`
    free : the parameter to recover. guess : where its search starts
    known_start : the initial state is given to the fit; else the fit finds it. level : noise by the range of an output
    method : of SciPy; Radau for stiff ones. cause : words of which a refusal must name one
    """

    name: str
    build: Callable[[Values], ce.Model]
    rates: Callable[..., Any]
    outputs: Mapping[str, Callable[..., Any]]
    p: Mapping[str, float]
    start: Mapping[str, float]
    units: Mapping[str, str]
    time: Array
    free: str
    guess: float
    inputs: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
    hold: str = "first"
    breaks: Callable[[Values], Any] | None = None
    switch: Callable[..., Any] | None = None
    known_start: bool = False
    method: str = "DOP853"
    level: float = 2e-3
    cause: tuple[str, ...] = ()

    @property
    def pieces(self) -> Pieces:
        """The inputs in SI, between whose samples SciPy starts anew."""
        made = {
            name: (np.asarray(t, dtype=float), to_si(v, self.units[name]))
            for name, (t, v) in self.inputs.items()
        }
        return Pieces(made, self.hold)

    @property
    def first(self) -> float:
        """Time at which the initial state holds."""
        return float(min([self.time[0], *(t[0] for t, _ in self.inputs.values())]))

    def truth(self, time: Array, p: Mapping[str, float] | None = None, start: Any = None) -> dict[str, Array]:
        """SI values of each output at the times."""
        values = dict(self.p if p is None else p)
        x0 = np.array(list(self.start.values()) if start is None else start, dtype=float)
        breaks = tuple(self.breaks(values)) if self.breaks else ()
        x = solve(self.rates, values, x0, self.first, time, self.pieces, breaks, self.switch, self.method)
        u = self.pieces.at(time)
        return {
            name: np.broadcast_to(np.asarray(f(time, x, values, u), dtype=float), time.shape)
            for name, f in self.outputs.items()
        }

    @cached_property
    def clean(self) -> dict[str, Array]:
        """The truth at the times of the record."""
        return self.truth(self.time)

    def sigma(self) -> dict[str, float]:
        """Standard deviation of the noise of each output, in the record's unit."""
        return {
            name: self.level * float(np.ptp(from_si(y, self.units[name]))) for name, y in self.clean.items()
        }

    def record(self, *, noisy: bool) -> ce.Experiment:
        """The experiment that the user has."""
        rng = np.random.default_rng(zlib.crc32(self.name.encode()))
        unit = self.units.get("time", "s")
        channels: dict[str, Any] = {
            name: (from_si(t, unit), np.asarray(v, dtype=float)) for name, (t, v) in self.inputs.items()
        }
        sigma = self.sigma()
        for name, y in self.clean.items():
            noise = rng.normal(0, sigma[name], len(y)) if noisy else 0.0
            channels[name] = (from_si(self.time, unit), from_si(y, self.units[name]) + noise)
        return ce.Experiment.from_arrays(self.name, units=dict(self.units), hold=self.hold, **channels)


# ---- samplings: times [s] of outputs


def equal(last: float, count: int, first: float = 0.0) -> Array:
    """Equal steps, both ends included."""
    return np.linspace(first, last, count)


def jittered(last: float, count: int, seed: int = 1) -> Array:
    """Equal steps with up to 40 % of a step of jitter; the first and last stay."""
    time = np.linspace(0, last, count)
    time[1:-1] += np.random.default_rng(seed).uniform(-0.4, 0.4, count - 2) * time[1]
    return time


def bursts(last: float, count: int, length: int) -> Array:
    """Bursts of `length` samples, a thousandth of the span apart each, spread over the span."""
    begin = np.linspace(0, last * (1 - length * 1e-3), count)
    return (begin[:, None] + last * 1e-3 * np.arange(length)).ravel()


def twelve(last: float) -> Array:
    """12 unequal samples, dense at first, as blood is drawn."""
    return last * np.array([0, 0.01, 0.02, 0.04, 0.07, 0.11, 0.17, 0.26, 0.38, 0.55, 0.75, 1.0])


CASES: dict[str, Case] = {}


def case(make: Callable[[], Case]) -> Callable[[], Case]:
    """Put the case into the list."""
    made = make()
    CASES[made.name] = made
    return make
