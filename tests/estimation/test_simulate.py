"""simulate: linear and nonlinear models, initial states given, fitted or missing."""

import importlib

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce

TRUE = {"J_eng": 0.4, "C_eng": 0.5}


def test_a_linear_model_by_its_exact_recursion(run_up):
    data = run_up(sigma=0.0)
    run = ce.simulate(ce.one_inertia(), data, parameters=TRUE, initial={"omega_eng": 20.0})
    np.testing.assert_allclose(run["omega"].values, data["omega"].values, rtol=1e-12)
    assert run["omega"].origin == "derived"
    assert run["omega"].unit == "rad/s"
    np.testing.assert_array_equal(run["T"].values, data["T"].values)
    assert set(run.names) == {"T", "omega"}
    assert run.name == data.name


def test_without_a_measured_output(run_up):
    data = run_up(sigma=0.0)
    run = ce.simulate(ce.one_inertia(), data.without("omega"), parameters=TRUE, initial={"omega_eng": 20.0})
    np.testing.assert_allclose(run["omega"].values, data["omega"].values, rtol=1e-12)


def test_by_euler(run_up):
    data = run_up(sigma=0.0, euler=True)
    run = ce.simulate(ce.one_inertia(), data, parameters=TRUE, initial={"omega_eng": 20.0}, method="euler")
    np.testing.assert_allclose(run["omega"].values, data["omega"].values, rtol=1e-12)


def test_parameters_as_a_set_a_mapping_or_defaults(run_up):
    data, model = run_up(), ce.one_inertia()
    pars = model.parameters()
    pars["J_eng"].set(0.4)
    pars["C_eng"].set(0.5)
    initial = {"omega_eng": 20.0}
    runs = [ce.simulate(model, data, parameters=p, initial=initial) for p in (pars, TRUE)]
    np.testing.assert_array_equal(runs[0]["omega"].values, runs[1]["omega"].values)
    default = ce.simulate(model, data, initial=initial)
    same = ce.simulate(model, data, parameters=model.parameters(), initial=initial)
    np.testing.assert_array_equal(default["omega"].values, same["omega"].values)


def test_parameters_outside_the_models_range_are_taken(run_up):
    run = ce.simulate(
        ce.one_inertia(), run_up(), parameters={"J_eng": 5e3, "C_eng": 0.0}
    )  # J_eng <= 1e3 in a fit; the initial state is fitted with the value held
    assert np.ptp(run["omega"].values) < 0.1
    said = run.history[-1].arguments["outside of bounds"]
    assert said == {"J_eng": "5000, where its bounds are 1e-06 and 1000"}


def test_a_missing_initial_state_is_fitted_by_least_squares(run_up):
    data = run_up(sigma=0.2)
    run = ce.simulate(ce.one_inertia(), data, parameters=TRUE)
    zero, one = (
        ce.simulate(ce.one_inertia(), data, parameters=TRUE, initial={"omega_eng": x})["omega"].values
        for x in (0.0, 1.0)
    )
    column, y = one - zero, data["omega"].values
    best = column @ (y - zero) / (column @ column)
    np.testing.assert_allclose(run["omega"].values, zero + best * column, rtol=1e-8)


def test_some_states_given_and_the_others_fitted(shaft, shaft_model):
    made = shaft(sigma=(0.0, 0.0))
    run = ce.simulate(shaft_model(), made.data, parameters=made.truth, initial={"omega_eng": made.start[0]})
    np.testing.assert_allclose(run["omega"].values, made.states[:, 0], rtol=1e-9)
    np.testing.assert_allclose(run["omega_load"].values, made.states[:, 1], rtol=1e-9)


def test_an_output_that_was_not_measured_is_simulated_too(shaft, shaft_model):
    made = shaft(two=False, sigma=(0.0, 0.0))
    run = ce.simulate(shaft_model(), made.data, parameters=made.truth)
    np.testing.assert_allclose(run["omega_load"].values, made.states[:, 1], rtol=1e-7)


def test_gaps_and_other_rates_of_the_output_do_not_matter(run_up):
    data = run_up(sigma=0.0, missing=0.3)
    run = ce.simulate(ce.one_inertia(), data, parameters=TRUE)
    whole = run_up(sigma=0.0)
    at = np.rint(run["omega"].time / 0.02).astype(int)  # from the first sample of the output that is there
    assert len(at) > 390
    np.testing.assert_allclose(run["omega"].values, whole["omega"].values[at], rtol=1e-8)
    assert np.isfinite(run["omega"].values).all()


def decay(**channels):
    """ẋ = −x + u as a model, with an experiment of the channels name = (time, values)."""
    b = ce.Blueprint("decay")
    x = b.state("x", unit="rad/s")
    b.ode("x", -x + (b.input("u", unit="rad/s2") if "u" in channels else 0))
    b.output("y", x, unit="rad/s")
    units = {"u": "rad/s2", "y": "rad/s"}
    made = [
        ce.experiment.Channel(n, units[n], time=np.asarray(t), values=np.asarray(v, dtype=float))
        for n, (t, v) in channels.items()
    ]
    return b.model(), ce.Experiment("made", tuple(made))


def test_a_given_start_holds_where_the_record_begins():
    """The first valid output comes later: it has no say in where the simulation starts."""
    time = np.arange(11) * 0.1
    y = np.where(time < 0.35, np.nan, 1.0)
    model, data = decay(u=(time, np.zeros(11)), y=(time, y))
    run = ce.simulate(model, data, initial={"x": 2.0})
    np.testing.assert_allclose(run["y"].time, time)
    np.testing.assert_allclose(run["y"].values, 2 * np.exp(-time), rtol=1e-12)
    later = ce.simulate(model, data)  # fitted to what was measured, it starts there
    assert later["y"].time[0] == pytest.approx(0.4)


def test_a_given_start_holds_where_the_inputs_begin_and_all_of_them_is_simulated():
    time = np.arange(11) * 0.1
    model, data = decay(u=(time, np.zeros(11)), y=([0.3, 0.5, 0.7], [1.0, 1.0, 1.0]))
    run = ce.simulate(model, data, initial={"x": 2.0})
    np.testing.assert_allclose(run["y"].time, time)
    np.testing.assert_allclose(run["y"].values, 2 * np.exp(-time), rtol=1e-12)


def test_a_given_start_keeps_the_rate_of_a_fast_output():
    fast = np.arange(41) * 0.025
    model, data = decay(u=([0.0, 0.5, 1.0, 1.5], np.zeros(4)), y=(fast, np.ones(41)))
    run = ce.simulate(model, data, initial={"x": 2.0})
    np.testing.assert_allclose(run["y"].time, np.arange(61) * 0.025)
    np.testing.assert_allclose(run["y"].values, 2 * np.exp(-run["y"].time), rtol=1e-12)


def test_a_given_start_without_inputs_holds_where_the_outputs_begin():
    time = np.arange(5) * 0.25
    model, data = decay(y=(time, [np.nan, 1.0, np.nan, 1.0, np.nan]))
    run = ce.simulate(model, data, initial={"x": 2.0})
    np.testing.assert_allclose(run["y"].values, 2 * np.exp(-time), rtol=1e-12)


def test_a_nonlinear_model_against_scipy():
    b = ce.Blueprint("pendulum")
    length = b.parameter("length", 1.0, min=0.1)
    angle, rate = b.state("angle"), b.state("rate")
    push = b.input("push")
    b.ode("angle", rate)
    b.ode("rate", -9.81 / length * ca.sin(angle) + push)
    b.output("y", angle + 0.1 * rate)
    time = np.arange(400) * 0.01
    value = np.sin(3 * time)
    data = ce.Experiment.from_arrays("swing", time=time, units={"push": "1"}, push=value)
    run = ce.simulate(b.model(), data, parameters={"length": 0.8}, initial={"angle": 1.0, "rate": 0.0})
    found = solve_ivp(
        lambda t, x: [x[1], -9.81 / 0.8 * np.sin(x[0]) + np.interp(t, time, value)],
        (0, time[-1]), [1.0, 0.0], "DOP853", time, rtol=1e-11, atol=1e-12, max_step=0.01,
    )  # fmt: skip
    np.testing.assert_allclose(run["y"].values, found.y[0] + 0.1 * found.y[1], atol=2e-7)


def test_the_linear_and_the_nonlinear_engine_agree(misfire):
    data = misfire(1, 1)
    runs = [
        ce.simulate(ce.two_mass(reciprocating_speed=speed), data)["omega"].values
        for speed in ("measured", "model")
    ]
    np.testing.assert_allclose(runs[0], runs[1], atol=0.05)
    residual = runs[1] - data["omega"].values
    assert residual.std() == pytest.approx(0.1, rel=0.05)


def test_a_simulated_record_can_be_fitted(shaft, shaft_model):
    made = shaft()
    run = ce.simulate(
        shaft_model(), made.data, parameters=made.truth,
        initial=dict(zip(("omega_eng", "omega_load", "twist"), made.start, strict=True)),
    )  # fmt: skip
    fit = ce.estimate(shaft_model(), run, progress=False)
    for name, value in made.truth.items():
        assert fit.values[name] == pytest.approx(value, rel=1e-6)


def test_the_data_are_not_changed(run_up):
    data = run_up()
    before = data["omega"].values.copy()
    ce.simulate(ce.one_inertia(), data)
    np.testing.assert_array_equal(data["omega"].values, before)


# ---- refused


def test_no_initial_state_and_nothing_measured(run_up, refused):
    with refused(
        ce.errors.SimulationError,
        "the initial state is not known, and no output was measured to fit it to",
        seen="no value for omega_eng",
        allowed="a value for each of omega_eng",
        cure="give initial={state: value, ...}",
    ):
        ce.simulate(ce.one_inertia(), run_up().without("omega"))


def test_an_unknown_state(run_up, refused):
    with refused(
        ce.errors.SimulationError,
        "the model one_inertia has no such state",
        seen="'omega'",
        allowed="omega_eng",
        cure="print(model.table()) lists the states",
    ):
        ce.simulate(ce.one_inertia(), run_up(), initial={"omega": 3.0})


@pytest.mark.parametrize("value", ["fast", None, float("nan"), (1.0, 2.0)])
def test_an_initial_value_that_is_no_number(run_up, refused, value):
    with refused(
        ce.errors.SimulationError,
        "the initial value of omega_eng is not a finite number",
        seen=str(value),
        cure="leave the state out to have it fitted",
    ):
        ce.simulate(ce.one_inertia(), run_up(), initial={"omega_eng": value})


def test_an_unknown_parameter(run_up, refused):
    with refused(ce.errors.ModelError, "the model one_inertia has no such parameter", seen="'J'"):
        ce.simulate(ce.one_inertia(), run_up(), parameters={"J": 1.0})


def test_an_unknown_method(run_up, refused):
    with refused(ce.errors.SimulationError, "the method is not known", allowed='"exact" or "euler"'):
        ce.simulate(ce.one_inertia(), run_up(), initial={"omega_eng": 1.0}, method="rk4")


def test_an_initial_state_that_cannot_be_fitted(run_up, refused, monkeypatch):
    module = importlib.import_module("casadi_engine.estimation.simulate")
    whole = module.estimate
    monkeypatch.setattr(module, "estimate", lambda *a, **k: whole(*a, **{**k, "max_iterations": 1}))
    b = ce.Blueprint("steep")
    x = b.state("x", unit="rad/s")
    torque = b.input("T", unit="N m")
    b.ode("x", torque - 0.1 * x - 0.01 * x**3)
    b.output("omega", x, unit="rad/s")
    with refused(
        ce.errors.SimulationError,
        "the initial state could not be fitted to the measured outputs",
        seen="not converged",
        cure="give initial={state: value, ...}",
    ):
        ce.simulate(b.model(), run_up())


def test_a_simulation_that_is_not_finite(run_up, refused):
    with refused(
        ce.errors.SimulationError,
        "the simulation is not finite",
        allowed="parameters and initial states that give finite numbers",
        cure="check the equations there",
    ):
        ce.simulate(
            ce.one_inertia(), run_up(), parameters={"J_eng": 1e-9, "C_eng": -1e3}, initial={"omega_eng": 1.0}
        )


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"model": None}, "model"),
        ({"model": "one_inertia"}, "model"),
        ({"data": None}, "data"),
        ({"data": "run.csv"}, "data"),
        ({"parameters": [0.4, 0.5]}, "parameters"),
        ({"initial": 20.0}, "initial"),
        ({"initial": ""}, "initial"),
    ],
)
def test_arguments_of_another_kind(run_up, arguments, name):
    given = {"model": ce.one_inertia(), "data": run_up(), **arguments}
    with pytest.raises(ce.errors.SimulationError) as caught:
        ce.simulate(given.pop("model"), given.pop("data"), **given)
    assert f"the argument {name} of simulate is of the wrong kind" in str(caught.value)
    assert f"seen: {type(arguments[name]).__name__}" in str(caught.value)


def test_a_list_of_records_is_told_what_to_do(run_up):
    with pytest.raises(ce.errors.SimulationError, match="simulate several one by one"):
        ce.simulate(ce.one_inertia(), [run_up(), run_up()])


# ---- from a fit


def test_a_fit_is_simulated_as_it_was_found(run_up):
    record = run_up()
    fit = ce.estimate(ce.one_inertia(), record, noise=ce.Noise(omega=0.05), progress=False)
    run = ce.simulate(fit, record)
    trace = fit.traces[record.name]["omega"]
    np.testing.assert_allclose(run["omega"].values, trace.simulated, rtol=1e-12)
    by_hand = ce.simulate(fit.model, record, parameters=fit.values, initial=fit.initial[record.name])
    np.testing.assert_array_equal(run["omega"].values, by_hand["omega"].values)
    faster = ce.simulate(fit, record, parameters={"C_eng": 0.0})
    assert faster["omega"].values[-1] > run["omega"].values[-1]


def test_the_initial_states_of_a_fit_hold_where_its_outputs_begin():
    b = ce.Blueprint("decay")
    x, rate, u = b.state("x"), b.parameter("rate", 1.0), b.input("u")
    b.ode("x", u - rate * x)
    b.output("y", x)
    time = 0.01 * np.arange(301)
    y = np.where(time < 1.0, np.nan, 3 * np.exp(-2 * (time - 1.0)))
    data = ce.Experiment.from_arrays("late", time=time, units={"u": "1", "y": "1"}, u=0 * time, y=y)
    fit = ce.estimate(b.model(), data, noise=ce.Noise(y=1e-3), progress=False)
    run = ce.simulate(fit, data)
    assert run["y"].time[0] == pytest.approx(1.0)
    np.testing.assert_allclose(run["y"].values, 3 * np.exp(-2 * (run["y"].time - 1.0)), atol=1e-8)
    # plain numbers hold where the inputs begin
    whole = ce.simulate(fit.model, data, parameters={"rate": 2.0}, initial={"x": 3.0})
    np.testing.assert_allclose(whole["y"].values, 3 * np.exp(-2 * time), atol=1e-8)


def test_a_parameter_that_varies_takes_the_value_of_the_records_name(run_up):
    first, second = run_up(), run_up(seed=1)
    model = ce.one_inertia()
    pars = model.parameters()
    pars.vary_by_experiment("C_eng")
    fit = ce.estimate(model, [first, second], parameters=pars, noise=ce.Noise(omega=0.05), progress=False)
    name = fit.data[0].name
    own = ce.simulate(fit, fit.data[0])
    by_hand = ce.simulate(
        model, fit.data[0], initial=fit.initial[name],
        parameters={"J_eng": fit.values["J_eng"], "C_eng": fit.values[f"C_eng@{name}"]},
    )  # fmt: skip
    np.testing.assert_array_equal(own["omega"].values, by_hand["omega"].values)


def test_a_number_for_an_initial_state_holds_where_the_inputs_begin():
    """An infusion from 0 on, whose first sample is drawn an hour later: A(0) = 0, and not A(1 h) = 0."""
    b = ce.Blueprint("drug", time_unit="h")
    k, volume = b.parameter("k", 1.0, unit="1/h", min=0), b.parameter("V", 10.0, unit="L", min=0.1)
    amount, rate = b.state("A", unit="mg"), b.input("R", unit="mg/h")
    b.ode("A", rate - k * amount)
    b.output("c", amount / volume, unit="mg/L")
    t = np.array([1, 2, 3, 4, 6, 8, 12.0])
    c = 100 / 0.5 * (1 - np.exp(-0.5 * np.minimum(t, 2))) * np.exp(-0.5 * np.maximum(t - 2, 0)) / 20
    data = ce.Experiment.from_arrays(
        "run",
        units={"R": "mg/h", "c": "mg/L", "time": "h"},
        hold={"R": "zero"},
        R=([0, 2, 12.0], [100, 0, 0]),
        c=(t, c),
    )
    fit = ce.estimate(b.model(), data, initial={"A": 0.0}, noise=ce.Noise(c=0.02), progress=False)
    assert fit.values["V"] == pytest.approx(20, abs=1e-4)
    assert fit.values["k"] == pytest.approx(0.5, abs=1e-5)
    assert fit.initial["run"]["A"].time == 0.0
    run = ce.simulate(fit, data)
    at = np.isin(np.round(run["c"].time / 3600, 9), t)
    np.testing.assert_allclose(run["c"].values[at], c, atol=1e-5)
    free = ce.estimate(b.model(), data, noise=ce.Noise(c=0.02), progress=False)
    assert free.initial["run"]["A"].time == 3600.0


def test_another_measurement_under_the_name_of_a_record_has_first_states_of_its_own(run_up):
    """The fit's own were taken by the name: 3 K were simulated from -0.02, with a band of 0.007."""
    fit = ce.estimate(ce.one_inertia(), run_up(), progress=False)
    fresh = run_up(sigma=0.0)
    time, torque = fresh["T"].time, fresh["T"].values
    faster = ce.simulate(ce.one_inertia(), fresh, parameters=TRUE, initial={"omega_eng": 30.0})[
        "omega"
    ].values
    faster = faster + 0.01 * np.random.default_rng(4).standard_normal(len(time))
    other = ce.Experiment.from_arrays(
        fit.data[0].name, time=time, units={"T": "N m", "omega": "rad/s"}, hold="zero", T=torque, omega=faster
    )
    assert ce.simulate(fit, other)["omega"].values[0] == pytest.approx(30.0, abs=0.2)
    shown = ce.simulate(fit, other, band=True)
    assert shown.simulated["omega"].values[0] == pytest.approx(30.0, abs=0.2)
    own = fit.initial[fit.data[0].name]["omega_eng"].value
    assert ce.simulate(fit, fit.data[0])["omega"].values[0] == pytest.approx(own)
