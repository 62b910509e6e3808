"""How far a propagation is from the equations' exact solution: the same with steps of half the length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casadi_engine.errors import SimulationError
from casadi_engine.simulation.exponential_runge_kutta import MOST_SUBSTEPS, ExponentialPropagator
from casadi_engine.simulation.general import GeneralPropagator
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.linear import LinearPropagator
from casadi_engine.simulation.observed import ObservedPropagator

Stepped = ExponentialPropagator | ObservedPropagator | GeneralPropagator
Propagator = LinearPropagator | Stepped

# Of a scheme of fourth order: its error is this many times its difference from half the step.
_RICHARDSON = 16 / 15


@dataclass(frozen=True)
class ErrorEstimate:
    """Largest estimated error of each output over the record, in the output's unit and relative to its largest value.

    substeps : integration steps to a sample; 0 for a linear model, which is solved exactly
    tolerance : relative, that was asked for
    """

    outputs: tuple[str, ...]
    absolute: tuple[float, ...]
    relative: tuple[float, ...]
    substeps: int
    tolerance: float

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
        text = f"integration: {steps} to a sample, estimated relative error {errors}"
        return text if self.within else f"{text}; more than the tolerance {self.tolerance:.1e}"

    def to_dict(self) -> dict[str, object]:
        """Plain numbers, ready for JSON."""
        return {
            "substeps": self.substeps,
            "tolerance": self.tolerance,
            "relative": dict(zip(self.outputs, self.relative, strict=True)),
            "absolute": dict(zip(self.outputs, self.absolute, strict=True)),
        }


def estimate_error(
    propagator: Propagator,
    z: Array,
    nodes: Array,
    *,
    outputs: tuple[str, ...],
    samples: int,
    tolerance: float = 1e-6,
) -> ErrorEstimate:
    """The integration error at z : (nz,) from ``nodes`` (M, n) scaled, by halving the step.

    samples : of the record; what lies behind them in the last interval does not count
    """
    if isinstance(propagator, LinearPropagator):
        none = (0.0,) * len(outputs)
        return ErrorEstimate(outputs, none, none, 0, tolerance)
    # The coarse path first: it may have refined its steps for stability.
    coarse = propagator.propagate(z, nodes, 0).y[0]
    fine = propagator.refined(2 * propagator.substeps).propagate(z, nodes, 0).y[0]
    return _largest(propagator, fine - coarse, fine, outputs, samples, tolerance)


def accumulated_error(
    propagator: Stepped,
    z: Array,
    nodes: Array,
    *,
    outputs: tuple[str, ...],
    samples: int,
    tolerance: float = 1e-6,
) -> ErrorEstimate:
    """`estimate_error` of one whole run whose states at the intervals' starts are ``nodes`` (M, n), scaled.

    What an interval's steps are off by is carried through the later ones by the sensitivities: all intervals are
    integrated side by side, which a single run is not.
    """
    coarse = propagator.propagate(z, nodes, 1)
    fine = propagator.refined(2 * propagator.substeps).propagate(z, nodes, 0)
    ends = np.broadcast_to(coarse.end_s, (len(nodes), nodes.shape[1], nodes.shape[1]))
    own = fine.end - coarse.end
    carried = np.zeros_like(nodes)
    for k in range(len(nodes) - 1):
        carried[k + 1] = ends[k] @ carried[k] + own[:, k]
    off = fine.y[0] - coarse.y[0] + np.einsum("kbma,ma->kbm", coarse.ys, carried)
    return _largest(propagator, off, fine.y[0], outputs, samples, tolerance)


def _largest(
    propagator: Stepped, off: Array, size: Array, outputs: tuple[str, ...], samples: int, tolerance: float
) -> ErrorEstimate:
    """The largest entries within the record; off, size : (R * ny, b, M)."""
    real, ny = _recorded(propagator.intervals, samples), len(outputs)
    absolute = [_RICHARDSON * float(np.abs(off[k::ny][real]).max(initial=0.0)) for k in range(ny)]
    sizes = [float(np.abs(size[k::ny][real]).max(initial=0.0)) for k in range(ny)]
    relative = tuple(one / other if other else one for one, other in zip(absolute, sizes, strict=True))
    return ErrorEstimate(outputs, tuple(absolute), relative, propagator.substeps, tolerance)


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

    Raises SimulationError where 64 steps to a sample do not reach the tolerance.
    """
    while True:
        found = estimate_error(propagator, z, nodes, outputs=outputs, samples=samples, tolerance=tolerance)
        if found.within or isinstance(propagator, LinearPropagator):
            return propagator, found
        if propagator.substeps >= MOST_SUBSTEPS:
            raise SimulationError(
                "the integration does not reach its tolerance: a law is too sharp for the record's rate",
                seen=f"{found.largest:.2g} with {propagator.substeps} steps to a sample",
                allowed=f"a relative error of {tolerance:.2g}",
                cure="make the law's smoothing wider, or the tolerance larger",
            )
        propagator = propagator.refined(min(2 * propagator.substeps, MOST_SUBSTEPS))


def _recorded(plan: Intervals, samples: int) -> np.ndarray:
    """(R, b, M) True for grid points of the record, False for the padding behind it."""
    at = (
        plan.samples[:, None, None]
        + plan.q * np.arange(plan.b)[None, :, None]
        + plan.length * np.arange(plan.m)[None, None, :]
    )
    return np.asarray(at < samples)
