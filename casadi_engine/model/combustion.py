"""The torque that combustion adds: gas torque less that of a motored cylinder.

A motored cylinder compresses its charge and expands it again on one polytrope, p (V/V_bdc)ⁿ = p_bdc. Its level is
pegged on the compression side of the measured trace, before anything burns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EffectError
from casadi_engine.model.crank_slider import piston_travel

Array = NDArray[np.float64]

# Crank angles from combustion TDC [rad]: combustion is looked for between valve closing and opening, and the
# polytrope is fitted where valves are surely shut and nothing burns yet.
OPENS, SHUTS = math.radians(-75.0), math.radians(150.0)
PEG_FROM, PEG_TO = math.radians(-110.0), math.radians(-35.0)
_EDGE = 0.05
_LEAST = 8
_RATIOS = np.linspace(6.0, 24.0, 181)


@dataclass(frozen=True)
class Motored:
    """The polytrope of a motored cylinder.

    pressure : at the bottom dead centre before compression [Pa], absolute
    exponent : of the polytrope        compression_ratio : V_bdc/V_tdc
    """

    pressure: float = 0.9e5
    exponent: float = 1.33
    compression_ratio: float = 10.0

    def volume(self, angle: Any, ratio: Any) -> Any:
        """V/V_tdc at the crank angle from TDC [rad]; ratio : r/L."""
        return 1 + 0.5 * (self.compression_ratio - 1) * piston_travel(angle, ratio)

    def trace(self, angle: Any, ratio: Any) -> Any:
        """Absolute pressure [Pa] of the closed cylinder."""
        return self.pressure * (self.compression_ratio / self.volume(angle, ratio)) ** self.exponent


def burning(angle: Any) -> Any:
    """1 between intake closing and exhaust opening of a four-stroke cycle, 0 else, with rounded edges."""
    middle, half = 0.5 * (OPENS + SHUTS), 0.5 * (SHUTS - OPENS)
    # cos(angle/2) repeats after 4π, so that no cycle has to be counted
    inside = ca.cos(0.5 * (angle - middle)) - math.cos(0.5 * half)
    return 0.5 * (1 + ca.tanh(inside / _EDGE))


def combustion_torque(angle: Any, pressure: Any, lever: Any, ratio: Any, motored: Motored) -> Any:
    """Torque [N m] of the pressure that combustion adds.

    angle : of the cylinder from its combustion TDC [rad]        pressure : absolute [Pa]
    lever : torque per pressure, A_p r f(angle) [m3]        ratio : r/L
    """
    return burning(angle) * (pressure - motored.trace(angle, ratio)) * lever


def compresses(angle: Array) -> bool:
    """True if enough samples at these angles from combustion TDC [rad] lie on the compression side."""
    return int(np.count_nonzero(_on_compression(angle))) >= _LEAST


def _on_compression(angle: Array) -> NDArray[np.bool_]:
    wrapped = _wrapped(angle)
    return np.asarray((wrapped > PEG_FROM) & (wrapped < PEG_TO))


def _wrapped(angle: Array) -> Array:
    """The angle within one cycle, from −2π to 2π."""
    return np.asarray(np.mod(np.asarray(angle) + 2 * math.pi, 4 * math.pi) - 2 * math.pi)


def fit_motored(angle: Array, pressure: Array, *, ratio: float) -> Motored:
    """Peg a motored trace on the compression side of a measured pressure.

    angle : (N,) rad from combustion TDC        pressure : (N,) Pa        ratio : r/L
    Level and exponent are fitted by least squares of log p for compression ratios from 6 to 24, and the best is
    taken. EffectError if no sample lies on the compression side, or the fit is no compression.
    """
    wrapped, values = _wrapped(angle), np.asarray(pressure, dtype=float)
    used = _on_compression(angle) & (values > 0)
    if np.count_nonzero(used) < _LEAST:
        raise EffectError(
            "the motored pressure cannot be pegged",
            seen=f"{np.count_nonzero(used)} samples between -110 and -35 degrees from combustion TDC",
            allowed=f"{_LEAST} or more, with pressure above 0",
            cure="give a record that holds a compression stroke, with absolute pressure",
        )
    log_p = np.log(values[used])
    # a straight line of log p over -log(V/V_bdc) for every compression ratio
    travel, middle = piston_travel(wrapped[used], ratio), log_p.mean()
    cost, level, exponent = (np.empty(len(_RATIOS)) for _ in range(3))
    for k, compression in enumerate(_RATIOS):
        x = -np.log((1 + 0.5 * (compression - 1) * travel) / compression)
        apart = x - x.mean()
        exponent[k] = float(apart @ log_p) / float(apart @ apart)
        level[k] = middle - exponent[k] * x.mean()
        rest = log_p - middle - exponent[k] * apart
        cost[k] = float(rest @ rest)
    cost[(exponent <= 1.0) | (exponent >= 1.7)] = math.inf
    best = int(np.argmin(cost))
    if not math.isfinite(cost[best]):
        raise EffectError(
            "the motored pressure cannot be pegged",
            seen="a trace that does not rise like a compression",
            allowed="a polytropic exponent between 1 and 1.7",
            cure="check the pressure's offset and the crank angle's zero (combustion TDC of cylinder 1)",
        )
    return Motored(float(np.exp(level[best])), float(exponent[best]), float(_RATIOS[best]))
