"""A sensor that feels another quantity: its law, where it may act, and that a repair names it."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import CrossSensitivity, library, ports_for

TIME = np.arange(250) * 3.0


def mixer(room=False):
    """A paddle in a bath that it heats: speed, torque and temperature are measured."""
    b = ce.Blueprint("mixer")
    inertia = b.parameter("J", 0.15, unit="kg m2", min=0.01, max=2)
    friction = b.parameter("d", 0.08, unit="N m s/rad", min=0.01, max=1)
    store = b.parameter("C", 8000, unit="J/K", min=500, max=50000)
    speed, warm = b.state("w", unit="rad/s"), b.state("T", unit="degC")
    torque, outside = b.input("M", unit="N m"), b.input("T_out", unit="degC")
    if room:
        b.input("T_room", unit="degC")
    b.ode(
        "w", (torque - friction * speed + b.port("shaft", "inertia", {"speed": speed}, unit="N m")) / inertia
    )
    gain = friction * speed**2 - 6.0 * (warm - outside)
    b.ode("T", (gain + b.port("bath", "inertia", {"temperature": warm}, unit="W")) / store)
    b.output("n", speed, unit="rad/s")
    b.output("torque", friction * speed, unit="N m")
    b.output("T_bath", warm, unit="degC")
    return b.model()


def record(name, seed, torque_felt=lambda warm, room: 0.0, stem=0.0, room=False):
    """By SciPy, the inputs joined by lines."""
    rng = np.random.default_rng(seed)
    levels = rng.uniform(0.5, 4.0, 21)
    torque = np.interp(TIME, np.linspace(0, TIME[-1], 21), levels)
    outside = 20 + 8 * np.sin(TIME / 90 + seed)
    inside = 22 + 5 * np.sin(TIME / 130 + 2 * seed)

    def rate(t, x):
        w, warm = x
        m, out = np.interp(t, TIME, torque), np.interp(t, TIME, outside)
        return [(m - 0.1 * w) / 0.12, (0.1 * w**2 - 6.0 * (warm - out)) / 9000]

    start = [torque[0] / 0.1, 18.0 + 6 * seed]
    w, warm = solve_ivp(
        rate, (0, TIME[-1]), start, t_eval=TIME, method="Radau", rtol=1e-9, atol=1e-11, max_step=3
    ).y
    shown = {
        "n": w + 0.15 * rng.standard_normal(len(TIME)),
        "torque": 0.1 * w + torque_felt(warm, inside) + 0.02 * rng.standard_normal(len(TIME)),
        "T_bath": warm + stem * (w - warm) + 0.02 * rng.standard_normal(len(TIME)),
    }
    inputs = {"M": torque, "T_out": outside} | ({"T_room": inside} if room else {})
    units = {"n": "rad/s", "torque": "N m", "T_bath": "degC", "M": "N m", "T_out": "degC", "T_room": "degC"}
    columns = inputs | shown
    own = {key: units[key] for key in columns}
    return ce.Experiment.from_arrays(name, time=TIME, units=own, **columns)


def test_it_acts_from_other_outputs_and_from_inputs():
    assert "cross_sensitivity" in [one.name for one in library()]
    names = [port.name for port in ports_for(mixer(room=True), CrossSensitivity())]
    others = {"n": ("torque", "T_bath"), "torque": ("n", "T_bath"), "T_bath": ("n", "torque")}
    outputs = [f"{one}_to_sensor_{other}" for one, every in others.items() for other in every]
    assert names == [
        *outputs,
        *(f"{one}_to_sensor_{other}" for one in ("M", "T_out", "T_room") for other in others),
    ]


def test_the_law_in_the_units_of_both():
    model = mixer().with_effect(CrossSensitivity(), at="T_bath_to_sensor_torque")
    coefficient, right_at = model.declarations[-2:]
    assert (coefficient.unit, right_at.unit) == ("N m/degC", "degC")
    line = next(one for one in model.equations().splitlines() if one.strip().startswith("torque ="))
    assert line.strip() == (
        "torque = d*w + T_bath_to_sensor_torque.cross_sensitivity.coefficient"
        "*(T - T_bath_to_sensor_torque.cross_sensitivity.right_at)"
    )
    known = {coefficient.name: 0.03, right_at.name: 0.5}
    data = record("run", 1)
    first = {"w": 8.0, "T": 20.0}
    with_it = ce.simulate(model, data, parameters=known, initial=first)
    without = ce.simulate(mixer(), data, initial=first)
    assert with_it["torque"].values - without["torque"].values == pytest.approx(
        0.03 * (without["T_bath"].values - 0.5), abs=1e-9
    )
    for name in ("n", "T_bath"):
        assert with_it[name].values == pytest.approx(without[name].values, abs=1e-9)


def test_a_thermometer_takes_a_share_of_the_difference_to_another_one():
    b = ce.Blueprint("bodies")
    hot, cold = b.state("a", unit="degC"), b.state("b", unit="degC")
    b.ode("a", -(hot - cold) / 10)
    b.ode("b", (hot - cold) / 20)
    b.output("hot", hot, unit="degC")
    b.output("cold", cold, unit="degC")
    model = b.model().with_effect(CrossSensitivity(), at="hot_to_sensor_cold", values={"coefficient": 0.25})
    assert model.declarations[-1].unit == "1"
    assert "cold = b + hot_to_sensor_cold.cross_sensitivity.coefficient*(a - b)" in model.equations()


@pytest.mark.parametrize(
    ("unit", "mixed"),
    [("mol/m3", True), ("g/L", True), ("1/mL", True), ("degC", True), ("V", False), ("m", False)],
)
def test_what_mixes_is_a_temperature_or_a_concentration(unit, mixed):
    b = ce.Blueprint("vessel")
    feed, inside = b.input("feed", unit=unit), b.state("c", unit=unit)
    b.ode("c", (feed - inside) / 10)
    b.output("out", inside, unit=unit)
    model = b.model().with_effect(CrossSensitivity(), at="feed_to_sensor_out")
    assert ("*(feed - c)" in model.equations()) is mixed
    assert ("right_at" in model.equations()) is not mixed


def test_a_repair_names_a_stream_that_passes_by_a_vessel():
    """It was taken for coloured noise, and nothing was missing: y + s z alone is no mixture."""

    def vessel():
        b = ce.Blueprint("cell", time_unit="min")
        volume, loss = b.parameter("V", 30.0, unit="L", min=1), b.parameter("r", 0.5, unit="mol/min", min=0)
        flow, feed = b.input("q", unit="L/min"), b.input("feed", unit="mol/L")
        c = b.state("c", unit="mol/L")
        b.ode("c", (flow * (feed - c) - loss + b.port("cell", "inertia", {"speed": c})) / volume)
        b.output("out", c, unit="mol/L")
        return b.model()

    def run(name, seed):
        rng = np.random.default_rng(seed)
        t = np.arange(300) * 1.0
        flow = np.interp(t, np.arange(0, 330, 30), rng.uniform(2, 8, 11))
        feed = np.interp(t, np.arange(0, 340, 20), rng.uniform(2, 6, 17))
        c = solve_ivp(
            lambda s, x: (0.8 * np.interp(s, t, flow) * (np.interp(s, t, feed) - x) - 0.6) / 16,
            (0, t[-1]), [3.0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=1.0,
        ).y[0]  # fmt: skip
        out = 0.8 * c + 0.2 * feed + 0.02 * rng.standard_normal(len(t))
        units = {"time": "min", "q": "L/min", "feed": "mol/L", "out": "mol/L"}
        return ce.Experiment.from_arrays(name, time=t, units=units, q=flow, feed=feed, out=out)

    found = ce.repair(vessel(), run("a", 1), fresh=run("b", 2), progress=False)
    (one,) = found.effects
    assert (one.key, found.confirmed) == ("feed_to_sensor_out.cross_sensitivity", True)
    assert one.amplitude.value == pytest.approx(0.2, abs=0.02)


def test_two_sensors_of_one_quantity_do_not_feel_one_another():
    b = ce.Blueprint("one")
    x = b.state("x", unit="m")
    b.ode("x", -x)
    b.output("left", x, unit="m")
    b.output("right", x, unit="m")
    assert ports_for(b.model(), CrossSensitivity()) == ()


def test_where_the_sensor_may_be_right_is_what_the_records_reach_and_zero():
    port, data = mixer().ports["T_bath_to_sensor_torque"], record("run", 1)

    class View:
        @staticmethod
        def courses(signal):
            return (np.array([20.0, 35.0]),) if signal == "input" else ()

        @staticmethod
        def has(signal):
            return signal in port.signals

        @staticmethod
        def is_mixed(signal):
            return signal == "input"

    fitted = CrossSensitivity().fitted(View(), data, {})
    assert (fitted.between, fitted.span) == (False, (-7.0, 42.0))
    assert fitted.nuisance["right_at"].values() == pytest.approx((-7.0, 17.5, 42.0))
    assert CrossSensitivity().idle(View()) == ""


def test_a_repair_names_a_torque_transducer_that_feels_the_temperature():
    """It was "the sensor torque drifts with time", which fresh data refuted."""
    records = [
        record(name, seed, lambda warm, _: 0.02 * (warm - 20)) for name, seed in (("run", 1), ("fresh", 2))
    ]
    found = ce.repair(mixer(), records[0], fresh=records[1], progress=False)
    assert (found.verdict, found.confirmed) == ("named", True)
    (one,) = found.effects
    assert one.key == "T_bath_to_sensor_torque.cross_sensitivity"
    coefficient, right_at = one.parameters.values()
    assert abs(coefficient.value - 0.02) < 3 * coefficient.stderr
    assert abs(right_at.value - 20) < 3 * right_at.stderr
    assert "a cross-sensitivity of sensor_torque to T_bath" in str(found)


def test_a_repair_names_what_a_sensor_feels_of_an_input_that_acts_on_nothing():
    records = [
        record(name, seed, lambda _, room: 0.015 * (room - 25), room=True)
        for name, seed in (("run", 1), ("fresh", 2))
    ]
    found = ce.repair(mixer(room=True), records[0], fresh=records[1], progress=False)
    assert (found.verdict, found.confirmed) == ("named", True)
    assert [one.key for one in found.effects] == ["T_room_to_sensor_torque.cross_sensitivity"]


def test_a_law_that_no_line_follows_is_said_to_depend_on_the_other_output():
    records = [
        record(name, seed, lambda warm, _: 0.1 * np.sin((warm - 20) / 2))
        for name, seed in (("run", 1), ("fresh", 2))
    ]
    found = ce.repair(mixer(), records[0], fresh=records[1], progress=False)
    assert found.verdict == "unnamed"
    assert "the sensor torque depends on T_bath too" in str(found)


def test_nothing_is_found_where_nothing_is_felt():
    found = ce.repair(mixer(), record("run", 1), fresh=record("fresh", 2), progress=False)
    assert found.verdict == "nothing missing"
