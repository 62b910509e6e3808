"""What a change of a start grows to on its way does not depend on the units of the states."""

import numpy as np
import pytest

import casadi_engine as ce


def uptake(unit):
    """A level of hundreds that a small second state draws down: stable, whatever the second one is counted in."""
    b = ce.Blueprint("uptake")
    k, p = (
        b.parameter("k", 0.02, unit="1/s", min=1e-4, max=1),
        b.parameter("p", 0.03, unit="1/s", min=1e-3, max=1),
    )
    level, small = b.state("G"), b.state("X")
    b.ode("G", -k * (level - 90) - unit * small * level)
    b.ode("X", -p * small)
    b.output("y", level)
    return b.model()


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_a_stable_model_is_checked_away_from_its_optimum(unit):
    time = np.linspace(0, 180, 60)
    level, small, step = np.empty(60), 0.01, 180 / 59 / 200
    now = 280.0
    for k in range(60):
        level[k] = now
        for _ in range(200):
            half = small * np.exp(-0.02 * step / 2)
            mid = now + step / 2 * (-0.015 * (now - 90) - small * now)
            now += step * (-0.015 * (mid - 90) - half * mid)
            small *= np.exp(-0.02 * step)
    y = level + 0.3 * np.random.default_rng(1).standard_normal(60)
    data = ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=y)
    fit = ce.estimate(uptake(unit), data, initial={"X": 0.01 / unit, "G": 280.0}, progress=False)
    assert fit.values["k"] == pytest.approx(0.015, rel=0.1)
    assert not any("grows" in text for text in fit.messages)
