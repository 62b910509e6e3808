"""Process noise in a fit: the parameters it adds, every record's gain, and the likelihood of the innovations.

Three ways to a gain: stated as numbers; its entries estimated with the physical parameters (the innovations form with
a parametrised observer, thesis 2.10); or by the Riccati equation from noise covariances, known or estimated (2.11,
2.12). Estimated entries and covariances are parameters like any other, with names of their own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EstimationError
from casadi_engine.model import Model
from casadi_engine.model.linear import LinearCore
from casadi_engine.parameters import Parameters, near_matches
from casadi_engine.parameters.compiled import ParameterMap
from casadi_engine.problem.noise import Level, Noise
from casadi_engine.simulation.discretisation import DiscreteCore
from casadi_engine.simulation.gain import Gain, GainPlan, RiccatiGain, StatedGain
from casadi_engine.simulation.grid import Grid

Array = NDArray[np.float64]

# Names of the parameters that noise adds begin so.
FAMILIES = ("gain", "process", "noise")
# Process noise at the start: what it adds to a state from one sample of the output to the next, in units of the
# output's noise, both divided by their magnitudes. The gain at the start is then small and stable.
_SHARE = 0.1
# An estimated level lies within this factor of its start.
_RANGE = 1e5


def output_stride(grid: Grid) -> int:
    """Grid steps between samples of the outputs, missing ones counted as samples."""
    points = [m.position for m in grid.measured.values()]
    if not points:
        return 1
    steps = np.diff(np.unique(np.concatenate(points)))
    return int(np.gcd.reduce(steps)) if len(steps) else 1


@dataclass(frozen=True)
class Start:
    """Where the search for noise begins: measurement (ny,) standard deviations, process name -> level."""

    measurement: Array
    process: dict[str, float]


class Predictor:
    """The predictor of a fit; what it adds to the parameter set of the fit, which it changes.

    names : the added parameters that the gain hangs on, in order; kind : "none" (output error), "stated",
    "innovations" or "process"
    """

    def __init__(self, noise: Noise, model: Model, grids: list[Grid], parameters: Parameters) -> None:
        self.noise, self.model = noise, model
        self.outputs = tuple(out.name for out in model.outputs)
        self.states = tuple(state.name for state in model.states)
        self.scale = np.array([state.scale for state in model.states])
        self.kind = (
            "stated" if noise.gain is not None
            else "innovations" if noise.innovations
            else "process" if noise.process is not None
            else "none"
        )  # fmt: skip
        self.names: tuple[str, ...] = ()
        self.every = output_stride(grids[0]) if self.kind != "none" else 1
        if self.kind in ("innovations", "process"):
            self._check_model()
            if self.kind == "process":
                _check_strides(grids)
            self.process = self._process_levels()
            self.start = self._start(grids)
            self.names = self._add(parameters, grids[0])
        self._rest(parameters)

    # ---- parameters

    def _check_model(self) -> None:
        if self.model.linear is None or self.model.has_slot_laws:
            raise EstimationError(
                "a predictor with an estimated or Riccati gain needs a linear model",
                seen=f"{self.model.name}, which has nonlinear terms",
                allowed="a model that is linear in its states and drives",
                cure="take the linear form of the model, or output error: Noise(omega=...) alone",
            )

    @property
    def _linear(self) -> LinearCore:
        self._check_model()
        return self.model.linear  # type: ignore[return-value]

    def _process_levels(self) -> dict[str, Level]:
        """State or drive -> level of the process noise; in the innovations form, that of the start."""
        b, drives = self._linear.B, tuple(d.name for d in self.model.drives)
        driven = [
            name for k, name in enumerate(self.states) if b.shape[1] and not ca.densify(b[k, :]).is_zero()
        ]
        wanted = self.noise.process
        if wanted is None or wanted == "estimate":
            return dict.fromkeys(driven or self.states, "estimate")
        for name in wanted:
            if name not in self.states and name not in drives:
                raise EstimationError(
                    "process noise is given for what is neither a state nor a drive of the model",
                    seen=repr(name),
                    allowed=near_matches(name, [*self.states, *drives]),
                    cure="print(model.table()) lists the states and drives",
                )
        return dict(wanted)

    def _start(self, grids: list[Grid]) -> Start:
        levels = []
        for output in self.outputs:
            level = self.noise.level(output)
            levels.append(scatter(grids, output) if level == "estimate" else float(level))
        measurement = np.array(levels)
        size = np.array([out.scale for out in self.model.outputs])
        relative = _SHARE * float(np.min(measurement / size)) / math.sqrt(self.every * grids[0].step)
        found = {}
        for name, level in self.process.items():
            if level != "estimate":
                found[name] = float(level)
            elif name in self.states:
                found[name] = relative * self.scale[self.states.index(name)]
            else:  # a drive: what makes that much of the state it acts on most
                k = [d.name for d in self.model.drives].index(name)
                push = np.abs(self._numbers(self._linear.B)[:, k] / self.scale).max()
                found[name] = relative / push if push > 0 else 1.0
        return Start(measurement, found)

    def _numbers(self, expression: ca.SX) -> Array:
        """An expression of the model's parameters at their defaults."""
        function = ca.Function("numbers", [self.model.p], [ca.densify(expression)])
        return np.asarray(function(self.model.parameter_vector()), dtype=float)

    def _add(self, parameters: Parameters, grid: Grid) -> tuple[str, ...]:
        """Put the parameters of the gain into the set, unless the user did; return their names."""
        units = {v.name: v.unit for v in (*self.model.states, *self.model.drives, *self.model.outputs)}
        names = []
        if self.kind == "innovations":
            lift = self._first_gain(parameters, grid)
            for name, value in zip(self._gain_names(), lift, strict=True):
                output, state = name.split(".")[1:]
                if name not in parameters:
                    unit = "1" if units[state] == units[output] else f"{units[state]}/({units[output]})"
                    parameters.add(name, value, unit=unit,
                                   description=f"correction of {state} by {output}")  # fmt: skip
            return self._gain_names()
        for name, level in self.process.items():
            if level == "estimate":
                unit = f"{units[name]}/sqrt(s)" if name in self.states else f"{units[name]} sqrt(s)"
                names.append(f"process.{name}")
                _add_level(parameters, names[-1], self.start.process[name], unit, f"process noise of {name}")
        for name, value in zip(self.outputs, self.start.measurement, strict=True):
            if self.noise.level(name) == "estimate":
                names.append(f"noise.{name}")
                _add_level(parameters, names[-1], value, units[name], f"measurement noise of {name}")
        return tuple(names)

    def _gain_names(self) -> tuple[str, ...]:
        return tuple(
            f"gain.{output}.{state}"
            for output in self.outputs
            if output in self.noise.innovations
            for state in self.states
        )

    def _first_gain(self, parameters: Parameters, grid: Grid) -> list[float]:
        """The stationary gain of the process noise at the start: stable, and of the right size."""
        try:
            none = ca.SX(0, 1)
            values = ca.DM(self.model.parameter_vector(parameters))
            gain = self._riccati(none, none)
            core = self._core(none, ca.SX(values), grid)
            seen = tuple(name in self.noise.innovations for name in self.outputs)
            lift = gain.at(np.zeros(0), core, core.at(np.zeros(0), 0), seen).lift[0] * self.scale[:, None]
        except FloatingPointError:
            raise _no_gain(parameters.as_dict()) from None
        columns = [k for k, name in enumerate(self.outputs) if name in self.noise.innovations]
        return lift[:, columns].T.ravel().tolist()

    def _core(self, z: ca.SX, physical: ca.SX, grid: Grid, method: str = "exact") -> DiscreteCore:
        hold = ("first",) * len(self.model.drives)
        return DiscreteCore(
            self.model, z, physical, step=grid.step, hold=hold, scale=self.scale, method=method
        )

    def _rest(self, parameters: Parameters) -> None:
        """Fix what an earlier fit's noise has left in the set: nothing hangs on it here."""
        for name in parameters.names:
            family = name.split(".")[0]
            idle = family in FAMILIES and family != name and name not in self.names
            if idle and parameters[name].vary and name not in self.model.parameter_names:
                parameters[name].set(vary=False)

    # ---- the gain

    def split(self, pmap: ParameterMap) -> tuple[ParameterMap, dict[str, ca.SX]]:
        """The map with the model's own parameters as ``physical``, and record -> the added ones as SX of z."""
        count = len(self.model.parameter_names)
        physical: Mapping[str, ca.SX] = pmap.physical
        tails = {record: expression[count:, 0] for record, expression in physical.items()}
        if not self.names:
            return pmap, tails
        own = {
            id(e): e[:count] for e in physical.values()
        }  # records that share parameters go on sharing them
        shared = {record: own[id(expression)] for record, expression in physical.items()}
        return replace(pmap, names=pmap.names[:count], physical=shared, _functions={}), tails

    def plan(self, tail: ca.SX, physical: ca.SX, level: Array | None = None) -> Array | GainPlan | None:
        """The gain of a record whose added parameters are ``tail`` and own ones ``physical``, SX of the fit's vector.

        level : (ny,) levels to which the innovations are whitened, None to leave them in the outputs' units
        """
        if self.noise.gain is not None:
            return self.noise.gain / self.scale[:, None]
        if self.kind == "none":
            return None
        used = tuple(name in self.noise.innovations for name in self.outputs)
        if self.kind == "innovations":
            return GainPlan(tail, self._stated, used)
        expression = ca.vertcat(tail, physical)

        def build(parts: ca.SX, z: ca.SX) -> Gain:
            return self._riccati(parts, z, level)

        return GainPlan(expression, build, (True,) * len(self.outputs))

    def _stated(self, entries: ca.SX, z: ca.SX) -> StatedGain:
        n, lift = len(self.states), ca.SX.zeros(len(self.states), len(self.outputs))
        used = [k for k, name in enumerate(self.outputs) if name in self.noise.innovations]
        for i, column in enumerate(used):
            lift[:, column] = entries[i * n : (i + 1) * n]
        return StatedGain(lift, z, self.scale)

    def _riccati(self, parts: ca.SX, z: ca.SX, level: Array | None = None) -> RiccatiGain:
        """parts : the added parameters, then the model's own; empty for numbers at the start."""
        values = (
            dict(zip(self.names, ca.vertsplit(parts[: len(self.names)]), strict=True)) if self.names else {}
        )
        own = parts[len(self.names) :]
        n, density = len(self.states), ca.SX.zeros(len(self.states), len(self.states))
        drives = [d.name for d in self.model.drives]
        b = self._linear.B
        b = ca.substitute(b, self.model.p, own) if own.numel() else ca.SX(ca.DM(self._numbers(b)))
        for name in self.process:
            size = values.get(f"process.{name}", self.start.process[name])
            column = ca.SX.zeros(n, 1)
            if name in self.states:
                column[self.states.index(name)] = 1
            else:
                column = b[:, drives.index(name)]
            density += size**2 * (column @ column.T)
        sigma = [
            values.get(f"noise.{name}", self.start.measurement[k]) for k, name in enumerate(self.outputs)
        ]
        return RiccatiGain(density, ca.vertcat(*sigma), z, scale=self.scale, every=self.every, level=level)

    def reference(self, tail: ca.SX, physical: ca.SX, z: ca.SX, start: Array, grid: Grid) -> Array:
        """(ny,) levels of the innovations at the start: the units in which the search sees them."""
        expression = ca.vertcat(tail, physical)
        gain, core = self._riccati(expression, z), self._core(z, physical, grid)
        try:
            found = gain.stationary(start, core, core.at(start, 0))
        except FloatingPointError:
            function = ca.Function("values", [z], [physical])
            values = np.asarray(function(start)).ravel().tolist()
            raise _no_gain(dict(zip(self.model.parameter_names, values, strict=True))) from None
        return np.sqrt(np.diag(found.innovation[0]))


def _no_gain(values: Mapping[str, float]) -> EstimationError:
    return EstimationError(
        "the predictor has no stable gain at the start values",
        seen=", ".join(f"{name}={value:.4g}" for name, value in values.items()),
        allowed="a model whose outputs show every mode that does not decay by itself",
        cure="measure one more output, or take output error: Noise(omega=...) alone",
    )


def _add_level(parameters: Parameters, name: str, value: float, unit: str, description: str) -> None:
    if name not in parameters:
        parameters.add(
            name, value, unit=unit, min=value / _RANGE, max=value * _RANGE, description=description
        )


def scatter(grids: list[Grid], output: str) -> float:
    """The noise of an output from its neighbouring samples: the second difference of a smooth signal is small."""
    series = [grid.measured[output].values for grid in grids if output in grid.measured]
    steps = np.concatenate([np.diff(s, 2) for s in series] or [np.zeros(0)])
    size = max((float(np.abs(s).max(initial=0.0)) for s in series), default=1.0)
    level = float(np.sqrt(np.mean(steps**2) / 6)) if len(steps) else size
    return max(level, 1e-5 * size, 1e-300)


def _check_strides(grids: list[Grid]) -> None:
    """Raise EstimationError where outputs of records come at different strides: a stationary gain is that of one."""
    strides = [output_stride(grid) for grid in grids]
    if len(set(strides)) > 1:
        raise EstimationError(
            "a gain from noise covariances is that of one distance between samples, and these records have several",
            seen=f"an output at every {', '.join(f'{n}.' for n in strides)} step of the inputs",
            allowed="records whose outputs come at the same stride",
            cure="resample them alike, record.resample(omega=2), or fit them apart",
        )
