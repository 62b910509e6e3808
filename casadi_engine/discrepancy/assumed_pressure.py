"""Assumed pressures as parameters: how a cylinder may differ from the one whose pressure it was given.

A pressure that was not measured, but taken from another cylinder and shifted, is wrong in known ways: combustion burns
stronger or weaker, in all cycles and from one to the next, earlier or later, and the charge is larger or smaller. With

    p = p_assumed + (5 % s + tau a_k) p_burned + 1 deg b dp/d(delay) + 2 % c p_motored

s, b, c (all cycles) and a_k (cycle k) are parameters with standard normal priors, so that the fit simulates with the
most likely pressure and everything after it counts with what is not known. Counting the scatter as noise neglects how
its response changes with the parameters; it moves the fit, and false alarms follow.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import null_space

from casadi_engine.discrepancy.combustion_scatter import assumed_cylinders, scatter_level
from casadi_engine.discrepancy.linear_algebra import Array, basis, inverse, triangle, without
from casadi_engine.discrepancy.null_model import NullModel, null_model
from casadi_engine.discrepancy.start import Start
from casadi_engine.estimation import Fit, estimate
from casadi_engine.experiment import Experiment
from casadi_engine.experiment.channel import Channel
from casadi_engine.model import Model
from casadi_engine.model.combustion import Motored, burning, compresses, fit_motored
from casadi_engine.model.declarations import ParameterDeclaration, Port, Variable
from casadi_engine.model.port_view import PortView
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise

# Standard deviations of what all cycles of a cylinder have in common: cylinders of one engine differ by about so much.
STRENGTH, TIMING, CHARGE = 0.05, math.radians(1.0), 0.02
# The scatter from cycle to cycle before the data have spoken, and the least one.
START, LEAST = 0.03, 1e-3
SCATTER = "assumed_pressure.scatter"
_NEEDED = ("angle", "pressure", "lever", "rod_ratio", "firing_offset")
_CYCLE = re.compile(r"\.assumed_pressure\.cycle_\d+(@|$)")
_CARRIED = re.compile(r"\.assumed_pressure\.\w+(@|$)")
# A cylinder's cycle is told from the next one a quarter turn before its combustion TDC.
_BEFORE = np.pi / 2
# The charge is shut in between these angles.
_SHUT_FROM, _SHUT_TO, _EDGE = math.radians(-140.0), math.radians(155.0), 0.05
_BURNS = 1e-3
# Combustion from cycle to cycle scatters less than this, but for engines that misfire.
_BEYOND = 0.15
_ROUNDS, _SETTLED = 4, 0.1


@dataclass(frozen=True, eq=False)
class Carried:
    """A model that carries its assumed pressures, with its parameters and records; cylinders : names of the ports."""

    model: Model
    parameters: Parameters
    data: tuple[Experiment, ...]
    fresh: tuple[Experiment, ...]
    cylinders: tuple[str, ...]


def carried_cylinders(model: Model) -> tuple[str, ...]:
    """The cylinder ports whose assumed pressure a model carries."""
    ending = ".assumed_pressure.strength"
    return tuple(n.removesuffix(ending) for n in model.parameter_names if n.endswith(ending))


def is_carried(name: str) -> bool:
    """True for a parameter (``name`` or ``name@record``) of an assumed pressure."""
    return name == SCATTER or bool(_CARRIED.search(name))


def carry(
    model: Model,
    parameters: Parameters,
    data: Sequence[Experiment],
    fresh: Sequence[Experiment] = (),
    *,
    cylinders: Any = "assumed",
    level: float = START,
) -> Carried:
    """Let a model carry the pressures that were assumed in any of the records.

    cylinders : names of ports, "assumed" for those of channels with that origin, or None for none
    level : tau, the standard deviation of a combustion's strength from cycle to cycle
    Each record has amplitudes of its own. What has no pressure channel, lever or crank angle is left as it is.
    Raises ModelError for a port that does not exist.
    """
    wanted = {record.name: _wanted(record, cylinders) for record in (*data, *fresh)}
    if cylinders != "assumed":
        for name in {name for own in wanted.values() for name in own}:
            _ = model.ports[name]
    names = tuple(
        port.name
        for port in model.ports
        if any(port.name in own for own in wanted.values()) and _can_carry(model, port)
    )
    names = tuple(n for n in names if n not in carried_cylinders(model))
    if not names:
        return Carried(model, parameters, tuple(data), tuple(fresh), ())
    vector = model.parameter_vector(parameters)
    numbers = dict(zip(model.parameter_names, (float(value) for value in vector), strict=True))
    moved = []
    most = 0
    for record in (*data, *fresh):
        for name in names:
            record, cycles = _with_shapes(model, record, name, numbers, used=name in wanted[record.name])
            most = max(most, cycles)
        moved.append(record)
    wider = _extended(model, names, most, level)
    ready = with_priors(parameters.extended(wider))
    if len(data) > 1:
        ready.vary_by_experiment(*(n for n in ready if _CARRIED.search(n) and n != SCATTER))
    return Carried(wider, ready, tuple(moved[: len(data)]), tuple(moved[len(data) :]), names)


def with_priors(parameters: Parameters) -> Parameters:
    """The set with the priors of its assumed pressures, and their scatter fixed; changed in place, and returned."""
    for name in parameters:
        if name == SCATTER:
            parameters.fix(name)
        elif is_carried(name):
            parameters[name].set(vary=True, prior=(0.0, 1.0))
    return parameters


def remarks(fit: Fit, cylinders: Any = "assumed") -> list[str]:
    """What the user should know of assumed pressures: the model could not carry them, or they scatter beyond belief."""
    carried = carried_cylinders(fit.model)
    left = {name for record in fit.data for name in _wanted(record, cylinders) if name in fit.model.ports}
    left = {name for name in left if name not in carried}
    found = []
    if left:
        found.append(
            f"what is wrong with the pressure of {', '.join(sorted(left))} is counted as noise alone, for this model "
            "or method cannot estimate it: false alarms come more often than stated"
        )
    if carried and fit.values[SCATTER] > _BEYOND:
        found.append(
            f"combustion in {', '.join(carried)} would scatter by {100 * fit.values[SCATTER]:.0f} % about the pressure "
            "that was assumed for it, more than combustion does: the pressure is another one; measure it"
        )
    return found


def _wanted(record: Experiment, cylinders: Any) -> tuple[str, ...]:
    if isinstance(cylinders, str):
        return assumed_cylinders(record) if cylinders == "assumed" else (cylinders,)
    return tuple(cylinders or ())


def _channel(port: str) -> str:
    return f"p{port.rpartition('_')[2]}"


def _can_carry(model: Model, port: Port) -> bool:
    inputs = [v.name for v in model.inputs]
    return set(_NEEDED) <= set(port.signals) and "theta" in inputs and _channel(port.name) in inputs


def scatter_carried(null: NullModel) -> float:
    """The standard deviation of combustion from cycle to cycle with which a null model was fitted."""
    return float(null.records[0].path.p[null.model.parameter_names.index(SCATTER)])


# ---- records ------------------------------------------------------------------------------------------


def _with_shapes(
    model: Model, record: Experiment, port: str, numbers: Mapping[str, float], *, used: bool
) -> tuple[Experiment, int]:
    """The record with the shapes of what may be wrong [Pa] and the cycle's number as channels, zero where the pressure
    was measured; and how many cycles there are."""
    if _channel(port) not in record or "theta" not in record:
        return record, 0
    channel = record[_channel(port)]
    view = PortView(model, model.ports[port])
    theta = record["theta"]
    angle = np.interp(channel.time, theta.time[theta.mask], theta.values[theta.mask])
    angle = angle - view.number("firing_offset", numbers)
    shapes = np.zeros((3, len(angle)))
    if used:
        shapes = np.array(_shapes(angle, channel.values, view.number("rod_ratio", numbers)))
    number = np.floor((angle + _BEFORE) / (4 * np.pi))
    # from the first cycle in which something burns
    burns = np.abs(shapes[0]) > _BURNS * np.abs(shapes[0]).max()
    number -= number[burns].min() if burns.any() else number.min()
    for name, values in zip(_names_of(port), (*shapes, number), strict=True):
        unit = "1" if name.endswith("cycle") else "Pa"
        made = Channel(name, unit, time=channel.time, values=values, hold=channel.hold, origin="derived")
        record = record.with_channel(made)
    return record, int(number.max()) + 1 if used else 0


def _names_of(port: str) -> tuple[str, ...]:
    return tuple(f"{_channel(port)}_{what}" for what in ("burned", "late", "charge", "cycle"))


def _shapes(angle: Array, pressure: Array, ratio: float) -> tuple[Array, Array, Array]:
    """Pressure of combustion, its change with a later combustion [1/rad], and of the motored charge; (N,) each [Pa]."""
    motored = fit_motored(angle, pressure, ratio=ratio) if compresses(angle) else Motored()
    trace = np.asarray(motored.trace(angle, ratio), dtype=float).ravel()
    window = np.asarray(ca.DM(burning(ca.DM(angle))), dtype=float).ravel()
    burned = window * np.nan_to_num(pressure - trace)
    # heat is released later: the pressure made moves with the crank, on the polytrope of its volume
    volume = np.log(np.asarray(motored.volume(angle, ratio), dtype=float).ravel())
    late = -window * (np.gradient(burned, angle) + motored.exponent * burned * np.gradient(volume, angle))
    middle, half = 0.5 * (_SHUT_FROM + _SHUT_TO), 0.5 * (_SHUT_TO - _SHUT_FROM)
    shut = 0.5 * (1 + np.tanh((np.cos(0.5 * (angle - middle)) - math.cos(0.5 * half)) / _EDGE))
    return burned, late, shut * trace


# ---- model --------------------------------------------------------------------------------------------


def _extended(model: Model, ports: Sequence[str], cycles: int, level: float) -> Model:
    """The model with the torque of what may be wrong in the slots of the cylinders."""
    words = "scatter of combustion from cycle to cycle where the pressure is assumed"
    tau = ca.SX.sym(SCATTER)
    declarations = [ParameterDeclaration(SCATTER, level, "1", 0.0, 1.0, False, words)]
    symbols, inputs, channels = [tau], [], []
    laws = ca.SX(model.laws)
    slots = [port.name for port in model.ports.with_slot]
    for port in ports:
        own, known, pressure = _wrong_pressure(port, cycles, tau)
        declarations += own[0]
        symbols += own[1]
        inputs += known[0]
        channels += known[1]
        laws[slots.index(port)] += pressure * model.ports[port].signals["lever"]
    return replace(
        model,
        declarations=(*model.declarations, *declarations),
        p=ca.vertcat(model.p, *symbols),
        inputs=(*model.inputs, *inputs),
        u=ca.vertcat(model.channels, *channels, model.channel_rates, model.late_channels),
        laws=laws,
    )


def _wrong_pressure(port: str, cycles: int, tau: Any) -> tuple[Any, Any, Any]:
    """Declarations and symbols of a cylinder's amplitudes, those of its channels, and the pressure that they add."""
    burned, late, charge, cycle = names = _names_of(port)
    known = [
        Variable(burned, "Pa", f"pressure of combustion in {port}, assumed", 1e6),
        Variable(late, "Pa", f"its change with a combustion that is later by 1 rad, in {port}", 1e6),
        Variable(charge, "Pa", f"pressure of the motored charge in {port}, assumed", 1e6),
        Variable(cycle, "1", f"number of the cycle of {port}", 1.0),
    ]
    u = [ca.SX.sym(name) for name in names]
    common = {
        "strength": f"combustion in {port} against the assumed, in {100 * STRENGTH:g} %",
        "timing": f"delay of combustion in {port} against the assumed, in {math.degrees(TIMING):g} degrees",
        "charge": f"charge of {port} against the assumed, in {100 * CHARGE:g} %",
    }
    words = common | {
        f"cycle_{k + 1}": f"combustion in cycle {k + 1} of {port}, in {SCATTER}" for k in range(cycles)
    }
    declared = [
        ParameterDeclaration(f"{port}.assumed_pressure.{name}", 0.0, "1", description=text)
        for name, text in words.items()
    ]
    s = [ca.SX.sym(one.name) for one in declared]
    each = ca.SX(0)
    for k in range(cycles):
        # a hat: between two samples at the seam, where nothing burns, it passes from one cycle to the next
        each += s[3 + k] * ca.fmax(0, 1 - ca.fabs(u[3] - k))
    pressure = (STRENGTH * s[0] + tau * each) * u[0] + TIMING * s[1] * u[1] + CHARGE * s[2] * u[2]
    return (declared, s), (known, u), pressure


# ---- the level of the scatter ---------------------------------------------------------------------------


def likely_scatter(null: NullModel, sigma: Mapping[str, float]) -> float:
    """The standard deviation of combustion from cycle to cycle that is most likely, all else in the fit free.

    null : of a fit that carries assumed pressures; sigma : output -> standard deviation of its noise
    The restricted likelihood of the residuals, linear about the optimum (Patterson & Thompson 1971).
    """
    tau = scatter_carried(null)
    chosen = [k for k, name in enumerate(null.parameters) if _CYCLE.search(name)]
    unit = inverse(null.turn)[:, chosen]
    rest = null_space(null.turn[chosen])
    width = null.turn.shape[1]
    rows = []
    for record in null.records:
        parts = []
        for output, e in record.residual.items():
            slopes = record.slopes[output]
            random = slopes[:, :width] @ unit
            full = e + random @ null.values[chosen]
            columns = [slopes[:, width:], slopes[:, :width] @ rest, random / tau, full[:, None]]
            parts.append(triangle(np.concatenate(columns, axis=1) / sigma[output]))
        stacked = np.concatenate(parts)
        starts = len(record.starts)
        rows.append(triangle(without(basis(stacked[:, :starts]), stacked[:, starts:])))
    if len(null.prior):
        kept = null.prior[np.abs(null.prior[:, :-1] @ unit).sum(axis=1) == 0]
        extra = np.zeros((len(kept), rows[0].shape[1]))
        extra[:, : rest.shape[1]], extra[:, -1] = kept[:, :-1] @ rest, kept[:, -1]
        rows.append(extra)
    every = np.concatenate(rows)
    left = without(basis(every[:, : rest.shape[1]]), every[:, rest.shape[1] :])
    return max(scatter_level(left[:, :-1], left[:, -1]), LEAST)


def settle_scatter(
    fit: Fit, parameters: Parameters, *, noise: Noise | None, options: Mapping[str, Any] | None = None
) -> tuple[Fit, Parameters]:
    """Fit again at the most likely scatter until that stays where it is; the fit, and its parameters' starts.

    fit : a converged one that carries assumed pressures; any other comes back as it is
    parameters, noise, options : as it was made with
    """
    if not fit.converged or not carried_cylinders(fit.model):
        return fit, parameters
    for _ in range(_ROUNDS):
        old = fit.values[SCATTER]
        new = likely_scatter(null_model(fit), {name: sigma for name, (sigma, _) in fit.noise.items()})
        if abs(math.log(new / old)) < _SETTLED:
            break
        ready = parameters.copy()
        ready[SCATTER].set(new)
        share = min(old / new, 10.0)
        values = {name: v * share if _CYCLE.search(name) else v for name, v in fit.values.items()}
        start = Start(values | {SCATTER: new}, fit.initial, fit.noise)
        again = estimate(
            fit.model, fit.data, parameters=ready, noise=noise, warm=start, progress=False, **(options or {})
        )
        if not again.converged:
            break
        fit, parameters = again, ready
    return fit, parameters
