"""What a fit finds out about its own standard errors, against curvatures and rises of chi-squared in closed form."""

import itertools
import re
import sys

import casadi
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, minimize_scalar
from scipy.signal import lfilter
from scipy.stats import norm

import casadi_engine as ce
from casadi_engine.deadline import TimeUp
from casadi_engine.errors import EstimationError
from casadi_engine.estimation import error_check
from casadi_engine.estimation import record as records
from casadi_engine.estimation.doubt import Doubt
from casadi_engine.estimation.error_check import words_of

REST = {"initial": {"x": 0.0, "w": 0.0}, "progress": False}
TIME = np.linspace(0, 1, 50)
EDGE = norm.ppf(0.975)


def bent(start=1.0, low=-5.0, high=5.0):
    """Two outputs p**2 t and p t: the answers of all p lie on a parabola."""
    b = ce.Blueprint("bent")
    p = b.parameter("p", start, min=low, max=high)
    x, w = b.state("x"), b.state("w")
    b.ode("x", p**2)
    b.ode("w", p)
    b.output("y1", x)
    b.output("y2", w)
    return b.model()


def bent_fit(square, line, truth=1.0, **options):
    """The fit with a p**2 worth ``square`` standard deviations of the noise for p = 1, a p worth ``line``."""
    size = np.sqrt((TIME**2).sum())
    units = {"y1": "1", "y2": "1"}
    data = ce.Experiment.from_arrays("r", time=TIME, units=units, y1=truth**2 * TIME, y2=truth * TIME)
    noise = ce.Noise(y1=size / square, y2=size / line)
    return ce.estimate(bent(truth), data, noise=noise, **{**REST, **options})


@pytest.mark.parametrize(
    ("square", "line", "p"), [(1.5, 2.0, 1.0), (1.5, 2.0, -0.7), (1.0, 1.0, 0.8), (3.0, 2.0, 0.1)]
)
def test_curvature_and_rises_are_those_of_the_parabola(square, line, p):
    fit = bent_fit(square, line, truth=p)
    slope = np.hypot(2 * square * p, line)
    curvature = EDGE * 2 * square * line / slope**3
    size = 1 / slope
    assert fit.estimates["p"].quadratic == pytest.approx(size, rel=1e-6)
    assert fit.stderr["p"] is None
    rises = [
        square**2 * ((p + d) ** 2 - p**2) ** 2 + line**2 * d**2 for d in (-2 * size, 2 * size)
    ]  # of data without noise
    (said,) = [text for text in fit.messages if "not quadratic" in text or "curvature" in text]
    if curvature < 1.5:
        words = f"chi-squared rises by {rises[0]:.2g} and {rises[1]:.2g}, not by 4"
        assert said == f"the likelihood is not quadratic along p: 2 standard errors away {words}"
    else:
        assert f"far from linear along p (curvature {curvature:.2g}, flat below 0.4)" in said
        assert said.endswith("call ce.posterior(fit)")


def test_a_flat_answer_keeps_its_error():
    fit = bent_fit(30.0, 30.0)
    assert fit.messages == ()
    assert fit.stderr["p"] == pytest.approx(1 / np.hypot(60, 30), rel=1e-6)
    assert fit.estimates["p"].quadratic is None


def test_a_linear_model_is_never_doubted_however_little_its_data_tell(line, line_data):
    """Unless a bound is near: errors of a regression are right at every noise level, larger than the values too."""
    made = line_data()
    pars = line().parameters()
    for name in pars:
        pars[name].set(min=-np.inf, max=np.inf)
    noise = ce.Noise(**{output.name: 1e3 for output in line().outputs})
    fit = ce.estimate(line(), made.data, parameters=pars, noise=noise, initial={"x": 0.0}, progress=False)
    assert max(fit.stderr[name] / abs(fit.values[name]) for name in fit.free) > 1
    assert fit.messages == ()


def test_a_rugged_fit_prints_no_error_and_says_what_to_call():
    fit = bent_fit(3.0, 2.0, truth=0.1)
    text = str(fit)
    assert "±" not in text
    assert "no error: not known (see note)" in text
    assert "call ce.posterior(fit)" in " ".join(text.split())
    assert fit.doubted == ("p",)


def test_a_curved_fit_prints_the_interval_of_its_profile():
    """The ends by brute force on the closed form."""
    square, line = 1.5, 2.0
    fit = bent_fit(square, line)

    def rise(p):
        return square**2 * (p**2 - 1) ** 2 + line**2 * (p - 1) ** 2

    ends = [
        minimize_scalar(lambda p: (rise(p) - EDGE**2) ** 2, bounds=side, method="bounded").x
        for side in ((0.0, 1.0), (1.0, 3.0))
    ]
    assert fit.estimates["p"].interval == pytest.approx(ends, abs=0.01)
    assert fit.doubted == ()
    assert f"95 %: {ends[0]:.2f} to {ends[1]:.2f}" in str(fit)
    assert "±" not in "".join(line for line in str(fit).splitlines() if line.startswith("  p "))


@pytest.mark.parametrize(("bend", "seen"), [(0.7, False), (4.0, True)])
def test_a_parameter_that_bends_with_another_is_profiled(bend, seen):
    """Outputs q + c p**2 and p: along p alone nothing is curved, for q takes up all of it, and the profile of q reaches
    lower by what p**2 makes up for, once c is above 1 where p goes 2 standard errors."""
    b = ce.Blueprint("bending")
    p, q = b.parameter("p", 0.0), b.parameter("q", 1.0)
    v, w = b.state("v"), b.state("w")
    b.ode("v", q + bend / 4 * p**2)
    b.ode("w", p)
    b.output("y1", v)
    b.output("y2", w)
    units = {"y1": "1", "y2": "1"}
    data = ce.Experiment.from_arrays("r", time=TIME, units=units, y1=TIME, y2=0.1 * TIME)
    size = np.sqrt((TIME**2).sum())
    fit = ce.estimate(
        b.model(), data, noise=ce.Noise(y1=size, y2=size), initial={"v": 0.0, "w": 0.0}, progress=False
    )
    assert fit.estimates["p"].stderr == pytest.approx(1.0)
    if not seen:
        assert fit.estimates["q"].stderr == pytest.approx(1.0, rel=0.01)
        assert fit.messages == ()
        return
    (said,) = fit.messages
    assert re.search(
        r"standard errors along .*p.* the best q lies 3.\d of its own off where the quadratic has it", said
    )
    p = np.linspace(-4, 4, 4001)

    def above(q):
        return ((q - 1 + bend / 4 * p**2) ** 2 + (p - 0.1) ** 2).min() - EDGE**2

    ends = brentq(above, -10, 0), brentq(above, 1, 10)
    assert fit.estimates["q"].interval == pytest.approx(ends, rel=0.02)
    assert ends[0] < 1 - 1.5 * EDGE


@pytest.mark.parametrize("by_logarithm", [False, True])
def test_a_positive_parameter_that_is_known_to_a_fifth(by_logarithm):
    """Where the data tell its amount the error is symmetric all the same; where they tell its logarithm, it is not."""
    b = ce.Blueprint("line")
    p = b.parameter("p", 1.0, min=1e-3, max=1e3)
    w = b.state("w")
    b.ode("w", casadi.log(p) if by_logarithm else p)
    b.output("y", w)
    data = ce.Experiment.from_arrays("r", time=TIME, units={"y": "1"}, y=0 * TIME if by_logarithm else TIME)
    noise = ce.Noise(y=0.2 * np.sqrt((TIME**2).sum()))
    fit = ce.estimate(b.model(), data, noise=noise, initial={"w": 0.0}, progress=False)
    if by_logarithm:
        assert fit.stderr["p"] is None
        ends = np.exp(-0.2 * EDGE), np.exp(0.2 * EDGE)
        assert fit.estimates["p"].interval == pytest.approx(ends, abs=3e-3)
        assert fit.messages == ("the likelihood is not symmetric in p: no symmetric error",)
    else:
        assert fit.stderr["p"] == pytest.approx(0.2, rel=1e-6)
        assert fit.messages == ()


@pytest.mark.parametrize("size", [0.03, 0.06, 0.09, 0.15])
def test_what_is_printed_holds_the_truth_as_often_as_it_says(size):
    """The data tell 1/p, from which ± of p has its far end 2 * size too near: whether it is printed must not depend on
    where the noise put p. The noise is moved through its quantiles."""
    b = ce.Blueprint("line")
    p = b.parameter("p", 1.0, min=1e-3, max=1e3)
    w = b.state("w")
    b.ode("w", 1 / p)
    b.output("y", w)
    noise = ce.Noise(y=size * np.sqrt((TIME**2).sum()))
    printed, held = [], []
    for z in norm.ppf((np.arange(40) + 0.5) / 40):
        data = ce.Experiment.from_arrays("r", time=TIME, units={"y": "1"}, y=TIME * (1 + size * z))
        one = ce.estimate(b.model(), data, noise=noise, initial={"w": 0.0}, progress=False).estimates["p"]
        ends = one.interval or (one.value - EDGE * one.stderr, one.value + EDGE * one.stderr)
        held.append(ends[0] < 1 < ends[1])
        printed.append(one.stderr is not None)
    assert sum(held) in (38, 39)  # 97.5 and 95 %: the quantiles end at 1.25 %
    assert all(printed) if size == 0.03 else not any(printed) or size == 0.06


@pytest.mark.parametrize("goes", [False, True])
def test_where_a_constant_explains_an_output_better_no_error_is_known(goes):
    """A sensor that stands at 3 while the model goes from 5 to 1: the rate that crosses it best is told by nothing that
    happened."""
    b = ce.Blueprint("decay")
    k, x = b.parameter("k", 0.5, min=0.01, max=200), b.state("x")
    b.ode("x", k * (1 - x))
    b.output("y", x)
    y = (1 + 4 * np.exp(-1.5 * TIME) if goes else 3.0) + 0.05 * np.random.default_rng(0).standard_normal(
        len(TIME)
    )
    data = ce.Experiment.from_arrays("r", time=TIME, units={"y": "1"}, y=y)
    fit = ce.estimate(b.model(), data, initial={"x": 5.0}, progress=False)
    assert any("a constant explains r/y better" in text for text in fit.messages) == (not goes)
    assert (fit.stderr["k"] is None) == (not goes)
    assert fit.estimates["k"].interval is None


@pytest.mark.parametrize(
    ("others", "colour", "told"), [(0.4, 0.0, True), (1.0, 0.0, False), (0.0, 0.9, True)]
)
def test_no_error_is_known_where_more_is_left_than_followed(others, colour, told):
    """One of three tones that are as large: its frequency is known to 0.1 % at a place where most is wrong. Noise of
    one colour, a good part of the motion, is none of that."""
    b = ce.Blueprint("tone")
    w = b.parameter("w", 1.1, unit="rad/s", min=0.1, max=30)
    x, v = b.state("x"), b.state("v")
    b.ode("x", v)
    b.ode("v", -w * w * x)
    b.output("y", x)
    t = np.arange(400) * 0.1
    e = np.random.default_rng(0).standard_normal(400)
    rest = others * (np.cos(2.9 * t) + np.cos(5.1 * t + 1))
    y = np.cos(1.002 * t) + rest + (0.15 * lfilter([1], [1, -colour], e) if colour else 0.1 * e)
    data = ce.Experiment.from_arrays("r", time=t, units={"y": "1"}, y=y)
    fit = ce.estimate(b.model(), data, progress=False)
    left = any(
        "more than half of the variance of r/y is left, and the residual is not white" in text
        for text in fit.messages
    )
    assert left == (not told)
    assert (fit.stderr["w"] is None) == (not told)
    assert fit.estimates["w"].interval is None


@pytest.mark.parametrize(
    ("missing", "call"),
    [
        (["Ks"], "for Ks call ce.profile(fit), or ce.posterior(fit)"),
        (["Ks", "P@lean"], "for Ks, P@lean call ce.posterior"),
    ],
)
def test_what_is_called_for_can_be_called(missing, call):
    """A parameter with a value in each record has no profile, which a note advised."""
    (said,) = words_of([Doubt("curved", "it is not quadratic", np.zeros(2), 0.2)], missing)
    assert call in said


def test_a_bound_within_two_errors_is_named():
    fit = bent_fit(30.0, 30.0, truth=0.02)
    assert not fit.messages
    data = ce.Experiment.from_arrays(
        "r", time=TIME, units={"y1": "1", "y2": "1"}, y1=0 * TIME, y2=0.05 * TIME
    )
    size = np.sqrt((TIME**2).sum())
    noise = ce.Noise(y1=size, y2=size / 30)
    fit = ce.estimate(bent(0.1, low=0.0), data, noise=noise, **REST)
    assert fit.messages == ("p reaches its lower bound within 2 standard errors: no symmetric error",)
    assert fit.estimates["p"].interval == pytest.approx((0.0, 0.05 + EDGE / 30), abs=1e-3)


@pytest.mark.parametrize(
    ("wide", "said"),
    [
        (1.0, "the outputs bend along p within the errors"),
        (
            8.0,
            "the errors are not known: within 2 standard errors along p the model has no value; call ce.posterior",
        ),
    ],
)
def test_where_the_model_has_no_value_within_the_errors_is_as_far_as_it_is_looked(wide, said):
    """What is one standard error off is a bound; of what is next to the optimum nothing is known."""
    b = ce.Blueprint("root")
    p = b.parameter("p", 1.0, min=-5, max=5)
    x, w = b.state("x"), b.state("w")
    b.ode("x", p**0.5)
    b.ode("w", p)
    b.output("y1", x)
    b.output("y2", w)
    data = ce.Experiment.from_arrays("r", time=TIME, units={"y1": "1", "y2": "1"}, y1=TIME, y2=TIME)
    size = wide * np.sqrt((TIME**2).sum())
    fit = ce.estimate(b.model(), data, noise=ce.Noise(y1=size, y2=size), **REST)
    (words,) = fit.messages
    assert words.startswith(said)
    assert fit.estimates["p"].stderr is None


def test_what_is_not_known_of_a_first_state_takes_no_interval_from_a_parameter():
    """Of eight fits of a repressilator none had an error, as noise made optima of what a first state may be."""
    t = np.arange(12) * 0.5
    b = ce.Blueprint("decay")
    k = b.parameter("k", 1.0, unit="1/s", min=0.01, max=50)
    x, z = b.state("x"), b.state("z")
    b.ode("x", -k * x)
    b.ode("z", 0 * z)
    b.output("y", x)
    b.output("other", casadi.sin(8 * z))
    rng = np.random.default_rng(2)
    data = ce.Experiment.from_arrays(
        "r", time=t, units={"y": "1", "other": "1"}, y=np.exp(-1.2 * t) + 0.2 * rng.standard_normal(12),
        other=0.3 + 1.5 * rng.standard_normal(12),
    )  # fmt: skip
    fit = ce.estimate(
        b.model(), data, noise=ce.Noise(y=0.2, other=1.5), initial={"x": 1.0, "z": (-2, 2)}, progress=False
    )
    own = fit.estimates["k"]
    assert own.stderr is None
    assert own.interval[0] < 1.2 < own.interval[1]
    assert fit.initial["r"]["z"].stderr is None
    assert any("along the first z of r" in words for words in fit.messages)


def test_a_profile_that_meets_a_lower_optimum_leads_to_it():
    """Two valleys and a low pass between: chi-squared is A (p^2 - 1)^2 + B (p - 0.3)^2. The point of the other
    sign is beyond the bounds."""
    size = np.sqrt((TIME**2).sum())
    data = ce.Experiment.from_arrays("r", time=TIME, units={"y1": "1", "y2": "1"}, y1=TIME, y2=0.3 * TIME)
    noise = ce.Noise(y1=size / np.sqrt(3.0), y2=size / np.sqrt(0.25))
    first = ce.estimate(bent(-1.0, high=0.9), data, noise=noise, **{**REST, "errors": "quadratic"})
    fit = ce.estimate(bent(-1.0, high=0.9), data, noise=noise, **REST)
    assert first.values["p"] < 0
    assert fit.values["p"] == pytest.approx(0.9)
    assert fit.cost < first.cost
    assert fit.stderr["p"] is None


def test_errors_of_a_higher_optimum_are_taken_back(monkeypatch):
    """Where the search from the lower place leads nowhere."""
    module = sys.modules["casadi_engine.estimation.estimate"]
    for name in ("from_lower_places", "looked_at_twice"):
        monkeypatch.setattr(module, name, lambda fit, *_: fit)
    size = np.sqrt((TIME**2).sum())
    data = ce.Experiment.from_arrays("r", time=TIME, units={"y1": "1", "y2": "1"}, y1=TIME, y2=0.3 * TIME)
    noise = ce.Noise(y1=size / np.sqrt(3.0), y2=size / np.sqrt(0.25))
    fit = ce.estimate(bent(-1.0, high=0.9), data, noise=noise, **REST)
    assert fit.values["p"] < 0
    assert fit.stderr["p"] is None
    assert fit.estimates["p"].interval is None
    assert "call ce.posterior(fit)" in fit.messages[0]


def test_the_errors_of_the_quadratic_are_there_when_asked_for():
    fit = bent_fit(3.0, 2.0, truth=0.1, errors="quadratic")
    assert fit.messages == ()
    assert fit.stderr["p"] == pytest.approx(1 / np.hypot(0.6, 2.0), rel=1e-6)


def test_a_wrong_word_for_the_errors_is_refused(refused):
    with refused(
        EstimationError,
        "errors is not acceptable",
        seen="'profile'",
        allowed='"checked", "quadratic", or seconds >= 0',
    ):
        bent_fit(1.0, 1.0, errors="profile")


# ---- the same, however a record is advanced


def pendulum(law=True):
    """A swing with friction: with ``law`` no linear core; few samples, so that errors are wide."""
    b = ce.Blueprint("pendulum")
    k, c = b.parameter("k", 9.0, min=-100, max=100), b.parameter("c", 0.3, min=-100, max=100)
    x, w = b.state("x"), b.state("w")
    b.ode("x", w)
    b.ode("w", -k * (casadi.sin(x) if law else x) - c * w)
    b.output("y", x)
    return b.model()


def swing(n=80):
    time = np.linspace(0, 6, n)
    y = 0.3 * np.cos(3 * time) * np.exp(-0.15 * time)
    y += 0.25 * np.random.default_rng(1).standard_normal(n)
    return ce.Experiment.from_arrays("swing", time=time, units={"y": "1"}, y=y)


@pytest.mark.parametrize("law", [True, False])
def test_shooting_intervals_change_nothing(law):
    """Runs of many intervals, whose starts are foreseen, see what one run sees."""
    said = []
    for interval in ("single", 8):
        fit = ce.estimate(
            pendulum(law),
            swing(),
            noise=ce.Noise(y=0.25),
            interval=interval,
            initial={"w": 0.0},
            progress=False,
        )
        assert fit.converged
        said.append(fit.messages)
    assert said[0]
    assert said[0] == said[1]


def test_a_long_record_is_judged_as_a_short_one(monkeypatch):
    plain = ce.estimate(pendulum(False), swing(), noise=ce.Noise(y=0.25), initial={"w": 0.0}, progress=False)
    monkeypatch.setattr(records, "_LONG", 100)
    monkeypatch.setattr(records, "_PART", 60)
    parts = ce.estimate(pendulum(False), swing(), noise=ce.Noise(y=0.25), initial={"w": 0.0}, progress=False)
    assert parts.messages == plain.messages


def test_what_is_not_quadratic_in_the_logarithm_may_be_so_in_what_is_printed(monkeypatch):
    """An amount known to 20 %: chi-squared rises by 6 and 2.7 two errors of the logarithm away, by 4 of the amount."""
    b = ce.Blueprint("line")
    p = b.parameter("p", 1.0, min=1e-3, max=1e3)
    w = b.state("w")
    b.ode("w", p)
    b.output("y", w)
    data = ce.Experiment.from_arrays("r", time=TIME, units={"y": "1"}, y=TIME)
    seen, asked = [], error_check._Around._simulated

    def watched(self, *arguments, **options):
        found = asked(self, *arguments, **options)
        seen.append(found[0])
        return found

    monkeypatch.setattr(error_check._Around, "_simulated", watched)
    noise = ce.Noise(y=0.2 * np.sqrt((TIME**2).sum()))
    fit = ce.estimate(b.model(), data, noise=noise, initial={"w": 0.0}, progress=False)
    logs = [(np.expm1(far) / 0.2) ** 2 for far in (-0.4, 0.4)]
    assert seen == pytest.approx([*logs, 4.0, 4.0, *logs], rel=1e-3)
    assert fit.messages == ()
    assert fit.stderr["p"] == pytest.approx(0.2, rel=1e-3)


def test_of_two_ways_the_milder_one_counts():
    def doubt(kind, size):
        return error_check.Doubt(kind, "", np.zeros(1), size)

    order = [
        [],
        [doubt("curved", 0.2)],
        [doubt("curved", 0.9)],
        [doubt("rugged", 0.5)],
        [doubt("rugged", 2.0)],
    ]
    for mild, grave in itertools.pairwise(order):
        assert min(grave, mild, key=error_check._gravity) is mild


def test_a_valley_that_bends_is_no_rugged_one():
    """Van der Pol: mu and w0 go together by 0.999 along a bend, which a straight line leaves within two errors. Its
    curvature falls with the step, where noise decides on optima it does not."""
    time = np.linspace(0, 12, 61)

    def motion(mu, w0):
        return solve_ivp(
            lambda _, s: [s[1], mu * (1 - s[0] ** 2) * s[1] - w0**2 * s[0]], (0, 12), [0.5, 0.0], t_eval=time,
            rtol=1e-9, atol=1e-9,
        ).y[0]  # fmt: skip

    b = ce.Blueprint("van_der_pol")
    mu, w0 = b.parameter("mu", 1.5, min=0.01, max=20), b.parameter("w0", 2.5, min=0.1, max=50)
    x, v = b.state("x"), b.state("v")
    b.ode("x", v)
    b.ode("v", mu * (1 - x**2) * v - w0**2 * x)
    b.output("y", x)
    y = motion(1.5, 2.5) + 0.3 * np.random.default_rng(3).standard_normal(len(time))
    data = ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=y)
    fit = ce.estimate(b.model(), data, noise=ce.Noise(y=0.3), progress=False, errors=20)
    assert not any("far from linear" in text for text in fit.messages)
    for name, truth in (("mu", 1.5), ("w0", 2.5)):
        one = fit.estimates[name]
        low, high = one.interval or (one.value - 1.96 * one.stderr, one.value + 1.96 * one.stderr)
        assert low < truth < high


def test_a_model_without_a_value_where_finer_steps_are_taken_has_no_error(monkeypatch):
    """The first look had a value by steps that were too long; that none is left is a doubt, not the end of it."""
    real, finer = error_check._Around._simulated, []
    monkeypatch.setattr(error_check._Around, "_integrated", lambda *_, **how: finer.append(1) or True)
    monkeypatch.setattr(
        error_check._Around, "_simulated", lambda *given, **how: None if finer else real(*given, **how)
    )
    fit = bent_fit(1.5, 2.0)
    assert finer
    assert fit.stderr["p"] is None
    assert any("the model has no value" in text for text in fit.messages)


def test_a_search_for_exchanges_that_takes_too_long_is_said(monkeypatch):
    """Of six states it took 25 s beside a fit of 2 s."""

    def long(*_):
        raise TimeUp

    monkeypatch.setattr(error_check, "exchanged", long)
    b = ce.Blueprint("lag")
    k, x = b.parameter("k", 1.0, min=0.1, max=10), b.state("x")
    b.ode("x", -k * x)
    b.output("y", x)
    time = np.arange(50) * 0.05
    y = np.exp(-1.3 * time) + 0.01 * np.random.default_rng(0).standard_normal(50)
    fit = ce.estimate(
        b.model(), ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=y), progress=False
    )
    assert fit.stderr["k"]
    said = "other optima, at which parameters are exchanged, were not looked for to the end: that takes more than"
    assert any(
        words.startswith(said) and words.endswith("starts=10 looks for them") for words in fit.messages
    )
