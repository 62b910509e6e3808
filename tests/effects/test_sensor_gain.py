"""A sensor or an input of a wrong gain: its law, where it is an offset, and the units that a gain tells."""

import math

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce


def joint(*, known=True):
    """An inertia on a spring, whose angle and speed are both measured; its inertia is known, or estimated."""
    b = ce.Blueprint("joint")
    inertia = b.parameter("J", 0.13, unit="kg m2", min=1e-4, vary=not known)
    loss, k = (
        b.parameter("D", 0.05, unit="N m s/rad", min=1e-4),
        b.parameter("k", 2.0, unit="N m/rad", min=1e-3),
    )
    q, w = b.state("q", unit="rad"), b.state("w", unit="rad/s", scale=10)
    slot = b.port("joint", "inertia", {"speed": w}, unit="N m")
    b.ode("q", w)
    b.ode("w", (b.input("T", unit="N m") + slot - k * q - loss * w) / inertia)
    b.output("angle", q, unit="rad")
    b.output("speed", w, unit="rad/s", scale=10)
    return b.model()


def measured(model, *, angle=1.0, speed=1.0, torque_shown=1.0, seed=0):
    """A record of other parameters, each channel times a factor, with noise of half a percent of the outputs."""
    rng, t = np.random.default_rng(seed), 0.01 * np.arange(1200)
    torque = 3 * np.repeat(rng.normal(size=40), 30)
    units = {"T": "N m", "angle": "rad", "speed": "rad/s"}
    blank = ce.Experiment.from_arrays("run", time=t, units=units, T=torque, angle=0 * t, speed=0 * t)
    true = model.parameters()
    true["D"], true["k"] = 0.07, 2.4
    made = ce.simulate(model, blank, parameters=true)
    shown = {
        name: factor * (made[name].values + 0.005 * np.std(made[name].values) * rng.normal(size=len(t)))
        for name, factor in (("angle", angle), ("speed", speed))
    }
    return ce.Experiment.from_arrays("run", time=t, units=units, T=torque_shown * torque, **shown)


# Effects of which each does something like a gain; the slow runs of units look among the whole library.
FEW = ["sensor_gain", "input_gain", "wrong_value", "sensor_offset", "coulomb_friction"]


def test_a_gain_multiplies_the_output_alone():
    model = joint()
    made = model.with_effect(ce.effects.SensorGain(), at="sensor_speed", values={"gain": 0.2})
    shown = ca.Function("shown", [made.x, made.u, made.t, made.p], [made.closed_outputs])
    assert shown([0.3, 5.0], 1.0, 0.0, made.parameter_vector()).full().ravel() == pytest.approx([0.3, 6.0])
    assert made.parameters()["sensor_speed.sensor_gain.gain"].unit == "1"
    np.testing.assert_array_equal(ca.DM(ca.jacobian(made.closed_ode, made.p[-1])), 0)


@pytest.mark.parametrize(("mean", "idle"), [(1e4, True), (900.0, False), (11.0, False), (0.0, False)])
def test_a_gain_of_what_is_all_but_constant_is_an_offset(mean, idle):
    class Port:
        def courses(self, signal):
            assert signal == "value"
            return (mean + math.sqrt(2) * np.sin(np.linspace(0, 20 * np.pi, 2001)), np.array([np.nan]))

    assert (ce.effects.SensorGain().idle(Port()) != "") == idle


def lifted(seed, *, gain=0.0, offset=0.0):
    """A load of 90 kg on a spring to a drum that turns as it is told: the force is its weight, and a tenth more or
    less."""
    t = np.arange(0, 20, 0.02)
    lift = 0.1 * np.sin(0.9 * t + seed) + 0.06 * np.sin(2.3 * t)

    def rate(time, y):
        return [y[1], (5e3 * (np.interp(time, t, lift) - y[0]) - 200 * y[1]) / 90 - 9.81]

    run = solve_ivp(rate, (0, 20), [-9.81 * 90 / 5e3, 0.0], t_eval=t, rtol=1e-9, atol=1e-12, max_step=0.02)
    force = (5e3 * (lift - run.y[0])) * (1 + gain) + offset
    rng = np.random.default_rng(seed)
    f = force + 3.0 * rng.standard_normal(len(t))
    x = run.y[0] + 1e-3 * rng.standard_normal(len(t))
    units = {"lift": "m", "F": "N", "x": "m"}
    return ce.Experiment.from_arrays(f"lift{seed}", time=t, units=units, lift=lift, F=f, x=x)


def hoist():
    b = ce.Blueprint("hoist")
    lift = b.input("lift", unit="m")
    k, c = b.parameter("k", 4e3, unit="N/m", min=100), b.parameter("c", 100.0, unit="N s/m", min=0)
    m, g = b.parameter("m", 90.0, unit="kg", vary=False), b.parameter("g", 9.81, unit="m/s2", vary=False)
    x, v = b.state("x", unit="m", scale=0.1), b.state("v", unit="m/s")
    force = k * (lift - x)
    b.ode("x", v)
    b.ode("v", (force - c * v + b.port("load", "inertia", {"speed": v}, unit="N")) / m - g)
    b.output("F", force, unit="N")
    b.output("x", x, unit="m")
    return b.model()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "name"), [({"gain": 0.04}, "sensor_gain"), ({"offset": 35.0}, "sensor_offset")]
)
def test_gain_and_offset_of_a_force_that_is_mostly_weight_are_told_apart(size, name):
    """No gain was looked for where an output varies by less than a tenth of its mean: false effects took its place."""
    data = [lifted(k, **size) for k in (1, 2, 3)]
    assert np.std(data[0]["F"].values) < 0.1 * np.mean(data[0]["F"].values)
    few = [
        "sensor_gain",
        "sensor_offset",
        "coulomb_friction",
        "constant_torque",
        "quadratic_drag",
    ]  # m is one with k
    found = ce.repair(hoist(), data[:2], fresh=data[2:], effects=few, progress=False)
    (one,) = found.effects
    assert (one.name, one.at) == (name, "sensor_F")
    assert found.confirmed
    assert abs(one.amplitude.value - next(iter(size.values()))) < 4 * one.amplitude.stderr


def test_a_gain_multiplies_the_input_wherever_it_stands():
    model = joint()
    made = model.with_effect(ce.effects.InputGain(), at="input_T", values={"gain": 0.2})
    rates = [ca.Function("rates", [m.x, m.u, m.t, m.p], [m.closed_ode]) for m in (model, made)]
    plain = rates[0]([0.3, 5.0], 1.2, 0.0, model.parameter_vector()).full()
    np.testing.assert_allclose(rates[1]([0.3, 5.0], 1.0, 0.0, made.parameter_vector()).full(), plain)


def test_a_crank_angle_has_no_gain():
    class Port:
        name = "input_theta"

    assert "counted in turns" in ce.effects.InputGain().idle(Port())


def test_an_input_that_acts_more_than_it_says_is_told_from_sensors_and_not_from_the_inertia():
    model = joint()
    found = ce.repair(model, measured(model, torque_shown=1 / 1.15), effects=FEW, starts=1, progress=False)
    (one,) = found.effects
    assert found.confirmed
    assert {(m.name, m.at) for m in one.members} == {
        ("input_gain", "input_T"),
        ("wrong_value", "parameter_J"),
    }


def test_the_units_of_an_input_are_told_before_a_search():
    """No fit explains the speed: what makes it good is a reading of the data, and no effect."""
    found = ce.repair(joint(), measured(joint(), torque_shown=1000.0), effects=FEW, starts=1, progress=False)
    assert found.status == "the data are at fault"
    words = "with the input T times 0.001 (numbers in N mm labelled N m) the fit explains 99 % of angle and"
    assert words in " ".join(str(found).split())


def test_a_gain_is_idle_nowhere_before_there_is_a_record():
    class Port:
        def courses(self, signal):
            return ()

    assert ce.effects.SensorGain().idle(Port()) == ""


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        ({"speed": 30 / math.pi}, "times as large, as numbers in rpm labelled rad/s would be"),
        pytest.param(
            {"speed": math.pi / 30},
            "times as large, as numbers in rad/s labelled rpm would be",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"angle": 180 / math.pi},
            "times as large, as numbers in deg labelled rad would be",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_exchanged_units_are_named(factors, words):
    (name,) = factors
    few = FEW if name == "speed" and factors[name] > 1 else None
    found = ce.repair(joint(), measured(joint(), **factors), effects=few, starts=1)
    assert [one.key for one in found.effects] == [f"sensor_{name}.sensor_gain"]
    size = found.effects[0].amplitude
    assert abs(1 + size.value - factors[name]) < 4 * size.stderr
    assert words in " ".join(str(found).split())


@pytest.mark.slow
def test_a_calibration_error_is_no_exchanged_unit():
    found = ce.repair(joint(), measured(joint(), speed=1.05), effects=FEW, starts=1)
    assert [one.key for one in found.effects] == ["sensor_speed.sensor_gain"]
    assert "labelled" not in str(found)


def test_one_sensor_too_large_or_the_other_too_small_is_a_class():
    """A linear system of which the inertia is unknown as well does not tell them apart."""
    found = ce.repair(joint(known=False), measured(joint(), speed=1.05), effects=FEW, starts=1)
    names = {one.label for one in found.effects[0].members}
    assert names == {"sensor_gain at sensor_speed", "sensor_gain at sensor_angle"}


def test_no_gain_is_found_in_sound_records():
    assert ce.repair(joint(), measured(joint(), seed=3), effects=FEW, starts=1).effects == ()
