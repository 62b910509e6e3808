"""Accelerometers as README writes them, with the port in what they show: behind, late, and beside another effect."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce

STEP, COUNT, HELD = 0.01, 1600, 50
EFFECTS = ["sensor_lag", "sensor_delay", "sensor_gain", "input_lag", "quadratic_drag", "coulomb_friction"]


def pendulum():
    b = ce.Blueprint("pendulum")
    J, k = b.parameter("J", 0.1, unit="kg m2", min=1e-4), b.parameter("k", 5.0, unit="N m/rad", min=0)
    c = b.parameter("c", 0.05, unit="N m s/rad", min=0)
    angle, speed = b.state("angle", unit="rad"), b.state("speed", unit="rad/s")
    missing = b.port("pivot", "inertia", {"speed": speed, "angle": angle})
    moved = (b.input("T", unit="N m") - k * angle - c * speed + missing) / J
    b.ode("angle", speed)
    b.ode("speed", moved)
    b.output("angle", angle, unit="rad")
    b.output("acc", moved, unit="rad/s2")
    return b.model()


def record(name, seed, *, behind=0.0, late=0, drag=0.0):
    """The torque jumps twice a second; behind : time constant [s] of the accelerometer; late : samples of a delay."""
    rng = np.random.default_rng(seed)
    torque = np.repeat(rng.uniform(-1, 1, COUNT // HELD), HELD)

    def moved(x, T):
        return (T - 4.0 * x[0] - 0.08 * x[1] - drag * x[1] * abs(x[1])) / 0.12

    def rates(T):
        return lambda s, x: [x[1], moved(x, T), (moved(x, T) - x[2]) / (behind or 1.0)]

    x = [np.array([0.1, 0.0, (torque[0] - 0.4) / 0.12])]
    for T in torque[:-1]:
        x.append(solve_ivp(rates(T), (0, STEP), x[-1], rtol=1e-9, atol=1e-11).y[:, -1])
    x = np.array(x)
    shown = x[:, 2] if behind else np.array([moved(own, T) for own, T in zip(x, torque, strict=True)])
    shown = np.r_[np.full(late, shown[0]), shown[: COUNT - late]]
    return ce.Experiment.from_arrays(
        name, time=STEP * np.arange(COUNT), units={"T": "N m", "angle": "rad", "acc": "rad/s2"}, hold={"T": "zero"},
        T=torque, angle=x[:, 0] + 0.002 * rng.standard_normal(COUNT),
        acc=shown + 0.1 * rng.standard_normal(COUNT),
    )  # fmt: skip


def found(**how):
    answer = ce.repair(
        pendulum(), record("found on", 1, **how), fresh=record("fresh", 2, **how), effects=EFFECTS, starts=1,
        progress=False,
    )  # fmt: skip
    return answer, {one.key: one for one in answer.effects}


def test_one_that_is_behind():
    """It was no candidate, as what acts at a port has no rate: a lag of the input and a gain were named."""
    answer, effects = found(behind=0.05)
    assert (list(effects), answer.confirmed) == (["sensor_acc.sensor_lag"], True)
    time = effects["sensor_acc.sensor_lag"].parameters["sensor_acc.sensor_lag.time"]
    assert abs(time.value - 0.05) < 4 * time.stderr < 1e-3


@pytest.mark.slow
def test_one_that_is_late():
    answer, effects = found(late=5)
    assert (list(effects), answer.confirmed) == (["sensor_acc.sensor_delay"], True)
    delay = effects["sensor_acc.sensor_delay"].amplitude
    assert abs(delay.value - 0.05) < 4 * delay.stderr < 1e-3


@pytest.mark.slow
def test_one_that_is_behind_beside_a_drag_that_it_shows():
    answer, effects = found(behind=0.05, drag=0.15)
    assert (set(effects), answer.confirmed) == ({"sensor_acc.sensor_lag", "pivot.quadratic_drag"}, True)
    drag = effects["pivot.quadratic_drag"].amplitude
    assert abs(drag.value - 0.15) < 4 * drag.stderr < 0.01


def test_the_rate_of_what_shows_a_port_has_the_laws_that_act_there():
    """Against a difference of the output along a simulation."""
    model = pendulum().with_effect(ce.effects.QuadraticDrag(), at="pivot", values={"coefficient": 0.15})
    plain, late = ({"J": 0.12, "k": 4.0, "c": 0.08}, 0.1 * STEP)
    still = ce.Experiment.from_arrays("free", time=STEP * np.arange(300), units={"T": "N m"}, T=np.zeros(300))
    delayed = model.with_effect(ce.effects.SensorDelay(), at="sensor_acc", values={"delay": late})
    runs = [
        ce.simulate(one, still, parameters=plain, initial={"angle": 1.0, "speed": 0.0}, tolerance=1e-10)[
            "acc"
        ].values
        for one in (model, delayed)
    ]
    rate = np.gradient(runs[0], STEP, edge_order=2)
    # up to the bend; what was before the first sample is guessed
    assert np.abs(runs[1] - runs[0] + late * rate)[1:].max() < 0.01 * np.abs(late * rate).max()
