"""Experiments from arrays and data frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.errors import ExperimentError, UnitError

from .channel import Channel, Step, check_channel_name, frozen, numbers
from .header import name_list
from .source import Loaded
from .units import FloatArray, as_recorded, split_header, to_si

if TYPE_CHECKING:
    import pandas as pd


def load_arrays(
    channels: Mapping[str, Any],
    *,
    time: Any,
    units: Mapping[str, str],
    hold: str | Mapping[str, str] = "first",
    origin: str | Mapping[str, str] = "measured",
    inputs: Iterable[str] = (),
    function: str = "from_arrays",
) -> Loaded:
    """Channels from arrays: the work of ``Experiment.from_arrays``."""
    names = tuple(check_channel_name(name) for name in channels)
    if not names:
        raise ExperimentError("no channel given", cure="give the arrays by keyword: omega=values")
    inputs = name_list(inputs, "inputs")
    units = _mapping(units, "units")
    for option, given in (("inputs", inputs), *_options(units, hold, origin)):
        for name in given:
            if name not in (*names, *(("time",) if option == "units" else ())):
                raise ExperimentError(
                    f"{option} speaks of a channel that is not there",
                    seen=repr(name),
                    allowed=", ".join(names),
                    cure="correct the name",
                )
    common = None if time is None else _seconds(numbers(time, what="the time"), units.get("time", "s"))
    made = tuple(_channel(name, data, common, units, hold, origin) for name, data in channels.items())
    for channel in made:
        if channel.name in inputs and channel.missing:
            index = int(np.flatnonzero(~channel.mask)[0])
            raise ExperimentError(
                f"input {channel.name!r} is missing at sample {index}",
                seen=f"NaN at {channel.time[index]:g} s",
                allowed="a number in every sample of an input; only outputs may have missing samples",
                cure="fill the gap, or cut the record there",
            )
    longest = max(len(channel) for channel in made)
    step = Step(function, {"channels": list(names)}, longest, longest)
    return Loaded(made, (step,), inputs=inputs)


def _mapping(units: Any, option: str) -> dict[str, str]:
    """The units by channel, or an error that shows the form."""
    if isinstance(units, Mapping) and all(isinstance(name, str) for name in units):
        return dict(units)
    raise UnitError(
        f"{option} is not a mapping from channel to unit",
        seen=repr(units),
        allowed="one unit for every channel",
        cure=f'write {option}={{"omega": "rad/s", "T": "N m"}}',
    )


def _word(given: Any, name: str, option: str, usual: str) -> str:
    """The hold or origin of a channel, from one word for all or a mapping by name."""
    if isinstance(given, str):
        return given
    if isinstance(given, Mapping):
        return given.get(name, usual)
    raise ExperimentError(
        f"{option} is not acceptable",
        seen=repr(given),
        allowed="one word for all channels, or a mapping from channel to word",
        cure=f'write {option}="{usual}", or leave it out',
    )


def _options(units: Any, hold: Any, origin: Any) -> list[tuple[str, Any]]:
    return [
        (option, given)
        for option, given in (("units", units), ("hold", hold), ("origin", origin))
        if isinstance(given, Mapping)
    ]


def _seconds(time: FloatArray, unit: str) -> FloatArray:
    values, kind = to_si(time, unit, where="the time")
    if kind != "s":
        raise UnitError(
            "the time has no unit of time",
            seen=unit,
            allowed="s, ms, min, h or another unit of time",
            cure="give it in s",
        )
    return frozen(values, float) if unit != "s" else time


def _channel(
    name: str,
    data: Any,
    common: FloatArray | None,
    units: Mapping[str, str],
    hold: str | Mapping[str, str],
    origin: str | Mapping[str, str],
) -> Channel:
    if name not in units:
        raise UnitError(
            f"no unit given for channel {name!r}",
            seen=f"units of {', '.join(units) or 'nothing'}",
            allowed="a unit for every channel, 1 when dimensionless",
            cure=f"add it to units: {{{name!r}: ...}}",
        )
    time: FloatArray | None
    if isinstance(data, tuple):
        if len(data) != 2:
            raise ExperimentError(
                f"channel {name!r} is a tuple of {len(data)}",
                allowed="an array on the common time, or a pair (time, values)",
                cure="give the values as an array",
            )
        own = numbers(data[0], what=f"the time of channel {name!r}")
        time, data = _seconds(own, units.get("time", "s")), data[1]
    else:
        time = common
    if time is None:
        raise ExperimentError(
            f"channel {name!r} has no time",
            allowed="an array on the common time, or a pair (time, values)",
            cure="give time= or a pair",
        )
    values, unit = numbers(data, what=f"channel {name!r}"), units[name]
    _, in_si = to_si(np.zeros(0), unit, where=f"channel {name!r}")
    if in_si != unit:  # else the array that was given may be shared
        values, unit = to_si(values, unit)
    return Channel(
        name=name,
        unit=unit,
        recorded=as_recorded(units[name]),
        time=time,
        values=values,
        hold=_word(hold, name, "hold", "first"),
        origin=_word(origin, name, "origin", "measured"),
    )


def load_frame(
    frame: pd.DataFrame,
    *,
    units: Mapping[str, str] | None = None,
    hold: str | Mapping[str, str] = "first",
    origin: str | Mapping[str, str] = "measured",
    inputs: Iterable[str] = (),
) -> Loaded:
    """Channels from a data frame: the work of ``Experiment.from_dataframe``."""
    if not all(hasattr(frame, part) for part in ("columns", "index", "iloc")):
        raise ExperimentError(
            "this is not a data frame",
            seen=type(frame).__name__,
            allowed="a pandas DataFrame",
            cure="make one, or use Experiment.from_arrays",
        )
    given = {} if units is None else _mapping(units, "units")
    labels: list[Any] = list(frame.columns)
    channels: dict[str, Any] = {}
    time: Any = None
    if frame.index.name is not None and split_header(str(frame.index.name))[0] == "time":
        labels, columns = [frame.index.name, *labels], [frame.index.to_numpy()]
    else:
        columns = []
    columns += [frame.iloc[:, position].to_numpy() for position in range(frame.shape[1])]
    seen: set[str] = set()
    for label, column in zip(labels, columns, strict=True):
        if not isinstance(label, str):
            raise ExperimentError(
                "a column's label is not text", seen=repr(label), allowed="name [unit]", cure="rename it"
            )
        name, unit = split_header(label)
        if name in seen:
            raise ExperimentError(
                f"column {label!r} is repeated", allowed="each name once", cure="rename or drop one of them"
            )
        seen.add(name)
        if unit is not None and given.setdefault(name, unit) != unit:
            raise UnitError(
                f"column {label!r} and units= disagree",
                seen=given[name],
                allowed=unit,
                cure="give the unit once",
            )
        if name == "time":
            time = column
        else:
            channels[name] = column
    if time is None:
        raise ExperimentError(
            "the data frame has no column for the time",
            seen=", ".join(str(label) for label in labels),
            allowed="a column, or the index, called time [s]",
            cure="rename the column",
        )
    return load_arrays(
        channels, time=time, units=given, hold=hold, origin=origin, inputs=inputs, function="from_dataframe"
    )
