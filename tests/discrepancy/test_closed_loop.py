"""Records of a closed loop: the input is made of the noisy reading, and that is no missing effect."""

import numpy as np
import pytest
from scipy.linalg import expm

import casadi_engine as ce

HEATER, WATER, FLOW, LOSS = 180.0, 1700.0, 20.0, 2.0


def controlled(name, *, seed, swing, quadratic=0.0):
    """A boiler whose PI controller reads its noisy sensor, each second, exactly integrated between."""
    whole = np.zeros((4, 4))
    whole[0, :] = [-FLOW / HEATER, FLOW / HEATER, 1 / HEATER, 0.0]
    whole[1, :] = [FLOW / WATER, -(FLOW + LOSS) / WATER, 0.0, 1 / WATER]
    noise, x, total = 0.08 * np.random.default_rng(seed).standard_normal(600), np.zeros(2), 0.0
    read, power = np.empty(600), np.empty(600)
    for k in range(600):
        read[k] = x[1] + noise[k]
        error = 30.0 + swing * np.sign(np.sin(0.02 * k)) - read[k]
        power[k] = 60 * error + total
        total += 0.6 * error
        for _ in range(10):
            step = expm(0.1 * whole)
            x = step[:2, :2] @ x + step[:2, 2] * power[k] - step[:2, 3] * quadratic * x[1] ** 2
    t = np.arange(600.0)
    units = {"P": "W", "T": "K"}
    return ce.Experiment.from_arrays(name, time=t, units=units, hold={"P": "zero"}, P=power, T=read)


def boiler():
    b = ce.Blueprint("boiler")
    heat, mass = b.parameter("Ch", 150.0, unit="J/K", min=20), b.parameter("Cw", 1500.0, unit="J/K", min=200)
    flow, loss = b.parameter("G", 15.0, unit="W/K", min=1), b.parameter("L", 1.5, unit="W/K", min=0)
    h, water, power = b.state("h", unit="K"), b.state("T", unit="K"), b.input("P", unit="W")
    b.ode("h", (power - flow * (h - water) + b.port("heater", "inertia", {"speed": h})) / heat)
    b.ode("T", (flow * (h - water) - loss * water + b.port("water", "inertia", {"speed": water})) / mass)
    b.output("T", water, unit="K")
    return b.model()


@pytest.mark.parametrize(
    "seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]
)
def test_noise_that_a_controller_carries_into_the_input_is_no_effect(seed):
    data, fresh = (
        controlled("run", seed=10 * seed, swing=5.0),
        controlled("fresh", seed=10 * seed + 1, swing=8.0),
    )
    found = ce.repair(boiler(), data, fresh=fresh, progress=False, initial={"h": 0.0, "T": 0.0})
    assert found.verdict == "nothing missing"
    assert found.noise.sigma["T"][0] == pytest.approx(0.08, rel=0.1)


def test_a_right_model_of_a_closed_loop_passes_its_residual_tests():
    """The controller's output is made of the reading of the same sample, and acts after it."""
    data, fresh = controlled("run", seed=4, swing=5.0), controlled("fresh", seed=5, swing=8.0)
    fit = ce.estimate(boiler(), data, initial={"h": 0.0, "T": 0.0}, progress=False)
    found = ce.validate(fit, fresh)
    assert found.passed
    wrong = controlled("bent", seed=6, swing=8.0, quadratic=0.02)
    assert not ce.validate(fit, wrong).passed
