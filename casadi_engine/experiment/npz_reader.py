"""Reading a NumPy .npz archive: keys ``name [unit]``, or a mapping that says which arrays belong together."""

from __future__ import annotations

import difflib
import io
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from casadi_engine.errors import DataFileError, ExperimentError, UnitError

from .channel import Channel, Step, frozen, numbers
from .header import Request
from .source import Loaded, Source
from .units import FloatArray, as_recorded, split_header, to_si

# What NumPy and zipfile raise on damaged or hostile archives; pickled objects come as ValueError.
_DAMAGED = (
    OSError, ValueError, EOFError, KeyError, RuntimeError, NotImplementedError, MemoryError, OverflowError,
    TypeError, SyntaxError, AttributeError, IndexError, struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
KEY_RULE = "one-dimensional arrays under the keys: time [s], name [unit], ..."
MAPPING_RULE = "channels={name: (time key, values key, unit)}"


def read_npz(source: Source, request: Request, channels: Mapping[str, Sequence[str]] | None = None) -> Loaded:
    """Channels of an .npz archive; NaN in an array is a missing sample.

    channels : name -> (key of its time in s, key of its values, unit of its values); left out, the keys
    are ``time [s]`` and ``name [unit]``.
    Raises :class:`DataFileError` or :class:`UnitError` with file and key.
    """
    arrays = _Archive(source)
    if channels is None:
        made, ignored = _by_keys(arrays, request)
    else:
        made, ignored = _by_mapping(arrays, request, channels)
    if not made:
        raise DataFileError(
            f"{source.path}: no array to read beside the time",
            seen=", ".join(arrays.keys),
            allowed=KEY_RULE,
            cure=f"rename the keys, or give {MAPPING_RULE}",
        )
    arguments: dict[str, Any] = {"file": source.path}
    if channels is not None:
        arguments["channels"] = {name: list(entry) for name, entry in channels.items()}
    if request.assumed:
        arguments["assumed"] = list(request.assumed)
    longest = max(len(channel) for channel in made)
    step = Step("read_experiment", arguments, longest, longest)
    return Loaded(made, (step,), ignored, source.path, source.sha256, request.inputs)


class _Archive:
    """The arrays of an archive, read when asked for; every failure is a DataFileError."""

    def __init__(self, source: Source) -> None:
        self.path = source.path
        try:
            self._file = np.load(io.BytesIO(source.content), allow_pickle=False)
        except _DAMAGED as error:
            self._refuse(error)
        if not isinstance(self._file, np.lib.npyio.NpzFile):
            raise DataFileError(
                f"{self.path}: a single array, not an .npz archive",
                allowed=KEY_RULE,
                cure="save it by numpy.savez",
            )
        self.keys: tuple[str, ...] = tuple(self._file.files)
        self._read: dict[str, FloatArray] = {}
        self._seconds: dict[str, FloatArray] = {}

    def _refuse(self, error: BaseException) -> NoReturn:
        raise DataFileError(
            f"{self.path}: not a readable .npz archive",
            seen=f"{type(error).__name__}: {error}"[:200],
            allowed="arrays of numbers saved by numpy.savez",
            cure="save the record again by numpy.savez",
        ) from None

    def get(self, key: str) -> FloatArray:
        """The (N,) array under a key."""
        if key not in self.keys:
            near = difflib.get_close_matches(key, self.keys, n=1)
            raise DataFileError(
                f"{self.path}: key {key!r} is missing",
                seen=", ".join(self.keys),
                cure=f"did you mean {near[0]!r}?" if near else f"rename the keys, or give {MAPPING_RULE}",
            )
        if key not in self._read:
            try:
                array = self._file[key]
            except _DAMAGED as error:
                self._refuse(error)
            try:
                self._read[key] = numbers(array, what=f"{self.path}, key {key!r}")
            except ExperimentError as error:
                raise _as_file_error(error) from None
        return self._read[key]

    def seconds(self, key: str) -> FloatArray:
        """The time under a key [s]: one array for all channels on it."""
        unit = split_header(key)[1]
        if unit is None or unit == "s":
            return self.get(key)
        if key not in self._seconds:
            where = f"{self.path}, key {key!r}"
            time, kind = to_si(self.get(key), unit, where=where)
            if kind != "s":
                raise UnitError(
                    f"{where}: not a unit of time",
                    seen=unit,
                    allowed="s, ms, min, h or another unit of time",
                    cure="give the time in s",
                )
            self._seconds[key] = frozen(time, float)
        return self._seconds[key]


def _as_file_error(error: ExperimentError) -> DataFileError:
    return DataFileError(error.problem, seen=error.seen, allowed=error.allowed, cure=error.cure)


def _by_keys(arrays: _Archive, request: Request) -> tuple[tuple[Channel, ...], tuple[str, ...]]:
    times = [key for key in arrays.keys if split_header(key)[0] == "time"]
    if len(times) != 1:
        raise DataFileError(
            f"{arrays.path}: {'more than one' if times else 'no'} key for the time",
            seen=", ".join(arrays.keys),
            allowed=KEY_RULE,
            cure=f"rename the keys, or give {MAPPING_RULE}",
        )
    unit = split_header(times[0])[1]
    if unit is None:
        raise DataFileError(
            f"{arrays.path}, key 'time': no unit", allowed=KEY_RULE, cure="rename it to time [s]"
        )
    entries: dict[str, tuple[str, str, str]] = {}
    ignored: list[str] = []
    for key in arrays.keys:
        if key == times[0]:
            continue
        name, unit = split_header(key)
        if not request.wants(name):
            ignored.append(key)
            continue
        if name in entries:
            raise DataFileError(
                f"{arrays.path}, key {key!r}: a repeated name",
                seen=f"{entries[name][1]!r} and {key!r}",
                allowed="each name once",
                cure="rename or delete one of them",
            )
        if unit is None:
            raise DataFileError(
                f"{arrays.path}, key {key!r}: no unit in the key",
                allowed=KEY_RULE,
                cure=f"rename the key to {key} [unit], or give {MAPPING_RULE}",
            )
        entries[name] = (times[0], key, unit)
    _refuse_missing(arrays, request, entries)
    made = tuple(_channel(arrays, request, name, *entry) for name, entry in entries.items())
    return made, tuple(ignored)


def _by_mapping(
    arrays: _Archive, request: Request, channels: Mapping[str, Sequence[str]]
) -> tuple[tuple[Channel, ...], tuple[str, ...]]:
    used: set[str] = set()
    made: list[Channel] = []
    for name, entry in channels.items():
        if isinstance(entry, str) or len(entry) != 3 or not all(isinstance(part, str) for part in entry):
            raise ExperimentError(
                f"the entry of channel {name!r} is not three texts",
                seen=repr(entry),
                allowed=MAPPING_RULE,
                cure='write for example channels={"omega": ("omega_time_s", "omega_rad_s", "rad/s")}',
            )
        used.update(entry[:2])
        made.append(_channel(arrays, request, name, entry[0], entry[1], entry[2]))
    _refuse_missing(arrays, request, channels)
    return tuple(made), tuple(key for key in arrays.keys if key not in used)


def _refuse_missing(arrays: _Archive, request: Request, entries: Mapping[str, Any]) -> None:
    for name in request.needed:
        if name not in entries:
            raise DataFileError(
                f"{arrays.path}: channel {name!r} is missing",
                seen=", ".join(entries) or "no channel",
                allowed=f"a key {name} [unit]",
                cure="add the array, or do not ask for it",
            )


def _channel(arrays: _Archive, request: Request, name: str, time_key: str, key: str, unit: str) -> Channel:
    where = f"{arrays.path}, key {key!r}"
    values, si = to_si(arrays.get(key), unit, where=where)
    time = arrays.seconds(time_key)
    missing = np.flatnonzero(np.isnan(values))
    if name in request.inputs and missing.size:
        raise DataFileError(
            f"{where}: NaN in an input at sample {missing[0]}",
            allowed="a number in every sample of an input; only outputs may have missing samples",
            cure="fill the gap, or cut the record there",
        )
    try:
        return Channel(
            name=name,
            unit=si,
            recorded=as_recorded(unit),
            time=time,
            values=values,
            hold=request.hold,
            origin="assumed" if name in request.assumed else "measured",
        )
    except ExperimentError as error:
        problem = f"{where}: {error.problem}"
        raise DataFileError(problem, seen=error.seen, allowed=error.allowed, cure=error.cure) from None
