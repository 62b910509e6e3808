"""A sensor that is behind: told from one that is late, beside another effect, and in a model that is not linear."""

import re
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce

STEP, COUNT = 0.5, 900


def plate(law=""):
    """A heated plate and its coolant; a loss by radiation makes it nonlinear."""
    b = ce.Blueprint("plate")
    heat, cold = b.input("P", unit="W"), b.input("T_in", unit="K")
    plate, coolant = b.state("T_p", unit="K", scale=100), b.state("T_c", unit="K", scale=100)
    across = b.parameter("hA", 40.0, unit="W/K", min=1, max=1e3) * (plate - coolant)
    flow = b.parameter("flow", 60.0, unit="W/K", min=1, max=1e3) * (coolant - cold)
    lost = 2e-8 * plate**4 if law == "radiation" else 0.0
    b.ode(
        "T_p", (heat - across - lost + b.port("plate", "inertia", {"speed": plate - cold}, unit="W")) / 160.0
    )
    b.ode("T_c", (across - flow) / b.parameter("C_c", 300.0, unit="J/K", min=10, max=1e4))
    b.output("T_plate", plate, unit="K")
    b.output("T_out", coolant, unit="K")
    return b.model()


def record(name, seed, *, behind=0.0, again=0.0, late=0.0, leak=0.0, law=""):
    rng, t = np.random.default_rng(seed), STEP * np.arange(COUNT)
    heat = np.repeat(rng.uniform(0, 3000, COUNT // 60), 60)
    cold = 300.0

    def rates(s, y):
        plate, coolant, shown, second = y
        across = 45.0 * (plate - coolant)
        lost = 2e-8 * plate**4 if law == "radiation" else 0.0
        heated = heat[min(int(s / STEP), COUNT - 1)] - across - lost - leak * (plate - cold)
        moves = (coolant - shown) / behind if behind else 0.0
        further = (shown - second) / again if again else 0.0
        return [heated / 160.0, (across - 70.0 * (coolant - cold)) / 320.0, moves, further]

    made = solve_ivp(
        rates,
        (0, t[-1]),
        [310.0, 305.0, 305.0, 305.0],
        t_eval=t,
        rtol=1e-9,
        atol=1e-9,
        max_step=STEP,
        dense_output=True,
    )
    shown = made.y[3 if again else 2] if behind else made.sol(np.maximum(t - late, 0.0))[1]
    values = {
        "T_plate": made.y[0] + 0.2 * rng.standard_normal(COUNT),
        "T_out": shown + 0.1 * rng.standard_normal(COUNT),
    }
    units = {"P": "W", "T_in": "K", "T_plate": "K", "T_out": "K"}
    hold = {"P": "zero", "T_in": "zero", "T_plate": "first", "T_out": "first"}
    cold = np.full(COUNT, cold)
    return ce.Experiment.from_arrays(name, time=t, units=units, hold=hold, P=heat, T_in=cold, **values)


def found(model, **how):
    effects = [
        "sensor_delay",
        "sensor_lag",
        "sensor_offset",
        "viscous_friction",
        "constant_torque",
        "wrong_value",
    ]
    return ce.repair(
        model,
        record("found on", 1, **how),
        fresh=record("fresh", 2, **how),
        effects=effects,
        starts=1,
        progress=False,
    )


@pytest.mark.parametrize("law", ["", "radiation"])
def test_a_slow_sensor_is_named_with_its_time_constant(law):
    """It had been a delay, without a doubt, and fresh data confirmed it."""
    answer = found(plate(law), behind=6.0, law=law)
    assert (answer.verdict, answer.confirmed) == ("named", True)
    (lag,) = answer.effects
    assert lag.key == "sensor_T_out.sensor_lag"
    assert lag.amplitude.value == 1.0
    assert lag.amplitude.fixed
    time = lag.parameters["sensor_T_out.sensor_lag.time"]
    assert abs(time.value - 6.0) < 4 * time.stderr


def test_a_late_sensor_stays_late():
    answer = found(plate(), late=5.0)
    assert [one.key for one in answer.effects] == ["sensor_T_out.sensor_delay"]
    assert answer.effects[0].amplitude.value == pytest.approx(5.0, abs=0.2)


def test_a_slow_sensor_beside_a_leak():
    """Effects that were prepared for the model without the sensor's state are looked for in the one with it."""
    answer = found(plate(), behind=6.0, leak=3.0)
    assert {one.key for one in answer.effects} == {"sensor_T_out.sensor_lag", "plate.viscous_friction"}
    sizes = {one.name: one.amplitude for one in answer.effects}
    assert abs(sizes["viscous_friction"].value - 3.0) < 4 * sizes["viscous_friction"].stderr


def test_a_filter_of_a_higher_order_is_no_delay_without_a_doubt():
    """A lag of 1.3 times the signal is none that a sensor has; where it does far better than a delay, the sensor has
    dynamics that the library lacks."""
    answer = found(plate(), behind=14.0, again=7.0)
    assert answer.verdict in ("class", "unnamed")
    if answer.verdict == "class":
        assert "sensor_T_out answers with dynamics of its own" in answer.unknown.sentence
        assert "or rather a law that the library lacks" in " ".join(str(answer).split())


def test_nothing_is_behind_where_nothing_is():
    assert found(plate()).verdict == "nothing missing"


def test_a_lag_of_the_only_sensor_is_said_in_the_time_of_the_model():
    """Of a model per hour the lag of the input was said in seconds, and that of the sensor in hours."""
    b = ce.Blueprint("drug", time_unit="h")
    amount, rate = b.state("A", unit="mg"), b.input("R", unit="mg/h")
    b.ode("A", rate - b.parameter("k", 0.8, unit="1/h", min=0.01) * amount)
    b.output("c", amount / b.parameter("V", 8.0, unit="L", min=0.1), unit="mg/L")
    rng, t = np.random.default_rng(1), 0.1 * np.arange(400)
    given = np.repeat(rng.uniform(0, 100, 20), 20)

    def rates(s, y):
        return [given[min(int(s / 0.1), 399)] - 0.5 * y[0], (y[0] / 10 - y[1]) / 0.6]

    shown = solve_ivp(rates, (0, t[-1]), [50.0, 5.0], t_eval=t, rtol=1e-9, max_step=0.1).y[1]
    units, hold = {"R": "mg/h", "c": "mg/L"}, {"R": "zero", "c": "first"}
    data = ce.Experiment.from_arrays(
        "drug", time=3600 * t, units=units, hold=hold, R=given, c=shown + 0.05 * rng.standard_normal(400)
    )
    answer = ce.repair(b.model(), data, effects=["sensor_lag", "sensor_offset"], starts=1, progress=False)
    assert [one.key for one in answer.effects] == ["sensor_c.sensor_lag"]
    words = " ".join(str(answer).split())
    # its error is not known here, and none is told
    told = re.search(r"the input R acts through a lag of about ([\d.]+) h \(an actuator\)", words)
    assert float(told.group(1)) == pytest.approx(0.6, abs=0.01)
    assert "is missing, or R acts behind by as much, confirmed" in words


def test_a_record_too_short_for_a_lag_keeps_the_usual_range():
    t = np.arange(3) * 2.0
    short = ce.Experiment.from_arrays("short", time=t, units={"y": "1"}, y=t)
    effect = ce.effects.SensorLag()
    assert effect.fitted(SimpleNamespace(name="sensor_y"), short, {}).span is None
    long = ce.Experiment.from_arrays("long", time=np.arange(100) * 2.0, units={"y": "1"}, y=np.arange(100.0))
    assert effect.fitted(SimpleNamespace(name="sensor_y"), long, {}).span == (1.0, 50.0)


@pytest.mark.parametrize(("given", "first"), [(None, 7.0), (0.0, 0.0), (2.5, 2.5)])
def test_what_a_sensor_shows_first_is_taken_where_nothing_was_given(given, first):
    record = ce.Experiment.from_arrays("run", time=np.arange(9) * 1.0, units={"y": "1"}, y=np.arange(9) + 7.0)
    effect = ce.effects.SensorLag(first=given)
    assert effect.fitted(SimpleNamespace(name="sensor_y"), record, {}).first == first


def shunted():
    """A coil behind a resistor: the voltage across both shows the current's state and the input at once, as a share."""
    b = ce.Blueprint("shunted")
    u, share = b.input("u", unit="V"), b.input("share", unit="1")
    i = b.state("i", unit="A")
    R = b.parameter("R", 2.5, unit="Ohm", min=0.1)
    b.ode("i", (u - R * i + b.port("coil", "inertia", {"speed": i}, unit="V")) / 4.0)
    b.output("shown", share * u + 0.5 * i, unit="V")
    b.output("i", i, unit="A")
    return b.model()


def held(name, seed, behind, step=0.25, count=600):
    """Both inputs jump; the voltmeter is behind."""
    rng, t = np.random.default_rng(seed), step * np.arange(count)
    u, share = (np.repeat(rng.uniform(low, high, count // 40), 40) for low, high in ((0, 5), (0.2, 1)))

    def rates(k):
        def of(s, y):
            return [(u[k] - 2.0 * y[0]) / 4.0, (share[k] * u[k] + 0.5 * y[0] - y[1]) / behind]

        return of

    x = [np.array([u[0] / 2.0, share[0] * u[0] + u[0] / 4])]
    for k in range(count - 1):
        x.append(solve_ivp(rates(k), (0, step), x[-1], rtol=1e-10, atol=1e-12).y[:, -1])
    x = np.array(x)
    return ce.Experiment.from_arrays(
        name, time=t, units={"u": "V", "share": "1", "shown": "V", "i": "A"},
        hold={"u": "zero", "share": "zero", "shown": "first", "i": "first"},
        u=u, share=share, shown=x[:, 1] + 0.02 * rng.standard_normal(count),
        i=x[:, 0] + 0.02 * rng.standard_normal(count),
    )  # fmt: skip


def test_a_slow_sensor_that_shows_an_input_which_jumps_is_named():
    """Its rate is infinite at the jumps: the lag moved nothing there, and the inputs were blamed instead."""
    answer = ce.repair(
        shunted(), held("found on", 1, 3.0), fresh=held("fresh", 2, 3.0), starts=1, progress=False,
        effects=["sensor_lag", "sensor_delay", "sensor_gain", "input_lag", "input_delay", "hidden_storage"],
    )  # fmt: skip
    assert ([one.key for one in answer.effects], answer.confirmed) == (["sensor_shown.sensor_lag"], True)
    (lag,) = answer.effects
    assert lag.amplitude.value == 1.0
    time = lag.parameters["sensor_shown.sensor_lag.time"]
    assert abs(time.value - 3.0) < 4 * time.stderr < 0.05


def test_a_lag_of_what_shows_inputs_at_once_is_exact():
    """Against a filter of the same course."""
    record = held("one", 3, 3.0)
    model = shunted().with_effect(ce.effects.SensorLag(), at="sensor_shown", values={"share": 1.0})
    u, share = (record[name].values[0] for name in ("u", "share"))
    run = ce.simulate(
        model, record, parameters={"R": 2.0, "sensor_shown.sensor_lag.time": 3.0}, tolerance=1e-9,
        initial={"i": u / 2.0, "sensor_shown_sensor_lag_behind": share * u + u / 4},
    )  # fmt: skip
    assert np.std(run["shown"].values - record["shown"].values) == pytest.approx(0.02, rel=0.1)


def test_a_lag_of_a_sensor_that_jumps_with_a_state_is_exact():
    """Of what jumps there is no rate, and none is asked for."""
    b = ce.Blueprint("switch")
    x = b.state("x")
    b.ode("x", -1.0)
    b.output("y", ca.sign(x))
    model = b.model().with_effect(ce.effects.SensorLag(), at="sensor_y", values={"share": 1.0})
    t = np.linspace(0, 2, 201)
    times = ce.Experiment.from_arrays("times", time=t, units={"y": "1"}, y=np.full(201, np.nan))
    run = ce.simulate(
        model, times, parameters={"sensor_y.sensor_lag.time": 0.2}, tolerance=1e-9,
        initial={"x": 1.0, "sensor_y_sensor_lag_behind": 1.0},
    )  # fmt: skip
    expected = np.where(t < 1, 1.0, -1 + 2 * np.exp(-(t - 1) / 0.2))
    np.testing.assert_allclose(run["y"].values, expected, atol=1e-6)
