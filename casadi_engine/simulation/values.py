"""The outputs of a model from a known start: exact where it is linear, else to a stated tolerance, jumps included."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_engine.errors import SimulationError
from casadi_engine.model import Model
from casadi_engine.model.jumps import jumps_in
from casadi_engine.simulation.adaptive import MOST_EVENTS, MOST_STEPS, TOO_MANY, Adaptive, Run
from casadi_engine.simulation.discretisation import Method
from casadi_engine.simulation.error_estimate import ErrorEstimate, Stepped, estimate_error, refined_to
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import cut
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.propagator import make_propagator
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator
from casadi_engine.simulation.switched_field import SwitchedField
from casadi_engine.simulation.tape import ArrayFunction

# Tolerances of the steps, relative to that of the result: two runs a factor 100 apart, and a third if they disagree.
_RUNS = (1e-2, 1e-4, 1e-6)
# Of their difference, the share that is left in the finer run; in theory a hundredth.
_LEFT = 0.1
# No run is asked for less than this.
_LEAST = 3e-14


@dataclass(frozen=True)
class Simulated:
    """outputs : (ny, N) on the grid; integration : how, and how far off."""

    outputs: Array
    integration: ErrorEstimate


def simulated(
    model: Model,
    grid: Grid,
    values: Array,
    start: Array,
    *,
    method: Method = "exact",
    tolerance: float = 1e-6,
) -> Simulated:
    """Simulate from ``start`` (n,), in the states' units, at parameters ``values`` (np,).

    tolerance : largest error of an output relative to its largest value

    Raises SimulationError where the result is not finite or the tolerance cannot be met.
    """
    if method == "exact" and not (grid.uniform and _by_steps(model)):
        return _adaptively(model, grid, values, start, tolerance)
    scale = np.array([state.scale for state in model.states])
    plan = cut(grid, None)
    outputs = tuple(out.name for out in model.outputs)
    about = {"outputs": outputs, "samples": grid.samples, "tolerance": tolerance}
    none, nodes = np.zeros(0), (start / scale)[None]
    propagator = make_propagator(
        model, grid, plan, ca.SX(0, 1), ca.SX(ca.DM(values)), scale=scale, method=method
    )
    if isinstance(propagator, RungeKuttaPropagator):
        return _adaptively(model, grid, values, start, tolerance)
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            if isinstance(propagator, Stepped):
                propagator, found = refined_to(propagator, none, nodes, **about)  # type: ignore[arg-type]
            else:
                found = estimate_error(propagator, none, nodes, **about)  # type: ignore[arg-type]
            path = propagator.propagate(none, nodes, 0)
    except (FloatingPointError, SimulationError):
        if method != "exact":
            raise _not_finite(model, values, None) from None
        return _adaptively(model, grid, values, start, tolerance)
    rows = path.y[0].reshape(len(plan.samples), len(outputs), plan.b).transpose(1, 2, 0)
    return Simulated(rows.reshape(len(outputs), -1)[:, : grid.samples], found)


def _by_steps(model: Model) -> bool:
    """True if steps from sample to sample suit the model: nothing jumps."""
    return not jumps_in(model.closed_ode, ca.vertcat(model.x, model.u, model.t))


def _adaptively(model: Model, grid: Grid, values: Array, start: Array, tolerance: float) -> Simulated:
    """By steps that follow the error, run with two tolerances that tell it."""
    field = SwitchedField(model, ca.SX(0, 1), ca.SX(ca.DM(values)))
    show = ArrayFunction([model.x, model.u, model.t, model.p], [model.closed_outputs])
    first = np.array([[hold == "first"] for hold in grid.holds]).reshape(len(grid.channels), 1)
    low = grid.channels[:, :-1]
    high = np.where(first, grid.channels[:, 1:], low)
    before: Array | None = None
    largest = np.inf
    for share in _RUNS:
        each = max(share * tolerance, _LEAST)
        run = _run(model, field, values, start, grid.time, low, high, each)
        with np.errstate(all="ignore"):
            outputs = show(np.ascontiguousarray(run.states.T), grid.channels, grid.time[None], values)[0]
        if not np.isfinite(outputs).all():
            raise _not_finite(model, values, float(grid.time[~np.isfinite(outputs).all(axis=0)][0]))
        if before is not None:
            absolute = _LEFT * np.abs(outputs - before).max(axis=1)
            size = np.abs(outputs).max(axis=1)
            # samples may be so close that both runs take the same steps: what a step is off by is less than this
            absolute = np.where(absolute > 0, absolute, each * size)
            relative = np.where(size > 0, absolute / np.where(size > 0, size, 1), absolute)
            largest = float(relative.max())
            if largest <= tolerance:
                names = tuple(out.name for out in model.outputs)
                sizes = (tuple(absolute.tolist()), tuple(relative.tolist()))
                found = ErrorEstimate(names, *sizes, -1, tolerance, _words(run), steps=run.steps)
                return Simulated(outputs, found)
        before = outputs
    raise SimulationError(
        "the simulation does not reach its tolerance",
        seen=f"runs whose steps are 100 times more exact differ by {largest / _LEFT:.2g} of an output's largest value",
        allowed=f"an estimated error of {tolerance:.2g}",
        cure="shorten the record (a chaotic motion forgets its start), check the equations, or give a larger tolerance",
    )


def _run(
    model: Model,
    field: SwitchedField,
    values: Array,
    start: Array,
    time: Array,
    low: Array,
    high: Array,
    tolerance: float,
) -> Run:
    scale = np.array([state.scale for state in model.states])
    machine = Adaptive(field, tolerance, scale=scale)
    try:
        with np.errstate(all="ignore"):
            return machine.run(start, time, low, high)
    except FloatingPointError as failure:
        if str(failure) == TOO_MANY:
            raise SimulationError(
                "the simulation takes too many steps",
                seen=f"{machine.steps} steps and {machine.events} events, at {machine.time:.6g} s of {time[-1]:.6g} s",
                allowed=f"{MOST_STEPS} steps, {MOST_EVENTS} events",
                cure="shorten the record, give a larger tolerance, or smooth a law that switches without end",
            ) from None
        raise _not_finite(model, values, machine.time) from None


def _words(run: Run) -> str:
    kind = "explicit steps of order 8, then CVODES" if run.stiff else "explicit steps of order 8"
    return f"{kind} that follow the error" + (f", {run.events} events" if run.events else "")


def _not_finite(model: Model, values: Array, time: float | None) -> SimulationError:
    numbers = ", ".join(f"{n}={value:.6g}" for n, value in zip(model.parameter_names, values, strict=True))
    parts = ([] if time is None else [f"at {time:.6g} s"]) + ([f"with {numbers}"] if numbers else [])
    return SimulationError(
        "the simulation is not finite",
        seen=", ".join(parts) or "a state or output that is infinite or not a number",
        allowed="parameters and initial states that give finite numbers",
        cure="check the equations there: a root or logarithm of a negative number, a division by 0, or a state that "
        "grows without limit",
    )
