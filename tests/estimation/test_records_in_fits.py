"""Initial states, gaps, several outputs and rates, and output times off the inputs' grid."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.experiment import Channel


def within(fit, truth, times=4.5):
    """Every estimate lies within this many standard errors of the truth."""
    for name, value in truth.items():
        error = fit.stderr[name]
        assert error is not None, name
        assert abs(fit.values[name] - value) < times * error, name


# ---- initial states


def test_initial_states_free_fixed_and_bounded(shaft, shaft_model):
    model, made = shaft_model(), shaft()
    free = ce.estimate(model, made.data, progress=False)
    within(free, made.truth)
    for k, (state, estimate) in enumerate(free.initial["shaft"].items()):
        assert abs(estimate.value - made.start[k]) < 4.5 * estimate.stderr, state
        assert (estimate.fixed, estimate.at_bound) == (False, False)
    assert free.dof == free.n - 8
    some = {"omega_eng": 100.0, "twist": (-0.2, 0.2), "omega_load": "free"}
    fit = ce.estimate(model, made.data, initial=some, progress=False)
    states = fit.initial["shaft"]
    assert (states["omega_eng"].value, states["omega_eng"].stderr) == (100.0, None)
    assert (states["omega_eng"].why, states["omega_eng"].fixed) == ("fixed", True)
    assert states["twist"].value == pytest.approx(-0.1, abs=4.5 * states["twist"].stderr)
    assert states["omega_load"].stderr < free.initial["shaft"]["omega_load"].stderr * 1.01
    assert fit.dof == fit.n - 7
    np.testing.assert_array_equal(fit.states_at_start["shaft"][0], 100.0)


def test_an_initial_state_at_its_bound(shaft, shaft_model):
    fit = ce.estimate(shaft_model(), shaft().data, initial={"twist": (-0.05, 0.2)}, progress=False)
    twist = fit.initial["shaft"]["twist"]
    assert (twist.at_bound, twist.stderr) == ("min", None)
    assert twist.value == pytest.approx(-0.05, abs=1e-6)
    assert twist.why == "at its lower bound: there is no symmetric error"
    assert fit.dof == fit.n - 7


def test_initial_states_of_each_record(shaft, shaft_model):
    a, b = shaft("a"), shaft("b", seed=4)
    initial = {"a": {"omega_eng": 100.0, "omega_load": 100.0, "twist": -0.1}}
    fit = ce.estimate(shaft_model(), [a.data, b.data], initial=initial, progress=False)
    assert all(state.fixed for state in fit.initial["a"].values())
    assert not any(state.fixed for state in fit.initial["b"].values())
    within(fit, a.truth)


def test_all_states_known_and_all_parameters_fixed(shaft, shaft_model):
    made, model = shaft(), shaft_model()
    pars = model.parameters()
    for name, value in made.truth.items():
        pars.fix(name, value)
    start = dict(zip(("omega_eng", "omega_load", "twist"), made.start, strict=True))
    for interval in ("auto", "single"):
        fit = ce.estimate(model, made.data, parameters=pars, initial=start, interval=interval, progress=False)
        assert fit.status == "converged"
        assert fit.dof == fit.n
        for k, output in enumerate(("omega", "omega_load")):
            np.testing.assert_allclose(fit.traces["shaft"][output].simulated, made.states[:, k], rtol=1e-10)


# ---- gaps, outputs, rates


def test_missing_samples_are_left_out(run_up):
    data = run_up(missing=0.2)
    fit = ce.estimate(ce.one_inertia(), data, noise=ce.Noise(omega=0.05), progress=False)
    valid = np.isfinite(data["omega"].values)
    assert fit.n == valid.sum() < 400
    within(fit, {"J_eng": 0.4, "C_eng": 0.5})
    trace = fit.traces["run_up"]["omega"]
    np.testing.assert_array_equal(trace.mask, valid)
    np.testing.assert_array_equal(np.isnan(trace.residual), ~valid)
    whole = ce.estimate(ce.one_inertia(), run_up(), noise=ce.Noise(omega=0.05), progress=False)
    assert fit.stderr["J_eng"] == pytest.approx(whole.stderr["J_eng"] / np.sqrt(0.8), rel=0.15)


def test_a_masked_sample_is_a_missing_one(run_up):
    data = run_up()
    mask = np.ones(400, dtype=bool)
    mask[50:120] = False
    wild = data["omega"].values.copy()
    wild[50:120] = np.nan
    units = {"T": "N m", "omega": "rad/s"}
    gap = ce.Experiment.from_arrays(
        "run_up", time=data["T"].time, units=units, hold="zero", T=data["T"].values, omega=wild
    )
    one = ce.estimate(ce.one_inertia(), data.masked("omega", mask), progress=False)
    other = ce.estimate(ce.one_inertia(), gap, progress=False)
    assert one.n == other.n == 330
    np.testing.assert_allclose(one.z, other.z, rtol=1e-12)


def test_two_outputs_have_noise_levels_of_their_own(shaft, shaft_model):
    made = shaft(sigma=(0.05, 0.4), n=3000)
    fit = ce.estimate(shaft_model(), made.data, progress=False)
    for output, sigma in (("omega", 0.05), ("omega_load", 0.4)):
        found, estimated = fit.noise[output]
        assert estimated
        assert found == pytest.approx(sigma, rel=4.5 / np.sqrt(2 * 3000))
    assert fit.cost == pytest.approx(fit.dof, rel=1e-6)
    within(fit, made.truth)
    known = ce.estimate(
        shaft_model(), made.data, noise=ce.Noise(omega=0.05, omega_load="estimate"), progress=False
    )
    assert known.noise["omega"] == (0.05, False)
    assert known.noise["omega_load"][1]
    one = ce.estimate(shaft_model(two=False), made.data, progress=False)
    assert one.n == 3000
    for name in made.truth:  # another output adds information
        assert fit.stderr[name] < one.stderr[name]


def test_noise_levels_are_a_fixed_point(shaft, shaft_model):
    fit = ce.estimate(shaft_model(), shaft().data, progress=False)
    levels = {name: sigma for name, (sigma, _) in fit.noise.items()}
    again = ce.estimate(shaft_model(), shaft().data, noise=ce.Noise(**levels), progress=False)
    np.testing.assert_allclose(again.z, fit.z, rtol=1e-6)
    np.testing.assert_allclose(again.covariance, fit.covariance, rtol=1e-4)
    for name, (sigma, _) in fit.noise.items():
        residual = fit.traces["shaft"][name].residual
        assert sigma == pytest.approx(np.sqrt(np.sum(residual**2) / (1200 * (1 - 8 / 2400))), rel=1e-5)


def test_a_resampled_output_gives_a_consistent_estimate(shaft, shaft_model):
    made = shaft(n=6000, two=False, sigma=(0.02, 0.1))
    model = shaft_model(two=False)
    whole = ce.estimate(model, made.data, noise=ce.Noise(omega=0.02), progress=False)
    thin = ce.estimate(model, made.data.resample(omega=15), noise=ce.Noise(omega=0.02), progress=False)
    assert (whole.n, thin.n) == (6000, 400)
    within(whole, made.truth)
    within(thin, made.truth)
    for name in made.truth:
        assert thin.stderr[name] == pytest.approx(whole.stderr[name] * np.sqrt(15), rel=0.1)
    assert len(thin.traces["shaft"]["omega"].time) == 400


@pytest.mark.parametrize("interval", ["auto", "single", 1, 7, 33, 60])
def test_a_resampled_output_in_any_interval(shaft, shaft_model, interval):
    data = shaft(two=False).data.resample(omega=15)
    model = shaft_model(two=False)
    best = ce.estimate(model, data, noise=ce.Noise(omega=0.05), interval="single", progress=False)
    fit = ce.estimate(model, data, noise=ce.Noise(omega=0.05), interval=interval, progress=False)
    assert fit.n == 80
    np.testing.assert_allclose(fit.z, best.z, rtol=1e-5)


@pytest.mark.parametrize("interval", ["auto", pytest.param("single", marks=pytest.mark.slow), 25])
def test_outputs_off_the_grid(shaft, shaft_model, interval):
    made = shaft(n=2400, step=1e-3, sigma=(0.0, 0.0))
    rng = np.random.default_rng(5)
    time = np.sort(rng.uniform(0.001, 2.39, 900))
    grid = made.data["T"].time
    noise = 0.05 * rng.standard_normal(900)
    # the truth between samples, to the accuracy of a cubic spline through exact points
    from scipy.interpolate import CubicSpline

    speed = CubicSpline(grid, made.states[:, 0])(time) + noise
    data = made.data.without("omega", "omega_load").with_channel(
        Channel("omega", "rad/s", time=time, values=speed)
    )
    fit = ce.estimate(
        shaft_model(two=False), data, noise=ce.Noise(omega=0.05), interval=interval, progress=False
    )
    assert (fit.status, fit.n) == ("converged", 900)
    within(fit, made.truth)
    assert fit.cost == pytest.approx(892, abs=4.5 * np.sqrt(2 * 892))
    trace = fit.traces["shaft"]["omega"]
    np.testing.assert_array_equal(trace.time, time)
    np.testing.assert_allclose(trace.simulated, speed - noise, atol=0.02)


def test_two_outputs_at_rates_of_their_own(shaft, shaft_model):
    made = shaft(n=3000)
    data = made.data.resample(omega=4, omega_load=10)
    fit = ce.estimate(shaft_model(), data, progress=False)
    assert fit.n == 750 + 300
    within(fit, made.truth)


def test_records_of_different_rates_and_lengths(run_up):
    data = [run_up("slow", step=0.04, n=150), run_up("fast", step=0.01, n=700, seed=1)]
    fit = ce.estimate(ce.one_inertia(), data, noise=ce.Noise(omega=0.05), progress=False)
    within(fit, {"J_eng": 0.4, "C_eng": 0.5})
    assert fit.n == 850
    alone = [ce.estimate(ce.one_inertia(), d, noise=ce.Noise(omega=0.05), progress=False) for d in data]
    information = sum(np.linalg.inv(one.covariance) for one in alone)
    np.testing.assert_allclose(np.linalg.inv(fit.covariance), information, rtol=0.2)


def test_a_record_of_three_samples(run_up):
    data = run_up(n=3)
    pars = ce.one_inertia().parameters()
    pars.fix("C_eng", 0.5)
    fit = ce.estimate(ce.one_inertia(), data, parameters=pars, noise=ce.Noise(omega=0.05), progress=False)
    assert (fit.status, fit.n, fit.dof) == ("converged", 3, 1)


def test_more_unknowns_than_samples_are_named_not_hidden(run_up):
    fit = ce.estimate(ce.one_inertia(), run_up(n=2), noise=ce.Noise(omega=0.05), progress=False)
    assert fit.undetermined
    assert fit.dof == 0
    assert all(error is None for error in fit.stderr.values())


def test_noise_free_data_return_the_truth(run_up):
    fit = ce.estimate(ce.one_inertia(), run_up(sigma=0.0), progress=False)
    assert fit.values["J_eng"] == pytest.approx(0.4, rel=1e-9)
    assert fit.values["C_eng"] == pytest.approx(0.5, rel=1e-9)
    assert fit.fit_percent["run_up"]["omega"]["simulation"] == pytest.approx(100)


def test_drives_and_inputs_of_the_fit(shaft, shaft_model):
    made = shaft()
    # alone: whether a second search is worth its time depends on what else the machine does
    fit = ce.estimate(shaft_model(), made.data, progress=False, errors="quadratic")
    assert set(fit.drives["shaft"]) == {"T", "T_load"}
    np.testing.assert_allclose(fit.drives["shaft"]["T"], [made.data["T"].time, made.data["T"].values])
    assert fit.data == (made.data,)
    assert set(fit.timing) == {"setup", "solve", "covariance", "total"}


def test_a_record_at_rest_is_fitted_without_overflow():
    """No torque, no speed: the level found is that of rounding, and the damping is said to be undetermined."""
    time = np.arange(50) * 0.02
    units = {"T": "N m", "omega": "rad/s"}
    rest = ce.Experiment.from_arrays("rest", time=time, units=units, T=np.zeros(50), omega=np.zeros(50))
    fit = ce.estimate(ce.one_inertia(), rest, progress=False)
    assert fit.converged
    assert abs(fit.initial["rest"]["omega_eng"].value) < 1e-9
    assert np.isfinite(fit.cost)
    assert fit.undetermined
