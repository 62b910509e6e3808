"""One record simulated at many points side by side: parameters and first states of their own, one run for all.

Where a likelihood is asked for at thousands of points, a step costs as much for a thousand of them as for a few.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from casadi_engine.deadline import ask
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator
from casadi_engine.simulation.sample_rows import to_rows
from casadi_engine.simulation.stage_newton import stages_of
from casadi_engine.simulation.sweeps import MACHINE, Sweeps, array_step, machine_ends


def runs_side_by_side(propagator: object) -> bool:
    """Whether a propagator has Runge-Kutta steps of one interval, which are laid already."""
    if not isinstance(propagator, RungeKuttaPropagator):
        return False
    return propagator.intervals.m == 1 and propagator.fineness is not None


def side_by_side(propagator: RungeKuttaPropagator, z: Array, first: Array) -> Array:
    """Outputs (P, R*ny, b, 1) at points z (nz, P) from first states (n, P), scaled; NaN from where a state is lost.

    propagator : one of which ``runs_side_by_side`` says so
    """
    layout = propagator.layout
    shown = layout.at[:, 0].tolist()  # numbers of the steps at which a sample is
    order = {own: k for k, own in enumerate(dict.fromkeys(shown))}
    found = np.empty((len(order), *first.shape))
    x, last = np.asarray(first, dtype=float), 0
    with np.errstate(all="ignore"):
        if not propagator.sweeps.scheme.implicit and first.shape[1] <= MACHINE:
            numbers, ends = machine_ends(propagator.sweeps, z, x)
            for step, row in order.items():
                found[row] = ends[int(numbers[step])]
        else:
            advance = _step(propagator.sweeps, z)
            for own, after in layout:
                ask(first.shape[1])
                if own.start in order:
                    found[order[own.start]] = x
                x, last = advance(x, own.start), int(after[0])
            found[order[last]] = x
        states = found[[order[k] for k in shown]]
        return to_rows(propagator.intervals, propagator.outputs.side_by_side(states, z))


def _step(sweeps: Sweeps, z: Array) -> Callable[[Array, int], Array]:
    """A step at z (nz, P): of states (n, P) and the number of the step."""
    scheme, slope = sweeps.scheme, sweeps.slope
    if not scheme.implicit:
        explicit, given = array_step(slope, scheme), sweeps.given
        return lambda x, k: explicit(x, given[:, k], z)[0]
    many, points = np.tile(z, scheme.stages), z.shape[1]
    rows = len(sweeps.known[0])

    def implicit(x: Array, k: int) -> Array:
        known = np.column_stack([own[:, k] for own in sweeps.known])
        both = np.concatenate([np.repeat(known, points, axis=1), many])
        found = stages_of(scheme, lambda s, own: slope.newton(s, own[:rows], own[rows:]), x, both)
        return np.asarray(found[-1])

    return implicit
