"""How far a propagation is from the equations' exact solution, by steps of half the length; and finer ones."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from casadi_engine.errors import SimulationError
from casadi_engine.simulation.carried_errors import carried_on
from casadi_engine.simulation.event_propagator import EventPropagator
from casadi_engine.simulation.exponential_runge_kutta import MOST_SUBSTEPS, ExponentialPropagator, TooStiff
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.linear import LinearPropagator
from casadi_engine.simulation.observed import ObservedPropagator
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator

Stepped = ExponentialPropagator | ObservedPropagator | RungeKuttaPropagator | EventPropagator
Propagator = LinearPropagator | Stepped

# Of a scheme of fourth order: its error is this many times its difference from half the step.
_RICHARDSON = 16 / 15
_EXPONENTIAL = "exponential Runge-Kutta steps of order 4"


@dataclass(frozen=True)
class ErrorEstimate:
    """Largest estimated error of each output over the record, in the output's unit and relative to its largest value.

    substeps : most integration steps to a sample; 0 for a linear model, which is solved exactly
    tolerance : relative, that was asked for; integrator : what the steps are, in words
    shift : the most by which the error moves an estimate of a fit, in standard errors; None outside of fits
    steps : number of all steps, of an integrator that chooses them itself; ``substeps`` is -1 then
    """

    outputs: tuple[str, ...]
    absolute: tuple[float, ...]
    relative: tuple[float, ...]
    substeps: int
    tolerance: float
    integrator: str = _EXPONENTIAL
    shift: float | None = None
    steps: int | None = None

    @property
    def largest(self) -> float:
        """The largest relative error of all outputs."""
        return max(self.relative, default=0.0)

    @property
    def within(self) -> bool:
        """True if no output's error is above the tolerance."""
        return self.largest <= self.tolerance

    def __str__(self) -> str:
        if self.substeps == 0:
            return "integration: exact"
        steps = "one step" if self.substeps == 1 else f"{self.substeps} steps"
        errors = ", ".join(
            f"{name} {value:.1e}" for name, value in zip(self.outputs, self.relative, strict=True)
        )
        kind = (
            f"{steps} to a sample"
            if self.substeps > 0
            else ""
            if self.steps is None
            else f"{self.steps} steps"
        )
        how = ", ".join(part for part in (self.integrator, kind) if part)
        text = f"integration: {how}, estimated relative error {errors}"
        if self.shift is not None:
            return f"{text}; it moves no estimate by more than {self.shift:.1g} standard errors"
        return text if self.within else f"{text}; more than the tolerance {self.tolerance:.1e}"

    def to_dict(self) -> dict[str, object]:
        """Plain numbers, ready for JSON."""
        return {
            "integrator": self.integrator,
            "substeps": self.substeps,
            **({} if self.steps is None else {"steps": self.steps}),
            "tolerance": self.tolerance,
            "relative": dict(zip(self.outputs, self.relative, strict=True)),
            "absolute": dict(zip(self.outputs, self.absolute, strict=True)),
        }


@dataclass(frozen=True)
class SignedError:
    """The estimated error of a whole run's outputs, off (R*ny, b, M), and their size, likewise.

    steps : where it arises, of each step, for a propagator that can be refined in places; None for any other
    """

    off: Array
    size: Array
    steps: Array | None = None


def signed_error(propagator: Stepped, z: Array, nodes: Array) -> SignedError:
    """The integration error of one whole run whose states at the intervals' starts are ``nodes`` (M, n), scaled.

    What an interval's steps are off by is carried through the later ones by the sensitivities: all intervals are
    integrated side by side, which a single run is not.
    """
    z = np.asarray(z, dtype=float)
    if isinstance(propagator, RungeKuttaPropagator):
        path = propagator.propagate(z, nodes, 1)
        off, steps = propagator.arising(z, path)
        return SignedError(off, path.y[0], steps)
    # The coarse path first: it may have refined its steps for stability.
    coarse = propagator.propagate(z, nodes, 1 if len(nodes) > 1 else 0)
    fine = propagator.finer(2).propagate(z, nodes, 0)
    off = fine.y[0] - coarse.y[0]
    if len(nodes) > 1:
        ends = np.broadcast_to(coarse.end_s, (len(nodes), nodes.shape[1], nodes.shape[1]))
        carried = carried_on(ends, (fine.end - coarse.end).T)
        off = off + np.einsum("kbma,ma->kbm", coarse.ys, carried)
    return SignedError(_RICHARDSON * off, fine.y[0])


def estimate_error(
    propagator: Propagator,
    z: Array,
    nodes: Array,
    *,
    outputs: tuple[str, ...],
    samples: int,
    tolerance: float = 1e-6,
) -> ErrorEstimate:
    """The integration error at z : (nz,) of a whole run through ``nodes`` (M, n), scaled.

    samples : of the record; what lies behind them in the last interval does not count
    """
    if isinstance(propagator, LinearPropagator):
        none = (0.0,) * len(outputs)
        return ErrorEstimate(outputs, none, none, 0, tolerance, "exact")
    found = signed_error(propagator, z, nodes)
    return summed_up(propagator, found, outputs=outputs, samples=samples, tolerance=tolerance)


def summed_up(
    propagator: Stepped,
    found: SignedError,
    *,
    outputs: tuple[str, ...],
    samples: int,
    tolerance: float = 1e-6,
) -> ErrorEstimate:
    """The largest errors of each output within the record."""
    real, ny = _recorded(propagator.intervals, samples), len(outputs)

    def largest(values: Array) -> list[float]:
        found = [float(np.abs(values[k::ny][real]).max(initial=0.0)) for k in range(ny)]
        return [value if math.isfinite(value) else math.inf for value in found]

    absolute, sizes = largest(found.off), largest(found.size)
    relative = tuple(one / other if other else one for one, other in zip(absolute, sizes, strict=True))
    words = _EXPONENTIAL
    if isinstance(propagator, RungeKuttaPropagator) and propagator.fineness is not None:
        words = propagator.fineness.scheme.name
    if isinstance(propagator, EventPropagator):
        words = f"explicit steps of order 8 that follow the error, {propagator.events} events"
    return ErrorEstimate(outputs, tuple(absolute), relative, propagator.substeps, tolerance, words)


def shortened(propagator: Stepped, found: SignedError, ratio: float) -> Stepped | None:
    """The propagator with steps for an error about ``ratio`` times smaller; None where they would be too many."""
    if isinstance(propagator, RungeKuttaPropagator):
        assert found.steps is not None
        try:
            return propagator.adapted(found.steps, ratio)
        except FloatingPointError:
            return None
    if isinstance(propagator, EventPropagator):
        return None if propagator.finest else propagator.finer(2)
    if propagator.substeps >= MOST_SUBSTEPS:
        return None
    wanted = propagator.substeps * 2 ** max(1, math.ceil(math.log2(max(ratio, 1.0)) / 4))
    return propagator.refined(min(wanted, MOST_SUBSTEPS))


def refined_to(
    propagator: Propagator,
    z: Array,
    nodes: Array,
    *,
    outputs: tuple[str, ...],
    samples: int,
    tolerance: float = 1e-6,
) -> tuple[Propagator, ErrorEstimate]:
    """The propagator with as many steps to a sample as the relative tolerance asks for, and the error it has then.

    Raises SimulationError where the most steps there may be do not reach the tolerance.
    """
    while True:
        if isinstance(propagator, LinearPropagator):
            about = estimate_error(
                propagator, z, nodes, outputs=outputs, samples=samples, tolerance=tolerance
            )
            return propagator, about
        try:
            found = signed_error(propagator, z, nodes)
        except TooStiff as fault:
            raise _out_of_reach(math.inf, propagator, tolerance) from fault
        about = summed_up(propagator, found, outputs=outputs, samples=samples, tolerance=tolerance)
        if about.within:
            return propagator, about
        finer = shortened(propagator, found, 2 * about.largest / tolerance)
        if finer is None:
            raise _out_of_reach(about.largest, propagator, tolerance)
        propagator = finer


def _out_of_reach(largest: float, propagator: Stepped, tolerance: float) -> SimulationError:
    return SimulationError(
        "the integration does not reach its tolerance: a law is too sharp for the record's rate",
        seen=f"{largest:.2g} with {propagator.substeps} steps to a sample",
        allowed=f"a relative error of {tolerance:.2g}",
        cure="make the law's smoothing wider, or the tolerance larger",
    )


def _recorded(plan: Intervals, samples: int) -> np.ndarray:
    """(R, b, M) True for grid points of the record, False for the padding behind it."""
    at = (
        plan.samples[:, None, None]
        + plan.q * np.arange(plan.b)[None, :, None]
        + plan.length * np.arange(plan.m)[None, None, :]
    )
    return np.asarray(at < samples)
