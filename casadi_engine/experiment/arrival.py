"""Channels in the units that a model declares."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from casadi_engine.errors import UnitError

from .channel import Channel
from .conditioning import changed
from .units import NOT_STATED, converted, read_unit

if TYPE_CHECKING:
    from .experiment import Experiment


def in_units(experiment: Experiment, units: Mapping[str, str]) -> Experiment:
    """Convert channels; the same object if nothing is to be converted. See ``Experiment.in_units``."""
    done: dict[str, Channel] = {}
    for name, unit in units.items():
        channel = experiment[name]
        target = read_unit(channel.unit).si if unit == NOT_STATED else unit
        if channel.unit == target:
            continue
        check_dimension(experiment, channel, target)
        if read_unit(channel.unit).steps_to(read_unit(target)) == (1.0, 1.0, 0.0):
            continue
        values = converted(channel.values, channel.unit, target)
        done[name] = dataclasses.replace(channel, unit=target, values=values)
    if not done:
        return experiment
    arguments: dict[str, Any] = {name: channel.unit for name, channel in done.items()}
    return changed(experiment, "in_units", arguments, done)


def check_dimension(experiment: Experiment, channel: Channel, unit: str) -> None:
    """Raise :class:`UnitError` unless the channel's values can be told in the unit."""
    own, wanted = read_unit(channel.unit), read_unit(unit, where=f"channel {channel.name!r}")
    if own.compatible(wanted):
        return
    cure = (
        "correct the unit in the header if the data are in another one, or declare the variable in the model with "
        f"unit={own.si!r}, or another unit of that dimension"
    )
    if own.si == "kg" and wanted.si == "m/s2":
        cure = "g is the gram: write gn for the acceleration of gravity as a unit"
    if _without_angle(own.exponents) == _without_angle(wanted.exponents):
        cure = "1/s may count revolutions: write rad/s, rpm or rev/s in both places, or 1/s in both"
    raise UnitError(
        f"{experiment.place}, column {channel.name!r}: the unit is of another dimension than the model declares",
        seen=f"{channel.unit} in the data (dimension {own.dimension})",
        allowed=f"{unit} (dimension {wanted.dimension}), or a unit that is converted to it",
        cure=cure,
    )


def _without_angle(exponents: tuple[tuple[str, Any], ...]) -> dict[str, Any]:
    return {base: power for base, power in exponents if base != "rad"}
