"""Absolute cylinder pressure from a sensor without a zero: every cycle is pegged on the polytrope of its compression.

A piezoelectric sensor shows changes of pressure alone: what it shows lacks a p_0 of its own in every cycle. While the
valves are shut and nothing burns the charge follows (p + p_0) V^n = C: for a given n both p_0 and C are a straight
line's (Brunt and Pond, SAE 970036; Lee, Yoon and Sunwoo 2008, Control Engineering Practice 16, 922-929).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.errors import ExperimentError

from .channel import Channel
from .conditioning import changed
from .header import name_list
from .holes import refuse_holes
from .pressures import FIRING_1342, tdc_of
from .slicing import crank_angle, finite
from .units import FloatArray

if TYPE_CHECKING:
    from .experiment import Experiment

# A compression counts with so many samples, over so much of the window.
_LEAST, _COVERED = 8, 0.8
# Exponents among which the best is looked for: from an isotherm to what no charge reaches.
_LOWEST, _HIGHEST = 1.0, 1.7


def peg_pressures(
    experiment: Experiment,
    names: Iterable[str] | str,
    *,
    compression_ratio: float,
    rod_ratio: float,
    exponent: float | None,
    window: tuple[float, float],
    offsets: Mapping[str, float] | None,
    theta: str,
    cycle_length: float,
) -> Experiment:
    """Pressures with the p_0 of each cycle added."""
    chosen = name_list(names, "channels")
    compression, ratio, low, high = _checked(chosen, compression_ratio, rod_ratio, window, cycle_length)
    tdc = FIRING_1342 if offsets is None else offsets
    done: dict[str, Channel] = {}
    found: dict[str, Any] = {}
    for name in chosen:
        channel = experiment[name]
        if channel.unit != "Pa":
            raise ExperimentError(
                f"channel {name!r} is not a pressure", seen=channel.unit, allowed="Pa", cure="name a pressure"
            )
        refuse_holes(
            experiment,
            experiment[theta],
            "the cycles of the pressure are not known across the hole",
            "split the record there by split_at_holes(), and peg the pressures of the pieces",
        )
        time, crank = crank_angle(experiment, theta)
        angle = np.interp(channel.time, time, crank) - tdc_of(tdc, name)
        cycle = np.floor(angle / cycle_length + 0.5)
        angle -= cycle_length * cycle
        inside = channel.mask & (channel.time >= time[0]) & (channel.time <= time[-1])
        inside &= (angle > low) & (angle < high)
        volume = _volume(angle, compression, ratio)
        whole = [k for k in np.unique(cycle) if _is_whole(angle[inside & (cycle == k)], high - low)]
        rows = [inside & (cycle == k) for k in whole]
        pieces = [(volume[row], channel.values[row]) for row in rows]
        if not pieces:
            raise ExperimentError(
                f"no cycle of pressure {name!r} can be pegged",
                seen=f"no compression of {_LEAST} samples or more over {_COVERED:.0%} of the window",
                allowed="a record that holds a compression stroke of the cylinder",
                cure="give a longer record, or check offsets and window",
            )
        n = _exponent(name, pieces) if exponent is None else finite(exponent, "the exponent")
        lifts = np.array([_lift(name, v, p, n) for v, p in pieces])
        nearest = np.abs(cycle[:, None] - np.array(whole)[None, :]).argmin(axis=1)
        done[name] = dataclasses.replace(channel, values=channel.values + lifts[nearest])
        found[name] = {"exponent": n, "added": lifts.tolist()}
    arguments = {
        "compression_ratio": compression,
        "rod_ratio": ratio,
        "window": [low, high],
        "pegged": found,
    }
    return changed(experiment, "peg_pressures", arguments, done)


def _volume(angle: FloatArray, compression: float, ratio: float) -> FloatArray:
    """V/V_tdc at the angle from TDC; ratio : r/L (Heywood 1988, equation 2.6)."""
    sine = np.sin(angle) ** 2
    travel = 1 - np.cos(angle) + ratio * sine / (1 + np.sqrt(1 - ratio**2 * sine))
    return np.asarray(1 + 0.5 * (compression - 1) * travel)


def _is_whole(angle: FloatArray, width: float) -> bool:
    return len(angle) >= _LEAST and float(np.ptp(angle)) >= _COVERED * width


def _line(volume: FloatArray, pressure: FloatArray, n: float) -> tuple[float, float, float]:
    """p_0, C and the sum of squares of p + p_0 = C V^-n."""
    shape = volume**-n
    apart = shape - shape.mean()
    level = float(apart @ pressure) / float(apart @ apart)
    lift = level * float(shape.mean()) - float(pressure.mean())
    rest = pressure + lift - level * shape
    return lift, level, float(rest @ rest)


def _lift(name: str, volume: FloatArray, pressure: FloatArray, n: float) -> float:
    lift, level, _ = _line(volume, pressure, n)
    if level <= 0:
        raise ExperimentError(
            f"pressure {name!r} does not rise like a compression",
            seen=f"a change of {level:.3g} Pa over the polytrope, in a cycle",
            allowed="a pressure that rises with falling volume in the window",
            cure="check the offsets (combustion TDC of each cylinder), the sign of the sensor and the window",
        )
    return lift


def _exponent(name: str, pieces: list[tuple[FloatArray, FloatArray]]) -> float:
    """The exponent of all cycles together with the least sum of squares."""
    from scipy import optimize

    def cost(n: float) -> float:
        return math.fsum(_line(volume, pressure, n)[2] for volume, pressure in pieces)

    found = float(optimize.minimize_scalar(cost, bounds=(_LOWEST, _HIGHEST), method="bounded").x)
    if min(found - _LOWEST, _HIGHEST - found) < 1e-3:
        raise ExperimentError(
            f"no polytropic exponent fits the compression of pressure {name!r}",
            seen=f"best at the end of the range, {found:.3g}",
            allowed=f"more than {_LOWEST:g}, less than {_HIGHEST:g}",
            cure="give the exponent, such as 1.32; or check offsets, window and compression_ratio",
        )
    return found


def _checked(
    names: tuple[str, ...],
    compression_ratio: float,
    rod_ratio: float,
    window: tuple[float, float],
    cycle_length: float,
) -> tuple[float, float, float, float]:
    if not names:
        raise ExperimentError(
            "peg_pressures was given no channel", cure='name the pressures: peg_pressures(("p1", "p2"), ...)'
        )
    compression = finite(compression_ratio, "the compression ratio")
    ratio = finite(rod_ratio, "the rod ratio")
    if compression <= 1 or not 0 <= ratio < 1:
        raise ExperimentError(
            "the geometry of the cylinder is not acceptable",
            seen=f"compression_ratio = {compression:g}, rod_ratio = {ratio:g}",
            allowed="compression_ratio > 1 and 0 <= rod_ratio < 1",
            cure="give V_bdc/V_tdc, and the crank radius over the rod's length",
        )
    try:
        low, high = (finite(end, "an end of the window") for end in window)
    except (TypeError, ValueError):
        low, high = 0.0, 0.0
    if not -cycle_length / 2 <= low < high <= 0:
        raise ExperimentError(
            "the window of the compression is not acceptable",
            seen=repr(window),
            allowed="two angles [rad] before combustion TDC, the first the smaller: (-1.9, -0.6)",
            cure="give the angles between the closing of the intake valve and the beginning of combustion",
        )
    return compression, ratio, low, high
