"""The first phase of a search: condensed steps against IPOPT alone, their number and their last convergence."""

import itertools
from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation.descent import Descender, Descent, gap_of
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.search import Search

DATA = Path(__file__).parents[2] / "data"

NAMES = ("J_eng", "J_load", "K_el", "C_el", "C_eng")
SIGNS = list(itertools.product((0.6, 1.4), repeat=5))
ENGINE = {"J_eng": 1 / 2.557, "J_load": 1 / 5.646, "K_el": 1992.0, "C_el": 2.5, "C_eng": 0.1541}
KNOWN = {True: ce.Noise(omega=0.05, omega_load=0.1), False: ce.Noise(omega=0.05)}


def set_off(model, truth, factors):
    pars = model.parameters()
    for name, factor in zip(NAMES, factors, strict=True):
        pars[name].set(truth[name] * factor)
    return pars


def search_of(model, data, pars, *, two=True, initial=None):
    return Search(
        model, (data,), pars.copy(), KNOWN[two], interval="auto", initial=initial, loss=Loss(), ties="substitute",
        method="exact", max_iterations=200, tolerance=1e-9, warm=None, progress=None,
    )  # fmt: skip


def descended(search, *, exact=False):
    """The first phase alone: its end, and the points that it saw."""
    points = []

    def watch(point):
        points.append(point)
        return False

    search.problem.damping = 0.1
    start = search._start(search.pmap.start, first=True)
    end = Descender(search.problem, search.lower, search.upper).run(start, watch, 60, exact=exact)
    return end, points


@pytest.fixture
def ipopt_alone(monkeypatch):
    """Make the first phase give up at once."""

    def nothing(self, start, watch, limit, *, exact=False):
        return Descent(start, 0, settled=False)

    return lambda: monkeypatch.setattr(Descender, "run", nothing)


@pytest.mark.parametrize("two", [True, False])
@pytest.mark.parametrize("factors", [SIGNS[0], SIGNS[13], SIGNS[31]])
def test_it_ends_where_ipopt_alone_does(shaft, shaft_model, ipopt_alone, two, factors):
    made, model = shaft(two=two), shaft_model(two)
    pars = set_off(model, made.truth, factors)
    options = {"parameters": pars, "noise": KNOWN[two], "progress": False}
    fit = ce.estimate(model, made.data, **options)
    ipopt_alone()
    alone = ce.estimate(model, made.data, **options)
    assert fit.converged
    assert alone.converged
    assert fit.cost == pytest.approx(alone.cost, rel=1e-9)
    np.testing.assert_allclose(fit.z, alone.z, rtol=1e-6)
    np.testing.assert_allclose(fit.covariance, alone.covariance, rtol=1e-4, atol=1e-12)


def counted(model, data, truth, noise):
    """The fits from all sign patterns: their ends and their numbers of iterations."""
    ends, counts = [], []
    for factors in SIGNS:
        pars = set_off(model, truth, factors)
        fit = ce.estimate(model, data, parameters=pars, noise=noise, progress=False)
        assert fit.converged
        ends.append(fit.z)
        counts.append(fit.iterations)
    return ends, counts


def test_all_sign_patterns_end_at_one_optimum_within_twenty_steps(shaft, shaft_model):
    made = shaft()
    ends, counts = counted(shaft_model(), made.data, made.truth, KNOWN[True])
    np.testing.assert_allclose(ends, np.tile(ends[0], (32, 1)), rtol=1e-5)
    assert max(counts) <= 20


def test_so_they_do_with_the_misfire_record(misfire):
    ends, counts = counted(
        ce.two_mass(reciprocating_speed="measured"), misfire(1, 4), ENGINE, ce.Noise(omega=0.1)
    )
    np.testing.assert_allclose(ends, np.tile(ends[0], (32, 1)), rtol=1e-4)
    assert max(counts) <= 20


@pytest.mark.parametrize("sigma", [(0.05, 0.1), (1.0, 2.0)])
def test_exact_steps_converge_quadratically(shaft, shaft_model, sigma):
    made, model = shaft(sigma=sigma), shaft_model()
    search = search_of(model, made.data, set_off(model, made.truth, (1.05,) * 5))
    search._weigh(np.array(sigma))
    end, _ = descended(search)
    assert end.settled
    descender = Descender(search.problem, search.lower, search.upper)
    x = end.x + 1e-3 * np.random.default_rng(0).standard_normal(len(end.x))
    search.problem.exact = True
    search.problem.forget()
    away = []
    for _ in range(4):
        x = descender._newton(search.problem.at(x))[0].x
        away.append(float(np.abs(x - end.x).max()))
    assert away[0] > 1e-5
    assert away[1] < 10 * away[0] ** 2
    assert away[2] < 1e-7
    assert away[3] < 1e-7


def test_damped_gauss_newton_steps_converge_by_a_share_only(shaft, shaft_model):
    made, model = shaft(), shaft_model()
    search = search_of(model, made.data, set_off(model, made.truth, (1.05,) * 5))
    end, _ = descended(search)
    problem, x, away = search.problem, end.x + 1e-3, []
    problem.damping, problem.exact = 0.1, False
    problem.forget()
    descender = Descender(problem, search.lower, search.upper)
    for _ in range(3):
        x = descender._gauss_newton(problem.at(x))[0].x
        away.append(float(np.abs(x[:5] - end.x[:5]).max()))
    assert 1e-3 < away[2] / away[1] < 0.5


def test_the_gaps_are_closed_at_the_end(shaft, shaft_model):
    made, model = shaft(), shaft_model()
    search = search_of(model, made.data, set_off(model, made.truth, SIGNS[9]))
    end, points = descended(search)
    assert gap_of(points[0], 0) > 1e-2
    assert end.settled
    assert gap_of(search.problem.at(end.x), 0) < 1e-9
    # and the gradient of the Lagrangian vanishes: what is left of it over a step is rounding
    descender = Descender(search.problem, search.lower, search.upper)
    search.problem.exact = True
    search.problem.forget()
    quadratic = descender._quadratic(search.problem.at(end.x))
    assert np.abs(quadratic.reduced.newton()).max() < 1e-6


def test_bounds_and_fixed_initial_states_act_as_in_ipopt(shaft, shaft_model, ipopt_alone):
    made, model = shaft(), shaft_model()
    pars = set_off(model, made.truth, (1.1, 0.9, 1.1, 1.0, 1.0))
    pars["K_el"].set(110.0, max=115.0)
    pars["C_eng"].set(0.2, min=0.18)
    initial = {"omega_eng": 100.0, "twist": (-0.2, -0.105)}
    options = {"parameters": pars, "noise": KNOWN[True], "initial": initial, "progress": False}
    end, _ = descended(search_of(model, made.data, pars, initial=initial))
    assert end.settled
    fit = ce.estimate(model, made.data, **options)
    ipopt_alone()
    alone = ce.estimate(model, made.data, **options)
    for one in (fit, alone):
        assert one.converged
        assert one.estimates["K_el"].at_bound == "max"
        assert one.estimates["C_eng"].at_bound == "min"
    assert fit.initial["shaft"]["omega_eng"].value == 100.0
    assert fit.cost == pytest.approx(alone.cost, rel=1e-7)
    np.testing.assert_allclose(fit.z, alone.z, rtol=1e-5)
    for state, estimate in fit.initial["shaft"].items():
        assert alone.initial["shaft"][state].value == pytest.approx(estimate.value, rel=1e-5, abs=1e-7)


def test_a_start_that_cannot_be_evaluated_is_left_to_ipopt(shaft, shaft_model):
    made, model = shaft(n=200), shaft_model()
    search = search_of(model, made.data, set_off(model, made.truth, (1,) * 5))
    start = np.full(search.problem.size, np.nan)
    end = Descender(search.problem, search.lower, search.upper).run(start, lambda point: False, 10)
    assert (end.steps, end.settled, end.stopped) == (0, False, False)


def test_a_stop_and_a_limit_are_kept(shaft, shaft_model):
    made, model = shaft(n=200), shaft_model()
    search = search_of(model, made.data, set_off(model, made.truth, SIGNS[3]))
    start = search._start(search.pmap.start, first=True)
    descender = Descender(search.problem, search.lower, search.upper)
    seen = []
    end = descender.run(start, lambda point: seen.append(point) or len(seen) == 3, 60)
    assert (end.stopped, end.steps, len(seen)) == (True, 2, 3)
    end = descender.run(start, lambda point: False, 2)
    assert (end.stopped, end.settled, end.steps) == (False, False, 2)


def test_a_curved_valley_that_the_data_do_not_determine_is_named_in_time():
    """Geometry, masses and stiffnesses scale together: the search ends in the valley and says which way it runs."""
    model = ce.two_mass()
    data = ce.read_experiment(DATA / "normal_1200rpm.csv.gz", optional=("omega_load",)).between(0, 0.15)
    pars = model.parameters()
    for name in ("r", "L", "A_p", "m_eq", "p_crank"):
        pars[name].set(vary=True)
    fit = ce.estimate(model, data, parameters=pars, progress=False)
    assert fit.status == "converged"
    assert fit.iterations <= 100  # IPOPT alone takes above 200
    assert any("r" in direction.text and "m_eq" in direction.text for direction in fit.undetermined)
    assert fit.stderr["r"] is None
