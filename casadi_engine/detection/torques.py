"""Torque of a motored and of a burning cylinder over the crank angle, learned from the pressures behind a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.detection.plant import vector_of
from casadi_engine.errors import ModelError
from casadi_engine.estimation import Fit
from casadi_engine.model import Model

Array = NDArray[np.float64]

CYCLE = 4 * math.pi
CELLS = 2880  # of a cycle: a quarter of a degree
# A cycle burned if its combustion work is at least this share of the upper quartile of them all.
BURNED = 0.5
# Share of a combustion's torque, by area, that may lie outside the windows that it is looked for in.
LEFT_OUT = 0.01


@dataclass(frozen=True, eq=False)
class TorqueTables:
    """What the cylinders do over a cycle of 4 pi, each (columns, CELLS): rates of states, torque over inertia [rad/s²].

    enter : (n, columns) the states whose rates they change
    known : by the gas in motored cylinders; squared : by the reciprocating masses, per speed squared; combustion :
        (spans, columns, CELLS), row i by a combustion in the i-th window after its own began
    order : (cylinders,) numbers of the cylinders as they fire; start : (cylinders,) crank angles where their windows
        begin [rad], rising within a cycle
    """

    enter: Array
    known: Array
    squared: Array
    combustion: Array
    order: NDArray[np.int64]
    start: Array

    @property
    def spans(self) -> int:
        """Number of windows that a combustion reaches over."""
        return len(self.combustion)


def learn_torques(fit: Fit) -> TorqueTables:
    """Torque tables of a fit whose records hold theta [rad] and the pressure of each cylinder [Pa].

    The motored pressure after TDC is that before it, mirrored, which makes no work; the rest is combustion.

    Raises
    ------
    ModelError : the model has no cylinders, no linear core, no channel theta, or laws that are not the cylinders'
    """
    model, ports = fit.model, _cylinder_ports(fit.model)
    offsets = np.array([float(ca.DM(ca.SX(port.signals["firing_offset"]))) for port in ports])
    names = [_channel_of(model, port.signals["pressure"]) for port in ports]
    grid = np.arange(CELLS) * CYCLE / CELLS
    motored, burned = np.zeros((len(ports), CELLS)), np.zeros((len(ports), CELLS))
    for row, (name, offset) in enumerate(zip(names, offsets, strict=True)):
        motored[row], burned[row] = _mean_pressures(fit, name, offset, grid)
    # One size for all cylinders, by their work: the records behind a fit may have loaded them unequally.
    work = np.array([row @ np.sin(grid - offset) for row, offset in zip(burned, offsets, strict=True)])
    burned *= (work.mean() / work)[:, None]
    torque = _Torque(fit, names)
    known = torque(grid, motored, 0.0)
    squared = torque(grid, motored, 1.0) - known
    if not np.allclose(torque(grid, motored, 2.0) - known, 4 * squared, rtol=1e-6, atol=1e-6):
        raise _unsuited(model, "torques that are not quadratic in speed", "use a fit without such effects")
    each = np.array(
        [torque(grid, motored + np.eye(len(ports))[[c]].T * burned, 0.0) - known for c in range(len(ports))]
    )
    order = np.argsort(offsets, kind="stable")
    start, spans = _windows(each, offsets, order, grid)
    combustion = np.zeros((spans, *known.shape))
    window = (np.searchsorted(start, start[0] + (grid - start[0]) % CYCLE, side="right") - 1) % len(order)
    for place, cylinder in enumerate(order):
        for span in range(spans):
            inside = window == (place + span) % len(order)
            combustion[span][:, inside] = each[cylinder][:, inside]
    return TorqueTables(torque.enter, known, squared, combustion, order + 1, start)


def _cylinder_ports(model: Model) -> list[Any]:
    ports = [port for port in model.ports if port.kind == "cylinder" and "firing_offset" in port.signals]
    if not ports or model.linear is None or "theta" not in [one.name for one in model.inputs]:
        seen = (
            "no cylinders" if not ports else "no linear core" if model.linear is None else "no channel theta"
        )
        raise _unsuited(model, seen, 'use two_mass or crankshaft with reciprocating_inertia="mean"')
    own = {port.name for port in ports}
    laws = [ca.SX(law) for law in ca.vertsplit(model.laws)] if model.laws.numel() else []
    for port, law in zip(model.ports.with_slot, laws, strict=True):
        if port.name not in own and not law.is_zero():
            raise _unsuited(model, f"a law at {port.name}", "use a fit without such effects")
    return ports


def _unsuited(model: Model, seen: str, cure: str) -> ModelError:
    return ModelError(
        f"misfires cannot be found with the model {model.name}",
        seen=seen,
        allowed="cylinders with pressures, a channel theta, a linear core, and no laws but the cylinders'",
        cure=cure,
    )


def _channel_of(model: Model, symbol: Any) -> str:
    return next(v.name for k, v in enumerate(model.inputs) if ca.is_equal(ca.SX(symbol), model.u[k]))


class _Torque:
    """All torques of the cylinders on the states' rates, from angle, pressures and speed."""

    def __init__(self, fit: Fit, pressures: list[str]) -> None:
        model, core = fit.model, fit.model.linear
        assert core is not None
        push = core.B @ model.drive_expressions + core.G @ ca.SX(model.slot_laws)
        theta = ca.SX.sym("theta")
        speed, gas = ca.SX.sym("speed"), ca.SX.sym("p", len(pressures))
        put = []
        for one in model.inputs:
            put.append(
                theta
                if one.name == "theta"
                else speed
                if one.unit == "rad/s"
                else gas[pressures.index(one.name)]
                if one.name in pressures
                else ca.SX(0)
            )
        put += [ca.SX(0)] * (model.u.numel() - len(put))
        turning = ca.vertcat(*[speed if one.unit == "rad/s" else ca.SX(0) for one in model.states])
        push = ca.substitute(push, ca.vertcat(model.u, model.x), ca.vertcat(*put, turning))
        push = ca.substitute(push, model.p, ca.SX(ca.DM(vector_of(fit))))
        self._rates = ca.Function("rates", [theta, gas, speed], [ca.densify(push)])
        # Distinct directions in which cylinders push: one for a rigid engine, one for each throw of a crankshaft.
        probe = self._evaluate(np.linspace(0.1, 12.4, 64), np.full((len(pressures), 64), 3e6), 50.0)
        rows = np.flatnonzero(np.abs(probe).max(axis=1) > 0)
        self.enter = np.eye(len(model.states))[:, rows]
        self._rows = rows

    def _evaluate(self, angle: Array, gas: Array, speed: float) -> Array:
        return np.asarray(self._rates(angle[None], gas, np.full((1, angle.size), speed)))

    def __call__(self, angle: Array, gas: Array, speed: float) -> Array:
        return self._evaluate(angle, gas, speed)[self._rows]


def _mean_pressures(fit: Fit, name: str, offset: float, grid: Array) -> tuple[Array, Array]:
    """Mean motored pressure (CELLS,) and mean rise by combustion (CELLS,) of a cylinder [Pa] over the crank angle."""
    cycles = []
    for record in fit.data:
        channel, angle = record[name], record["theta"]
        turned = np.interp(channel.time, angle.time[angle.mask], angle.values[angle.mask]) - offset
        good = channel.mask
        first, last = (
            math.ceil((turned[0] + CYCLE / 2) / CYCLE - 0.02),
            math.floor((turned[-1] + CYCLE / 2) / CYCLE + 0.02),
        )
        for number in range(first, last):
            cycles.append(np.interp(grid - CYCLE / 2 + number * CYCLE, turned[good], channel.values[good]))
    if not cycles:
        raise _unsuited(fit.model, f"no whole cycle of {name} in the fit's records", "fit longer records")
    traces = np.array(cycles)
    # At the cell k of a trace the cylinder's own angle is grid[k] - 2 pi, TDC of combustion in the middle.
    middle, late = CELLS // 2, np.arange(1, CELLS // 4)
    mirrored = traces.copy()
    mirrored[:, middle + late] = traces[:, middle - late]
    # Behind the closed valves alone: where the exhaust is open, both are alike.
    rise = traces - mirrored
    work = np.sum(rise[:, middle + late] * np.sin(grid[late]), axis=1)
    burns = work >= BURNED * np.quantile(work, 0.75)
    if not work.max() > 0:
        raise _unsuited(fit.model, f"no combustion in {name}", "fit a record of the running engine as well")
    fade = np.clip((np.arange(CELLS) - middle - 0.22 * CELLS) / (0.03 * CELLS), 0, 1)
    lift = rise[burns].mean(axis=0) * (1 - fade)
    base = traces[burns].mean(axis=0) - lift
    place = np.rint(((grid - offset + CYCLE / 2) % CYCLE) / CYCLE * CELLS).astype(int) % CELLS
    return base[place], lift[place]


def _windows(each: Array, offsets: Array, order: NDArray[np.int64], grid: Array) -> tuple[Array, int]:
    """Angles where the windows begin, (cylinders,), and how many windows a combustion spans."""
    size = sum(
        np.interp((grid + offset) % CYCLE, np.append(grid, CYCLE), np.append(row, row[0]))
        for row, offset in zip(np.abs(each).sum(axis=1), offsets, strict=True)
    )
    size = np.roll(size, CELLS // 2)  # TDC in the middle
    inside = np.cumsum(size) / size.sum()
    begin = int(np.searchsorted(inside, LEFT_OUT / 10)) - CELLS // 2
    end = int(np.searchsorted(inside, 1 - LEFT_OUT)) - CELLS // 2
    start = offsets[order] + begin * CYCLE / CELLS
    widths = np.diff(np.append(start, start[0] + CYCLE))
    spans = max(1, math.ceil((end - begin) * CYCLE / CELLS / widths.min() - 0.02))
    return start, min(spans, len(order))
