"""Receptances of a linear core: what an output answers to a sinusoidal torque."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_engine.errors import ModelError
from casadi_engine.model.model import Model
from casadi_engine.parameters import Parameters, near_matches

# s = jω + this share of ω: a millionth of damping keeps models without dampers finite at their resonances.
_DAMPING = 1e-6


@dataclass(frozen=True, eq=False)
class Receptance:
    """Complex amplitudes of outputs over those of torques, per frequency.

    hz : (N,) Hz        outputs, torques : names        units : of the outputs
    values : (N, ny, m) complex, H(j2πf) = C (j2πf I − A)⁻¹ B + D, in the output's unit per N m
    """

    hz: NDArray[np.float64]
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    torques: tuple[str, ...]
    values: NDArray[np.complex128]

    def __post_init__(self) -> None:
        self.hz.setflags(write=False)
        self.values.setflags(write=False)

    def error(self, other: Receptance) -> NDArray[np.float64]:
        """(N,) ‖H_other − H‖/‖H‖ at each frequency, over all outputs and torques together."""
        size = np.linalg.norm(self.values, axis=(1, 2))
        apart = np.linalg.norm(other.values - self.values, axis=(1, 2))
        return np.divide(apart, size, out=np.zeros_like(size), where=size > 0)


def receptance(
    model: Model,
    hz: ArrayLike,
    parameters: Parameters | Mapping[str, float] | None = None,
    *,
    torques: Sequence[str] | None = None,
) -> Receptance:
    """Work out the receptances of a model's linear core; laws are left out.

    hz : (N,) frequencies > 0 [Hz]      parameters : as in `Model.parameter_vector`
    torques : names of drives or of ports that take a torque; None: the drives that enter the core, and cylinders
        whose torque is a law, without those that are combinations of others
    ModelError for a general model, an unknown torque, or frequencies that are not > 0.
    """
    at = np.atleast_1d(np.asarray(hz, dtype=float))
    if model.linear is None:
        raise ModelError(
            f"the model {model.name} has no receptances, because it has no linear core",
            seen="equations that are not affine in states and drives",
            allowed="a model with model.linear",
            cure="move the nonlinear terms into laws of ports (Blueprint.port, Blueprint.law)",
        )
    if at.ndim != 1 or not at.size or not np.all(np.isfinite(at) & (at > 0)):
        raise ModelError(
            "the frequencies are not acceptable",
            seen=repr(hz),
            allowed="one or more finite numbers > 0, in Hz",
            cure="give numpy.geomspace(1, 500, 400), for instance",
        )
    core = model.linear
    matrices = ca.Function(
        "core", [model.p], [ca.densify(m) for m in (core.A, core.B, core.G, core.C, core.D)]
    )
    a, b, g, c, d = (np.array(part.full()) for part in matrices(model.parameter_vector(parameters)))
    drives = [variable.name for variable in model.drives]
    slots = [port.name for port in model.ports.with_slot]
    columns = dict(zip(slots, g.T, strict=True)) | dict(zip(drives, b.T, strict=True))
    straight = dict(zip(drives, d.T, strict=True))
    names = _default_torques(model, columns) if torques is None else _checked(torques, columns)
    inputs = np.array([columns[name] for name in names]).reshape(len(names), len(a)).T
    through = np.array([straight.get(name, np.zeros(len(c))) for name in names]).reshape(len(names), len(c)).T
    outputs = tuple(variable.name for variable in model.outputs)
    units = tuple(variable.unit for variable in model.outputs)
    return Receptance(at, outputs, units, tuple(names), response(a, inputs, c, at) + through)


def response(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], hz: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """(N, ny, m) C (sI − A)⁻¹ B at s = j2πf, for A (n, n), B (n, m), C (ny, n) and frequencies hz (N,)."""
    s = 2 * math.pi * hz * (1j + _DAMPING)
    states = np.linalg.solve(s[:, None, None] * np.eye(len(a)) - a, np.broadcast_to(b, (len(hz), *b.shape)))
    return np.asarray(c @ states, dtype=complex)


def _default_torques(model: Model, columns: Mapping[str, NDArray[np.float64]]) -> list[str]:
    """Drives and cylinders that act, without those whose torque is a combination of the ones before."""
    wanted = [variable.name for variable in model.drives]
    wanted += [port.name for port in model.ports if port.kind == "cylinder"]
    names: list[str] = []
    basis: list[NDArray[np.float64]] = []
    for name in wanted:
        column = columns[name]
        rest = column - sum((one * (one @ column) for one in basis), np.zeros_like(column))
        if np.linalg.norm(rest) > 1e-9 * np.linalg.norm(column):
            basis.append(rest / np.linalg.norm(rest))
            names.append(name)
    return names


def _checked(names: Sequence[str], columns: Mapping[str, object]) -> list[str]:
    for name in names:
        if name not in columns:
            raise ModelError(
                "there is no such torque",
                seen=repr(name),
                allowed=near_matches(name, columns),
                cure="name drives, or ports that take a torque",
            )
    return list(names)
