"""Several searches: optima told apart and grouped, neighbours along the least known direction, what is said of them."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import casadi_engine as ce
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.multistart import attempts_from, best_of, distinct_optima
from casadi_engine.estimation.search import Search

# chi-squared of `valleys` is A (p^2 - 1)^2 + B (p - 0.3)^2: a lower valley near 1 and a higher one near -1.
A, B, SAMPLES = 6.0, 1.0, 50


def chi2(p):
    return A * (p**2 - 1) ** 2 + B * (p - 0.3) ** 2


@pytest.fixture
def valleys():
    """A model whose likelihood has two valleys in p, its noise, its record, and a set that starts at the worse one."""

    def make(start=-1.0, q=0.0):
        b = ce.Blueprint("valleys")
        p = b.parameter("p", start, min=-5, max=5)
        x, w = b.state("x"), b.state("w")
        b.ode("x", p**2)
        b.ode("w", p)
        b.output("y1", x)
        b.output("y2", w)
        time = np.linspace(0, 1, SAMPLES)
        size = np.sqrt((time**2).sum())
        data = ce.Experiment.from_arrays(
            "r", time=time, units={"y1": "1", "y2": "1"}, y1=1.0 * time, y2=0.3 * time
        )
        return b.model(), data, ce.Noise(y1=size / np.sqrt(A), y2=size / np.sqrt(B))

    return make


REST = {"initial": {"x": 0.0, "w": 0.0}, "interval": "single", "progress": False}
HIGH, LOW = (minimize_scalar(chi2, bounds=side, method="bounded") for side in ((-1.2, -0.5), (0.5, 1.2)))


def search_of(model, data, noise):
    return Search(
        model, (data,), model.parameters(), noise, interval="single", initial=REST["initial"], loss=Loss(),
        ties="substitute", method="exact", max_iterations=100, tolerance=1e-9, warm=None, progress=None,
    )  # fmt: skip


def test_one_start_ends_in_the_valley_it_starts_in(valleys):
    model, data, noise = valleys()
    fit = ce.estimate(model, data, noise=noise, **{**REST, "errors": "quadratic"})
    assert fit.values["p"] == pytest.approx(HIGH.x, abs=1e-5)
    assert fit.cost == pytest.approx(HIGH.fun, rel=1e-6)
    assert not any("other optim" in message for message in fit.messages)


def test_a_profile_that_comes_below_it_leads_to_the_lower_valley(valleys):
    model, data, noise = valleys()
    fit = ce.estimate(model, data, noise=noise, **REST)
    assert fit.converged
    assert fit.values["p"] == pytest.approx(LOW.x, abs=1e-5)
    assert fit.cost == pytest.approx(LOW.fun, rel=1e-6)


def test_neighbours_find_the_lower_valley(valleys):
    model, data, noise = valleys()
    fit = ce.estimate(model, data, noise=noise, neighbours=1, **REST)
    assert fit.converged
    assert fit.values["p"] == pytest.approx(LOW.x, abs=1e-5)
    assert fit.cost == pytest.approx(LOW.fun, rel=1e-6)
    assert [o.cost for o in fit.optima] == pytest.approx([LOW.fun, HIGH.fun], rel=1e-6)
    assert [o.values["p"] for o in fit.optima] == pytest.approx([LOW.x, HIGH.x], abs=1e-4)
    # the start, its two neighbours, and that neighbour of the lower optimum which does not lead back
    assert sum(o.starts for o in fit.optima) == 4
    assert fit.options["neighbours"] == 1


def test_the_direction_between_two_optima_and_the_rival_are_said_in_words(valleys):
    model, data, noise = valleys()
    fit = ce.estimate(model, data, noise=noise, neighbours=1, **REST)
    share = 100 * (HIGH.x - LOW.x) / abs(LOW.x)
    assert fit.optima[0].apart == ""
    assert fit.optima[1].apart == f"p {share:+.3g} %"
    message = next(m for m in fit.messages if "other optim" in m)
    assert message == (
        f"1 other optimum explains the data as well: p {share:+.3g} % at a cost {HIGH.fun - LOW.fun:.2g} higher; "
        "the errors are not known, call ce.posterior(fit)"
    )
    assert fit.stderr["p"] is None
    assert "Optima: " in str(fit)
    assert f"(p {share:+.3g} %)" in str(fit)


def test_an_optimum_far_above_is_no_rival(valleys):
    model, data, noise = valleys()
    low = ce.Noise(**{k: noise.level(k) / 3 for k in ("y1", "y2")})  # costs nine times as far apart
    pars = model.parameters()
    search = search_of(model, data, low)
    attempts = attempts_from(search, [np.array([1.0]), np.array([-1.0])])
    optima = distinct_optima(search, attempts, best_of(attempts))
    assert len(optima) == 2
    assert optima[1].cost - optima[0].cost > 3.84
    fit = ce.estimate(model, data, parameters=pars, noise=low, starts=8, seed=1, **REST)
    assert len(fit.optima) >= 2
    assert not any("other optim" in message for message in fit.messages)


def test_optima_are_grouped_by_cost_and_place(valleys):
    model, data, noise = valleys()
    search = search_of(model, data, noise)
    attempts = attempts_from(search, [np.array([value]) for value in (-1.1, 0.9, -0.9, 1.2, 1.0)])
    best = best_of(attempts)
    optima = distinct_optima(search, attempts, best)
    assert [o.starts for o in optima] == [3, 2]
    # as near in place but not in cost, or in cost but not in place, is another one
    nearby = replace(attempts[1], v=attempts[1].v + 1.0)
    assert len(distinct_optima(search, [*attempts, nearby], best)) == 3


def test_the_best_is_a_converged_one_of_the_least_merit(valleys):
    model, data, noise = valleys()
    attempts = attempts_from(search_of(model, data, noise), [np.array([-1.0]), np.array([1.0])])
    assert best_of(attempts) is attempts[1]
    spoilt = replace(
        attempts[1], solution=replace(attempts[1].solution, status="not converged: for the test")
    )
    assert best_of([attempts[0], spoilt]) is attempts[0]
    assert best_of([spoilt]) is spoilt


def test_an_interruption_among_the_neighbours_keeps_the_best(valleys):
    model, data, noise = valleys(start=0.9)
    searches = []

    def stop(iteration, cost, percent):
        searches.append(iteration)
        return searches.count(0) == 2  # the second search: the first neighbour

    fit = ce.estimate(model, data, noise=noise, neighbours=1, **{**REST, "progress": stop})
    assert fit.status == "interrupted"
    assert fit.values["p"] == pytest.approx(LOW.x, abs=1e-5)
    assert sum(o.starts for o in fit.optima) == 2
    assert any(m.startswith("stopped by the user: this is the best of 1 optima so far") for m in fit.messages)


def test_no_neighbours_of_what_is_no_optimum(valleys):
    model, data, noise = valleys()
    fit = ce.estimate(model, data, noise=noise, neighbours=1, max_iterations=1, **REST)
    assert not fit.converged
    assert sum(o.starts for o in fit.optima) == 1


@pytest.mark.parametrize("given", [-1, 0.5, True, "2"])
def test_other_numbers_of_neighbours_are_refused(valleys, refused, given):
    model, data, noise = valleys()
    with refused(
        ce.errors.EstimationError,
        "neighbours is not acceptable",
        seen=repr(given),
        allowed="a whole number >= 0",
        cure="leave neighbours out",
    ):
        ce.estimate(model, data, noise=noise, neighbours=given, **REST)


def test_neighbours_stay_within_the_bounds(valleys):
    model, data, noise = valleys()
    pars = model.parameters()
    pars["p"].set(max=-0.4)
    fit = ce.estimate(model, data, parameters=pars, noise=noise, neighbours=1, **REST)
    assert fit.values["p"] == pytest.approx(HIGH.x, abs=1e-5)
    assert all(o.values["p"] <= -0.4 + 1e-9 for o in fit.optima)


def test_more_neighbours_than_parameters_are_those_there_are(valleys):
    model, data, noise = valleys(start=1.0)
    fit = ce.estimate(model, data, noise=noise, neighbours=7, **REST)
    assert sum(o.starts for o in fit.optima) == 3


def test_where_the_set_is_impossible_drawn_starts_are_searched_from():
    """x' = -k x with a root that has no number below k = 1."""
    b = ce.Blueprint("rooted")
    k, x = b.parameter("k", 0.5, min=0.1, max=5.0), b.state("x")
    b.ode("x", -k * x + 1e-9 * ca.sqrt(k - 1))
    b.output("y", x)
    time = np.arange(100) * 0.02
    y = np.exp(-2 * time) + 0.01 * np.random.default_rng(0).standard_normal(100)
    data = ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=y)
    options = {"noise": ce.Noise(y=0.01), "progress": False}
    with pytest.raises(EstimationError, match="cannot be evaluated at the start values"):
        ce.estimate(b.model(), data, **options)
    fit = ce.estimate(b.model(), data, starts=12, **options)
    assert fit.converged
    assert abs(fit.values["k"] - 2.0) < 4 * fit.stderr["k"]
