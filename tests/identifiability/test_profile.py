"""Profile likelihoods against exact parabolas, t-intervals, and brute force over closed forms."""

import math
from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import chi2
from scipy.stats import t as student

import casadi_engine as ce
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.fit import Optimum
from casadi_engine.identifiability import profile
from casadi_engine.identifiability.practical_summary import shape

module = import_module("casadi_engine.identifiability.profile")
Interval, LOST = module.Interval, module.LOST


def linear_model():
    """y = a + b t: the cost is a parabola."""
    b = ce.Blueprint("line")
    slope = b.parameter("b", 1.0, min=-100, max=100)
    x, u = b.state("x"), b.input("u")
    b.ode("x", slope + 0 * u)
    b.output("y", x)
    return b.model()


def line_data(n=12, sigma=0.3, seed=2):
    time = np.linspace(0, 3, n)
    y = 0.5 + 2 * time + sigma * np.random.default_rng(seed).standard_normal(n)
    return time, y, ce.Experiment.from_arrays("line", time=time, units={"u": "1", "y": "1"}, u=0 * time, y=y)


@pytest.mark.parametrize(
    ("moved", "higher", "ends"),
    [(9.0, 2.0, (True, False)), (-9.0, 2.0, (False, True)), (9.0, 5.0, (True, True))],
)
def test_no_interval_ends_before_another_optimum_that_the_data_hardly_tell(moved, higher, ends):
    """Glucose in 24 samples: p1 up to 0.030, of a fit whose starts had found 0.0311 for 3.1 of chi-squared."""
    _, _, data = line_data()
    fit = ce.estimate(linear_model(), data, noise=ce.Noise(y=0.3), progress=False)
    place = fit.values["b"] + moved * fit.stderr["b"]
    other = Optimum(fit.cost + higher, {**fit.values, "b": place}, 1, "converged", apart="b +1 %")
    line = profile(replace(fit, optima=(*fit.optima, other)), "b", points=3)["b"]
    assert (line.interval.low is not None, line.interval.high is not None) == ends
    assert line.interval.lost is not all(ends)
    if not all(ends):
        why = f"{line.interval.low_why or ''}{line.interval.high_why or ''}"
        assert why.startswith(
            f"another optimum lies beyond, at {place:.6g}, with a chi-squared that is 2 higher"
        )
        assert shape(line) == "not known: there is another optimum"


@pytest.mark.parametrize("level", [0.68, 0.95])
def test_a_parabola_is_met_exactly(level):
    _, _, data = line_data()
    fit = ce.estimate(linear_model(), data, noise=ce.Noise(y=0.3), progress=False)
    line = profile(fit, "b", points=3, level=level)["b"]
    half = math.sqrt(chi2.ppf(level, 1)) * fit.stderr["b"]
    assert line.interval.low == pytest.approx(fit.values["b"] - half, rel=1e-6)
    assert line.interval.high == pytest.approx(fit.values["b"] + half, rel=1e-6)
    np.testing.assert_allclose(line.rise, line.quadratic(line.values), atol=1e-6)


def test_with_estimated_noise_it_is_students_interval():
    time, y, data = line_data(n=8)
    fit = ce.estimate(linear_model(), data, progress=False)
    low, high = profile(fit, "b", points=3).intervals["b"]
    design = np.stack([time, np.ones_like(time)], axis=1)
    (slope, _), rest, *_ = np.linalg.lstsq(design, y, rcond=None)
    error = math.sqrt(rest[0] / 6 * np.linalg.inv(design.T @ design)[0, 0])
    half = student.ppf(0.975, 6) * error
    assert (low, high) == pytest.approx((slope - half, slope + half), rel=1e-5)


def run_up(n=25, sigma=0.6, seed=4):
    """Few noisy samples of a run-up from rest, so that profiles are no parabolas."""
    time = 0.08 * np.arange(n)
    y = 4 * (1 - np.exp(-time / 0.8)) + sigma * np.random.default_rng(seed).standard_normal(n)
    units = {"T": "N m", "omega": "rad/s"}
    data = ce.Experiment.from_arrays(
        "run_up", time=time, units=units, hold="zero", T=np.full(n, 2.0), omega=y
    )
    return time, y, data


def test_a_bent_profile_agrees_with_brute_force():
    time, y, data = run_up()
    model = ce.one_inertia()
    pars = model.parameters()
    pars["J_eng"].set(0.4, min=0.01, max=40)
    pars["C_eng"].set(0.5, min=1e-4, max=50)
    fit = ce.estimate(
        model, data, parameters=pars, noise=ce.Noise(omega=0.6), initial={"omega_eng": 0.0}, progress=False
    )

    def cost(inertia, damping):
        return float(np.sum((y - 2 / damping * (1 - np.exp(-damping / inertia * time))) ** 2) / 0.36)

    def lowest(inertia):
        best = minimize_scalar(
            lambda log: cost(inertia, math.exp(log)),
            bounds=(-3, 2),
            method="bounded",
            options={"xatol": 1e-10},
        )
        return best.fun

    found = profile(fit, "J_eng", points=8)["J_eng"]
    base, threshold = lowest(fit.values["J_eng"]), chi2.ppf(0.95, 1)
    ends = [
        brentq(lambda j: lowest(j) - base - threshold, *bracket)
        for bracket in ((0.05, fit.values["J_eng"]), (fit.values["J_eng"], 8.0))
    ]
    assert found.interval.low == pytest.approx(ends[0], rel=2e-3)
    assert found.interval.high == pytest.approx(ends[1], rel=2e-3)
    np.testing.assert_allclose(found.rise, [lowest(v) - base for v in found.values], atol=1e-4)
    skew = (found.interval.high - fit.values["J_eng"]) / (fit.values["J_eng"] - found.interval.low)
    assert skew > 1.2
    assert "times the other" in str(profile(fit, "J_eng", points=4))
    assert set(found.others) == {"C_eng"}


def test_a_bound_ends_a_side():
    _, _, data = run_up()
    pars = ce.one_inertia().parameters()
    pars["J_eng"].set(0.4, min=0.01, max=40)
    pars["C_eng"].set(0.5, min=0.38, max=50)
    fit = ce.estimate(
        ce.one_inertia(),
        data,
        parameters=pars,
        noise=ce.Noise(omega=0.6),
        initial={"omega_eng": 0.0},
        progress=False,
    )
    line = profile(fit, "C_eng", points=3)["C_eng"]
    assert line.interval.low is None
    assert line.interval.low_why == "at its bound"
    assert line.values[0] == pytest.approx(0.38)
    assert "C_eng, below: at its bound" in str(profile(fit, "C_eng", points=3))


def test_a_parameter_that_the_data_do_not_tell_has_an_open_profile():
    """Only a*b shows; the profile of a is flat down to its bounds."""
    b = ce.Blueprint("product")
    a, c = b.parameter("a", 1.0, min=0.2, max=5), b.parameter("c", 2.0, min=1e-3, max=1e3)
    x, u = b.state("x"), b.input("u")
    b.ode("x", a * c * u)
    b.output("y", x)
    time = np.linspace(0, 1, 30)
    y = 2 * time + 0.1 * np.random.default_rng(0).standard_normal(30)
    data = ce.Experiment.from_arrays("run", time=time, units={"u": "1", "y": "1"}, u=np.ones(30), y=y)
    fit = ce.estimate(b.model(), data, noise=ce.Noise(y=0.1), progress=False)
    line = profile(fit, "a", points=3)["a"]
    assert line.interval.low is None
    assert line.interval.high is None
    assert np.ptp(line.rise) < 1e-5
    assert "flat: not identifiable in practice" in str(profile(fit, "a", points=3))


def test_ties_and_progress():
    _, _, data = run_up(sigma=0.2)
    pars = ce.one_inertia().parameters()
    pars["J_eng"].set(0.4, min=0.01, max=40)
    pars.tie("C_eng", "1.25*J_eng")
    fit = ce.estimate(ce.one_inertia(), data, parameters=pars, noise=ce.Noise(omega=0.2), progress=False)
    seen = []
    found = profile(fit, points=2, progress=lambda name, count: seen.append((name, count)))
    assert list(found.lines) == ["J_eng"]
    assert seen[-1] == ("J_eng", found.refits)
    low, high = found.intervals["J_eng"]
    assert low < fit.values["J_eng"] < high
    assert profile(fit, points=2, progress=False).intervals == found.intervals
    with pytest.raises(
        EstimationError, match="progress is not acceptable; seen: 'bar'; allowed: None, False"
    ):
        profile(fit, points=2, progress="bar")


def test_what_has_a_value_in_each_record_is_said_to_have_no_profile():
    b = ce.Blueprint("decay")
    rate, size = b.parameter("k", 0.5, min=0.01, max=10), b.parameter("a", 1.0, min=0.1, max=5)
    x = b.state("x")
    b.ode("x", -rate * x)
    b.output("y", size * x)
    time = np.arange(60) * 0.03
    noise = 0.02 * np.random.default_rng(0).standard_normal((2, 60))
    data = [
        ce.Experiment.from_arrays(name, time=time, units={"y": "1"}, y=1.3 * np.exp(-k * time) + e)
        for name, k, e in zip(("one", "two"), (1.2, 0.8), noise, strict=True)
    ]
    pars = b.model().parameters()
    pars.vary_by_experiment("k")
    fit = ce.estimate(b.model(), data, parameters=pars, initial={"x": 1.0}, progress=False)
    found = profile(fit, points=2)
    assert list(found.lines) == ["a"]
    assert found.messages[-1].startswith("k@one, k@two: what has a value in each record has no profile")
    assert not profile(fit, "a", points=2).messages


def test_messages():
    _, _, data = line_data()
    fit = ce.estimate(linear_model(), data, noise=ce.Noise(y=0.3), progress=False)
    with pytest.raises(EstimationError, match="a profile needs a fit; seen: str"):
        profile("fit")
    with pytest.raises(EstimationError, match="there is no such free parameter in the fit"):
        profile(fit, "a")
    with pytest.raises(EstimationError, match="the level of the intervals is not acceptable; seen: 95"):
        profile(fit, level=95)
    with pytest.raises(EstimationError, match="points is not acceptable; seen: 1"):
        profile(fit, points=1)
    with pytest.raises(EstimationError, match="there is no profile of this parameter; seen: 'c'; allowed: b"):
        _ = profile(fit, points=2)["c"]
    robust = ce.estimate(linear_model(), data, noise=ce.Noise(y=0.3), loss="huber", progress=False)
    with pytest.raises(EstimationError, match="needs the likelihood of normal noise; seen: loss=huber"):
        profile(robust)
    _, _, curved = run_up()
    short = ce.estimate(ce.one_inertia(), curved, noise=ce.Noise(omega=0.6), max_iterations=1, progress=False)
    assert not short.converged
    with pytest.raises(EstimationError, match="a profile needs a fit that converged, with free parameters"):
        profile(short)


def test_a_wall_behind_a_flat_is_found():
    """Two losses of which the sum is known to 0.1 %: one of them may be anything up to that, and the step that leaps
    over the flat had ended its interval at the estimate, or at a refit that ended elsewhere."""
    b = ce.Blueprint("losses")
    first, second = (b.parameter(name, 0.4, unit="1/s", min=0) for name in ("first", "second"))
    w = b.state("w", unit="rad/s")
    b.ode("w", b.input("T", unit="rad/s2") - (first + second) * w)
    b.output("speed", w, unit="rad/s")
    t = 0.02 * np.arange(1500)
    drive = 2 + np.sign(np.sin(1.1 * t))
    speed = np.empty(len(t))
    speed[0] = 1.0
    decay = np.exp(-0.02)
    for k in range(len(t) - 1):
        speed[k + 1] = decay * speed[k] + (1 - decay) * drive[k]
    shown = speed + 0.05 * np.random.default_rng(2).standard_normal(len(t))
    units = {"T": "rad/s2", "speed": "rad/s"}
    record = ce.Experiment.from_arrays(
        "run", time=t, units=units, hold={"T": "zero", "speed": "first"}, T=drive, speed=shown
    )
    fit = ce.estimate(b.model(), record, noise=ce.Noise(speed=0.05), progress=False)
    line = ce.profile(fit, "first")["first"]
    assert line.interval.low_why == "at its bound"
    assert line.interval.high == pytest.approx(fit.values["first"] + fit.values["second"], rel=0.01)


def test_a_side_that_was_not_reached_is_not_flat():
    """A ratio known to 0.005 % was "flat: not identifiable in practice", as its refits had not converged."""
    lost = Interval(None, None, f"{LOST} did not converge: not converged: the iterations ran out", None)
    assert lost.lost
    assert not Interval(None, 1.0, "at its bound", None).lost
    line = SimpleNamespace(interval=lost)
    assert shape(line) == "not known: a refit did not end"


def test_a_prior_counts_while_its_parameter_is_held():
    """y = p of 8 samples of 0.5 and a prior: the posterior is normal, and the profile its 95 %."""
    b = ce.Blueprint("line")
    p, x = b.parameter("p", 1.0, min=-50, max=50), b.state("x")
    b.ode("x", 1e-9 * p)
    b.output("y", p + x)
    seen = 3 + 0.5 * np.random.default_rng(0).standard_normal(8)
    record = ce.Experiment.from_arrays("r", time=np.arange(8.0), units={"y": "1"}, y=seen)
    pars = b.model().parameters()
    pars["p"].set(prior=(2.5, 0.2))
    fit = ce.estimate(
        b.model(), record, parameters=pars, noise=ce.Noise(y=0.5), initial={"x": 0.0}, progress=False
    )
    weight = 8 / 0.25 + 1 / 0.04
    middle = (seen.sum() / 0.25 + 2.5 / 0.04) / weight
    found = ce.profile(fit, "p")
    interval = found["p"].interval
    low, high = interval.low, interval.high
    np.testing.assert_allclose([low, high], middle + 1.96 * np.array([-1, 1]) / np.sqrt(weight), rtol=2e-3)
    assert not any("less than the fit" in words for words in found.messages)


def test_an_end_that_was_found_stays_where_a_refit_beyond_it_failed(monkeypatch):
    _, _, data = line_data()
    fit = ce.estimate(linear_model(), data, noise=ce.Noise(y=0.3), progress=False)
    ends = {-1.0: ([], 1.5, f"{LOST} failed further on"), 1.0: ([], 2.5, None)}
    monkeypatch.setattr(module._Walker, "_side", lambda self, name, centre, sign: ends[sign])
    interval = profile(fit, "b", points=3)["b"].interval
    assert (interval.low, interval.high) == (1.5, 2.5)
    assert interval.low_why == f"{LOST} failed further on"
    assert not interval.lost
