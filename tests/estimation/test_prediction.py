"""Bands of predictions: against the scatter of refits, an identity of least squares, and draws of the same errors."""

from types import SimpleNamespace

import casadi
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.errors import SimulationError

SIGMA = 0.3
QUIET = {"noise": ce.Noise(omega=SIGMA), "progress": False}


def record(seed, name="run_up", n=120, start=3.0, rest=False):
    """An inertia that runs up under a torque with a step, exact for the zero-order hold."""
    time, decay = 0.05 * np.arange(n), np.exp(-0.05 * 0.5 / 0.4)
    torque = np.where(time < 3, 2.0, 4.0) + (np.sin(time) if rest else 0.0)
    speed = np.empty(n)
    speed[0] = start
    for k in range(n - 1):
        speed[k + 1] = decay * speed[k] + (1 - decay) / 0.5 * torque[k]
    speed += SIGMA * np.random.default_rng(seed).standard_normal(n)
    units = {"T": "N m", "omega": "rad/s"}
    return ce.Experiment.from_arrays(name, time=time, units=units, hold="zero", T=torque, omega=speed)


MODEL = ce.one_inertia()


def fit_of(*data, **options):
    return ce.estimate(MODEL, list(data), **{**QUIET, **options})


@pytest.fixture(scope="module")
def many_fits():
    return [fit_of(record(seed)) for seed in range(100)]


def test_the_squares_of_the_errors_add_up_to_what_was_estimated():
    """Trace of the projection of least squares: two parameters and one initial state."""
    fit = fit_of(record(0))
    band = ce.simulate(fit, fit.data[0], band=True)["omega"]
    assert np.sum((band.stderr / SIGMA) ** 2) == pytest.approx(3, rel=1e-6)
    assert band.sigma == SIGMA
    np.testing.assert_allclose(band.value, fit.traces["run_up"]["omega"].simulated, atol=1e-9)
    np.testing.assert_allclose((band.high - band.low) / 2, 1.959964 * band.stderr, rtol=1e-5)
    wide = 1.959964 * np.hypot(band.stderr, SIGMA)
    np.testing.assert_allclose((band.high_noise - band.low_noise) / 2, wide, rtol=1e-5)


@pytest.mark.parametrize("stated", [None, SIGMA / 3])
def test_errors_that_count_with_the_noise_as_it_is_are_those_of_the_band(stated):
    """At the first sample the output is the state that was fitted, in coloured noise and in more than was stated."""
    plain, random = record(0), np.random.default_rng(3)
    noise = random.standard_normal(120)
    for k in range(1, 120):
        noise[k] = 0.8 * noise[k - 1] + 0.6 * noise[k]
    noise = SIGMA * (noise if stated is None else random.standard_normal(120))
    speed = plain["omega"].values - SIGMA * np.random.default_rng(0).standard_normal(120) + noise
    units = {"T": "N m", "omega": "rad/s"}
    data = ce.Experiment.from_arrays(
        "run_up", time=plain["T"].time, units=units, hold="zero", T=plain["T"].values, omega=speed
    )
    fit = fit_of(data, noise=ce.Noise(omega="estimate" if stated is None else stated))
    band = ce.simulate(fit, data, band=True)["omega"]
    first = fit.initial["run_up"]["omega_eng"].stderr
    assert fit.own_noise["run_up/omega_eng"] > 1.5
    assert band.stderr[0] == pytest.approx(first, rel=0.05)


@pytest.mark.slow  # the identity above and the draws below hold the same errors
@pytest.mark.parametrize("kind", ["its own record", "fresh", "given start"])
def test_errors_are_the_scatter_of_refits(kind, many_fits):
    """Of the record that was fitted, of another one to which the start is fitted, and from a start that is known."""
    found, errors = [], []
    options = {"initial": {"omega_eng": 3.0}} if kind == "given start" else {}
    for seed, fit in enumerate(many_fits):
        fresh = record(1000 + seed, "fresh", n=60, start=1.0, rest=True)
        data = fit.data[0] if kind == "its own record" else fresh
        prediction = ce.simulate(fit, data, band=True, **options)
        found.append(prediction["omega"].value)
        errors.append(prediction["omega"].stderr)
    scatter, claimed = np.std(found, axis=0), np.sqrt(np.mean(np.square(errors), axis=0))
    some = claimed > 1e-6
    assert np.sqrt(np.mean(scatter[some] ** 2)) == pytest.approx(
        np.sqrt(np.mean(claimed[some] ** 2)), rel=0.12
    )
    np.testing.assert_allclose(scatter[some], claimed[some], rtol=0.3)
    if kind == "given start":
        assert claimed[0] == 0.0


def pendulum():
    import casadi

    b = ce.Blueprint("pendulum")
    k, c = b.parameter("k", 9.0, min=-100, max=100), b.parameter("c", 0.3, min=-100, max=100)
    x, w = b.state("x"), b.state("w")
    b.ode("x", w)
    b.ode("w", -k * casadi.sin(x) - c * w)
    b.output("y", x)
    return b.model()


def swing():
    time = np.linspace(0, 6, 150)
    y = 0.8 * np.cos(2.9 * time) * np.exp(-0.15 * time)
    y += 0.02 * np.random.default_rng(1).standard_normal(150)
    return ce.Experiment.from_arrays("swing", time=time, units={"y": "1"}, y=y)


def test_a_model_without_a_linear_core_has_the_same_identity():
    fit = ce.estimate(pendulum(), swing(), noise=ce.Noise(y=0.02), progress=False)
    band = ce.simulate(fit, fit.data[0], band=True)["y"]
    assert np.sum((band.stderr / 0.02) ** 2) == pytest.approx(4, rel=1e-4)
    np.testing.assert_allclose(band.value, fit.traces["swing"]["y"].simulated, atol=1e-5)


@pytest.mark.parametrize("make", [lambda: fit_of(record(0)), lambda: ce.estimate(
    pendulum(), swing(), noise=ce.Noise(y=0.02), progress=False)])  # fmt: skip
def test_draws_of_the_same_errors_make_the_same_band(make):
    fit = make()
    drawn = np.random.default_rng(3).multivariate_normal(fit.z, fit.covariance, 2000)
    posterior = SimpleNamespace(fit=fit, draws={name: drawn[:, k] for k, name in enumerate(fit.free)})
    data = fit.data[0]
    by_draws, by_slopes = ce.simulate(posterior, data, band=True), ce.simulate(fit, data, band=True)
    assert (by_draws.draws, by_slopes.draws) == (200, 0)
    for name, band in by_draws.bands.items():
        other = by_slopes[name]
        np.testing.assert_allclose(band.stderr, other.stderr, rtol=0.25)
        np.testing.assert_allclose(band.value, other.value, atol=0.4 * other.stderr.max())
        assert np.mean(band.high - band.low) == pytest.approx(np.mean(other.high - other.low), rel=0.1)
        noisy = np.mean(band.high_noise - band.low_noise), np.mean(other.high_noise - other.low_noise)
        assert noisy[0] == pytest.approx(noisy[1], rel=0.1)
    assert "200 draws of the posterior" in str(by_draws)


def test_a_prediction_in_words():
    fit = fit_of(record(0))
    prediction = ce.simulate(fit, fit.data[0], band=True)
    text = str(prediction)
    assert text.startswith("Prediction of run_up with 95 % bands, from errors of the fit along exact slopes")
    assert text.endswith("Next: ce.plot(prediction)")
    assert prediction.simulated["omega"].origin == "derived"


def test_a_value_of_its_own_record_has_no_error_on_another():
    pars = ce.one_inertia().parameters()
    pars.vary_by_experiment("C_eng")
    fit = fit_of(record(0, "a"), record(1, "b"), parameters=pars)
    own = ce.simulate(fit, fit.data[0], band=True)
    assert own.messages == ()
    fresh = ce.simulate(fit, record(2, "fresh"), band=True)
    assert fresh.messages == (
        "the error of C_eng@fresh is not in the band: the fit has none for this record",
    )
    assert "Note: the error of C_eng@fresh" in str(fresh)


def test_errors_that_are_not_symmetric_are_said_of_the_band():
    pars = ce.one_inertia().parameters()
    fit = fit_of(record(0))
    pars["C_eng"].set(fit.values["C_eng"], max=fit.values["C_eng"] + 0.5 * fit.stderr["C_eng"])
    near = fit_of(record(0), parameters=pars)
    assert near.estimates["C_eng"].interval is not None
    (said,) = ce.simulate(near, near.data[0], band=True).messages
    assert said == "the errors of the fit are not symmetric, those of the band are taken to be"


# ---- what has no band


def test_a_band_asks_for_a_fit_with_errors(refused):
    data, model = record(0), ce.one_inertia()
    fit = fit_of(data)
    with refused(
        SimulationError, "a band needs the errors of a fit", seen="Model", cure="simulate(fit, data"
    ):
        ce.simulate(model, data, band=True)
    with refused(
        SimulationError, "about the parameters of the fit", seen="parameters=", cure="leave them out"
    ):
        ce.simulate(fit, data, parameters={"J_eng": 0.4}, band=True)
    for band in ("95", 2, None):
        with refused(
            SimulationError, "band is neither True nor False", seen=repr(band), cure="give band=True"
        ):
            ce.simulate(fit, data, band=band)
    lost = fit_of(data, max_iterations=1)
    with refused(SimulationError, "the fit has no errors", seen="not converged", cure="print(fit)"):
        ce.simulate(lost, data, band=True)
    predicted = fit_of(data, noise=ce.Noise(omega="innovations"))
    with refused(
        SimulationError, "process noise moves the simulation", seen="innovations", cure="leave band out"
    ):
        ce.simulate(predicted, data, band=True)
    prediction = ce.simulate(fit, data, band=True)
    with refused(
        SimulationError, "no band of this output", seen="'speed'", allowed="omega", cure="name an output"
    ):
        prediction["speed"]
    nothing = SimpleNamespace(fit=fit, draws={"sigma(omega)": np.ones(5)})
    with refused(SimulationError, "no draws of the model's parameters", seen="sigma(omega)", allowed="J_eng"):
        ce.simulate(nothing, data, band=True)


def test_undetermined_parameters_have_no_band(refused):
    """Two parameters of which the data tell the product."""
    b = ce.Blueprint("product")
    p, q = b.parameter("p", 1.0), b.parameter("q", 1.0)
    w = b.state("w")
    b.ode("w", p * q)
    b.output("y", w)
    time = np.linspace(0, 1, 50)
    data = ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=2 * time)
    fit = ce.estimate(b.model(), data, noise=ce.Noise(y=0.01), progress=False)
    with refused(SimulationError, "the fit has no errors", seen="do not determine"):
        ce.simulate(fit, data, band=True)


def test_unknown_errors_ask_for_the_posterior(refused):
    b = ce.Blueprint("bent")
    p = b.parameter("p", 0.1, min=-5, max=5)
    x, w = b.state("x"), b.state("w")
    b.ode("x", p**2)
    b.ode("w", p)
    b.output("y1", x)
    b.output("y2", w)
    time = np.linspace(0, 1, 50)
    data = ce.Experiment.from_arrays(
        "r", time=time, units={"y1": "1", "y2": "1"}, y1=0.01 * time, y2=0.1 * time
    )
    size = np.sqrt((time**2).sum())
    fit = ce.estimate(
        b.model(),
        data,
        noise=ce.Noise(y1=size / 3, y2=size / 2),
        initial={"x": 0.0, "w": 0.0},
        progress=False,
    )
    assert fit.doubted == ("p",)
    with refused(
        SimulationError, "the errors of the fit are not known", seen="doubted: p", cure="ce.posterior(fit)"
    ):
        ce.simulate(fit, data, band=True)
    drawn = SimpleNamespace(fit=fit, draws={"p": np.linspace(-0.5, 0.5, 11)})
    band = ce.simulate(drawn, data, band=True)["y1"]
    ends = np.quantile(np.linspace(-0.5, 0.5, 11) ** 2, [0.025, 0.975])
    assert (band.low[-1], band.high[-1]) == pytest.approx(ends)


def sparse(seed):
    """Eight samples of that record, and the speed without noise at all times."""
    whole = record(seed)
    speed = whole["omega"].values
    quiet = speed - SIGMA * np.random.default_rng(seed).standard_normal(len(speed))
    speed = np.where(np.arange(len(speed)) % 15 == 0, speed, np.nan)
    units = {"T": "N m", "omega": "rad/s"}
    time, torque = whole["T"].time, whole["T"].values
    return ce.Experiment.from_arrays("r", time=time, units=units, hold="zero", T=torque, omega=speed), quiet


def test_a_band_is_as_much_wider_as_estimated_noise_asks_for():
    """Few samples tell their own noise badly: the quantile is that of Student's distribution."""
    few, _ = sparse(3)
    for noise, quantile in (
        (ce.Noise(omega=SIGMA), 1.95996),
        (None, 2.57058),
    ):  # the latter of 5 degrees of freedom
        fit = fit_of(few, noise=noise, errors="quadratic")
        band = ce.simulate(fit, few, band=True)["omega"]
        assert fit.dof == 5
        assert (band.high - band.value) / band.stderr == pytest.approx(quantile, rel=1e-4)
        wide = np.hypot(band.stderr, band.sigma)
        assert (band.high_noise - band.value) / wide == pytest.approx(quantile, rel=1e-4)


@pytest.mark.slow
def test_a_band_of_few_samples_holds_what_it_says():
    held = []
    for seed in range(300):
        data, quiet = sparse(seed)
        band = ce.simulate(fit_of(data, noise=None, errors="quadratic"), data, band=True)["omega"]
        quiet = quiet[: len(band.value)]  # up to the last sample
        held.append(np.mean((band.low <= quiet) & (quiet <= band.high)))
    assert np.mean(held) == pytest.approx(0.95, abs=0.03)


def growing():
    b = ce.Blueprint("growth")
    r, most = b.parameter("r", 0.5, unit="1/s", min=0.01, max=10), b.parameter("K", 5.0, min=0.1, max=200)
    x = b.state("x")
    b.ode("x", r * x * (1 - x / most))
    b.output("x", x)
    return b.model()


def grown(time, *, until, seed=0):
    """The closed form of logistic growth with noise, and times without a value after ``until``."""
    values = 1.8 / (0.3 + 5.7 * np.exp(-0.6 * time)) + 0.15 * np.random.default_rng(seed).standard_normal(
        len(time)
    )
    return ce.Experiment.from_arrays(
        "r", time=time, units={"x": "1"}, x=np.where(time <= until, values, np.nan)
    )


def test_a_fitted_record_goes_on_at_times_without_values():
    """Rows of the measurement with more times behind them, and the times alone, tell the same start and end."""
    model, known = growing(), {"noise": ce.Noise(x=0.15), "progress": False}
    fit = ce.estimate(model, grown(np.linspace(0, 10, 12), until=10), **known)
    longer = np.append(np.linspace(0, 10, 12), np.linspace(11, 16, 6))
    part = ce.simulate(fit, grown(longer, until=10), band=True)["x"]
    alone = ce.simulate(fit, grown(longer, until=-1), band=True)["x"]
    np.testing.assert_array_equal(part.time, longer)
    np.testing.assert_allclose(alone.value, part.value, rtol=1e-6)
    np.testing.assert_allclose(alone.stderr, part.stderr, rtol=1e-3)
    assert alone.stderr[0] == pytest.approx(fit.initial["r"]["x"].stderr, rel=0.05)


def test_such_bands_cover_the_course():
    """40 fits: 95 % of the closed form at the start, in the bend and at the end."""
    model, inside, times = growing(), [], np.linspace(0, 16, 9)
    for seed in range(40):
        fit = ce.estimate(model, grown(np.linspace(0, 10, 12), until=10, seed=seed), noise=ce.Noise(x=0.15),
                          progress=False, errors="quadratic")  # fmt: skip
        band = ce.simulate(fit, grown(times, until=-1), band=True)["x"]
        true = 1.8 / (0.3 + 5.7 * np.exp(-0.6 * times))
        inside.append((band.low <= true) & (true <= band.high))
    assert (np.sum(inside, axis=0) >= 33).all()


def test_a_band_without_slopes_is_refused():
    b = ce.Blueprint("outflow")
    k, x = b.parameter("k", 1.0, min=0.1, max=10), b.state("x")
    b.ode("x", -k * casadi.sqrt(x))
    b.output("x", x)
    time = np.linspace(0, 1.2, 25)
    seen = (1 - time / 2) ** 2 + 0.01 * np.random.default_rng(0).standard_normal(25)
    record = ce.Experiment.from_arrays("r", time=time, units={"x": "1"}, x=seen)
    fit = ce.estimate(b.model(), record, noise=ce.Noise(x=0.01), initial={"x": 1.0}, progress=False)
    late = ce.Experiment.from_arrays(
        "late", time=np.linspace(0, 4, 9), units={"x": "1"}, x=np.full(9, np.nan)
    )
    with pytest.raises(SimulationError, match=r"no slopes along the simulation|not finite"):
        ce.simulate(fit, late, initial={"x": 1.0}, band=True)


@pytest.mark.parametrize("kind", ["outliers", "louder"])
def test_the_start_of_a_fresh_record_is_fitted_as_the_fit_was(kind):
    """By its loss, and with the error that its own noise asks for: a band of least squares beside outliers, or with
    the level of the fit beside five times that noise, held the truth in two thirds."""
    fit, inside = fit_of(record(0), loss="huber" if kind == "outliers" else "square"), []
    for seed in range(20):
        plain, random = record(100 + seed, "fresh", n=60, start=1.0), np.random.default_rng(seed)
        speed = np.array(plain["omega"].values)
        if kind == "outliers":
            speed[random.choice(np.arange(20), 3, replace=False)] += 15 * SIGMA
        else:
            speed += 5 * SIGMA * random.standard_normal(60)
        units = {"T": "N m", "omega": "rad/s"}
        fresh = ce.Experiment.from_arrays(
            "fresh", time=plain["T"].time, units=units, hold="zero", T=plain["T"].values, omega=speed
        )
        band = ce.simulate(fit, fresh, band=True)["omega"]
        inside.append(band.low[0] <= 1.0 <= band.high[0])
    assert 17 <= sum(inside) <= 20


def polymer():
    """Radicals of which there are none at first: 50/s fast once they are there."""
    b = ce.Blueprint("polymer")
    kd = b.parameter("kd", 2.5e-4, unit="1/s", min=2.5e-7, max=0.25)
    kp = b.parameter("kp", 800.0, unit="L/(mol s)", min=0.8, max=8e5)
    kt = b.parameter("kt", 6e7, unit="L/(mol s)", min=6e4, max=6e10)
    i, m, r = (
        b.state("I", unit="mol/L", scale=0.01),
        b.state("M", unit="mol/L"),
        b.state("R", unit="mol/L", scale=1e-8),
    )
    b.ode("I", -kd * i)
    b.ode("M", -kp * m * r)
    b.ode("R", 1.2 * kd * i - 2 * kt * r**2)
    b.output("M_out", m, unit="mol/L")
    b.output("R_esr", 1e9 * r, unit="nmol/L")
    return b.model()


def batch(name, seed, until):
    def rates(t, x):
        return [-3e-4 * x[0], -900 * x[1] * x[2] * 1e-8, (3.6e-4 * x[0] - 1.4e8 * (x[2] * 1e-8) ** 2) * 1e8]

    t, rng = np.r_[0.0, 1.0, 3.0, np.arange(10, until, 120.0)], np.random.default_rng(seed)
    y = solve_ivp(rates, (0, t[-1]), [0.02, 5.0, 0.0], method="LSODA", t_eval=t, rtol=1e-9, atol=1e-12).y
    values = {
        "M_out": y[1] + 0.02 * rng.standard_normal(len(t)),
        "R_esr": 10 * y[2] + 6 * rng.standard_normal(len(t)),
    }
    return y, ce.Experiment.from_arrays(name, time=t, units={"M_out": "mol/L", "R_esr": "nmol/L"}, **values)


def test_what_becomes_stiff_after_its_start_is_fitted_and_has_a_band():
    """ "The model cannot be evaluated at the start values", where a simulation had no trouble, and no band."""
    begin = {"I": 0.02, "M": 5.0, "R": 0.0}
    _, data = batch("batch", 1, 3600)
    fit = ce.estimate(polymer(), data, initial=begin, noise=ce.Noise(M_out=0.02, R_esr=6.0), progress=False)
    assert fit.converged
    for true, error, name in ((3e-4, 1e-4, "kd"), (900.0, 100.0, "kp"), (7e7, 3e7, "kt")):
        assert abs(fit.values[name] - true) < 4 * fit.stderr[name] < error
    again, fresh = batch("another", 2, 3000)
    for record, true in ((data, batch("batch", 1, 3600)[0]), (fresh, again)):
        band = ce.simulate(fit, record, initial=begin, band=True).bands["M_out"]
        inside = (band.low - 1e-3 <= true[1]) & (true[1] <= band.high + 1e-3)
        assert inside.mean() > 0.5
        assert 0 < np.median(band.high - band.low) < 0.1
