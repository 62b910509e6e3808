"""What a fit reports is what it found: scales from the data, bounds in standard errors, a last look at the optimum."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.answer_notes import of_the_integration
from casadi_engine.estimation.ipopt import Solver
from casadi_engine.estimation.standard_errors import _acts
from casadi_engine.estimation.summary import _said

INF = np.inf
STEP, COUNT = 0.01, 1000
TIME = STEP * np.arange(COUNT)
SQUARE = np.sign(np.sin(2 * TIME))


def lag(a=(1.0, -INF, INF), b=(0.0, -INF, INF)):
    """dx/dt = -a x + b u, each parameter as (start, min, max)."""
    p = ce.Blueprint("lag")
    pole = p.parameter("a", a[0], min=a[1], max=a[2])
    gain = p.parameter("b", b[0], min=b[1], max=b[2])
    x, u = p.state("x"), p.input("u")
    p.ode("x", -pole * x + gain * u)
    p.output("y", x)
    return p.model()


def response(a, b, start=0.0, u=SQUARE):
    """Its exact recursion for a held input."""
    decay = np.exp(-a * STEP)
    x = np.empty(len(u))
    x[0] = start
    for k in range(len(u) - 1):
        x[k + 1] = decay * x[k] + (1 - decay) / a * b * u[k]
    return x


def record(y, sigma=0.0, u=SQUARE, seed=0):
    noise = sigma * np.random.default_rng(seed).standard_normal(len(y))
    units = {"u": "1", "y": "1"}
    time = STEP * np.arange(len(y))
    return ce.Experiment.from_arrays("run", time=time, units=units, hold="zero", u=u, y=y + noise)


def right(fit, **truth):
    """Converged, as good as the noise, and every truth within three standard errors."""
    assert fit.converged, fit.status
    assert fit.cost / fit.n == pytest.approx(1, abs=0.2)
    for name, value in truth.items():
        assert abs(fit.values[name] - value) < 3 * fit.stderr[name], name
    if fit.options["loss"] != "square":
        return
    trace = fit.traces["run"]["y"]
    sigma = fit.noise["y"][0]
    shown = np.sum(((trace.measured - trace.simulated)[trace.mask] / sigma) ** 2)
    assert shown == pytest.approx(fit.cost, rel=1e-6, abs=1e-3)


# ---- scales


@pytest.mark.parametrize("most", [1e1, 1e5, 1e9, INF])
def test_a_weak_damper_from_0_beside_a_bound(most):
    """The report that began it: 0.0015 within [0, 1e5] from 0 came out as 0, with a fit of -101 %."""
    p = ce.Blueprint("oscillator")
    c, k = p.parameter("c", 0.0, min=0, max=most), p.parameter("k", 4.0, min=1e-3)
    q, v = p.state("q"), p.state("v")
    p.ode("q", v)
    p.ode("v", -k * q - c * v)
    p.output("y", q)
    time, omega = 0.05 * np.arange(2000), np.sqrt(4 - 0.0015**2 / 4)
    y = np.exp(-0.00075 * time) * (np.cos(omega * time) + 0.00075 / omega * np.sin(omega * time))
    y += 1e-3 * np.random.default_rng(0).standard_normal(len(time))
    data = ce.Experiment.from_arrays("run", time=time, units={"y": "1"}, y=y)
    fit = ce.estimate(p.model(), data, noise=ce.Noise(y=1e-3), progress=False)
    right(fit, c=0.0015, k=4.0)
    assert fit.fit_percent["run"]["y"]["simulation"] > 99.8


def test_a_bound_that_does_not_act_has_no_say():
    data = record(response(1.5, 0.002), 1e-5)
    fits = [
        ce.estimate(lag(b=(0.0, 0, most)), data, noise=ce.Noise(y=1e-5), progress=False)
        for most in (1e1, 1e9)
    ]
    np.testing.assert_allclose(fits[0].z, fits[1].z, rtol=1e-9)
    np.testing.assert_allclose(fits[0].covariance, fits[1].covariance, rtol=1e-6)
    assert fits[0].iterations == fits[1].iterations


CASES = {
    "0, truth 1e6": ({"b": (0.0, -INF, INF)}, 1e6),
    "0, truth 1e-9": ({"b": (0.0, -INF, INF)}, 1e-9),
    "1e-12 above a bound, truth 1e3": ({"b": (1e-12, 1e-13, INF)}, 1e3),
    "1e-12, truth 1e3": ({"b": (1e-12, -INF, INF)}, 1e3),
    "1, truth 1e6": ({"b": (1.0, -INF, INF)}, 1e6),
    "1, truth 1e-9": ({"b": (1.0, -INF, INF)}, 1e-9),
    "twelve decades": ({"b": (1e6, 0, INF)}, 1e-6),
    "negative range": ({"b": (-1.0, -1e6, -1e-6)}, -0.003),
    "on the lower bound": ({"b": (0.0, 0, INF)}, 2.0),
    "on the upper bound": ({"b": (1e4, 0, 1e4)}, 2.0),
    "both from 0": ({"a": (0.0, 0, 1e9), "b": (0.0, 0, 1e9)}, 2.0),
    "just above a bound": ({"b": (3.0, 1.0, 1e6)}, 1.02),
    "state of 1e8": ({"b": (1e8, 0, INF)}, 2e8),
    "state of 1e-9": ({"b": (1e-9, 0, INF)}, 2e-9),
}


@pytest.mark.parametrize(("settings", "truth"), CASES.values(), ids=CASES)
def test_a_start_far_from_the_truth_arrives(settings, truth):
    sigma = 2e-3 * abs(truth)
    data = record(response(1.5, truth), sigma)
    fit = ce.estimate(lag(**settings), data, noise=ce.Noise(y=sigma), progress=False)
    right(fit, a=1.5, b=truth)


@pytest.mark.parametrize(
    "options", [{"loss": "huber"}, {"noise": ce.Noise()}, {"initial": {"x": (0.0, 1e6)}}]
)
def test_options_keep_what_a_start_of_0_needs(options):
    data = record(response(1.5, 0.002, start=1e-4), 1e-6)
    fit = ce.estimate(lag(b=(0.0, 0, 1e9)), data, **{"noise": ce.Noise(y=1e-6), **options}, progress=False)
    right(fit, a=1.5, b=0.002)


def test_ties_priors_and_constraints_from_0():
    data, noise = record(response(1.5, 0.002), 1e-5), ce.Noise(y=1e-5)
    tied = lag().parameters()
    tied.add("k", 0.0, min=0, max=1e8)
    tied.tie("b", "k*1e-6 - 0.001")  # through zero
    weak = lag(b=(0.0, 0, 1e6)).parameters()
    weak["b"].prior = (0.0, 1e3)
    held = lag(b=(0.0, -INF, 1e7)).parameters()
    held.constrain("a*b", 0, 1e6)
    for pars in (tied, weak, held):
        right(ce.estimate(lag(), data, parameters=pars, noise=noise, progress=False), a=1.5, b=0.002)


@pytest.mark.parametrize("size", [1e-6, 1e6])
def test_a_nonlinear_model_in_small_and_large_units(size):
    """Duffing's equation, damping and cubic stiffness from 0, against SciPy."""
    p = ce.Blueprint("duffing")
    c, k3 = p.parameter("c", 0.0, min=0, max=1e6), p.parameter("k3", 0.0, min=0)
    q, v = p.state("q"), p.state("v")
    p.ode("q", v)
    p.ode("v", -4 * q - c * v - k3 * q**3)
    p.output("y", q)
    time = 0.05 * np.arange(400)
    solved = solve_ivp(
        lambda t, x: [x[1], -4 * x[0] - 0.05 * x[1] - 1.5 * x[0] ** 3 / size**2], (0, 20), [size, 0],
        t_eval=time, rtol=1e-11, atol=1e-13 * size, method="DOP853",
    )  # fmt: skip
    y = solved.y[0] + 0.01 * size * np.random.default_rng(1).standard_normal(len(time))
    data = ce.Experiment.from_arrays("run", time=time, units={"y": "1"}, y=y)
    right(ce.estimate(p.model(), data, progress=False), c=0.05, k3=1.5 / size**2)


# ---- bounds


def test_the_truth_on_a_bound_is_reported_on_it():
    """Without the bound the estimate is negative; with it, it rests on 0 whatever the other bound."""
    data = record(response(1.5, 0.0, start=1.0), 1e-3, seed=2)
    free = ce.estimate(lag(b=(0.5, -INF, INF)), data, noise=ce.Noise(y=1e-3), progress=False)
    assert free.values["b"] < 0
    for most in (1.0, 1e5):
        fit = ce.estimate(lag(b=(0.5, 0, most)), data, noise=ce.Noise(y=1e-3), progress=False)
        assert fit.converged
        assert fit.values["b"] == 0.0
        assert fit.estimates["b"].at_bound == "min"
        assert abs(fit.values["a"] - 1.5) < 3 * fit.stderr["a"]


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_a_bound_acts_in_standard_errors_alone(scale):
    """The same distances and forces in other units say the same."""
    variance = (0.5 * scale) ** 2
    assert _acts(1e-6 * scale, 1.0 / scale, variance)  # held: it would go 0.25 beyond
    assert not _acts(0.1 * scale, 10.0 / scale, variance)  # a fifth of a standard error away
    assert not _acts(1e-3 * scale, 1e-3 / scale, variance)  # near, but it would not go beyond
    assert _acts(0.0, 0.0, variance)
    assert not _acts(0.0, -1.0 / scale, variance)


# ---- the last look


def pendulum():
    """Upside down: what is not exactly at the top falls off within seconds, faster than rounding allows."""
    p = ce.Blueprint("pendulum")
    k = p.parameter("k", 400.0, min=1)
    q, v = p.state("q"), p.state("v")
    u = p.input("u")
    p.ode("q", v)
    p.ode("v", k * q + u)
    p.output("y", q)
    return p.model()


def test_intervals_that_no_start_leads_along_are_judged_by_the_trajectory_near_them():
    """Growth of e^60 over the record: intervals join to 1e-15, the simulation from the start, in all its digits, misses
    by far more than the noise, and was taken for the fit: it had "not converged"."""
    time = STEP * np.arange(300)
    y = 0.01 * np.sin(3 * time) + 1e-4 * np.random.default_rng(0).standard_normal(300)
    u = (-9 - 410.0) * 0.01 * np.sin(3 * time)
    data = ce.Experiment.from_arrays("run", time=time, units={"u": "1", "y": "1"}, u=u, y=y)
    fit = ce.estimate(pendulum(), data, noise=ce.Noise(y=1e-4), progress=False)
    assert fit.converged
    trace = fit.traces["run"]["y"]
    assert fit.cost == pytest.approx(np.sum(((trace.measured - trace.simulated) / 1e-4) ** 2))
    assert 0.8 < fit.cost / fit.n < 1.2
    assert abs(fit.values["k"] - 410) < 3 * fit.estimates["k"].stderr
    assert fit.estimates["k"].stderr < 1
    assert any("a change of the start of run grows 2e+25 times" in words for words in fit.messages)


def test_a_point_that_is_not_stationary_is_no_optimum(monkeypatch):
    """The solver's word alone is not enough: it is told to accept anything."""
    solve = Solver.solve

    def hasty(self, start, lower, upper, *, exact=False):
        found = solve(self, start, lower, upper, exact=exact)
        x = found.x.copy()
        x[1] *= 1.001  # 0.001 of b, a third of its standard error
        return type(found)(x, found.lam_g, found.lam_x, found.status, found.iterations, found.words)

    data = record(response(1.5, 2.0), 1e-2)
    monkeypatch.setattr(Solver, "solve", hasty)
    fit = ce.estimate(lag(b=(1.0, 0, 10)), data, noise=ce.Noise(y=1e-2), interval="single", progress=False)
    assert not fit.converged
    assert "one more step would still lower chi-squared by" in fit.status
    assert any("go on from here (warm=fit)" in message for message in fit.messages)
    assert fit.stderr["b"] is None
    assert [optimum.status for optimum in fit.optima] == [fit.status]


def test_open_joints_are_no_optimum(monkeypatch):
    """Nodes moved a little: the cost found is not that of the simulation."""
    solve = Solver.solve

    def open_joints(self, start, lower, upper, *, exact=False):
        found = solve(self, start, lower, upper, exact=exact)
        x = found.x.copy()
        x[4::7] += 1e-2
        return type(found)(x, found.lam_g, found.lam_x, found.status, found.iterations, found.words)

    data = record(response(1.5, 2.0), 1e-2)
    monkeypatch.setattr(Solver, "solve", open_joints)
    fit = ce.estimate(lag(b=(1.0, 0, 10)), data, noise=ce.Noise(y=1e-2), progress=False)
    assert not fit.converged
    assert "the simulation from the printed values has chi-squared" in fit.status
    assert any("take a shorter record" in message for message in fit.messages)


def test_what_the_solver_gives_up_is_an_optimum_if_it_is_one():
    """One iteration short of its own test, yet stationary: the answer is that of the unhurried search."""
    data = record(response(1.5, 2.0), 1e-2)
    whole = ce.estimate(lag(b=(1.9, 0, 10)), data, noise=ce.Noise(y=1e-2), progress=False)
    stopped = [
        ce.estimate(lag(b=(1.9, 0, 10)), data, noise=ce.Noise(y=1e-2), max_iterations=most, progress=False)
        for most in range(1, 8)
    ]
    assert not stopped[0].converged
    for fit in stopped:
        near = np.abs(fit.z - whole.z).max() < 1e-2 * min(whole.stderr.values())
        assert near or not fit.converged


# ---- little data, and data without noise


@pytest.mark.parametrize("count", [3, 4, 10, 200])
def test_data_without_noise(count):
    """The truth to many digits; with known noise the errors are those of linear least squares (by differences)."""
    data = record(response(1.5, 2.0, start=0.3, u=np.ones(count)), u=np.ones(count))
    fit = ce.estimate(lag(), data, noise=ce.Noise(y=0.01), errors="quadratic", progress=False)
    assert fit.converged
    np.testing.assert_allclose(fit.z, [1.5, 2.0], rtol=1e-5)
    assert not fit.messages
    point = np.array([1.5, 2.0, 0.3])
    steps = [
        (response(*(point + d), u=np.ones(count)) - response(*(point - d), u=np.ones(count))) / 2e-5
        for d in 1e-5 * np.eye(3)
    ]
    covariance = 1e-4 * np.linalg.inv(np.array(steps) @ np.array(steps).T)
    np.testing.assert_allclose(
        [fit.stderr["a"], fit.stderr["b"]], np.sqrt(np.diag(covariance)[:2]), rtol=1e-2
    )


def test_data_without_noise_have_no_tighter_errors_by_a_robust_loss():
    data = record(response(1.5, 2.0, start=0.3))
    fits = [
        ce.estimate(lag(), data, noise=ce.Noise(y=0.01), loss=loss, progress=False)
        for loss in ("square", "huber")
    ]
    np.testing.assert_allclose(fits[1].covariance, fits[0].covariance, rtol=1e-3)


@pytest.mark.parametrize("count", [2, 3])
def test_fewer_samples_than_unknowns(count, refused):
    data = record(response(1.5, 2.0, start=0.3, u=np.ones(count)), u=np.ones(count))
    with refused(
        EstimationError,
        "too few samples to estimate the parameters and the noise level",
        seen=f"{count} that count, for 3 unknown",
        allowed="a known noise level",
        cure="take a longer record",
    ):
        ce.estimate(lag(), data, progress=False)
    fit = ce.estimate(lag(), data, noise=ce.Noise(y=0.01), progress=False)
    assert fit.dof == 0
    assert bool(fit.undetermined) == (count == 2)


@pytest.mark.parametrize("noise", [None, ce.Noise(y=0.01)], ids=["estimated", "known"])
def test_an_output_of_zeros_determines_the_gain_alone(noise):
    fit = ce.estimate(lag(), record(np.zeros(200), u=np.ones(200)), noise=noise, progress=False)
    assert fit.converged
    assert fit.values["b"] == pytest.approx(0.0, abs=1e-9)
    assert fit.stderr["a"] is None
    assert fit.estimates["a"].why == "the data do not determine it"
    assert [direction.text for direction in fit.undetermined] == ["a"]
    assert not any("not white" in message for message in fit.messages)


def test_a_constant_output_determines_the_quotient():
    fit = ce.estimate(lag(), record(np.full(200, 3.0), u=np.ones(200)), progress=False)
    assert fit.converged
    assert fit.values["b"] / fit.values["a"] == pytest.approx(3.0, rel=1e-6)
    assert fit.stderr["a"] is None
    assert fit.stderr["b"] is None
    assert len(fit.undetermined) == 1


# ---- words


def test_advice_names_only_what_the_model_has():
    """A model without inputs is not told to excite it, nor to give the inputs at a higher rate."""
    p = ce.Blueprint("decay")
    a, b = p.parameter("a", 1.0, min=0), p.parameter("b", 1.0, min=0)
    x = p.state("x")
    p.ode("x", -(a + b) * x)
    p.output("y", x)
    data = ce.Experiment.from_arrays("run", time=TIME, units={"y": "1"}, y=np.exp(-TIME))
    fit = ce.estimate(p.model(), data, noise=ce.Noise(y=0.01), progress=False)
    said = " ".join(fit.messages) + str(fit)
    assert "add a record with another start" in said
    assert "excite" not in said
    assert "input" not in said


def test_the_initial_state_of_a_fit_is_taken_as_it_is():
    data = record(response(1.5, 2.0, start=0.7), 1e-2)
    fit = ce.estimate(lag(), data, noise=ce.Noise(y=1e-2), progress=False)
    for initial in (fit.initial, fit.initial["run"]):
        again = ce.estimate(lag(), data, noise=ce.Noise(y=1e-2), initial=initial, progress=False)
        assert again.initial["run"]["x"].value == fit.initial["run"]["x"].value
        assert again.initial["run"]["x"].fixed
        np.testing.assert_allclose(again.z, fit.z, rtol=1e-6)


@pytest.mark.parametrize(
    ("shift", "misfit", "told"),
    [(0.05, 1.0, False), (0.25, 1.0, True), (float("inf"), 1.0, True), (0.25, 100.0, False)],
)
def test_a_coarse_integration_is_told_by_what_it_does_to_the_estimates(shift, misfit, told):
    """Beside a residual that is ten times the stated level steps may be longer: it was said that they cannot be
    shorter, as the equations were too sharp."""
    found = SimpleNamespace(shift=shift, substeps=64)
    messages = of_the_integration({"run": found}, misfit)
    assert len(messages) == told
    for message in messages:
        assert message == (
            f"the integration of run moves the estimates by up to {shift:.2g} standard errors, and shorter steps were "
            "not reached: the equations change too sharply; make them smoother"
        )
        assert "input" not in message  # a model need not have any


def test_several_records_and_starts_from_0():
    data = [record(response(1.5, gain), 1e-5, seed=seed) for seed, gain in enumerate((0.002, -0.004))]
    pars = lag(b=(0.0, -1e6, 1e6)).parameters()
    pars.vary_by_experiment("b")
    fit = ce.estimate(lag(), data, parameters=pars, noise=ce.Noise(y=1e-5), starts=4, progress=False)
    assert fit.converged
    for name, gain in zip([name for name in fit.free if name != "a"], (0.002, -0.004), strict=True):
        assert abs(fit.values[name] - gain) < 3 * fit.stderr[name]
    assert fit.optima[0].starts == 4


def test_a_warm_start_that_knows_more_than_0():
    data = record(response(1.5, 0.002), 1e-5)
    first = ce.estimate(lag(b=(0.0, 0, 1e9)), data, noise=ce.Noise(y=1e-5), progress=False)
    again = ce.estimate(lag(b=(0.0, 0, 1e9)), data, noise=ce.Noise(y=1e-5), warm=first, progress=False)
    assert again.converged
    np.testing.assert_allclose(again.z, first.z, rtol=1e-6)


@pytest.mark.parametrize("law", ["square", "product"])
def test_a_start_on_a_saddle_is_no_optimum(law):
    """p**2 from 0, and p*q from 0, 0: no slope, no answer, and the message says why; from 1 the truth comes out."""

    def model(start):
        b = ce.Blueprint(law)
        p = b.parameter("p", start)
        q = b.parameter("q", start) if law == "product" else p
        x, u = b.state("x"), b.input("u")
        b.ode("x", -1.5 * x + p * q * u)
        b.output("y", x)
        return b.model()

    data = record(response(1.5, 2.0), 1e-2)
    stuck = ce.estimate(model(0.0), data, noise=ce.Noise(y=1e-2), max_iterations=30, progress=False)
    assert not stuck.converged
    assert "the data have no slope in" in stuck.status
    assert any(
        "start elsewhere, not where the outputs do not depend on it" in said for said in stuck.messages
    )
    fit = ce.estimate(model(1.0), data, noise=ce.Noise(y=1e-2), progress=False)
    assert fit.converged
    assert fit.values["p"] * fit.values.get("q", fit.values["p"]) == pytest.approx(2.0, abs=0.01)
    assert bool(fit.undetermined) == (law == "product")


def test_notes_are_printed_whole():
    """One ended in "may still be too small, as the residual", and the next line was another one."""
    words = "a word of eleven " * 60
    fit = SimpleNamespace(messages=("short", words, "third"))
    assert _said(fit, 4) == ["Note: short", "Note: 2 more in fit.messages"]
    assert _said(SimpleNamespace(messages=("one", "two")), 4) == ["Note: one", "Note: two"]
    cut = _said(SimpleNamespace(messages=(words,)), 3)
    assert len(cut) == 3
    assert cut[-1].endswith(" …")
    assert all(len(line) <= 100 for line in cut)
