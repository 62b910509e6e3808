"""A speed sensor that is late by many samples: found, timed and confirmed; and nothing is missing where it is known."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce

STEP, SAMPLES, J, C = 0.01, 800, 0.3, 0.6
SPEED = 1.8  # standard deviation [rad/s]
EFFECTS = ["sensor_delay", "coulomb_friction", "sensor_gain", "constant_torque"]
DELAY = "sensor_y.sensor_delay.delay"


def record(name, seed, *, late, decibel):
    """J dw/dt = 2 u - c w by SciPy, from five seconds before the record on; a sensor shows w(t - late).

    decibel : of the search's speed over the noise
    """
    rng = np.random.default_rng(seed)
    frequency, phase = np.exp(rng.uniform(np.log(0.1), np.log(2.5), 7)), rng.uniform(0, 2 * np.pi, 7)

    def torque(t):
        return np.sin(2 * np.pi * np.multiply.outer(t, frequency) + phase).sum(axis=-1) / 2

    t = STEP * np.arange(SAMPLES)
    run = solve_ivp(
        lambda s, w: (2 * torque(s) - C * w) / J, (-5.0, t[-1]), [0.0], method="DOP853", rtol=1e-10, atol=1e-12,
        dense_output=True,
    )  # fmt: skip
    speed = run.sol(t - late)[0]
    y = speed + SPEED * 10 ** (-decibel / 20) * rng.standard_normal(SAMPLES)
    return ce.Experiment.from_arrays(name, time=t, units={"u": "N m", "y": "rad/s"}, u=torque(t), y=y)


def rotor():
    b = ce.Blueprint("rotor")
    u = b.input("u", unit="N m")
    inertia = b.parameter("J", 0.4, unit="kg m2", min=0.01, max=5)
    damping = b.parameter("c", 0.45, unit="N m s/rad", min=0, max=10)
    w = b.state("w", unit="rad/s")
    shaft = b.port("shaft", "inertia", {"speed": w})
    b.ode("w", (2 * u - damping * w + shaft) / inertia)
    b.output("y", w, unit="rad/s")
    return b.model()


def check(fit, late):
    found = fit.estimates[DELAY]
    assert abs(found.value - late) < 4 * found.stderr
    assert abs(found.value - late) < 1e-3
    for name, truth in (("J", J), ("c", C)):
        one = fit.estimates[name]
        assert abs(one.value - truth) < 4 * one.stderr
    assert abs(dict(fit.model.lags)["y"] - late) <= 0.6 * STEP


@pytest.mark.parametrize("late", [pytest.param(0.12, marks=pytest.mark.slow), 0.124])
def test_a_sensor_that_is_late_is_named_timed_and_confirmed(late):
    """The score at no delay is far from a delay of twelve samples; a law of second order would be as well."""
    data, fresh = (
        record(name, seed, late=late, decibel=35) for name, seed in (("search", 1), ("fresh", 101))
    )
    found = ce.repair(rotor(), data, fresh=fresh, effects=EFFECTS, progress=False)
    assert found.verdict == "class"  # its input late by as much is the same
    assert ", or u acts late by as much, confirmed" in " ".join(str(found).split())
    assert [one.key for one in found.effects] == ["sensor_y.sensor_delay"]
    assert len(found.effects[0].members) == 1
    assert found.confirmed is True
    assert not found.messages
    check(found.fit, late)
    for side in (found.gaps.estimation_after, found.gaps.validation_after):
        assert side.gap.chi2_per_sample == pytest.approx(1, abs=4 * np.sqrt(2 / SAMPLES))
    assert f"y(t + {DELAY}) = w" in found.equation.text


@pytest.mark.slow
@pytest.mark.parametrize("fresh", [pytest.param(True, marks=pytest.mark.slow), False])
def test_where_the_delay_is_declared_nothing_is_missing(fresh):
    model = rotor().with_effect(ce.effects.SensorDelay(), at="sensor_y")
    data = record("search", 1, late=0.12, decibel=40)
    other = record("fresh", 101, late=0.12, decibel=40) if fresh else None
    found = ce.repair(model, data, fresh=other, effects=EFFECTS, progress=False)
    assert found.verdict == "nothing missing"
    assert not found.effects
    check(found.fit, 0.12)
