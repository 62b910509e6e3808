"""What a fit prints of errors that its quadratic does not tell: along every direction, of first states, of ties."""

import importlib

import casadi
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.estimation import Estimate
from casadi_engine.estimation.answer_notes import UNTOLD, errors_then
from casadi_engine.estimation.doubted import Judged

TIME = np.linspace(0, 1, 50)


def record(**outputs):
    units = dict.fromkeys(outputs, "1")
    return ce.Experiment.from_arrays("r", time=np.linspace(0, 1, len(TIME)), units=units, **outputs)


def noisy(values, sigma, seed=0):
    return values + sigma * np.random.default_rng(seed).standard_normal(len(values))


def buried(phase):
    """Four gains that are hardly told, and one small oscillation whose frequency is the best known number of all."""
    b = ce.Blueprint("buried")
    gains = [b.parameter(f"c{k}", 0.0, min=-50, max=50) for k in range(4)]
    w = b.parameter("w", 40.0, unit="rad/s", min=1, max=200)
    time, states = b.state("t"), [b.state(f"x{k}") for k in range(4)]
    b.ode("t", 1.0)
    for k, (gain, state) in enumerate(zip(gains, states, strict=True)):
        b.ode(f"x{k}", gain)
        b.output(f"y{k}", state)
    b.output("swing", 0.3 * casadi.sin(w * time + phase))
    return b.model()


def test_the_best_known_parameter_is_looked_along_too(monkeypatch):
    """The three directions that the data tell least of are the gains'."""
    # other starts find other optima, which say the same of it
    module = importlib.import_module("casadi_engine.estimation.estimate")
    monkeypatch.setattr(module, "looked_at_twice", lambda fit, *_: fit)
    truth = {f"y{k}": noisy(0 * TIME, 1.0, k) for k in range(4)}
    data = record(**truth, swing=noisy(0.3 * np.sin(40 * TIME + 0.5), 0.5, 9))
    start = {"t": 0.0, **{f"x{k}": 0.0 for k in range(4)}}
    noise = ce.Noise(**{f"y{k}": 1.0 for k in range(4)}, swing=0.5)
    fit = ce.estimate(buried(0.5), data, noise=noise, initial=start, progress=False)
    assert fit.stderr["w"] is None
    assert all(fit.stderr[f"c{k}"] for k in range(4))
    assert any("along w" in text for text in fit.messages)


def growth():
    b = ce.Blueprint("growth")
    rate = b.parameter("g", 1.0, min=0.1, max=10)
    x, z = b.state("x"), b.state("z")
    b.ode("x", 4.0 * x * (1 - x / 10))
    b.ode("z", -rate * z)
    b.output("y", x)
    b.output("w", z)
    return b.model()


@pytest.mark.parametrize(("sigma", "known"), [(4.0, False), (0.02, True)])
def test_a_first_state_has_an_error_where_its_quadratic_holds_alone(sigma, known):
    """Of a seed of 0.3 that grows to ten, in noise of four, 0.02 ± 0.011 had been printed."""
    y = 10 / (1 + (10 / 0.3 - 1) * np.exp(-4.0 * TIME))
    data = record(y=noisy(y, sigma, 3), w=noisy(5 * np.exp(-TIME), 0.02, 4))
    noise = ce.Noise(y=sigma, w=0.02)
    fit = ce.estimate(growth(), data, noise=noise, initial={"x": (0.0, 9.0), "z": 5.0}, progress=False)
    first = fit.initial["r"]["x"]
    assert (first.stderr is not None) == known
    assert fit.stderr["g"]
    assert any("the first x of r" in text for text in fit.messages) != known


def decay():
    b = ce.Blueprint("decay")
    rate, x = b.parameter("k", 1.0, unit="1/s", min=0.01, max=50), b.state("x")
    b.ode("x", -rate * x)
    b.output("y", x)
    return b.model()


def test_what_a_tie_bends_has_an_interval_and_no_error():
    pars = decay().parameters()
    pars.add("q", 1.0, min=-np.inf, max=np.inf)
    pars.tie("q", "1/k**4")
    pars.add("half", 1.0, min=-np.inf, max=np.inf)
    pars.tie("half", "k/2")
    data = record(y=noisy(np.exp(-1.3 * TIME), 0.1, 1))
    fit = ce.estimate(
        decay(), data, parameters=pars, initial={"x": 1.0}, noise=ce.Noise(y=0.1), progress=False
    )
    k, q = fit.estimates["k"], fit.estimates["q"]
    assert k.stderr
    assert fit.stderr["half"] == pytest.approx(k.stderr / 2)
    assert q.stderr is None
    ends = sorted(1 / (k.value + side * 1.96 * k.stderr) ** 4 for side in (-1, 1))
    assert q.interval == pytest.approx(ends, rel=1e-3)


def test_few_samples_are_said_to_widen_an_interval():
    few = ce.Experiment.from_arrays(
        "r", time=TIME[::8], units={"y": "1"}, y=noisy(np.exp(-1.3 * TIME), 0.05, 2)[::8]
    )
    fit = ce.estimate(decay(), few, progress=False)
    (said,) = [text for text in fit.messages if text.startswith("few samples")]
    assert "from 5 degrees of freedom" in said
    assert "goes 2.6 standard errors" in said
    many = ce.estimate(decay(), record(y=noisy(np.exp(-1.3 * TIME), 0.05, 2)), progress=False)
    assert not any(text.startswith("few samples") for text in many.messages)


def test_a_known_first_state_holds_at_the_first_time_where_the_first_samples_are_missing():
    y = noisy(5 * np.exp(-2.0 * TIME), 0.05, 5)
    whole = ce.estimate(decay(), record(y=y), initial={"x": 5.0}, progress=False)
    y[:8] = np.nan
    without = ce.estimate(decay(), record(y=y), initial={"x": 5.0}, progress=False)
    assert without.values["k"] == pytest.approx(2.0, abs=5 * without.stderr["k"])
    assert without.values["k"] == pytest.approx(whole.values["k"], abs=0.03)


def test_colour_of_many_short_records_is_seen_in_all_of_them():
    rng, records = np.random.default_rng(7), []
    for k in range(8):
        colour = np.zeros(25)
        for j in range(1, 25):
            colour[j] = 0.8 * colour[j - 1] + 0.03 * rng.standard_normal()
        y = np.exp(-1.3 * TIME[:25]) + colour
        records.append(ce.Experiment.from_arrays(f"r{k}", time=TIME[:25], units={"y": "1"}, y=y))
    first = {f"r{k}": {"x": 1.0} for k in range(8)}
    fit = ce.estimate(decay(), records, initial=first, progress=False)
    assert any("not white" in text for text in fit.messages)
    assert fit.own_noise["k"] > 1.5


def test_a_posterior_for_arviz_from_a_fit():
    fit = ce.estimate(decay(), record(y=noisy(np.exp(-1.3 * TIME), 0.05, 2)), progress=False)
    made = fit.to_inference_data(draws=200)
    assert made["posterior"]["k"].shape == (1, 200)


def test_an_interval_of_a_curved_likelihood_says_that_one_search_found_its_optimum():
    """Of a weak nonlinear oscillation, whose neighbouring optima no profile from here meets."""
    b = ce.Blueprint("swing")
    w, q, v = b.parameter("w", 9.5, unit="rad/s", min=1, max=40), b.state("q"), b.state("v", unit="1/s")
    b.ode("q", v)
    b.ode("v", -(w**2) * (q + 0.1 * q**3) - 0.2 * v)
    b.output("y", q)
    time = 0.05 * np.arange(300)

    def ode(t, z):
        return [z[1], -100.0 * (z[0] + 0.1 * z[0] ** 3) - 0.2 * z[1]]

    y = solve_ivp(ode, (0, time[-1]), [0.3, 0.0], t_eval=time, rtol=1e-9, atol=1e-10).y[0]
    data = ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=noisy(y, 0.6, 3))
    options = {"noise": ce.Noise(y=0.6), "initial": {"q": 0.3, "v": 0.0}, "progress": False}
    fit = ce.estimate(b.model(), data, **options)
    assert fit.estimates["w"].interval
    words = "the intervals are of the one optimum that was found: starts=10 looks for others"
    assert any(text.endswith(words) for text in fit.messages)


def test_first_states_go_along_with_parameters_whose_intervals_are_not_symmetric():
    """A top whose third rate nobody measures: a w2 is known, a and w2 are not; w2 stood as 7.0 +- 1.0, and 10.7 is
    within 95 % of the likelihood."""
    b = ce.Blueprint("top")
    a, c = (b.parameter(name, value, min=0.01, max=0.99) for name, value in (("a", 0.5), ("b", 0.3)))
    d = b.parameter("d", 0.05, unit="1/s", min=0, max=2)
    x, y, z = (b.state(name, unit="rad/s") for name in ("x", "y", "z"))
    b.ode("x", a * y * z - d * x)
    b.ode("y", -c * x * z - d * y)
    b.ode("z", (c - a) / (1 - a * c) * x * y - d * z)
    b.output("g0", x, unit="rad/s")
    b.output("g1", y, unit="rad/s")
    random, time, records = np.random.default_rng(1000), 0.05 * np.arange(200), []

    def rate(_, w):
        return [
            0.6 * w[1] * w[2] - 0.08 * w[0],
            -0.4 * w[0] * w[2] - 0.08 * w[1],
            -0.2 / 0.76 * w[0] * w[1] - 0.08 * w[2],
        ]

    for k, start in enumerate(([1.0, 0.2, 6.0], [0.3, 2.0, 4.0], [2.0, 2.0, -5.0])):
        w = solve_ivp(rate, (0, 10), start, t_eval=time, rtol=1e-9, atol=1e-11).y[:2]
        g = w + 0.1 * random.standard_normal(w.shape)
        units = {"g0": "rad/s", "g1": "rad/s"}
        records.append(ce.Experiment.from_arrays(f"r{k}", time=time, units=units, g0=g[0], g1=g[1]))
    fit = ce.estimate(
        b.model(), records, progress=False, errors=60.0
    )  # the usual seconds are few on a slow machine
    assert fit.estimates["a"].interval is not None
    assert [fit.initial[f"r{k}"]["z"].stderr for k in range(3)] == [None] * 3
    assert fit.stderr["d"] == pytest.approx(4e-4, rel=0.2)
    text = " ".join(str(fit).split())
    assert "rad/s (error not known)" in text


def test_errors_that_are_said_to_be_none_are_not_printed():
    """Of a chaotic run at fifty times its noise 1.9088 +- 0.0008 was printed, 1100 of these off, and beside it that the
    errors are too small."""
    known, gone = Estimate(1.9, 0.0008, "1"), Estimate(2.0, None, "1", why="fixed")
    found = Judged({"g": known, "h": gone}, {"m": {"x": known}}, ("first",))
    assert found.as_told(["the residual is louder; the standard errors are too small"]) is found
    told = found.as_told([f"the residual is louder; {UNTOLD}"])
    for one in (told.estimates["g"], told.initial["m"]["x"]):
        assert (one.value, one.stderr, one.interval, one.quadratic) == (1.9, None, None, 0.0008)
        assert "see note" in one.why
    assert told.estimates["h"] is gone
    assert told.said == ("first",)
    assert errors_then(None, 3.0, counted=True) == UNTOLD
    assert errors_then(None, 3.0) == "the standard errors are too small"
