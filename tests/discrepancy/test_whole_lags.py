"""A delay of several samples where the output jumps from one to the next."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce


def tank():
    """Strong acid and base in a tank: pH passes its range within two samples."""
    b = ce.Blueprint("tank")
    strength = b.parameter("c", 0.011, unit="mol/L", min=1e-4)
    x = b.state("x", unit="mol/L", scale=1e-3)
    base = b.input("q", unit="L/s")
    acts = b.port("tank", "inertia", {"speed": x}, unit="mol/s")
    b.ode("x", (0.002 - base * strength - (0.2 + base) * x + acts) / 20)
    b.output("pH", 7 - ca.asinh(x / 2e-7) / np.log(10), unit="1")
    return b.model()


def record(name, seed, late):
    time = np.arange(900.0)
    rng = np.random.default_rng(seed)
    base = 0.17 + 0.04 * np.sign(np.sin(2 * np.pi * (time + 500 * rng.random()) / 90))

    def rate(t, x):
        q = np.interp(t, time, base)
        return (0.002 - q * 0.012 - (0.2 + q) * x) / 20

    x = solve_ivp(rate, (0, 899), [1e-3], t_eval=time, rtol=1e-10, atol=1e-14, max_step=1.0).y[0]
    y = 7 - np.arcsinh(x / 2e-7) / np.log(10)
    shown = np.concatenate([np.full(late, y[0]), y[: len(y) - late]]) + 0.03 * rng.standard_normal(900)
    return ce.Experiment.from_arrays(name, time=time, units={"q": "L/s", "pH": "1"}, q=base, pH=shown)


def test_a_delay_of_four_samples_of_an_output_that_jumps_is_found():
    """One step along the model foretold a third of a second, and the search stayed there."""
    found = ce.repair(
        tank(), record("one", 1, 4), fresh=record("two", 2, 4), noise=ce.Noise(pH=0.03), progress=False,
        effects=["sensor_delay", "sensor_offset", "constant_torque"],
    )  # fmt: skip
    (effect,) = found.effects
    assert effect.key == "sensor_pH.sensor_delay"
    assert found.confirmed
    delay = effect.parameters["sensor_pH.sensor_delay.delay"]
    assert delay.value == pytest.approx(4.0, abs=4 * delay.stderr)
