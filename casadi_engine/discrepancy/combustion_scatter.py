"""The scatter of combustion from cycle to cycle: random amplitudes of known shapes, and their most likely level."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.null_model import FOUR_STROKE, RecordNull
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.model.combustion import combustion_torque, compresses, fit_motored
from casadi_engine.simulation.candidate_sensitivities import Direction, torque_direction

# A cylinder's cycle is told from the next one a quarter turn before its combustion TDC.
_BEFORE = np.pi / 2
_LOWEST, _HIGHEST = 1e-6, 1.0


@dataclass(frozen=True, eq=False)
class Scatter:
    """Random amplitudes of one kind in one record; ``kind`` names their standard deviation in the noise model."""

    kind: str
    record: str
    directions: tuple[Direction, ...]


def combustion_scatter(
    model: Model, record: RecordNull, *, cylinders: Sequence[str], kind: str = "combustion"
) -> Scatter:
    """One direction per cylinder port and cycle: the torque of that combustion times a relative amplitude.

    The torque is that above the motored trace pegged on the record, as in the effects of combustion; where the record
    holds no compression the port's ``combustion_torque``, or ``gas_torque`` where the model knows no other.
    Raises ModelError for an unknown port.
    """
    directions = []
    for name in cylinders:
        angle, torque = model.ports[name].signals["angle"], _burned(model, record, name)
        found = record.path.function([angle])(*record.path.at_samples().arguments)[0]
        first, last = (math.floor((float(a) + _BEFORE) / FOUR_STROKE) for a in (found.min(), found.max()))
        for number in range(first, last + 1):
            low = FOUR_STROKE * number - _BEFORE
            inside = (angle >= low) * (angle < low + FOUR_STROKE)
            directions.append(torque_direction(model, name, inside * torque, name=f"{kind} {name} {number}"))
    return Scatter(kind, record.name, tuple(directions))


def _burned(model: Model, record: RecordNull, name: str) -> Any:
    """The torque of combustion [N m] at a cylinder port."""
    signals = model.ports[name].signals
    if {"pressure", "lever", "rod_ratio"} <= set(signals):
        wanted = [signals["angle"], signals["pressure"], signals["rod_ratio"]]
        found = record.path.function(wanted)(*record.path.at_samples().arguments)[0]
        angle, pressure, ratio = np.broadcast_to(found, (3, record.path.grid.samples))
        if compresses(angle):
            motored = fit_motored(angle, pressure, ratio=float(ratio[0]))
            return combustion_torque(
                signals["angle"], signals["pressure"], signals["lever"], signals["rod_ratio"], motored
            )
    return signals.get("combustion_torque", signals["gas_torque"])


def assumed_cylinders(record: Experiment) -> tuple[str, ...]:
    """Ports of the cylinders whose pressure was not measured but taken from another one."""
    return tuple(
        f"cylinder_{name[1:]}"
        for name in record.names
        if re.fullmatch(r"p\d+", name) and record[name].origin == "assumed"
    )


def scatter_likelihood(scatter: Array, rest: Array, tau: float) -> float:
    """-2 log likelihood of e = G c + noise, c ~ N(0, tau^2), noise ~ N(0, 1), but for a constant.

    scatter : (m, g) and rest : (m,) whitened, free of what the parameters explain
    """
    energy, directions = np.linalg.eigh(scatter.T @ scatter)
    energy = np.maximum(energy, 0.0)
    projected = directions.T @ (scatter.T @ rest)
    gain = tau**2 / (1 + tau**2 * energy)
    return float(np.log1p(tau**2 * energy).sum() - (projected**2 * gain).sum())


def scatter_level(scatter: Array, rest: Array) -> float:
    """The standard deviation of the scatter amplitudes that is most likely; arguments as ``scatter_likelihood``."""
    from scipy import optimize

    if not scatter.shape[1]:
        return 0.0
    energy, directions = np.linalg.eigh(scatter.T @ scatter)
    energy = np.maximum(energy, 0.0)
    square = (directions.T @ (scatter.T @ rest)) ** 2

    def cost(log_tau: float) -> float:
        variance = math.exp(2 * log_tau)
        return float((np.log1p(variance * energy) - square * variance / (1 + variance * energy)).sum())

    found = optimize.minimize_scalar(cost, bounds=(math.log(_LOWEST), math.log(_HIGHEST)), method="bounded")
    return math.exp(float(found.x)) if float(found.fun) < 0 else 0.0
