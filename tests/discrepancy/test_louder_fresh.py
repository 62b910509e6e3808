"""Fresh data with more noise than those of the search, white: no law is made of that."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce

TIME = np.arange(500) * 0.05


def pendulum():
    b = ce.Blueprint("pendulum")
    inertia = b.parameter("J", 2.0, unit="kg m2", min=0.1, max=20)
    damping = b.parameter("c", 0.5, unit="N m s/rad", min=0, max=10)
    angle, speed, torque = b.state("a", unit="rad"), b.state("w", unit="rad/s"), b.input("T", unit="N m")
    slot = b.port("pivot", "inertia", {"speed": speed, "angle": angle}, unit="N m")
    b.ode("a", speed)
    b.ode("w", (torque - 20.0 * ca.sin(angle) - damping * speed + slot) / inertia)
    b.output("angle", angle, unit="rad")
    return b.model()


def record(name, seed, size, noise):
    """By SciPy, with a constant torque of 3 N m that the model lacks."""
    rng = np.random.default_rng(seed)
    torque = size * np.interp(TIME, np.linspace(0, TIME[-1], 40), rng.uniform(-1, 1, 40))

    def rate(t, x):
        return [x[1], (np.interp(t, TIME, torque) - 20.0 * np.sin(x[0]) - 0.8 * x[1] + 3.0) / 1.6]

    run = solve_ivp(rate, (0, TIME[-1]), [0.1, 0.0], t_eval=TIME, rtol=1e-9, atol=1e-11, max_step=0.05)
    shown = run.y[0] + noise * rng.standard_normal(len(TIME))
    return ce.Experiment.from_arrays(
        name, time=TIME, units={"T": "N m", "angle": "rad"}, T=torque, angle=shown
    )


@pytest.mark.parametrize("noise", [0.002, 0.008])
def test_a_constant_torque_is_all_that_is_missing(noise):
    """With four times the noise in fresh data it was "or rather a law that the library lacks"."""
    found = ce.repair(
        pendulum(), record("run", 1, 6, 0.002), fresh=record("fresh", 2, 14, noise), progress=False
    )
    assert found.confirmed
    assert found.effects[0].key == "pivot.constant_torque"
    assert abs(found.effects[0].amplitude.value - 3.0) < 4 * found.effects[0].amplitude.stderr
    assert "law that the library lacks" not in str(found)
    assert found.unknown is None
