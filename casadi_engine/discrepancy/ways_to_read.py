"""The usual ways in which a record is stated wrong: a sign, a unit, a clock, two columns in each other's place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from casadi_engine.discrepancy.exchanged_units import exchanges
from casadi_engine.experiment import Channel, Experiment
from casadi_engine.experiment.units import NOT_STATED, converted, read_unit
from casadi_engine.model import Model
from casadi_engine.model.declarations import Variable

_PREFIX = "a prefix, milli or kilo, that was not stated or not meant"
# Factors of a time that is taken for seconds, or was made of them.
_CLOCKS = {
    1e-3: "milliseconds stated as seconds", 1e3: "seconds stated as milliseconds", 60.0: "minutes stated as seconds",
    1 / 60.0: "seconds stated as minutes",
}  # fmt: skip
_TIME = "the time"
# Units of temperatures, and what has to be added to numbers of one scale that are labelled with the other.
_SCALES = ("K", "degC")
_LABELLED = {273.15: "numbers in degC labelled K", -273.15: "numbers in K labelled degC"}
# Channels of one unit beyond which no two of them are looked at in each other's place: a wiring of so many is looked
# at as a whole.
_CHANNELS = 8


@dataclass(frozen=True)
class Reading:
    """A way to read the records: channels, or the time, times a factor and plus a number, or two channels exchanged.

    what : "input", "output", "time", "exchange", or "numbers" for two channels of unlike units; names : of channels;
    words : what is done, for a sentence;
    check : what may be wrong; named : a search for effects tells it, by the sensor or the input
    """

    what: str
    names: tuple[str, ...]
    words: str
    check: str
    factor: float = 1.0
    plus: float = 0.0
    named: bool = False

    def of(self, record: Experiment) -> Experiment:
        """The record read so."""
        if self.what == "time":
            begin = None if record.begin is None else self.factor * record.begin
            return replace(record, channels=tuple(self._later(c) for c in record.channels), begin=begin)
        if self.what in ("exchange", "numbers"):
            if any(name not in record for name in self.names):
                return record
            one, other = (record[name] for name in self.names)
            return record.with_channel(_as(one, other)).with_channel(_as(other, one))
        for name in self.names:
            if name in record:
                own = record[name]
                record = record.with_channel(replace(own, values=self.factor * own.values + self.plus))
        return record

    def _later(self, channel: Channel) -> Channel:
        return replace(channel, time=self.factor * channel.time)


def _as(one: Channel, other: Channel) -> Channel:
    """A channel with the numbers that were recorded for another one, in the unit that it is said to have."""
    values = other.values
    if one.recorded != other.recorded:
        values = converted(values, other.unit, other.recorded) if other.recorded else values
        values = converted(values, one.recorded, one.unit) if one.recorded else values
    return replace(one, time=other.time, values=values, mask=other.mask, rows=other.rows)


def readings(model: Model, data: Sequence[Experiment], *, every: bool = False) -> list[Reading]:
    """The usual ways in which a record is stated wrong, one at a time, of channels that move; the most usual first.

    Of one output among several those are left out that a search for effects tells, unless ``every`` one is asked for.
    """
    found = []
    moving = [one for one in model.inputs if any(np.ptp(record[one.name].values) > 0 for record in data)]
    for variable in moving:
        words = f"the input {variable.name} reversed"
        found.append(Reading("input", (variable.name,), words, "look at its sign", -1.0))
        found += _units("input", variable.name, variable.unit)
    outputs = [variable for variable in model.outputs if any(variable.name in record for record in data)]
    every = every or len(outputs) == 1
    for variable in outputs:
        words = f"the output {variable.name} reversed"
        own = [Reading("output", (variable.name,), words, "look at its sign", -1.0, named=True)]
        own += _units("output", variable.name, variable.unit)
        found += [one for one in own if every or not one.named]
    for factor, words in _CLOCKS.items():
        found.append(Reading("time", (), f"{_TIME} times {factor:.4g} ({words})", "look at its unit", factor))
    found = sorted(found, key=lambda one: (one.factor != -1.0, one.what != "time", _PREFIX not in one.words))
    usual = sum(one.factor == -1.0 or one.what == "time" for one in found)
    # a look is as cheap at two columns exchanged as at one of the many units
    found[usual:usual] = [
        *_exchanged(moving), *_exchanged(outputs), *(_across(moving, outputs) if every else ()),
    ]  # fmt: skip
    found += _temperatures("input", moving)
    return [*found, *(one for one in _temperatures("output", outputs) if every or not one.named)]


def _units(what: str, name: str, unit: str) -> Iterator[Reading]:
    """Numbers in a unit that is taken for that of the channel, or a prefix that is not its own; none of a temperature,
    whose usual units have another zero."""
    if unit in _SCALES:
        return
    found: dict[float, str] = {}
    for right, label, ratio in exchanges(unit):
        found.setdefault(float(f"{1 / ratio:.6g}"), f"numbers in {right} labelled {label}")
    told = set(found) if what == "output" else set()
    for factor in (1e-3, 1e3):
        found.setdefault(factor, _PREFIX)
    for factor, words in found.items():
        said = f"the {what} {name} times {factor:.4g} ({words})"
        yield Reading(what, (name,), said, "look at its unit", factor, named=factor in told)


def _exchanged(channels: Sequence[Variable]) -> Iterator[Reading]:
    """Two channels of one dimension, each with the numbers of the other."""
    alike: dict[object, list[str]] = {}
    for one in channels:
        kind = NOT_STATED if one.unit == NOT_STATED else read_unit(one.unit).dimension
        alike.setdefault(kind, []).append(one.name)
    for names in alike.values():
        if len(names) <= _CHANNELS:
            for pair in combinations(names, 2):
                words = f"{pair[0]} and {pair[1]} exchanged"
                yield Reading("exchange", pair, words, "look which column is which")


def _across(inputs: Sequence[Variable], outputs: Sequence[Variable]) -> Iterator[Reading]:
    """Two channels of different units under each other's heading."""
    crossed = [(one, other) for one in inputs for other in outputs]
    for pairs in (crossed, list(combinations(inputs, 2)), list(combinations(outputs, 2))):
        for one, other in [pair for pair in pairs if not _of_one_kind(*pair)][:_CHANNELS]:
            words = f"the numbers of {one.name} and {other.name} exchanged"
            yield Reading("numbers", (one.name, other.name), words, "look which column is which")


def _of_one_kind(one: Variable, other: Variable) -> bool:
    """True of two units of one dimension, or neither of which is stated."""
    if NOT_STATED in (one.unit, other.unit):
        return one.unit == other.unit
    return read_unit(one.unit).dimension == read_unit(other.unit).dimension


def _temperatures(what: str, channels: Sequence[Variable]) -> Iterator[Reading]:
    """Temperatures in degrees Celsius taken for kelvin, or the other way round: each channel, and all of them."""
    names = [one.name for one in channels if one.unit in _SCALES]
    groups = [(name,) for name in names] + ([tuple(names)] if len(names) > 1 else [])
    for group in groups:
        which = f"the {what}{'s' * (len(group) > 1)} {' and '.join(group)}"
        told = what == "output" and len(group) == 1  # by the offset of a sensor
        for plus, words in _LABELLED.items():
            sign = "plus" if plus > 0 else "minus"
            said = f"{which} {sign} {abs(plus)} ({words})"
            yield Reading(what, group, said, "look at its unit", plus=plus, named=told)
