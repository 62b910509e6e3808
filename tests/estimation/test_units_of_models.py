"""Data arrive in the units that a model declares: closed forms in the user's units, whatever the data were in."""

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import ExperimentError, ModelError, UnitError
from casadi_engine.experiment.units import converted
from casadi_engine.identifiability.fisher import fisher
from casadi_engine.identifiability.plans import plan
from casadi_engine.model.arrival import arriving

T = np.arange(400) * 0.01
RISE = 1 - np.exp(-T / 0.8)


def shaft(unit="rpm", **declared):
    """J dw/dt = T - C w; its output in another unit than the state: as it stands in those that count the same."""
    b = ce.Blueprint("shaft")
    inertia = b.parameter("J", 0.7, unit="kg m2", min=1e-3)
    damping = b.parameter("C", 0.3, unit="N m s/rad", min=0)
    w, torque = b.state("w", unit="rad/s"), b.input("T", unit="N m")
    b.ode("w", (torque - damping * w) / inertia)
    seen = {"rpm": w * 30 / np.pi, "m/s2": 2 * w, "1": 2 * w}.get(unit, w)
    b.output("speed", seen, **({"unit": unit} if unit else declared))
    return b.model()


def first_order(name, gain, *, input_unit, output_unit, start=0.5):
    """tau dx/dt = gain*u - x with tau = 0.8 s, x measured."""
    b = ce.Blueprint(name)
    k = b.parameter("gain", start)
    x, u = b.state("x", unit=output_unit), b.input("u", unit=input_unit)
    b.ode("x", (k * u - x) / 0.8)
    b.output("y", x, unit=output_unit)
    return b.model()


def record(**channels):
    """Channels name=(unit, values)."""
    units = {name: unit for name, (unit, _) in channels.items()}
    values = {name: values for name, (_, values) in channels.items()}
    return ce.Experiment.from_arrays("run", time=T, units=units, **values)


def test_an_output_in_rpm_gives_the_right_inertia():
    # 2 N m on 0.4 kg m2 and 0.5 N m s/rad: w = 4 (1 - exp(-t/0.8)) rad/s
    for unit, factor in (("rpm", 30 / np.pi), ("rad/s", 1.0), ("deg/s", 180 / np.pi)):
        data = record(T=("N mm", np.full(400, 2000.0)), speed=(unit, 4 * RISE * factor))
        fit = ce.estimate(shaft(), data, noise=ce.Noise(speed=1.0), progress=False)
        assert fit.values["J"] == pytest.approx(0.4, rel=1e-8)
        assert fit.values["C"] == pytest.approx(0.5, rel=1e-8)
        assert fit.data[0]["speed"].unit == "rpm"
        assert fit.traces["run"]["speed"].measured == pytest.approx(4 * RISE * 30 / np.pi, abs=1e-9)
        assert fit.noise["speed"][0] == 1.0  # the level is in the declared unit
        assert ce.validate(fit, data).records["run"]["speed"].rmse < 1e-8


def test_an_input_in_bar_gives_the_right_gain():
    # u = 3 bar, gain 2 mm/bar: x = 6 mm (1 - exp(-t/0.8))
    model = first_order("valve", 2.0, input_unit="bar", output_unit="mm")
    for unit, factor in (("bar", 1.0), ("Pa", 1e5), ("kPa", 100.0), ("psi", 1e5 / 6894.757293168361)):
        data = record(u=(unit, np.full(400, 3.0 * factor)), y=("m", 6e-3 * RISE))
        fit = ce.estimate(model, data, progress=False)
        assert fit.values["gain"] == pytest.approx(2.0, rel=1e-7)


@pytest.mark.parametrize(("declared", "offset"), [("degC", 0.0), ("K", 273.15), ("degF", None)])
def test_a_temperature_arrives_in_the_models_scale(declared, offset):
    # a body of 80 degC cools to 20 degC with 0.8 s: 20 + 60 exp(-t/0.8)
    b = ce.Blueprint("body")
    tau = b.parameter("tau", 0.5, unit="s", min=1e-2)
    x, around = b.state("x", unit=declared), b.input("around", unit=declared)
    b.ode("x", (around - x) / tau)
    b.output("T", x, unit=declared)
    celsius = 20 + 60 * np.exp(-T / 0.8)
    data = record(around=("K", np.full(400, 293.15)), T=("degC", celsius))
    fit = ce.estimate(b.model(), data, progress=False)
    assert fit.values["tau"] == pytest.approx(0.8, rel=1e-8)
    start = 176.0 if offset is None else 80.0 + offset
    assert fit.initial["run"]["x"].value == pytest.approx(start, rel=1e-9)
    assert fit.initial["run"]["x"].unit == declared


def test_a_flow_in_litres_per_minute_fills_a_tank():
    # 6 L/min fill 0.1 L in 1 s
    b = ce.Blueprint("tank", time_unit="min")
    share = b.parameter("share", 0.5, unit="1")
    volume, flow = b.state("V", unit="L"), b.input("Q", unit="L/min")
    b.ode("V", share * flow)
    b.output("level", volume, unit="L")
    data = record(Q=("m3/s", np.full(400, 1e-4)), level=("cm3", 90.0 * T))
    fit = ce.estimate(b.model(), data, progress=False)
    assert fit.values["share"] == pytest.approx(0.9, rel=1e-9)


def test_pharmacokinetics_in_hours_and_milligrams():
    # one compartment with absorption, ka = 1.2/h, k = 0.3/h, dose 100 mg, volume 20 L; samples in h
    hours = np.array([0.0, 0.25, 0.5, 1, 1.5, 2, 3, 4, 6, 8, 12, 16, 24])
    amount = 100 / 20 * 1.2 / (1.2 - 0.3) * (np.exp(-0.3 * hours) - np.exp(-1.2 * hours))
    b = ce.Blueprint("oral", description="one compartment", time_unit="h")
    ka, k = b.parameter("ka", 2.0, unit="1/h", min=0), b.parameter("k", 0.2, unit="1/h", min=0)
    gut, blood = b.state("gut", unit="mg/L"), b.state("blood", unit="mg/L")
    b.ode("gut", -ka * gut)
    b.ode("blood", ka * gut - k * blood)
    b.output("c", blood, unit="mg/L")
    model = b.model()
    fine = np.linspace(0, 24, 481)
    whole = 100 / 20 * 1.2 / (1.2 - 0.3) * (np.exp(-0.3 * fine) - np.exp(-1.2 * fine))
    data = ce.Experiment.from_arrays("dose", time=fine, units={"time": "h", "c": "ug/L"}, c=1000 * whole)
    assert data["c"].span == (0.0, 86400.0)
    run = ce.simulate(model, data, parameters={"ka": 1.2, "k": 0.3}, initial={"gut": 5.0, "blood": 0.0})
    assert run["c"].unit == "mg/L"
    assert run["c"].values == pytest.approx(whole, abs=1e-9)
    fit = ce.estimate(model, data, initial={"gut": 5.0, "blood": 0.0}, progress=False)
    assert fit.values["ka"] == pytest.approx(1.2, rel=1e-6)
    assert fit.values["k"] == pytest.approx(0.3, rel=1e-6)
    assert "one compartment; odes per h, divided by 3600 for time in s" in str(model)
    assert np.interp(hours, fine, whole)[:2] == pytest.approx(amount[:2], rel=1e-2)


def test_the_time_of_a_blueprint_runs_in_its_unit():
    # dx/dt = cos(t) with t in min: x = sin(t)
    b = ce.Blueprint("clock", time_unit="min")
    x = b.state("x")
    b.ode("x", b.drive("d", ca.cos(b.time), unit="1"))
    b.output("y", x)
    time = np.linspace(0, 60, 6001)
    data = ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=np.zeros(6001))
    run = ce.simulate(b.model(), data, initial={"x": 0.0})
    assert run["y"].values == pytest.approx(np.sin(time / 60), abs=1e-6)


@pytest.mark.parametrize("where", ["parameter", "state", "input"])
def test_hours_in_a_model_whose_time_was_not_stated_are_refused(where):
    def model(**options):
        b = ce.Blueprint("pk", **options)
        k = b.parameter("k", 0.3, unit="1/h" if where == "parameter" else "1/s")
        x = b.state("x", unit="mg/h" if where == "state" else "mg")
        u = b.input("u", unit="mg/h" if where == "input" else "mg/s")
        b.ode("x", u - k * x)
        b.output("y", x)
        return b.model()

    with pytest.raises(ModelError, match=r"time of the model pk in s or in h") as caught:
        model()
    assert 'Blueprint("pk", time_unit="h")' in str(caught.value)
    assert 'time_unit="s"' in str(caught.value)
    assert model(time_unit="s").states[0].name == "x"
    assert model(time_unit="h").states[0].name == "x"


@pytest.mark.parametrize("unit", ["m", "furlong", "1/s", "", 3])
def test_a_time_unit_that_is_none(unit):
    with pytest.raises(ModelError, match="not a unit of time"):
        ce.Blueprint("x", time_unit=unit)


def test_another_dimension_is_refused_by_name(tmp_path):
    data = record(T=("N m", np.full(400, 2.0)), speed=("m", 4 * RISE))
    path = tmp_path / "run.csv"
    data.to_csv(path)
    data = ce.read_experiment(path)
    for call in (
        lambda: ce.estimate(shaft(), data, progress=False),
        lambda: ce.simulate(shaft(), data, initial={"w": 0.0}),
        lambda: ce.validate(shaft(), data),
        lambda: ce.repair(shaft(), data, progress=False),
        lambda: fisher(shaft(), data, noise=ce.Noise(speed=1.0)),
    ):
        with pytest.raises(UnitError) as caught:
            call()
        for piece in (
            "run.csv, column 'speed'",
            "m in the data (dimension m)",
            "rpm (dimension s-1 rad)",
            "unit='m'",
        ):
            assert piece in str(caught.value)


def test_gravity_and_grams_are_told_apart():
    data = record(T=("N m", T), speed=("g", T))
    with pytest.raises(UnitError, match="g is the gram: write gn"):
        arriving(shaft(unit="m/s2"), data)
    data = record(T=("N m", T), speed=("gn", T))
    assert arriving(shaft(unit="m/s2"), data)["speed"].values == pytest.approx(9.80665 * T)


def test_one_stands_for_dimensionless_and_nothing_for_si():
    turning = record(T=("N mm", np.full(400, 2000.0)), speed=("rpm", 4 * RISE * 30 / np.pi))
    fit = ce.estimate(shaft(unit=None), turning, progress=False)  # not stated: the equations are in SI
    assert fit.values["J"] == pytest.approx(0.4, rel=1e-8)
    assert fit.model.outputs[0].unit == "-"
    assert fit.data[0]["speed"].unit == "rad/s"
    with pytest.raises(UnitError, match=r"1 \(dimension 1\)"):
        ce.estimate(shaft(unit="1"), turning, progress=False)
    with pytest.raises(UnitError, match="1/s may count revolutions"):
        ce.estimate(shaft(unit="1/s"), turning, progress=False)
    angle = record(T=("N m", T), speed=("deg", T))
    assert arriving(shaft(unit="1"), angle)["speed"].unit == "rad"


def test_a_unit_that_cannot_be_read_is_refused_where_it_is_declared():
    b = ce.Blueprint("b")
    for declare in (
        lambda: b.parameter("k", 1.0, unit="1/fortnight"),
        lambda: b.state("k", unit="1/fortnight"),
        lambda: b.input("k", unit="1/fortnight"),
        lambda: b.output("k", 1.0, unit="1/fortnight"),
    ):
        with pytest.raises(
            ModelError, match="the unit of k cannot be read: unknown unit 'fortnight'"
        ) as caught:
            declare()
        assert "  1/fortnight\n    ^^^^^^^^^\n" in str(caught.value)
        assert 'declaration of "k" in the Blueprint' in str(caught.value)


def test_one_name_in_two_units_is_refused():
    b = ce.Blueprint("b")
    x, u = b.state("x"), b.input("w", unit="rpm")
    b.ode("x", u - x)
    b.output("w", x, unit="rad/s")
    with pytest.raises(ModelError, match="input and as output in two units"):
        b.model()


def test_nothing_is_made_where_nothing_is_to_be_converted():
    data = record(T=("N m", np.full(400, 2.0)), speed=("rad/s", 4 * RISE))
    assert arriving(shaft(unit="rad/s"), data) is data
    once = arriving(shaft(), data)
    assert arriving(shaft(), once) is once
    assert once["T"] is data["T"]
    assert str(once.history[-1]) == "in_units(speed='rpm'): 400 -> 400 samples"
    assert data.in_units({"speed": "rad/s"}) is data
    with pytest.raises(ExperimentError, match="no channel 'x'"):
        data.in_units({"x": "m"})


def test_a_simulation_in_the_models_units_is_written_and_read_back(tmp_path):
    data = record(T=("N m", np.full(400, 2.0)))
    run = ce.simulate(shaft(), data, parameters={"J": 0.4, "C": 0.5}, initial={"w": 0.0})
    assert run["speed"].unit == "rpm"
    run.to_csv(tmp_path / "run.csv")
    assert (tmp_path / "run.csv").read_text().splitlines()[0] == "time [s],T [N m],speed [rpm]"
    again = arriving(shaft(), ce.read_experiment(tmp_path / "run.csv"))
    assert again["speed"].values == pytest.approx(4 * RISE * 30 / np.pi, abs=1e-9)
    assert converted(again["speed"].values, "rpm", "rad/s") == pytest.approx(4 * RISE, abs=1e-10)


def test_a_hole_in_an_input_stops_every_verb():
    keep = (T < 1) | (T > 2)
    data = ce.Experiment.from_arrays(
        "run",
        time=T[keep],
        units={"T": "N m", "speed": "rad/s"},
        T=np.full(keep.sum(), 2.0),
        speed=4 * RISE[keep],
    )
    model = shaft()
    for call in (
        lambda: ce.estimate(model, data, progress=False),
        lambda: ce.simulate(model, data, initial={"w": 0.0}),
        lambda: ce.validate(model, data),
        lambda: ce.repair(model, data, progress=False),
        lambda: fisher(model, data, noise=ce.Noise(speed=1.0)),
    ):
        with pytest.raises(ExperimentError, match="column 'T', after sample 99: rows are missing"):
            call()
    for told in (data.bridged(T="join"), data.split_at_holes()):
        fit = ce.estimate(model, told, progress=False)
        assert fit.values["J"] == pytest.approx(0.4, rel=1e-6)


def test_the_crank_angle_of_a_model_is_in_rad():
    def model(unit):
        b = ce.Blueprint("b")
        x, theta = b.state("x"), b.input("theta", unit=unit)
        b.ode("x", theta - x)
        b.output("y", x)
        return b.model()

    with pytest.raises(ModelError, match="theta is the crank angle, and that is in rad; seen: theta in deg"):
        model("deg")
    assert model("rad").inputs[0].unit == "rad"


def test_a_plan_is_made_for_models_in_si():
    b = ce.Blueprint("engine")
    x, load = b.state("x", unit="rad/s"), b.input("T_load", unit="kN m")
    theta = b.input("theta", unit="rad")
    b.ode("x", theta - load - x)
    b.output("omega", x, unit="rad/s")
    data = record(theta=("rad", 100 * T), T_load=("N m", T), omega=("rad/s", T))
    with pytest.raises(
        ExperimentError, match="in another unit than SI, and plans are made in SI; seen: T_load in kN m"
    ):
        plan(b.model(), data)
