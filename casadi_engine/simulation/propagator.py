"""The right propagator for a model: exact blocks, an exponential integrator, or Runge-Kutta steps."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import SimulationError
from casadi_engine.model import Model
from casadi_engine.model.jumps import jumps_in
from casadi_engine.model.linearity import is_affine
from casadi_engine.simulation.discretisation import Method
from casadi_engine.simulation.error_estimate import Stepped
from casadi_engine.simulation.event_propagator import EventPropagator
from casadi_engine.simulation.exponential_runge_kutta import ExponentialPropagator
from casadi_engine.simulation.gain import Gain, Seen, StatedGain
from casadi_engine.simulation.gappy import GappyPredictor
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.linear import LinearPropagator
from casadi_engine.simulation.observed import ObservedPropagator, with_states_shown
from casadi_engine.simulation.runge_kutta import Fineness, RungeKuttaPropagator
from casadi_engine.simulation.shared_core import Cores
from casadi_engine.simulation.split import split, timed_drives


class _CorePropagator(LinearPropagator):
    """The linear propagator of a model whose simple laws joined its drives: those are its own business."""

    shown: int | None = None

    def drives_at(self, z: Array, points: NDArray[np.intp] | None = None) -> Array:
        """(m, k) drives of the model at the grid points with these numbers (k,), all by default."""
        return super().drives_at(z, points)[: self.shown]


class _GappyCore(GappyPredictor):
    """The same for a predictor with gaps."""

    shown: int | None = None

    def drives_at(self, z: Array) -> Array:
        """(m, N) drives of the model on the grid."""
        return super().drives_at(z)[: self.shown]


def fineness_of(propagator: object) -> int | float | Fineness | None:
    """How finely a propagator integrates, for another one of the same grid; None for one that is exact."""
    if isinstance(propagator, RungeKuttaPropagator):
        return propagator.fineness
    if isinstance(propagator, EventPropagator):
        return propagator.tolerance
    if isinstance(propagator, (ExponentialPropagator, ObservedPropagator)):
        return propagator.substeps
    return None


def steps_kept(propagator: object, most: int) -> AbstractContextManager[None]:
    """What a point far off asks of the integration is not asked of the others; see ``RungeKuttaPropagator``."""
    return propagator.unchanged(most) if isinstance(propagator, RungeKuttaPropagator) else nullcontext()


class Trajectory(Protocol):
    """What a propagation gives; see ``LinearTrajectory`` for the shapes."""

    y: Array
    ys: Array

    @property
    def end(self) -> Array: ...
    @property
    def end_z(self) -> Array: ...
    @property
    def end_s(self) -> Array: ...


def make_propagator(
    model: Model,
    grid: Grid,
    intervals: Intervals,
    z: ca.SX,
    physical: ca.SX,
    *,
    scale: Array,
    method: Method = "exact",
    gain: Array | Gain | None = None,
    used: Seen | None = None,
    steps: int | float | Fineness | None = None,
    cores: Cores | None = None,
) -> LinearPropagator | GappyPredictor | Stepped:
    """Propagator of a model over one record.

    A linear core alone is propagated exactly; a core with nonlinear laws by the exponential integrator, whatever its
    outputs show; equations that have no useful core by Runge-Kutta steps.

    method : "exact", or "euler" for a linear model; gain : (n, ny) correction gain per scaled state, a Gain that hangs
    on z, or None; used : the outputs that correct the state, None for all
    cores : discrete cores shared with further records of the same fit; None for its own
    steps : how finely a nonlinear model is integrated, `fineness_of` another propagator of the same grid; None for the
    fewest steps that are stable
    Raises SimulationError where a method or a gain does not go with the model or with the record.
    """
    if not isinstance(method, str) or method not in ("exact", "euler"):
        raise SimulationError(
            "the method is not known",
            seen=repr(method),
            allowed='"exact" or "euler"',
            cure='leave it out for "exact"',
        )
    if switches_with_states(model):
        _check_options(grid, method, gain)
        tolerance = {"tolerance": steps} if isinstance(steps, float) else {}
        return EventPropagator(model, grid, intervals, z, physical, scale=scale, **tolerance)
    fineness = steps if isinstance(steps, Fineness) else None
    if not grid.uniform or fineness is not None or switches_in_time(model):
        _check_options(grid, method, gain)
        return RungeKuttaPropagator(model, grid, intervals, z, physical, scale=scale, fineness=fineness)
    bent = model.has_slot_laws or model.linear is None or timed_drives(model)
    parts = split(model) if bent else None
    inner = parts.model if parts is not None else model
    if inner.linear is not None and not inner.has_slot_laws:
        made = _linear(
            inner, grid, intervals, z, physical, scale=scale, method=method, gain=gain, used=used, cores=cores
        )
        made.shown = len(model.drives)
        return made
    if method != "exact" or gain is not None:
        raise SimulationError(
            "this model has nonlinear terms, and the option is for linear models",
            seen=f"method={method!r}" if method != "exact" else "a correction gain",
            allowed='method="exact" without a gain',
            cure="take the linear form of the model, or leave the option out",
        )
    whole = steps if isinstance(steps, int) else 1
    if parts is not None:
        return ExponentialPropagator(model, parts, grid, intervals, z, physical, scale=scale, substeps=whole)
    shown = with_states_shown(model)
    parts = split(shown)
    if parts is not None and parts.model.has_slot_laws:
        states = ExponentialPropagator(
            shown, parts, grid, intervals, z, physical, scale=scale, substeps=whole
        )
        return ObservedPropagator(model, states, grid, z, physical)
    return RungeKuttaPropagator(model, grid, intervals, z, physical, scale=scale)


@lru_cache(maxsize=64)
def switches_with_states(model: Model) -> bool:
    """True if the equations jump where the states say so: their events are met one by one."""
    return model.has_jumps and jumps_in(model.closed_ode, model.x)


@lru_cache(maxsize=64)
def bends_between_samples(model: Model) -> bool:
    """True if the equations are not affine in the channels and time: then an integrator of a linear core, for which
    drives are lines between samples, and one that reads channels between samples have different answers."""
    return not is_affine(model.closed_ode, model.u, model.t)


@lru_cache(maxsize=64)
def switches_in_time(model: Model) -> bool:
    """True if the equations jump at instants that time or a channel decides: steps are cut there."""
    return model.has_jumps and jumps_in(model.closed_ode, ca.vertcat(model.u, model.t))


def _check_options(grid: Grid, method: Method, gain: Array | Gain | None) -> None:
    """Refuse what asks for a linear model on equal steps."""
    if method == "exact" and gain is None:
        return
    why = (
        "the equations jump"
        if grid.uniform
        else "the samples of this record are not equally spaced, or inputs and outputs were not sampled together"
    )
    raise SimulationError(
        f"{why}, and the option is for linear models on equal steps",
        seen=f"method={method!r}" if method != "exact" else "a correction gain",
        allowed='method="exact" without a gain',
        cure="resample the inputs to the outputs' times, or leave the option out",
    )


def _linear(
    model: Model,
    grid: Grid,
    intervals: Intervals,
    z: ca.SX,
    physical: ca.SX,
    *,
    scale: Array,
    method: Method,
    gain: Array | Gain | None,
    used: Seen | None,
    cores: Cores | None,
) -> _CorePropagator | _GappyCore:
    """The propagator of a linear core, with or without correction."""
    if gain is None:
        return _CorePropagator(model, grid, intervals, z, physical, scale=scale, method=method, cores=cores)
    feedback, seen = _feedback(model, grid, used)
    if isinstance(gain, np.ndarray):
        if starts_afresh(model, gain, scale):
            _check_pairs(grid)
            seen = np.ones_like(seen)
        gain = StatedGain(ca.SX(ca.DM(gain * scale[:, None])), z, scale)
    if seen.all():
        return _CorePropagator(
            model, grid, intervals, z, physical, scale=scale, method=method, gain=gain, feedback=feedback,
            cores=cores,
        )  # fmt: skip
    return _GappyCore(
        model,
        grid,
        intervals,
        z,
        physical,
        scale=scale,
        method=method,
        gain=gain,
        feedback=feedback,
        seen=seen,
    )


def after_missing(grid: Grid) -> NDArray[np.bool_]:
    """(N,) True for the grid points that follow one at which an output was not measured.

    A predictor that starts each step from the measurement has no prediction there: adjacent pairs alone count
    (thesis 2.37).
    """
    there = np.ones(grid.samples, dtype=bool)
    for measured in grid.measured.values():
        own = np.zeros(grid.samples, dtype=bool)
        own[measured.position.astype(int)] = True
        there &= own
    return np.concatenate([[False], ~there[:-1]])


def _feedback(model: Model, grid: Grid, used: Seen | None) -> tuple[Array, NDArray[np.bool_]]:
    """(ny, N) measured outputs on the grid, interpolated where there is none, and where there is one.

    An output that corrects nothing counts as there.
    """
    rows, seen = [], []
    for k, output in enumerate(model.outputs):
        measured = grid.measured.get(output.name)
        if used is not None and not used[k]:
            rows.append(np.zeros(grid.samples))
            seen.append(np.ones(grid.samples, dtype=bool))
            continue
        if measured is None:
            raise SimulationError(
                "a predictor needs every output on the inputs' time grid",
                seen=f"{output.name} was not measured",
                allowed="outputs that were sampled together with the inputs",
                cure="resample the inputs to the output's times, or take output error (no gain)",
            )
        there = np.zeros(grid.samples, dtype=bool)
        there[measured.position.astype(int)] = True
        rows.append(np.interp(np.arange(grid.samples), measured.position, measured.values))
        seen.append(there)
    return np.array(rows), np.array(seen)


def _check_pairs(grid: Grid) -> None:
    """Refuse a record in which no sample follows another, for a predictor that starts afresh at each."""
    lost = {name: grid.samples - len(m.values) for name, m in grid.measured.items()}
    after = after_missing(grid)
    after[0] = True
    if all(after[m.position.astype(int)].all() for m in grid.measured.values()):
        raise SimulationError(
            "there are no two neighbouring samples to predict one from the other",
            seen=", ".join(
                f"{count} of {grid.samples} samples of {name} missing"
                for name, count in lost.items()
                if count
            ),
            allowed="outputs at the rate of the inputs",
            cure="resample the inputs to the output's times, or take output error (no gain)",
        )


def starts_afresh(model: Model, gain: Array, scale: Array) -> bool:
    """True if L C = I whatever the parameters: the corrected state is the measured one, without memory.

    A sample after a missing one then has no prediction and must not count (``after_missing``).
    """
    core = model.linear
    if core is None or ca.depends_on(core.C, model.p):
        return False
    c = np.asarray(ca.evalf(ca.densify(core.C)), dtype=float) * scale
    return bool(np.abs(gain @ c - np.eye(len(scale))).max() < 1e-9)
