"""Derivatives of the linear propagator against CasADi's own, on random small models."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_engine.simulation.intervals import Intervals
from casadi_engine.simulation.linear import LinearPropagator

TOLERANCE = 1e-9


def case(
    made,
    seed,
    *,
    states,
    inputs=2,
    outputs=1,
    holds=None,
    plan=(2, 2, 3),
    method="exact",
    stride=1,
    **kind,
):
    """A propagator of a random model, its reference, and a point."""
    rng = np.random.default_rng(seed)
    model = made.linear(rng, states=states, inputs=inputs, outputs=outputs, **kind)
    m, b, q = plan
    intervals = Intervals(m, b, q, np.arange(0, q, stride))
    samples = intervals.padded - (1 if m > 1 else 0)  # the last interval is padded
    holds = holds or ("first",) * inputs
    grid = made.grid(
        rng.normal(size=(inputs, samples)).reshape(inputs, samples), samples=samples, holds=holds
    )
    count = model.p.numel()
    z = ca.SX.sym("z", count)
    physical = z * (1 + 0.3 * ca.sin(z)) if count else ca.DM.zeros(0, 1)
    scale = made.scale(model)
    propagator = LinearPropagator(model, grid, intervals, z, physical, scale=scale, method=method)
    step = made.euler_step if method == "euler" else made.exact_step(propagator._drives.holds)
    reference = made.reference(model, grid, intervals, z, physical, scale, step)
    return propagator, reference, rng.uniform(0.5, 1.5, count), rng.normal(size=(m, states)), rng


CASES = {
    "one state": {"states": 1, "inputs": 1},
    "two states, two outputs": {"states": 2, "outputs": 2},
    "three states, strided outputs": {"states": 3, "outputs": 2, "stride": 2, "plan": (2, 2, 4)},
    "four states, three inputs": {"states": 4, "inputs": 3, "outputs": 3, "parameters": 3},
    "zero hold": {"states": 3, "holds": ("zero", "zero")},
    "mixed holds": {"states": 3, "inputs": 3, "holds": ("first", "zero", "first"), "outputs": 2},
    "no feedthrough": {"states": 3, "through": False},
    "no constant terms": {"states": 3, "offsets": False},
    "no inputs": {"states": 2, "inputs": 0},
    "one-sample intervals": {"states": 3, "plan": (4, 1, 1)},
    "single interval": {"states": 3, "plan": (1, 3, 4)},
    "no drives": {"states": 3, "inputs": 0, "offsets": False, "outputs": 2},
    "euler": {"states": 3, "method": "euler", "outputs": 2},
    "euler, zero hold": {"states": 2, "method": "euler", "holds": ("zero", "first")},
    "one parameter": {"states": 2, "parameters": 1},
}


@pytest.mark.parametrize("name", CASES)
def test_first_and_second_derivatives_equal_casadis(made, name):
    propagator, reference, z, nodes, rng = case(made, sum(map(ord, name)), **CASES[name])
    value, first, second = made.compare(propagator, reference, z, nodes, rng)
    print(f"{name}: value {value:.1e}, first {first:.1e}, second {second:.1e}")
    assert value < TOLERANCE
    assert first < TOLERANCE
    assert second < TOLERANCE
