"""Derivatives of the exponential integrator against CasADi, on the same recursion written out."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_engine.model import Blueprint
from casadi_engine.simulation.exponential_runge_kutta import ExponentialPropagator
from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.split import split
from tests.quick import few

TOLERANCE = 1e-9


def bent_model(rng, *, states=3, laws=1, bent_outputs=False, through=False, bent_drives=False):
    """A linear core with laws of differences of states, of time, channels and parameters."""
    b = Blueprint("bent")
    p = [b.parameter(f"p{i}", rng.uniform(0.5, 1.5)) for i in range(3)]
    x = [b.state(f"x{i}", scale=rng.uniform(0.5, 2)) for i in range(states)]
    u = b.input("u0")
    d = b.drive("d0", (p[0] ** 2 * u if bent_drives else u) + 0.3 * ca.sin(b.time), unit="1")
    slots = []
    for j in range(laws):
        rate = x[j % states] - (x[(j + 1) % states] if states > 1 else 0)
        slots.append(b.port(f"s{j}", "coupling", {"twist_rate": rate}))
        law = -p[2] * ca.tanh(rate * (1 + j)) * (1 + 0.2 * ca.sin(p[1]))
        if j == 1:
            law += 0.1 * x[0] ** 2 * p[0] * u + 0.2 * ca.cos(b.time) * x[j % states]
        b.law(f"s{j}", law)
    for i in range(states):
        rate = -x[i] * p[0] + rng.normal() * p[1] * x[(i + 1) % states] + 0.3 + rng.normal() * d
        b.ode(f"x{i}", rate + sum(rng.normal() * slot * p[1] for slot in slots))
    b.output("y0", x[0] * (p[1] ** 2 if bent_outputs else 1) + (0.3 * d * p[0] * p[1] if through else 0))
    if states > 1:
        b.output("y1", x[1] + 0.5 * x[0])
    return b.model()


CASES = {
    "one state": {"states": 1},
    "two states": {"states": 2},
    "two laws": {"laws": 2, "step": 0.05},
    "as many laws as signals": {"states": 2, "laws": 2, "step": 0.03},
    "parameters everywhere": {
        "laws": 3, "bent_outputs": True, "through": True, "bent_drives": True, "step": 0.03,
    },
    "strided": {"states": 2, "plan": (2, 2, 4), "stride": 2, "through": True},
    "with the intervals' ends": {
        "states": 2, "bent_drives": True, "bent_outputs": True, "through": True,
    },
    "two steps to a sample": {"states": 2, "substeps": 2},
    "three steps to a sample": {
        "laws": 2, "substeps": 3, "bent_drives": True, "bent_outputs": True, "through": True,
    },
    "zero hold": {"states": 2, "laws": 2, "holds": ("zero",), "substeps": 2},
    "one-sample intervals": {"states": 2, "plan": (5, 1, 1)},
    "single interval": {"states": 2, "plan": (1, 2, 3)},
    "as many intervals as states": {"states": 3, "plan": (3, 1, 2)},
}  # fmt: skip


@pytest.mark.parametrize("name", few(CASES, *list(CASES)[::4]))
def test_first_and_second_derivatives_equal_casadis(made, name):
    options = dict(CASES[name])
    m, b, q = options.pop("plan", (2, 2, 2))
    stride = options.pop("stride", 1)
    substeps, step, holds = (
        options.pop("substeps", 1), options.pop("step", 0.1), options.pop("holds", ("first",)),
    )  # fmt: skip
    rng = np.random.default_rng(3)
    model = made.without_rates(bent_model(rng, **options))
    plan = Intervals(m, b, q, np.arange(0, q, stride))
    samples = plan.padded - (1 if m > 1 else 0)
    grid = made.grid(rng.normal(size=(1, samples)), samples=samples, step=step, holds=holds)
    z = ca.SX.sym("z", 3)
    physical, scale = z * (1 + 0.3 * ca.sin(z)), made.scale(model)
    propagator = ExponentialPropagator(
        model, split(model), grid, plan, z, physical, scale=scale, substeps=substeps
    )
    reference = made.reference(model, grid, plan, z, physical, scale, made.krogstad_step(holds, substeps))
    found = made.compare(
        propagator, reference, rng.uniform(0.5, 1.5, 3), rng.normal(size=(m, len(scale))), rng
    )
    assert propagator.substeps == substeps
    assert max(found) < TOLERANCE
