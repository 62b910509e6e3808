"""One record, measured or planned, near its operating point: its outputs and their exact sensitivities.

A planned record holds input channels alone. Its outputs are then taken at every point of the inputs' grid, and its
start is the motion that repeats from one engine cycle to the next (or the equilibrium, without a crank angle).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ExperimentError, SimulationError
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.model.arrival import arriving
from casadi_engine.parameters import near_matches
from casadi_engine.simulation.grid import Grid, Measured, lay_grid
from casadi_engine.simulation.intervals import Intervals, Observation, cut
from casadi_engine.simulation.propagator import make_propagator

Array = NDArray[np.float64]

_CYCLE = 4 * math.pi
# A start is found when the next step is this small, in scaled states; a linear model takes one step.
_SETTLED, _STEPS = 1e-9, 30
# A step into states where the equations are not finite is shortened, but not below this length.
_SHORTEST = 1e-4
# Over this last share of a cycle the inputs are led back to those at its start.
_SEAM = 0.25
# A mode of the start is moved where that explains this many standard errors.
_DEMANDED = 3.0
# Singular values of the sensitivities to the start below this share tell nothing of it.
_BLIND = 1e-11


@dataclass(frozen=True, eq=False)
class PlannedExperiment:
    """An experiment that may be made, or was: its inputs, what would be measured, and how it starts.

    experiment : the input channels; outputs that it holds were measured (unless their origin is "derived")
    label : what to call it (default: the experiment's name)
    outputs : names of the model's outputs that are measured (default: those that the experiment holds, or all)
    every : an output that the experiment does not hold is measured at every so-many-th point of the inputs' grid
    start : state -> value, the operating point at the first sample; states left out are worked out
    known_start : True if the experimenter will know the initial state; otherwise it is estimated with the rest

    Raises ExperimentError if what is given is no experiment, or ``every`` no whole number >= 1.
    """

    experiment: Experiment
    label: str = ""
    outputs: tuple[str, ...] | None = None
    every: int = 1
    start: Mapping[str, float] = field(default_factory=dict)
    known_start: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.experiment, Experiment):
            raise ExperimentError(
                "a planned experiment needs an experiment with the input channels",
                seen=type(self.experiment).__name__,
                allowed="an Experiment",
                cure="make it by Experiment.from_arrays, or by identifiability.plan from a record",
            )
        whole = isinstance(self.every, int | np.integer) and not isinstance(self.every, bool)
        if not whole or self.every < 1:
            raise ExperimentError(
                "`every` of a planned experiment is not acceptable",
                seen=repr(self.every),
                allowed="a whole number >= 1",
                cure="leave it out to measure at every point",
            )
        if self.outputs is not None:
            names = (self.outputs,) if isinstance(self.outputs, str) else tuple(self.outputs)
            object.__setattr__(self, "outputs", names)

    @property
    def name(self) -> str:
        """The label, or the experiment's name."""
        return self.label or self.experiment.name


def planned(data: Any) -> tuple[PlannedExperiment, ...]:
    """Experiments, planned or not, one or several or by label, as planned ones whose names differ.

    Raises ExperimentError for anything else.
    """
    if isinstance(data, Mapping):
        given = [
            replace(one, label=str(label))
            if isinstance(one, PlannedExperiment)
            else PlannedExperiment(one, str(label))
            for label, one in data.items()
        ]
    else:
        several = isinstance(data, Iterable) and not isinstance(data, str)
        items = [data] if isinstance(data, Experiment | PlannedExperiment) else list(data) if several else []
        if not items:
            raise ExperimentError(
                "there is no experiment",
                seen=repr(data) if not several else "an empty sequence",
                allowed="an Experiment or PlannedExperiment, a sequence of them, or a mapping from label to one",
                cure="read one by read_experiment(path), or make one by identifiability.plan",
            )
        given = [one if isinstance(one, PlannedExperiment) else PlannedExperiment(one) for one in items]
    taken: set[str] = set()
    named = []
    for one in given:
        name, number = one.name, 2
        while name in taken:
            name, number = f"{one.name}_{number}", number + 1
        taken.add(name)
        named.append(replace(one, label=name))
    return tuple(named)


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """What a record would tell, sample by sample (K samples of all outputs).

    start : (n,) initial state in its units; residual : (K,) simulated less measured, 0 where nothing was measured
    in_v : (K, nv) of the outputs to the free parameters' coordinates; in_start : (K, n) to the scaled initial state
    column : (K,) number of the output; was_measured : (K,) bool, False for samples that are only planned
    """

    start: Array
    residual: Array
    in_v: Array
    in_start: Array
    column: NDArray[np.int16]
    was_measured: NDArray[np.bool_]

    def without_start(self, weight: Array, known: NDArray[np.bool_]) -> Array:
        """(K, nv) weighted sensitivities to the parameters, less what a change of the unknown start explains.

        weight : (K,) 1/sigma of each sample; known : (n,) states whose start is known
        """
        rows = self.in_v * weight[:, None]
        seen = (self.in_start * weight[:, None])[:, ~known]
        size = np.linalg.norm(seen, axis=0)
        seen = seen[:, size > 0] / size[size > 0]
        if not seen.size:
            return rows
        basis, values, _ = np.linalg.svd(seen, full_matrices=False)
        basis = basis[:, values > _BLIND * values[0]]
        # twice, or the rounding of the first subtraction would look like information
        for _ in range(2):
            rows = rows - basis @ (basis.T @ rows)
        return rows


class OperatingRecord:
    """A record of a model as a function of the coordinates v of the free parameters and the initial state.

    v : (nv,) SX symbols; physical : (np,) SX of them, the model's parameters
    Raises ExperimentError or SimulationError if the experiment lacks what the model needs.
    """

    def __init__(self, model: Model, plan: PlannedExperiment, v: ca.SX, physical: ca.SX) -> None:
        plan = replace(plan, experiment=arriving(model, plan.experiment))
        self.model, self.plan, self.v, self.physical = model, plan, v, physical
        self.outputs = _outputs_of(model, plan)
        there = tuple(name for name in self.outputs if _was_measured(plan, name))
        inputs = [variable.name for variable in model.inputs]
        source = plan.experiment if there else plan.experiment.only(*inputs) if inputs else plan.experiment
        self.grid = _with_planned(lay_grid(model, source, outputs=there), self.outputs, there, plan.every)
        self.measured_there = there
        self.scale = np.array([state.scale for state in model.states])
        self.names = tuple(variable.name for variable in model.outputs)
        self._intervals = cut(self.grid, None)
        self._observation = Observation(self.grid, self._intervals, self.names)
        self._propagator = make_propagator(model, self.grid, self._intervals, v, physical, scale=self.scale)
        self._linear = model.linear is not None and not model.has_slot_laws
        self._weights = np.array([1 / out.scale for out in model.outputs])
        self._rate_function: ca.Function | None = None
        self._output_function: ca.Function | None = None
        self._last: Array | None = None  # the start that was found before, from which the next one is not far

    @property
    def count(self) -> int:
        """Number of samples that count."""
        return int(self._observation.valid.sum())

    @property
    def duration(self) -> float:
        """Length of the record [s]."""
        return self.grid.span

    def at(self, v: Array, *, closest: bool = False) -> Sensitivity:
        """Outputs and sensitivities at the coordinates v : (nv,), from the start that was given or worked out.

        closest : True for the start that explains the measured samples best. Its noise would excite fast modes, and
            sensitivities taken there promise too much; the usual start leaves the settled motion only where the
            samples demand it
        Raises SimulationError if the simulation is not finite.
        """
        return self._evaluate(v, self._start(v, closest=closest))

    def _evaluate(self, v: Array, start: Array) -> Sensitivity:
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                path = self._propagator.propagate(v, start[None], 1)
        except FloatingPointError:
            raise self._not_finite() from None
        seen = self._observation
        y = seen.observe(path.y)[:, :, 0]
        in_start = seen.observe_starts(path.ys)
        in_start = in_start if in_start.ndim == 2 else in_start[:, 0]
        valid, column = seen.valid[:, 0], seen.column[:, 0]
        real = np.isin(np.array(self.names, dtype=object), self.measured_there)[column]
        residual = np.where(real, y[0] - seen.measured[:, 0], 0.0)
        if not (np.isfinite(y).all() and np.isfinite(in_start).all()):
            raise self._not_finite()
        return Sensitivity(
            start * self.scale,
            residual[valid],
            y[1:, valid].T.copy(),
            in_start[valid],
            column[valid].astype(np.intp),
            real[valid],
        )

    def _not_finite(self) -> SimulationError:
        return SimulationError(
            f"the simulation of {self.plan.name} is not finite",
            seen="the parameters' values and the start",
            allowed="values for which the equations give finite numbers",
            cure="change the parameters' values, or give start={state: value, ...}",
        )

    # ---- the start

    def _start(self, v: Array, *, closest: bool) -> Array:
        """(n,) scaled initial state."""
        names = [state.name for state in self.model.states]
        for name in self.plan.start:
            if name not in names:
                raise ExperimentError(
                    f"the model {self.model.name} has no such state",
                    seen=repr(name),
                    allowed=near_matches(name, names),
                    cure="print(model.table()) lists the states",
                )
        given = np.array([float(self.plan.start.get(name, math.nan)) for name in names]) / self.scale
        free = np.isnan(given)
        if not free.any():
            return given
        if not self.measured_there:
            return np.where(free, self._settled(v), given)
        if self._last is None:
            self._last = self._settled(v)
        found = self._fitted(v, np.where(free, self._last, given), free, closest=closest)
        if closest:  # where the next point's start will be near
            self._last = found
        return found

    def _fitted(self, v: Array, start: Array, free: NDArray[np.bool_], *, closest: bool) -> Array:
        """The start that explains the measured samples best, or the given one moved only as far as they demand."""
        slope = self._rates(start, v)[1][np.ix_(free, free)]
        modes = None if closest or not np.isfinite(slope).all() else _slow_first(slope)
        last = start
        for _ in range(_STEPS):
            start, here = self._finite(v, start, last)
            real = here.was_measured
            weight = self._weights[here.column[real]]
            slope, rest = here.in_start[real][:, free] * weight[:, None], here.residual[real] * weight
            step = _least_squares(slope, rest) if modes is None else _demanded(slope, rest, modes)
            last, start = start, start.copy()
            start[free] -= step
            if self._linear or np.abs(step).max() < _SETTLED * max(1.0, float(np.abs(start).max())):
                break
        return start

    def _finite(self, v: Array, start: Array, last: Array) -> tuple[Array, Sensitivity]:
        """The start, drawn back to the last one until the simulation is finite (a tank's level stays above 0)."""
        while True:
            try:
                return start, self._evaluate(v, start)
            except SimulationError:
                if np.abs(start - last).max() <= _SHORTEST * max(1.0, float(np.abs(last).max())):
                    raise
                start = 0.5 * (start + last)

    def _settled(self, v: Array) -> Array:
        """The start of a motion that repeats in the first engine cycle but for an even change of all speeds.

        Without a crank angle it is the equilibrium under the first inputs.
        """
        length = self._cycle_length()
        if length is None:
            return self._equilibrium(v)
        intervals = Intervals(1, length, 1, np.zeros(1, np.intp))
        grid = replace(self.grid, samples=length + 1, rows=tuple(self._closed_cycle(length)), measured={})
        constants = np.asarray(ca.Function("p", [self.v], [self.physical])(v)).reshape(-1)
        cycle = make_propagator(
            self.model, grid, intervals, ca.SX(0, 1), ca.SX(ca.DM(constants)), scale=self.scale
        )
        n, (speed, row) = len(self.scale), self._crank_speed(length)
        turning = np.array([state.unit == "rad/s" for state in self.model.states]) / self.scale
        start, drift = self._equilibrium(v), 0.0
        for _ in range(_STEPS):
            path = cycle.propagate(np.zeros(0), start[None], 1)
            slope = np.asarray(path.end_s)[0] - np.eye(n)
            defect = path.end[:, 0] - start
            if row is not None:  # the record tells the mean speed, and the torques need not balance there
                y = path.y[0].reshape(len(self.names), -1)[row]
                ys = np.asarray(path.ys).reshape(len(self.names), length, -1)[row]
                defect = np.append(defect - drift * turning, y.mean() - speed)
                slope = np.block([[slope, -turning[:, None]], [ys.mean(axis=0)[None], np.zeros((1, 1))]])
            step = _least_squares(slope, defect)
            start = start - step[:n]
            drift -= float(step[n]) if row is not None else 0.0
            if np.abs(step[:n]).max() < _SETTLED * max(1.0, float(np.abs(start).max())):
                break
        if not np.isfinite(start).all():
            raise self._not_finite()
        return start

    def _closed_cycle(self, length: int) -> Array:
        """(nu, length+1) the first cycle's inputs, led back evenly to where they began.

        Cycles differ, and a jump would ring in the fast modes.
        """
        channels: Array = self.grid.channels[:, : length + 1].copy()
        gap = channels[:, 0] - channels[:, length]
        gap[[variable.name for variable in self.model.inputs].index("theta")] += _CYCLE
        share = np.clip((np.arange(length + 1) / length - 1) / _SEAM + 1, 0.0, 1.0)
        channels += gap[:, None] * share**2 * (3 - 2 * share)
        return channels

    def _cycle_length(self) -> int | None:
        """Grid steps of the first engine cycle, to the nearest, or None."""
        names = [variable.name for variable in self.model.inputs]
        if "theta" not in names:
            return None
        theta = self.grid.channels[names.index("theta")]
        passed = np.flatnonzero(theta >= theta[0] + _CYCLE)
        if not len(passed) or passed[0] >= len(theta) - 1:
            return None
        k = int(passed[0])
        return k if theta[k] + theta[k - 1] < 2 * (theta[0] + _CYCLE) else k - 1

    def _crank_speed(self, length: int) -> tuple[float, int | None]:
        """Mean rate of the crank angle over the first cycle [rad/s], and the output that shows it."""
        names = [variable.name for variable in self.model.inputs]
        theta = self.grid.channels[names.index("theta")]
        speed = float((theta[length] - theta[0]) / (self.grid.time[length] - self.grid.time[0]))
        return speed, self.names.index("omega") if "omega" in self.names else None

    def _equilibrium(self, v: Array) -> Array:
        """The scaled state that stays with the first inputs held; the least one where several do.

        Where the equations have no finite slope at zero (the root of a tank's level) the search begins away from it,
        and ends where the first samples are explained.
        """
        zero = np.zeros(len(self.scale))
        if self._is_regular(zero, v):
            return self._newton(zero, v, self._rates)
        if not self._is_regular(zero + 1.0, v):
            return zero
        found = self._newton(zero + 1.0, v, self._rates)
        return self._newton(found, v, self._first_errors) if self.measured_there else found

    def _is_regular(self, state: Array, v: Array) -> bool:
        return all(np.isfinite(part).all() for part in self._rates(state, v))

    def _newton(self, state: Array, v: Array, errors: Callable[[Array, Array], tuple[Array, Array]]) -> Array:
        """A root of errors(state, v) -> (values, slope), by steps that keep the equations finite."""
        for _ in range(_STEPS):
            rate, slope = errors(state, v)
            if not (np.isfinite(rate).all() and np.isfinite(slope).all()):
                break
            step = _least_squares(slope, rate)
            while not self._is_regular(state - step, v) and np.abs(step).max() > _SETTLED:
                step = 0.5 * step
            if not self._is_regular(state - step, v):
                break
            state = state - step
            if np.abs(step).max() < _SETTLED * max(1.0, float(np.abs(state).max())):
                break
        return state

    def _first_errors(self, state: Array, v: Array) -> tuple[Array, Array]:
        """Outputs less their first measured samples (ny,), weighted, and the slope (ny, n) to the scaled state."""
        model, rows = self.model, [self.names.index(name) for name in self.measured_there]
        first = np.array([self.grid.measured[name].values[0] for name in self.measured_there])
        if self._output_function is None:
            x = ca.SX.sym("x", len(self.scale))
            of = ca.Function("y", [model.x, model.u, model.t, model.p], [model.closed_outputs])
            y: Any = of(x * ca.DM(self.scale), self.grid.channels[:, 0], self.grid.start, self.physical)
            parts = [y, ca.densify(ca.jacobian(y, x))]
            self._output_function = ca.Function("first", [x, self.v], parts)
        y, slope = (np.asarray(part, dtype=float) for part in self._output_function(state, v))
        weight = self._weights[rows]
        return (y.reshape(-1)[rows] - first) * weight, slope.reshape(-1, len(state))[rows] * weight[:, None]

    def _rates(self, state: Array, v: Array) -> tuple[Array, Array]:
        """Rates (n,) of the scaled states at the first inputs, and their Jacobian (n, n)."""
        if self._rate_function is None:
            model = self.model
            x, s = ca.SX.sym("x", len(self.scale)), ca.DM(self.scale)
            ode = ca.Function("ode", [model.x, model.u, model.t, model.p], [model.closed_ode])
            rates: Any = ode(x * s, self.grid.channels[:, 0], self.grid.start, self.physical)
            parts = [rates / s, ca.densify(ca.jacobian(rates / s, x))]
            self._rate_function = ca.Function("rates", [x, self.v], parts)
        rate, slope = (np.asarray(part, dtype=float) for part in self._rate_function(state, v))
        return rate.reshape(-1), slope.reshape(len(state), -1)


def _least_squares(slope: Array, rest: Array) -> Array:
    """The least step that explains ``rest`` : (K,) by ``slope`` : (K, n), columns of any size."""
    size = np.linalg.norm(slope, axis=0)
    size = np.where(size > 0, size, 1.0)
    found: Array = np.linalg.lstsq(slope / size, rest, rcond=_BLIND)[0] / size
    return found


def _was_measured(plan: PlannedExperiment, name: str) -> bool:
    """True if the experiment holds samples of an output; a derived channel is a plan or a simulation."""
    return name in plan.experiment and plan.experiment[name].origin != "derived"


def _slow_first(slope: Array) -> list[Array]:
    """Modes of a system matrix (n, n), each a basis (n, 1 or 2), by rising magnitude of the eigenvalue."""
    values, vectors = np.linalg.eig(slope)
    found = []
    for k in np.argsort(np.abs(values), kind="stable"):
        if values[k].imag > 0:
            found.append(np.stack([vectors[:, k].real, vectors[:, k].imag], axis=1))
        elif values[k].imag == 0:
            found.append(vectors[:, [k]].real)
    return found


def _demanded(slope: Array, rest: Array, modes: list[Array]) -> Array:
    """As ``_least_squares``, with the modes alone that explain more than noise would, tried from the slowest on.

    A start moved by noise rings in modes that the samples hardly show.
    """
    best = rest - slope @ _least_squares(slope, rest)
    noise = float(best @ best) / max(len(rest) - slope.shape[1], 1)
    chosen: Array = np.zeros((slope.shape[1], 0))
    step, left = np.zeros(slope.shape[1]), float(rest @ rest)
    for mode in modes:
        basis = np.concatenate([chosen, mode], axis=1)
        found = basis @ _least_squares(slope @ basis, rest)
        after = float(np.sum((rest - slope @ found) ** 2))
        if left - after > _DEMANDED**2 * mode.shape[1] * noise:
            chosen, step, left = basis, found, after
    return step


def _outputs_of(model: Model, plan: PlannedExperiment) -> tuple[str, ...]:
    """The outputs that count: asked for, else those that the experiment holds, else all of the model's."""
    known = tuple(variable.name for variable in model.outputs)
    if plan.outputs is None:
        return tuple(name for name in known if _was_measured(plan, name)) or known
    for name in plan.outputs:
        if name not in known:
            raise ExperimentError(
                f"{plan.name}: the model {model.name} has no such output",
                seen=repr(name),
                allowed=", ".join(known),
                cure="build the model with this output, such as two_mass(outputs=(...))",
            )
    if not plan.outputs:
        raise ExperimentError(
            f"{plan.name}: no output is measured",
            seen="outputs=()",
            allowed=", ".join(known),
            cure="leave outputs out for all",
        )
    return plan.outputs


def _with_planned(grid: Grid, outputs: tuple[str, ...], there: tuple[str, ...], every: int) -> Grid:
    """The grid with samples of the outputs that were not measured, values 0."""
    index = np.arange(0, grid.samples, every)
    absent = Measured(grid.time[index], np.zeros(len(index)), index, index)
    return replace(grid, measured=grid.measured | {name: absent for name in outputs if name not in there})
