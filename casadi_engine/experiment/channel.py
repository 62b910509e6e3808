"""One measured quantity with its own time, and one line of an experiment's history."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ExperimentError, UnitError

from .units import FloatArray, read_unit

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

HOLDS = ("first", "zero")
ORIGINS = ("measured", "assumed", "derived")
RATE_TOLERANCE = 1e-6

# A name becomes a column header on writing, so it may hold nothing that a header gives a meaning to.
_BAD_NAME = re.compile(r"[\[\],\"\x00-\x1f\x7f\ud800-\udfff]")


def check_channel_name(name: Any, *, where: str = "") -> str:
    """Return the name if it may name a channel; raise :class:`ExperimentError` otherwise."""
    opening = f"{where}: " if where else ""
    allowed = "text without brackets, commas, double quotes and control characters; 'time' is reserved"
    if not isinstance(name, str) or not name or name != name.strip() or _BAD_NAME.search(name):
        raise ExperimentError(
            f"{opening}not a channel name", seen=repr(name), allowed=allowed, cure="rename the channel"
        )
    if name == "time":
        raise ExperimentError(
            f"{opening}a channel cannot be called 'time'", allowed=allowed, cure="rename the channel"
        )
    return name


def _is_frozen(array: Any) -> bool:
    """True when nobody can write into the array, so that it may be shared instead of copied."""
    while isinstance(array, np.ndarray):
        if array.flags.writeable:
            return False
        array = array.base
    return array is None


def frozen(values: Any, dtype: type) -> NDArray[Any]:
    """Read-only array with the values: the same object if it is read-only already, a copy otherwise."""
    if type(values) is np.ndarray and values.dtype == np.dtype(dtype) and _is_frozen(values):
        return values
    array: NDArray[Any] = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array


def numbers(values: Any, *, what: str) -> FloatArray:
    """Read-only (N,) float array; raises :class:`ExperimentError` for anything else."""
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(float), np.nan)
    try:
        array = np.asarray(values)
    except (ValueError, TypeError):
        array = np.asarray(None)
    if array.ndim != 1 or array.dtype.kind not in "fiu":
        raise ExperimentError(
            f"{what} is not a list of real numbers",
            seen=f"{type(values).__name__} of shape {array.shape} and type {array.dtype}",
            allowed="a one-dimensional array of floats or integers",
            cure="convert it first, for example numpy.asarray(values, dtype=float).ravel()",
        )
    if array.dtype == np.float64:
        return frozen(array, float)
    with np.errstate(over="ignore"):  # a long double may not fit: it becomes inf and is refused below
        return frozen(array, float)


def sampling_rate(time: FloatArray, tolerance: float = RATE_TOLERANCE) -> float | None:
    """Rate [1/s] when the (N,) times lie on a uniform grid within ``tolerance`` steps, else None."""
    with np.errstate(over="ignore", invalid="ignore"):
        step = (time[-1] - time[0]) / (time.size - 1)
        grid = time[0] + step * np.arange(time.size)
        off = np.max(np.abs(time - grid))
        if not np.isfinite(step) or step < np.finfo(float).tiny or not off <= tolerance * step:
            return None
        return float(1.0 / step)


@dataclass(frozen=True)
class Step:
    """One line of history: what was done to an experiment.

    function : name of the verb. arguments : JSON-able. rows_in, rows_out : samples of the longest channel
    that it touched, before and after.
    """

    function: str
    arguments: Mapping[str, Any]
    rows_in: int
    rows_out: int

    def to_dict(self) -> dict[str, Any]:
        """JSON-able dict with the four fields."""
        return {
            "function": self.function,
            "arguments": dict(self.arguments),
            "rows_in": self.rows_in,
            "rows_out": self.rows_out,
        }

    def __str__(self) -> str:
        arguments = ", ".join(f"{key}={value!r}" for key, value in self.arguments.items())
        return f"{self.function}({arguments}): {self.rows_in} -> {self.rows_out} samples"


@dataclass(frozen=True, eq=False)
class Channel:
    """One quantity on its own time axis.

    name : its key in the experiment.  unit : of the values; readers convert to SI, `Experiment.in_units` to any other.
    time : (N,) s, strictly increasing, N >= 2.
    values : (N,) in ``unit``; NaN where the sample is missing.
    mask : (N,) bool, True = valid sample; left out, every sample that is not NaN is valid.
    hold : "first" (straight line between samples) or "zero" (the sample holds until the next).
    origin : "measured", "assumed" or "derived".
    rows : (N,) row of each sample in the source file (the header is row 1); empty when not from a file.
    bridge : what it does where rows are missing, "hold" or "join"; empty if that was not said (`Experiment.bridged`).
    recorded : the unit in which the numbers stood that were read, empty if they were given in ``unit``.

    The arrays are copies and read-only. Raises :class:`ExperimentError` or :class:`UnitError` by name.

    >>> omega = Channel("omega", "rad/s", time=[0.0, 0.1, 0.2], values=[125.0, float("nan"), 126.0])
    >>> omega.mask
    array([ True, False,  True])
    >>> omega.rate
    10.0
    """

    name: str
    unit: str
    time: FloatArray
    values: FloatArray
    mask: BoolArray = field(default_factory=lambda: np.ones(0, dtype=bool))
    hold: str = "first"
    origin: str = "measured"
    rows: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64), repr=False)
    bridge: str = field(default="", repr=False)
    recorded: str = field(default="", repr=False, compare=False)

    def __post_init__(self) -> None:
        check_channel_name(self.name)
        what = f"channel {self.name!r}"
        own = read_unit(self.unit, where=what)
        if self.recorded and not read_unit(self.recorded, where=what).compatible(own):
            raise UnitError(
                f"{what} was recorded in a unit of another dimension",
                seen=f"{self.recorded} for {self.unit}",
                allowed="a unit that its values can be converted from",
                cure="leave `recorded` out",
            )
        _one_of(self.hold, HOLDS, f"{what}: unknown hold")
        _one_of(self.origin, ORIGINS, f"{what}: unknown origin")
        time = numbers(self.time, what=f"the time of {what}")
        values = numbers(self.values, what=what)
        self._check_numbers(what, time, values)
        mask, values = self._mask_and_values(what, values)
        store = {"time": time, "values": values, "mask": mask, "rows": self._rows(what, time.size)}
        for key, value in store.items():
            object.__setattr__(self, key, value)

    def _check_numbers(self, what: str, time: FloatArray, values: FloatArray) -> None:
        if time.size != values.size:
            raise ExperimentError(
                f"{what} has values and times of different number",
                seen=f"{values.size} values, {time.size} times",
                allowed="as many values as times",
                cure="give the channel as a pair (time, values) if it has its own time",
            )
        if time.size < 2:
            raise ExperimentError(
                f"{what} has fewer than two samples",
                seen=f"{time.size}",
                allowed="two or more",
                cure="keep a longer piece or a smaller resampling factor",
            )
        if not np.isfinite(time).all():
            index = int(np.flatnonzero(~np.isfinite(time))[0])
            raise ExperimentError(
                f"the time of {what} is not finite at sample {index}",
                seen=f"{time[index]}",
                allowed="finite times",
                cure="leave those samples out",
            )
        later = time[1:] > time[:-1]
        if not later.all():
            index = int(np.flatnonzero(~later)[0]) + 1
            raise ExperimentError(
                f"the time of {what} does not increase at sample {index}",
                seen=f"{float(time[index])!r} after {float(time[index - 1])!r}",
                allowed="strictly increasing times",
                cure="sort the samples and leave out repeated ones",
            )
        if np.isinf(values).any():
            index = int(np.flatnonzero(np.isinf(values))[0])
            raise ExperimentError(
                f"{what} is not finite at sample {index}",
                seen=f"{values[index]}",
                allowed="finite numbers, or NaN for a missing sample",
                cure="mark the sample as missing by NaN",
            )

    def _mask_and_values(self, what: str, values: FloatArray) -> tuple[BoolArray, FloatArray]:
        present = ~np.isnan(values)
        given = np.asarray(self.mask)
        if given.size:
            if given.shape != values.shape or given.dtype != np.bool_:
                raise ExperimentError(
                    f"the mask of {what} does not fit",
                    seen=f"shape {given.shape}, type {given.dtype}",
                    allowed=f"shape {values.shape}, type bool, True for a valid sample",
                    cure="give one truth value for each sample",
                )
            if (given & present).sum() < present.sum():
                values = frozen(np.where(given, values, np.nan), float)
                present = ~np.isnan(values)
        return frozen(present, bool), values

    def _rows(self, what: str, size: int) -> IntArray:
        rows = frozen(self.rows, np.int64)
        if rows.shape not in ((0,), (size,)):
            raise ExperimentError(
                f"the row numbers of {what} do not fit",
                seen=f"shape {rows.shape}",
                allowed=f"shape ({size},) or none",
                cure="leave the row numbers out",
            )
        return rows

    def __len__(self) -> int:
        return int(self.time.size)

    @property
    def rate(self) -> float | None:
        """Sampling rate [1/s] if the time is uniform within 1e-6 of a step, else None."""
        return sampling_rate(self.time)

    @property
    def span(self) -> tuple[float, float]:
        """First and last time [s]."""
        return float(self.time[0]), float(self.time[-1])

    @property
    def missing(self) -> int:
        """Number of samples that are not valid."""
        return int(self.mask.size - self.mask.sum())


def _one_of(value: Any, allowed: tuple[str, ...], problem: str) -> None:
    if value not in allowed:
        raise ExperimentError(
            problem, seen=value, allowed=", ".join(allowed), cure="choose one of the allowed words"
        )
