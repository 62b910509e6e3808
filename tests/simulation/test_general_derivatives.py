"""Derivatives of the general propagator against CasADi, on the same Runge-Kutta recursion written out."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_engine.simulation.general import GeneralPropagator
from casadi_engine.simulation.intervals import Intervals

TOLERANCE = 1e-9


def compared(made, model, seed, *, plan=(2, 2, 2), stride=1, beyond=0, step=0.05, substeps=1, channels=1):
    """Value, first and second differences from the reference."""
    rng = np.random.default_rng(seed)
    m, b, q = plan
    intervals = Intervals(m, b, q, np.arange(0, q + beyond, stride))
    samples = intervals.padded - (1 if m > 1 else 0)
    grid = made.grid(
        rng.normal(size=(channels, samples)), samples=samples, step=step, holds=("first",) * channels
    )
    z = ca.SX.sym("z", model.p.numel())
    physical = z * (1 + 0.3 * ca.sin(z)) if z.numel() else ca.DM.zeros(0, 1)
    scale = made.scale(model)
    propagator = GeneralPropagator(model, grid, intervals, z, physical, scale=scale)
    step_rule = made.runge_kutta_step(substeps)
    reference = made.reference(model, grid, intervals, z, physical, scale, step_rule)
    point, nodes = rng.uniform(0.5, 1.5, z.numel()), rng.normal(size=(m, len(scale)))
    found = made.compare(propagator, reference, point, nodes, rng)
    print("value {:.1e}, first {:.1e}, second {:.1e}".format(*found))
    return found


CASES = {
    "one state": {"states": 1},
    "two states": {"states": 2},
    "three states": {"states": 3},
    "two states, strided": {"states": 2, "plan": (2, 2, 4), "stride": 2},
    "one-sample intervals": {"states": 2, "plan": (5, 1, 1)},
    "single interval": {"states": 2, "plan": (1, 2, 3)},
    "with the intervals' ends": {"states": 2, "beyond": 1},
    "many intervals": {"states": 2, "plan": (45, 1, 2), "beyond": 1},
    "as many intervals as states": {"states": 3, "plan": (3, 1, 2)},
}


@pytest.mark.parametrize("name", CASES)
def test_first_and_second_derivatives_equal_casadis(made, name):
    options = dict(CASES[name])
    model = made.general(np.random.default_rng(len(name)), states=options.pop("states"))
    assert max(compared(made, model, sum(map(ord, name)), **options)) < TOLERANCE


def test_a_linear_model_has_the_same_derivatives_here(made):
    model = made.linear(np.random.default_rng(3), states=2, inputs=2, outputs=2)
    assert max(compared(made, model, 5, channels=2, step=0.02)) < TOLERANCE
