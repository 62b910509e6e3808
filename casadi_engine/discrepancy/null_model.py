"""The null fit as the score tests see it: residuals, and their slopes in every free parameter and initial state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.discrepancy.late_samples import completed, with_all_samples
from casadi_engine.errors import EstimationError, SimulationError
from casadi_engine.estimation.constraints import ParameterConstraints
from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.estimation.fit import Fit
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.model.jumps import jumps, jumps_in
from casadi_engine.parameters.compiled import ParameterMap, compile
from casadi_engine.simulation.candidate_sensitivities import (
    Direction,
    at_measurements,
    grid_sensitivities,
    initial_direction,
    parameter_direction,
)
from casadi_engine.simulation.error_estimate import refined_to
from casadi_engine.simulation.exponential_runge_kutta import MOST_SUBSTEPS
from casadi_engine.simulation.grid import Grid, lay_grid
from casadi_engine.simulation.intervals import Observation, cut
from casadi_engine.simulation.null_path import NullPath, null_path
from casadi_engine.simulation.propagator import make_propagator, switches_in_time
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator

Array = NDArray[np.float64]
Index = NDArray[np.intp]

FOUR_STROKE = 4 * np.pi
# Pieces that stand in for engine cycles where there is no crank angle.
_PIECES = 10
# A constraint this close to its limit (in its own units) is taken to hold.
_AT_LIMIT = 1e-6
# Places along a record from which where a state goes is told; times as far as it goes that the rest of a spring may
# well be away: a force that is a spring's from a million times as far is a constant.
_PLACES, _TRAVELS = 4, 10.0


@dataclass(frozen=True, eq=False)
class RecordNull:
    """One record at the null optimum.

    residual : output -> (N,) measured less simulated, at the samples that count; time : output -> (N,) s
    index : output -> (N,) their numbers in the channel, of ``length[output]`` samples
    cycle : output -> (N,) number of the engine cycle, 0 from theta = 0 on, or of a piece of the record
    slopes : output -> (N, n_theta + n_start) in the free directions of the parameters, then the free initial states
    starts : the free initial states; begins : state of an effect's own -> how far from where it may well begin it
        does begin, and the standard deviation of that
    """

    name: str
    path: NullPath
    residual: Mapping[str, Array]
    time: Mapping[str, Array]
    index: Mapping[str, Index]
    length: Mapping[str, int]
    cycle: Mapping[str, Index]
    slopes: Mapping[str, Array]
    starts: tuple[str, ...]
    begins: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the measured outputs."""
        return tuple(self.residual)

    def valid(self, output: str) -> NDArray[np.bool_]:
        """(length,) True for the samples of an output's channel that count."""
        found = np.zeros(self.length[output], dtype=bool)
        found[self.index[output]] = True
        return found

    def columns(self, directions: Sequence[Direction]) -> dict[str, Array]:
        """Sensitivities of directions: output -> (N, K)."""
        if not directions:
            return {name: np.zeros((len(e), 0)) for name, e in self.residual.items()}
        found = at_measurements(self.path, grid_sensitivities(self.path, directions))
        return {name: found[name].T for name in self.residual}


@dataclass(frozen=True, eq=False)
class NullModel:
    """The null optimum of all records.

    parameters : names of the free vector z; units; values : (nz,); turn : (nz, n_theta), z moves by turn @ step in the
    directions that bounds and constraints leave free
    prior : (r, n_theta + 1) rows [d(prior residual)/d(step), prior residual] of the priors, in standard deviations
    """

    model: Model
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    turn: Array
    prior: Array
    records: tuple[RecordNull, ...]

    @property
    def count(self) -> int:
        """Samples that count, over all records and outputs."""
        return sum(len(e) for record in self.records for e in record.residual.values())


_KNOWN: WeakKeyDictionary[Fit, NullModel] = WeakKeyDictionary()


def null_model(fit: Fit) -> NullModel:
    """The null model of a fit, by single shooting from its initial states; once for as long as the fit is there.

    Raises EstimationError for a fit with a correction gain, whose residuals are innovations of a predictor, and for
    equations that jump with their states.
    """
    if fit.gain is not None:
        raise EstimationError(
            "the score test needs a simulation, and this fit is a one-step predictor",
            seen="a fit with a correction gain",
            allowed="output error: noise without gain",
            cure="fit again without a gain",
        )
    if fit not in _KNOWN:
        _KNOWN[fit] = _null_of(fit)
    return _KNOWN[fit]


def _null_of(fit: Fit) -> NullModel:
    names = tuple(record.name for record in fit.data)
    starts = {name: dict(fit.initial[name]) for name in names}
    held = {
        name: tuple(s for s, e in starts[name].items() if e.fixed or e.at_bound is not False)
        for name in names
    }
    first = {name: np.array([e.value for e in starts[name].values()]) for name in names}
    at_bound = tuple(name for name in fit.free if fit.estimates[name].at_bound is not False)
    return null_at(
        fit.model,
        fit.data,
        fit.parameters,
        fit.z,
        first,
        held_starts=held,
        held_parameters=at_bound,
        steps=steps_of(fit),
    )


def steps_of(fit: Fit) -> dict[str, int]:
    """Steps to a sample of each record's exponential integrator, as a fit took them.

    Those that it took in places are more than an integrator of whole samples may take.
    """
    return {
        name: min(about.substeps, MOST_SUBSTEPS)
        for name, about in fit.integration.items()
        if about.substeps > 0
    }


@lru_cache(maxsize=64)
def _jumps(model: Model) -> tuple[int, ...]:
    """Numbers of the states whose equations jump, but for what sensors were given: those act on no other state, and
    jump where an output has a corner, by its rate."""
    given = tuple(f"{one.at}_{one.effect.name}_" for one in model.effects if one.at.startswith("sensor_"))
    return tuple(
        k
        for k, state in enumerate(model.states)
        if not (given and state.name.startswith(given)) and jumps_in(model.closed_ode[k], model.x)
    )


def refuse_jumps(model: Model) -> None:
    """Raise EstimationError for equations that jump with their states: a score is a slope along a smooth simulation."""
    if not _jumps(model):
        return
    row = _jumps(model)[0]
    switch = next(s for s in jumps(model.closed_ode[row], model.x) if s.kind != "kink")
    raise EstimationError(
        "effects are scored along a simulation without jumps, and the equations jump with the states",
        seen=f"the ode of {model.states[row].name} jumps at {switch.g} = "
        f"{'a whole number' if switch.kind == 'integer' else 0}",
        allowed="equations that jump at instants in time at most",
        cure="round the jump: tanh(v/width) for sign(v), 0.5*(1 + tanh(v/width)) for v > 0; friction of the library, "
        "model.with_effect(ce.effects.CoulombFriction(), at=port), is rounded by itself",
    )


def null_at(
    model: Model,
    data: Sequence[Experiment],
    parameters: object,
    z: Array,
    first: Mapping[str, Array],
    *,
    held_starts: Mapping[str, tuple[str, ...]] | None = None,
    held_parameters: Sequence[str] = (),
    steps: Mapping[str, int] | None = None,
) -> NullModel:
    """The null model at z : (nz,) and first states record -> (n,), parameters and states in their units.

    steps : record -> steps to a sample of its exponential integrator; left out, the fewest that are stable
    """
    refuse_jumps(model)
    pmap = compile(parameters, model.parameter_names, tuple(r.name for r in data))  # type: ignore[arg-type]
    z = np.asarray(z, dtype=float)
    turn = free_directions(model, pmap, z, held_parameters)
    prior = prior_rows(pmap, z, turn)
    records = []
    for record in data:
        p = pmap.unpack(z, record.name)
        slope = ca.Function("slope", [pmap.z], [ca.densify(ca.jacobian(pmap.physical[record.name], pmap.z))])
        moved = np.asarray(slope(z), dtype=float).reshape(len(p), len(z)) @ turn
        held = (held_starts or {}).get(record.name, ())
        records.append(
            _record(
                model,
                record,
                p,
                moved,
                np.asarray(first[record.name], dtype=float),
                held,
                (steps or {}).get(record.name),
            )
        )
    units = tuple(unit_of(parameters, name) for name in pmap.free)
    return NullModel(model, pmap.free, units, z, turn, prior, tuple(records))


def unit_of(parameters: object, name: str) -> str:
    return str(parameters[name.partition("@")[0]].unit)  # type: ignore[index]


def free_directions(model: Model, pmap: ParameterMap, z: Array, held: Sequence[str]) -> Array:
    """(nz, n_theta) steps of z, each about the size of its entry, that keep what bounds and constraints hold."""
    nz = len(z)
    scale = np.where(z != 0, np.abs(z), pmap.scale)
    rows = [np.eye(nz)[[name in held for name in pmap.free]]]
    coordinates = Coordinates(pmap)
    constraints = ParameterConstraints(model, pmap, coordinates)
    if constraints.count:
        v = coordinates.of(z)
        value, jacobian = constraints.evaluate(v)
        acts = np.minimum(np.abs(value - constraints.lower), np.abs(constraints.upper - value)) < _AT_LIMIT
        acts |= constraints.lower == constraints.upper
        rows.append(jacobian[acts] / coordinates.slope(v) * scale)
    held_rows = np.concatenate(rows)
    if not len(held_rows):
        return np.diag(scale)
    _, strength, turn = np.linalg.svd(held_rows, full_matrices=True)
    rank = int((strength > 1e-9 * strength.max(initial=1.0)).sum())
    return np.asarray(scale[:, None] * turn[rank:].T)


def prior_rows(pmap: ParameterMap, z: Array, turn: Array) -> Array:
    residual = ca.vertcat(ca.SX(0, 1), *[(p.mean - p.expression) / p.sigma for p in pmap.priors])
    if not residual.numel():
        return np.zeros((0, turn.shape[1] + 1))
    function = ca.Function("priors", [pmap.z], [residual, ca.densify(ca.jacobian(-residual, pmap.z))])
    value, slope = (np.asarray(part, dtype=float) for part in function(z))
    return np.column_stack([slope.reshape(-1, len(z)) @ turn, value.ravel()])


def _record(
    model: Model,
    record: Experiment,
    p: Array,
    moved: Array,
    first: Array,
    held: tuple[str, ...],
    steps: int | None,
) -> RecordNull:
    measured = tuple(out.name for out in model.outputs if out.name in record)
    path = null_path(model, lay_grid(model, record, outputs=measured), p, first, steps=steps)
    seen = path.grid.measured
    grid = with_all_samples(path.grid, record)
    path = replace(path, grid=grid)
    out = path.function([model.output_expressions])(*path.at_samples().arguments)[0]
    simulated = at_measurements(path, np.broadcast_to(out, (len(model.outputs), grid.samples))[None])
    starts = [k for k, state in enumerate(model.states) if state.name not in held]
    directions = [parameter_direction(model, column, name=f"theta_{k}") for k, column in enumerate(moved.T)]
    directions += [
        initial_direction(model, k, model.states[k].scale, name=model.states[k].name) for k in starts
    ]
    residual = {name: grid.measured[name].values - simulated[name][0] for name in simulated}
    for name, own in seen.items():
        if len(own.beyond):
            inside = np.isin(grid.measured[name].index, own.index)
            residual[name] = completed(own, residual[name][inside], mirror=True)
    base = RecordNull(
        name=record.name,
        path=path,
        residual=residual,
        time={name: grid.measured[name].time for name in residual},
        index={name: grid.measured[name].index for name in residual},
        length={name: len(record[name].time) for name in residual},
        cycle={name: cycle_numbers(model, grid, grid.measured[name].time) for name in residual},
        slopes={},
        starts=tuple(model.states[k].name for k in starts),
        begins=own_states(model, path.x.T),
    )
    if switches_in_time(
        model
    ):  # an instant that moves with a parameter is no part of the equation along the path
        scale = np.array([state.scale for state in model.states])
        exact = replace(path, grid=replace(grid, measured=seen))
        slopes = _propagated_slopes(exact, moved, first / scale, scale, starts)
        slopes = {name: completed(seen[name], rows, mirror=False) for name, rows in slopes.items()}
    else:
        slopes = base.columns(directions)
    return RecordNull(**{**vars(base), "slopes": slopes})


def own_states(model: Model, x: Array) -> dict[str, tuple[float, float]]:
    """State of an effect's own -> how far from where it may well begin it does begin along states (M, n), and the
    standard deviation of that, in its scale, if they are more than a place or two.

    One that follows a signal begins where the signal goes (``reach``); one that is counted from where something rests
    (``rests``) may well be so many times as far from there as it goes; any other begins anywhere where it goes itself.
    """
    found: dict[str, tuple[float, float]] = {}
    if len(x) < _PLACES:
        return found
    for one in model.effects:
        reach = float(getattr(one.effect, "reach", 0.0))
        for k, state in enumerate(model.states):
            if state.name.startswith(f"{one.at}_{one.effect.name}_"):
                goes = float(np.std(x[:, k]))
                away = float(np.mean(x[:, k])) / _TRAVELS if getattr(one.effect, "rests", False) else 0.0
                off = float(x[0, k]) - one.effect.first if reach > 0 else away
                found[state.name] = off / state.scale, (reach or goes) / state.scale
    return found


def _propagated_slopes(
    path: NullPath, moved: Array, start: Array, scale: Array, starts: Sequence[int]
) -> dict[str, Array]:
    """The slopes of a record by the derivatives of its steps; start : (n,) and ``starts`` in scaled states."""
    model, grid = path.model, path.grid
    z, plan = ca.SX.sym("z", moved.shape[1]), cut(grid, None)
    physical = ca.SX(ca.DM(path.p)) + ca.SX(ca.DM(moved)) @ z
    propagator = make_propagator(model, grid, plan, z, physical, scale=scale)
    here, nodes = np.zeros(moved.shape[1]), start[None]
    if isinstance(
        propagator, RungeKuttaPropagator
    ):  # half of the steps of which the path does not feel the error
        names = tuple(out.name for out in model.outputs)
        with suppress(SimulationError, FloatingPointError):
            propagator, _ = refined_to(propagator, here, nodes, outputs=names, samples=grid.samples)
            propagator = propagator.finer(2)  # type: ignore[union-attr]
    found = propagator.propagate(here, nodes, 1)
    observation = Observation(grid, plan, tuple(out.name for out in model.outputs))
    by_start = observation.observe_starts(found.ys).reshape(-1, len(start))
    by_z = observation.observe(found.y[1:]).reshape(moved.shape[1], len(by_start))
    by_start = by_start[:, list(starts)]
    every = np.concatenate([by_z.T, by_start], axis=1)
    return {name: every[rows] for name, rows in observation.where.items()}


def cycle_numbers(model: Model, grid: Grid, time: Array) -> Index:
    """(N,) number of the engine cycle at the times [s], 0 from theta = 0 on, also in a piece of a record, so that it is
    the one of `Experiment.cycles` and of a misfire less one; ten equal pieces of the record without theta."""
    names = [v.name for v in model.inputs]
    if "theta" in names:
        theta = np.interp(time, grid.time, grid.channels[names.index("theta")])
        number = np.floor(theta / FOUR_STROKE).astype(int)
        return np.asarray(number, dtype=np.intp)
    number = np.floor((time - grid.start) / grid.span * _PIECES).astype(int)
    return np.asarray(np.clip(number, 0, _PIECES - 1), dtype=np.intp)


def above_rounding(null: NullModel, sigma: Mapping[str, float]) -> dict[str, float]:
    """Levels no lower than the rounding of the measured numbers: an effect may explain a record to the last digit."""
    found = dict(sigma)
    for record in null.records:
        for output in record.outputs:
            size = float(np.abs(record.path.grid.measured[output].values).max(initial=0.0))
            found[output] = max(found[output], np.finfo(float).eps * size)
    return found
