"""Cylinder pressures that were not measured, made from those that were."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.errors import ExperimentError

from .channel import Channel, Step, check_channel_name
from .holes import refuse_holes
from .slicing import crank_angle, finite
from .units import FloatArray

if TYPE_CHECKING:
    from .experiment import Experiment

# Combustion TDC [rad] of each cylinder's pressure for the firing order 1-3-4-2, evenly spaced over 4 pi.
FIRING_1342: Mapping[str, float] = {"p1": 0.0, "p3": math.pi, "p4": 2 * math.pi, "p2": 3 * math.pi}


def shift_pressures(
    experiment: Experiment,
    pairs: Mapping[str, str],
    *,
    offsets: Mapping[str, float] | None,
    theta: str,
    cycle_length: float,
) -> Experiment:
    """New pressure channels, each a measured one shifted by its firing offset."""
    if not isinstance(pairs, Mapping) or not pairs:
        raise ExperimentError(
            "no pressure to make",
            seen=repr(pairs),
            allowed="{new: measured}",
            cure='write {"p3": "p1", "p4": "p2"}',
        )
    tdc = FIRING_1342 if offsets is None else offsets
    cycle_length = finite(cycle_length, "cycle_length")
    if cycle_length <= 0:
        raise ExperimentError(
            "cycle_length is not positive",
            seen=f"{cycle_length:g}",
            allowed="4 pi (four-stroke), 2 pi (two-stroke)",
        )
    made: list[Channel] = []
    for new, old in pairs.items():
        _check_pair(experiment, new, old)
        for name in (old, theta):
            refuse_holes(
                experiment,
                experiment[name],
                "the shifted pressure would run across the hole",
                "split the record there by split_at_holes(), and shift the pressures of the pieces",
            )
        shift = tdc_of(tdc, new) - tdc_of(tdc, old)
        made.append(_shifted(experiment, new, experiment[old], shift, theta, cycle_length))
    rows = max(len(channel) for channel in made)
    arguments: dict[str, Any] = {
        "pairs": dict(pairs),
        "offsets": {name: float(tdc[name]) for name in dict.fromkeys([*pairs, *pairs.values()])},
        "theta": theta,
        "cycle_length": cycle_length,
    }
    inputs = experiment.inputs
    if inputs:
        # A pressure made from an input is an input as well.
        inputs = tuple(dict.fromkeys((*inputs, *(new for new, old in pairs.items() if old in inputs))))
    return dataclasses.replace(
        experiment,
        channels=(*experiment.channels, *made),
        history=(*experiment.history, Step("shift_pressures", arguments, rows, rows)),
        inputs=inputs,
    )


def _check_pair(experiment: Experiment, new: str, old: str) -> None:
    check_channel_name(new, where="shift_pressures")
    if new in experiment.names:
        raise ExperimentError(
            f"channel {new!r} is there already",
            seen=f"origin {experiment[new].origin}",
            allowed="a new name",
            cure=f"take it out first: without({new!r})",
        )
    source = experiment[old]
    if source.unit != "Pa":
        raise ExperimentError(
            f"channel {old!r} is not a pressure", seen=source.unit, allowed="Pa", cure="name a pressure"
        )
    if source.missing:
        raise ExperimentError(
            f"pressure {old!r} has missing samples, so it cannot be shifted",
            seen=f"{source.missing} of {len(source)} missing",
            allowed="no missing sample",
            cure="cut the record there",
        )


def tdc_of(offsets: Mapping[str, float], name: str) -> float:
    """Combustion TDC [rad] of a pressure."""
    if not isinstance(offsets, Mapping) or name not in offsets:
        raise ExperimentError(
            f"no firing offset of pressure {name!r}",
            seen=", ".join(map(str, offsets)) if isinstance(offsets, Mapping) else repr(offsets),
            allowed="the combustion TDC [rad] of every pressure",
            cure=f"give offsets={{{name!r}: ...}}",
        )
    return finite(offsets[name], f"the firing offset of {name!r}")


def _shifted(
    experiment: Experiment, new: str, source: Channel, shift: float, theta: str, cycle_length: float
) -> Channel:
    """p_new(theta) = p_old(theta - shift), taken from a neighbouring cycle where the record ends."""
    time, crank = crank_angle(experiment, theta)
    if source.time[0] < time[0] or source.time[-1] > time[-1]:
        raise ExperimentError(
            f"the crank angle {theta!r} does not cover pressure {source.name!r}",
            seen=f"{time[0]:.9g} to {time[-1]:.9g} s",
            allowed=f"at least {source.span[0]:.9g} to {source.span[1]:.9g} s",
            cure="cut the record to where both are there",
        )
    angle = np.interp(source.time, time, crank)
    known, values = _closed_cycle(angle, source.values, cycle_length)
    low, high = known[0], known[-1]
    wanted = angle - (shift - cycle_length * round(shift / cycle_length))
    wanted = np.where(wanted < low, wanted + cycle_length, wanted)
    wanted = np.where(wanted > high, wanted - cycle_length, wanted)
    if wanted.min() < low or wanted.max() > high:
        raise ExperimentError(
            f"the record is too short to shift pressure {source.name!r}",
            seen=f"{(angle[-1] - angle[0]) / cycle_length:.3g} engine cycles",
            allowed="one engine cycle or more",
            cure="give a longer record",
        )
    return dataclasses.replace(source, name=new, values=np.interp(wanted, known, values), origin="assumed")


def _closed_cycle(
    angle: FloatArray, values: FloatArray, cycle_length: float
) -> tuple[FloatArray, FloatArray]:
    """Close a record of one cycle that ends a step before it would repeat."""
    gap = cycle_length - (angle[-1] - angle[0])
    if 0.0 < gap <= 2 * float(np.median(np.diff(angle))):
        return np.append(angle, angle[0] + cycle_length), np.append(values, values[0])
    return angle, values
