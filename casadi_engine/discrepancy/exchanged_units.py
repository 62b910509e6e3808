"""Units that are taken for one another: what a sensor shows whose numbers have another unit than its label; and what no
sensor does."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from casadi_engine.experiment.units import CONFUSED, NOT_STATED, read_unit

if TYPE_CHECKING:
    from casadi_engine.discrepancy.refit import Addition
    from casadi_engine.experiment import Experiment
    from casadi_engine.model import Model

# Gain by which a sensor may be wrong that shows its own unit; factor by which a stated value may be; how near to a
# ratio of units a larger one has to be.
WRONG, _STATED, _NEAR = 0.5, 5.0, 0.05
# Factors of a sensor whose sign is turned, or of whose encoder twice or four times the edges are counted.
_MISREAD = (-1.0, 2.0, 4.0)
# Share of its signal with which a sensor may lag: with all of it, but for errors; where these are larger, a delay does
# as well.
LAG, _WHOLE = "sensor_lag", 1.1
# Standard errors by which it does so clearly.
_CLEARLY = 2.0
# Effects by which an input is late, with all of it but for errors and for what else is missing.
BEHIND = ("input_lag", "input_delay")
# All by which a channel is late.
LATE = (LAG, "sensor_delay", *BEHIND)
# Share of a lag that a lead of the same sensor may take back.
_TAKEN_BACK = 0.1
# Share of the shortest time within which a time is the shortest one.
_AT = 1e-3
# Share of a record by which a sensor may be late: with a longer delay most of what it shows is of no time that was
# simulated.
_LATE = 0.5


def exchanges(unit: str) -> Iterator[tuple[str, str, float]]:
    """(unit of the numbers, unit on the label, by how much they are too large) for a channel of this unit."""
    if unit == NOT_STATED:
        return
    own = read_unit(unit)
    for name in CONFUSED:
        other = read_unit(name)
        times, over, plus = own.steps_to(other)
        ratio = times / over
        if own.dimension == other.dimension and ratio != 1 and not plus:
            yield name, unit, ratio
            yield unit, name, 1 / ratio


def impossible(
    effects: Sequence[Addition], values: Mapping[str, float], model: Model, data: Sequence[Experiment]
) -> bool:
    """True if an effect would be what none is: see ``impossible_gain``; a delay of a sensor by more than half of a
    record; a lag and a lead of one sensor; or a small share of an input that is late, or far more than all of it."""
    shortest = min(record.duration for record in data)
    late = (
        abs(values.get(one.amplitude, 0.0)) > _LATE * shortest
        for one in effects
        if getattr(one.candidate.source.effect, "retards", False)
    )
    partly = (
        abs(values.get(one.amplitude, 1.0) - 1) > WRONG
        for one in effects
        if one.candidate.effect in BEHIND and not is_shortest(one, values)
    )
    return (
        any(late)
        or any(partly)
        or _early_and_behind(effects, values)
        or impossible_gain(effects, values, model)
    )


def _early_and_behind(effects: Sequence[Addition], values: Mapping[str, float]) -> bool:
    """True if a sensor would be behind by a lag and early by a good part of it: the two take each other back, and what
    is left of both is no sensor's."""
    for one in effects:
        if one.candidate.effect != LAG:
            continue
        time = values.get(f"{one.key}.time", one.nuisance["time"].start) * min(
            values.get(one.amplitude, 1.0), 1.0
        )
        for other in effects:
            early = other.candidate.effect == "sensor_delay" and other.candidate.port == one.candidate.port
            if early and values.get(other.amplitude, 0.0) < -_TAKEN_BACK * time:
                return True
    return False


def is_shortest(one: Addition, values: Mapping[str, float]) -> bool:
    """True of an input that is late by the shortest time that is searched: how much of it is so stands for a shorter
    one."""
    shortest = one.nuisance["time"].start
    return (
        values.get(f"{one.key}.time", math.inf) <= shortest * (1 + _AT)
        and values.get(one.amplitude, 0.0) <= 1
    )


def more_than_whole(
    effects: Sequence[Addition], values: Mapping[str, float], errors: Mapping[str, float | None]
) -> bool:
    """True of a sensor that would lag with clearly more than all of its signal, beyond errors too: none does, but a
    delay, and a filter of a higher order, are nearly that."""
    for one in effects:
        beyond = values.get(one.amplitude, 0.0) - 1
        if (
            one.candidate.effect == LAG
            and beyond > _WHOLE - 1
            and beyond > _CLEARLY * (errors.get(one.amplitude) or 0.0)
        ):
            return True
    return False


def impossible_gain(effects: Sequence[Addition], values: Mapping[str, float], model: Model) -> bool:
    """True if a sensor would show half as much too much, or more, an input act five times as much as it says or the
    other way round, or a stated value be of the other sign or wrong by a factor of five, and that is no ratio of units,
    nor what a channel shows that is read wrong."""
    for one in effects:
        allowed: tuple[float, ...] = ()
        factor, at = 1 + values.get(one.amplitude, 0.0), one.candidate.port
        if one.candidate.effect == "sensor_gain" and abs(factor - 1) > WRONG:
            units, allowed = [out.unit for out in model.outputs if at == f"sensor_{out.name}"], _MISREAD
        elif one.candidate.effect == "input_gain" and not 0 <= factor <= _STATED:
            units, allowed = [own.unit for own in model.inputs if at == f"input_{own.name}"], _MISREAD
        elif one.amplitude.endswith(".wrong_value.share") and not 1 / _STATED <= factor <= _STATED:
            units = [model.parameters()[at.removeprefix("parameter_")].unit]
        else:
            continue
        ratios = [share for unit in units for *_, share in exchanges(unit)]
        if not any(abs(factor / share - 1) <= _NEAR for share in (*ratios, *allowed)):
            return True
    return False
