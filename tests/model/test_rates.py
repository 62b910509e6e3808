"""Rates of outputs, and delays of sensors that show a channel at once."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import ConstantTorque, CoulombFriction, SensorDelay, SensorOffset
from casadi_engine.errors import EffectError, IdentifiabilityError
from casadi_engine.experiment import Channel
from casadi_engine.model import Blueprint
from casadi_engine.model.parcel import pack, unpack

MASS, DAMPING, LATE, STEP = 2.0, 3.0, 0.01, 1e-3


def force(t):
    return 5 * np.sin(2 * np.pi * 1.3 * t) + np.cos(7 * t)


def force_rate(t):
    return 5 * 2 * np.pi * 1.3 * np.cos(2 * np.pi * 1.3 * t) - 7 * np.sin(7 * t)


def accelerometer(shown=lambda a, v, force, t: a, drive=lambda force, t: force):
    b = Blueprint("accelerometer")
    v, m, c = b.state("v", unit="m/s"), b.parameter("m", MASS), b.parameter("c", DAMPING)
    push = b.drive("push", drive(b.input("F", unit="N"), b.time), unit="N")
    a = (push - c * v) / m
    b.ode("v", a)
    b.output("a", shown(a, v, push, b.time), unit="m/s2")
    return b.model()


def record(hold="first", step=STEP, length=2.0):
    t = np.arange(round(length / step) + 1) * step
    return ce.Experiment.from_arrays("run", time=t, units={"F": "N"}, hold=hold, F=force(t))


@pytest.fixture(scope="module")
def speed():
    """The speed by SciPy, from before the record on, so that a delayed output can be read off."""
    return solve_ivp(
        lambda t, v: (force(t) - DAMPING * v) / MASS, (-0.1, 2.1), [0.3], rtol=1e-11, atol=1e-12,
        dense_output=True,
    )  # fmt: skip


def acceleration(speed, t):
    return (force(t) - DAMPING * speed.sol(t)[0]) / MASS


def jerk(speed, t):
    return (force_rate(t) - DAMPING * acceleration(speed, t)) / MASS


@pytest.mark.parametrize(("hold", "off"), [("first", 2e-5), ("zero", 6e-3)])
def test_a_delayed_accelerometer_shows_what_was_there_before(speed, hold, off):
    """A stair of the force is half a step late in the speed: that alone is the larger error of a zero hold."""
    data, first = record(hold), {"v": float(speed.sol(0.0)[0])}
    late = accelerometer().with_effect(SensorDelay(), at="sensor_a", values={"delay": LATE})
    plain, found = (ce.simulate(model, data, initial=first)["a"] for model in (accelerometer(), late))
    t = found.time
    truth, after = acceleration(speed, t - LATE), t >= LATE
    np.testing.assert_allclose(found.values[after], truth[after], atol=off)
    # before the first instant is shown, the signal goes on backwards to second order
    third = np.abs(np.gradient(np.gradient(jerk(speed, t), t), t)).max()
    assert np.abs(found.values - truth)[~after].max() < LATE**3 / 6 * third + 5 * off
    assert np.abs(plain.values - truth).max() > 20 * np.abs(found.values - truth)[after].max()


def test_a_delay_is_recovered_from_a_record_of_the_delayed_output(speed):
    data = record()
    t = data["F"].time
    noise = np.random.default_rng(3).normal(scale=1e-2, size=len(t))
    tau = 2e-3
    data = data.with_channel(Channel("a", "m/s2", time=t, values=acceleration(speed, t - tau) + noise))
    late = accelerometer().with_effect(SensorDelay(), at="sensor_a")
    found = ce.estimate(late, data, parameters=late.parameters(), progress=False)
    delay = found.estimates["sensor_a.sensor_delay.delay"]
    assert abs(delay.value - tau) < 3 * delay.stderr
    assert delay.stderr < 0.05 * tau


def number(model, expression, **values):
    symbols = ca.symvar(expression)
    return float(ca.Function("f", symbols, [expression])(*[values[s.name()] for s in symbols]))


def test_the_rate_counts_states_drives_and_time():
    """y = a F t with the drive F t: dy/dt by hand."""
    model = accelerometer(shown=lambda a, v, push, t: v * push, drive=lambda F, t: F * ca.sin(t))
    assert model.rates == ("F",)
    v, F, rate, t = 0.4, 1.3, -2.0, 0.7
    push = F * np.sin(t)
    expected = (push - DAMPING * v) / MASS * push + v * (rate * np.sin(t) + F * np.cos(t))
    signal = model.ports["sensor_a"].signals["rate"]
    assert number(model, signal, v=v, push=push, F=F, F_rate=rate, t=t, m=MASS, c=DAMPING) == pytest.approx(
        expected
    )


def test_models_without_feedthrough_have_no_rates_of_channels():
    for model in (ce.two_mass(), ce.crankshaft(), ce.one_inertia()):
        assert model.rates == ()
        assert model.u.numel() == len(model.inputs)


@pytest.mark.parametrize(
    "shown",
    [
        lambda a, v, push, t: v + ca.sign(push),
        lambda a, v, push, t: ca.floor(100 * v) / 100,
        lambda a, v, push, t: ca.if_else(v > 0, a, 0.0),
    ],
)
def test_an_output_that_jumps_has_no_rate(shown):
    """The slope between jumps is no rate: a delay would silently do less than it should."""
    model = accelerometer(shown=shown)
    assert list(model.ports["sensor_a"].signals) == ["value"]
    with pytest.raises(EffectError, match="cannot act at the port sensor_a, which has no signal rate"):
        model.with_effect(SensorDelay(), at="sensor_a")
    assert model.with_effect(SensorOffset(), at="sensor_a").rates == ()


def test_a_delayed_output_has_no_rate_of_its_own():
    """It would need the second derivative of the force, or the rate of a law's torque."""
    for model in (
        accelerometer().with_effect(SensorDelay(), at="sensor_a"),
        ce.two_mass().with_effect(SensorDelay(), at="sensor_omega"),
    ):
        (sensor,) = [port for port in model.ports if port.kind == "sensor"]
        assert list(sensor.signals) == ["value"]


def test_an_effect_behind_a_delay_is_in_the_delayed_signal():
    model = ce.two_mass(reciprocating_speed="measured")
    late = model.with_effect(SensorDelay(), at="sensor_omega")
    both = late.with_effect(ConstantTorque(), at="engine", values={"torque": 3.0})
    inertia = model.parameters()["J_eng"].value
    x, u = [1.0] * 3, [0.1] * both.u.numel()
    symbol = both.p[both.parameter_names.index("sensor_omega.sensor_delay.delay")]
    slope = ca.jacobian(both.closed_outputs, symbol)
    found = ca.Function("c", [both.x, both.u, both.t, both.p], [slope])
    without = both.parameter_vector({"engine.constant_torque.torque": 0.0})
    moved = float(found(x, u, 0.0, both.parameter_vector()) - found(x, u, 0.0, without))
    assert abs(moved) == pytest.approx(3.0 / inertia, rel=1e-9)


def test_a_model_with_rates_is_sent_printed_and_not_tested_exactly():
    late = accelerometer().with_effect(SensorDelay(), at="sensor_a", values={"delay": LATE})
    copy = unpack(pack(late))
    assert copy.rates == ("F",)
    assert copy.equations() == late.equations()
    assert late.equations().splitlines()[-1] == "a(t + sensor_a.sensor_delay.delay) = (push - c*v)/m"
    assert "F_rate" not in late.equations()
    with pytest.raises(IdentifiabilityError, match="no rule for the rate of a channel") as caught:
        ce.identifiability(late)
    assert "seen: F; allowed: outputs of states, channels and parameters" in str(caught.value)
    assert "do: test the model without the delay of that sensor" in str(caught.value)


def swing(w=2 * np.pi * 2.0):
    b = Blueprint("swing")
    w = b.parameter("w", w)
    x, v = b.state("x"), b.state("v")
    b.ode("x", v)
    b.ode("v", -(w**2) * x)
    b.output("x", x)
    return b.model()


@pytest.mark.parametrize("late", [0.03, 0.0325, 0.4])
@pytest.mark.parametrize("equal", [True, False])
def test_a_late_sensor_is_exact_behind_its_delay(late, equal):
    """A swing of 2 Hz, of which a delay takes up to most of a turn; of a part of a step the third order is left out."""
    t, step, turn = np.arange(400) * 5e-3, 5e-3, 2 * np.pi * 2.0
    if not equal:
        t = t + 1e-3 * np.sin(40 * t)
    data = ce.Experiment.from_arrays("run", time=t, units={"x": "1"}, x=np.zeros(400))
    model = swing().with_effect(SensorDelay(), at="sensor_x", values={"delay": late})
    shown = ce.simulate(model, data, initial={"x": 1.0, "v": 0.0})["x"].values
    after = t - t[0] >= late
    error = np.abs(shown - np.cos(turn * (t - t[0] - late)))[after].max()
    assert error < (turn * step) ** 3 / 6 + 2e-5
    assert np.abs(shown).max() < 1 + 1e-6


@pytest.mark.parametrize("late", [0.012, 0.1, -0.08])
def test_a_long_delay_is_found_from_no_delay(late):
    """From a start at 0, where second order would be far off; the samples of before the record are left out."""
    t, turn = np.arange(500) * 5e-3, 2 * np.pi * 2.0
    x = np.cos(turn * (t - late)) + 0.01 * np.random.default_rng(1).standard_normal(500)
    data = ce.Experiment.from_arrays("run", time=t, units={"x": "1"}, x=x)
    b = Blueprint("swing")
    w, c = b.parameter("w", 12.0, min=1), b.parameter("c", 0.05)
    p, v = b.state("p"), b.state("v")
    b.ode("p", v)
    b.ode("v", -(w**2) * p - c * v)
    b.output("x", p)
    b.output("y", v)
    speed = -turn * np.sin(turn * t) + 0.1 * np.random.default_rng(2).standard_normal(500)
    data = data.with_channel(Channel("y", "1", time=t, values=speed))
    model = b.model().with_effect(SensorDelay(), at="sensor_x")
    fit = ce.estimate(model, data, progress=False)
    found = fit.estimates["sensor_x.sensor_delay.delay"]
    assert abs(found.value - late) < 4 * found.stderr < 1e-3
    assert abs(dict(fit.model.lags).get("x", 0.0) - late) <= 0.6 * 5e-3 + 1e-9
    assert fit.n == 1000 - round(abs(dict(fit.model.lags)["x"]) / 5e-3)
    assert np.isnan(fit.traces["run"]["x"].residual).sum() == 1000 - fit.n
    run = ce.simulate(fit, data)["x"].values
    assert np.abs(run - np.cos(turn * (t - late)))[(t > late) & (t < t[-1] + late)].max() < 0.01


def test_a_delay_of_more_than_half_of_the_record_says_that_it_is_not_exact():
    t = np.arange(200) * 5e-3
    data = ce.Experiment.from_arrays("run", time=t, units={"x": "1"}, x=np.cos(4 * np.pi * t))
    model = swing(12.0).with_effect(SensorDelay(), at="sensor_x", values={"delay": 0.7})
    pars = model.parameters()
    pars.fix("sensor_x.sensor_delay.delay", 0.7)
    fit = ce.estimate(model, data, parameters=pars, progress=False)
    assert any(
        "(sensor_x.sensor_delay.delay = 0.7 s): a delay counts to second order" in one for one in fit.messages
    )
    pars.fix("sensor_x.sensor_delay.delay", 0.4)
    near = ce.estimate(model, data, parameters=pars, progress=False)
    assert not any("counts to second order" in one for one in near.messages)


@pytest.mark.parametrize("late", [0.7, 1.9])
def test_a_simulation_shows_any_delay_exactly_behind_it(late):
    """Of a record of 2 s."""
    t, turn = np.arange(400) * 5e-3, 2 * np.pi * 2.0
    data = ce.Experiment.from_arrays("run", time=t, units={"x": "1"}, x=np.zeros(400))
    model = swing().with_effect(SensorDelay(), at="sensor_x", values={"delay": late})
    shown = ce.simulate(model, data, initial={"x": 1.0, "v": 0.0})["x"].values
    after = t >= late
    np.testing.assert_allclose(shown[after], np.cos(turn * (t - late))[after], atol=1e-5)


@pytest.mark.slow
def test_dry_friction_that_is_kept_sharp_is_fitted_beside_a_delay():
    """Events take steps as they come: there is none to be as fine as that of the fit before."""
    t = np.arange(300) * 0.01
    push = 3 * np.sin(2 * np.pi * 1.1 * t)
    run = solve_ivp(
        lambda s, y: [y[1], np.interp(s, t, push) - 20 * y[0] - 0.4 * np.tanh(y[1] / 1e-3)], (0, t[-1]), [0.1, 1.0],
        dense_output=True, rtol=1e-8, atol=1e-9, max_step=5e-3,
    )  # fmt: skip
    x = run.sol(np.maximum(t - 0.05, 0.0))[0] + 1e-3 * np.random.default_rng(0).standard_normal(300)
    b = Blueprint("slide")
    k = b.parameter("k", 18.0, unit="N/m", min=1)
    p, v = b.state("p", unit="m"), b.state("v", unit="m/s")
    force = b.port("mass", "inertia", {"speed": v})
    b.ode("p", v)
    b.ode("v", b.input("F", unit="N") - k * p + force)
    b.output("x", p, unit="m")
    model = b.model().with_effect(CoulombFriction(), at="mass", sharp=True, values={"torque": 0.3})
    model = model.with_effect(SensorDelay(), at="sensor_x", values={"delay": 0.04})
    data = ce.Experiment.from_arrays("run", time=t, units={"F": "N", "x": "m"}, F=push, x=x)
    fit = ce.estimate(model, data, progress=False)
    found = fit.estimates["sensor_x.sensor_delay.delay"]
    assert fit.converged
    assert abs(found.value - 0.05) < 4 * found.stderr < 4e-3
