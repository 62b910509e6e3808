"""IPOPT on multiple-shooting problems: where it ends, in how many iterations, and how it chooses its Hessian."""

import itertools
from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation import ipopt, nlp_functions
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.spectral_start import SpectralStarts

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
        model, (data,), pars.copy(), KNOWN[two], interval=16, initial=initial, loss=Loss(), ties="substitute",
        method="exact", max_iterations=200, tolerance=1e-9, warm=None, progress=None,
    )  # fmt: skip


def solved(search, start=None, **options):
    """A solution, and the damping and kind of Hessian after each iteration."""
    chosen, steer = [], search.solver._steer

    def noted(gap):
        steer(gap)
        chosen.append((search.problem.damping, search.problem.exact))

    search.solver._steer = noted
    start = search._start(search.pmap.start, first=True) if start is None else start
    return search.solver.solve(start, search.lower, search.upper, **options), chosen


def counted(model, data, truth, noise, signs):
    """The fits from these sign patterns: their ends and their numbers of iterations."""
    ends, counts = [], []
    for factors in signs:
        pars = set_off(model, truth, factors)
        fit = ce.estimate(model, data, parameters=pars, noise=noise, progress=False)
        assert fit.converged
        ends.append(fit.z)
        counts.append(fit.iterations)
    return ends, counts


@pytest.mark.parametrize("signs", [SIGNS[::5], pytest.param(SIGNS, marks=pytest.mark.slow)], ids=len)
def test_sign_patterns_end_at_one_optimum_within_twenty_steps(shaft, shaft_model, monkeypatch, signs):
    monkeypatch.setattr(SpectralStarts, "search", lambda *_, **__: None)
    made = shaft()
    ends, counts = counted(shaft_model(), made.data, made.truth, KNOWN[True], signs)
    np.testing.assert_allclose(ends, np.tile(ends[0], (len(signs), 1)), rtol=1e-5)
    assert max(counts) <= 20


@pytest.mark.slow
def test_so_they_do_with_the_misfire_record(misfire):
    ends, counts = counted(
        ce.two_mass(reciprocating_speed="measured"), misfire(1, 4), ENGINE, ce.Noise(omega=0.1), SIGNS
    )
    np.testing.assert_allclose(ends, np.tile(ends[0], (32, 1)), rtol=1e-4)
    assert max(counts) <= 20


@pytest.mark.parametrize("two", [True, False])
def test_the_end_is_a_point_of_no_slope_without_gaps(shaft, shaft_model, two):
    """By the derivatives of the Lagrangian at the end, which IPOPT's own judgement is no part of."""
    made, model = shaft(two=two), shaft_model(two)
    search = search_of(model, made.data, set_off(model, made.truth, SIGNS[9]), two=two)
    found, _ = solved(search)
    assert found.status == "converged"
    point = search.problem.at(found.x)
    assert point.gap < 1e-9
    jacobian = search.problem.jacobian_pattern.matrix(search.problem.jacobian(found.x)).full()
    np.testing.assert_allclose(point.gradient + jacobian.T @ found.lam_g, 0, atol=1e-8)


def test_the_damping_falls_and_the_exact_hessian_ends_the_search(shaft, shaft_model):
    made, model = shaft(), shaft_model()
    search = search_of(model, made.data, set_off(model, made.truth, SIGNS[13]))
    _, chosen = solved(search)
    damping, exact = zip(*chosen, strict=True)
    assert (damping[0], exact[0]) == (0.03, False)
    assert damping[1] == pytest.approx(0.009)
    assert (damping[-1], exact[-1]) == (0.0, True)
    assert list(exact) == sorted(exact)


@pytest.mark.parametrize("sigma", [(0.05, 0.1), (1.0, 2.0)])
def test_a_start_near_the_optimum_takes_few_exact_steps(shaft, shaft_model, sigma):
    """A thousandth off, quadratic convergence ends in four iterations; at the optimum itself there is none."""
    made, model = shaft(sigma=sigma), shaft_model()
    search = search_of(model, made.data, set_off(model, made.truth, (1.05,) * 5))
    search._weigh(np.array(sigma))
    end, _ = solved(search)
    off = end.x + 1e-3 * np.random.default_rng(0).standard_normal(len(end.x))
    again, chosen = solved(search, off, exact=True)
    assert again.iterations <= 4
    assert all(kind == (0.0, True) for kind in chosen)
    np.testing.assert_allclose(again.x, end.x, atol=1e-7)
    before = search.problem.evaluations
    assert solved(search, again.x, exact=True)[0].iterations == 0
    assert search.problem.evaluations - before <= 1


def test_steps_cut_short_raise_the_damping(shaft, shaft_model):
    made, model = shaft(n=200), shaft_model()
    search = search_of(model, made.data, set_off(model, made.truth, (1,) * 5))
    solver, problem = search.solver, search.problem
    problem.damping, problem.exact, solver._history = 0.01, False, [2.0, 1.0]
    for evaluations, wanted in ((3, 0.1), (2, 0.1), (1, 0.03)):
        problem.evaluations += evaluations
        solver._steer(1.0)
        assert problem.damping == pytest.approx(wanted)
    problem.damping = 0.0
    problem.evaluations += 5
    solver._steer(1.0)
    assert problem.damping == ipopt._LEAST


def test_no_step_is_longer_than_the_linearised_problem_reaches(shaft, shaft_model):
    made, model = shaft(), shaft_model()
    search = search_of(model, made.data, set_off(model, made.truth, (20, 0.05, 20, 0.05, 20)))
    seen, watch = [], search.solver._seen

    def noted(x, cost, gap):
        seen.append(x[: search.problem.nv])
        return watch(x, cost, gap)

    search.solver._seen = noted
    solved(search)
    size = np.where(search.coordinates.log, 1.0, np.maximum(1.0, np.abs(seen[:-1])))
    steps = np.abs(np.diff(seen, axis=0)) / size
    assert 0.5 < steps.max() <= nlp_functions._LONGEST


def test_bounds_and_fixed_initial_states_act(shaft, shaft_model):
    made, model = shaft(), shaft_model()
    pars = set_off(model, made.truth, (1.1, 0.9, 1.1, 1.0, 1.0))
    pars["K_el"].set(110.0, max=115.0)
    pars["C_eng"].set(0.2, min=0.18)
    initial = {"omega_eng": 100.0, "twist": (-0.2, -0.105)}
    fit = ce.estimate(model, made.data, parameters=pars, noise=KNOWN[True], initial=initial, progress=False)
    assert fit.converged
    assert fit.estimates["K_el"].at_bound == "max"
    assert fit.estimates["C_eng"].at_bound == "min"
    assert fit.values["K_el"] == pytest.approx(115.0, rel=1e-6)
    assert fit.initial["shaft"]["omega_eng"].value == 100.0
    # no other point within the bounds is better: the others' slopes vanish, those at bounds point outwards
    held = pars.copy()
    held["K_el"].set(115.0, vary=False)
    held["C_eng"].set(0.18, vary=False)
    less = ce.estimate(model, made.data, parameters=held, noise=KNOWN[True], initial=initial, progress=False)
    assert fit.cost == pytest.approx(less.cost, rel=1e-6)


def test_gauss_newton_steps_are_stopped_by_their_caller(shaft, shaft_model):
    made, model = shaft(n=200), shaft_model()
    search = search_of(model, made.data, set_off(model, made.truth, SIGNS[3]))
    start, seen = search._start(search.pmap.start, first=True), []

    def stop(objective, gap):
        seen.append((objective, gap, search.problem.exact))
        return len(seen) == 4

    end = search.solver.gauss_newton(start, search.lower, search.upper, damping=0.1, stop=stop)
    assert len(seen) == 4
    assert not any(exact for *_, exact in seen)
    assert search.problem.at(end).objective == pytest.approx(seen[-1][0])
    assert seen[-1][0] < seen[0][0]
    # and a search after them is not stopped
    assert search.solver.solve(end, search.lower, search.upper).status == "converged"


@pytest.mark.slow  # test_reported.py names directions
def test_a_curved_valley_that_the_data_do_not_determine_is_named_in_time():
    """Geometry, masses and stiffnesses scale together: the search ends in the valley and says which way it runs."""
    model = ce.two_mass()
    data = ce.read_experiment(DATA / "normal_1200rpm.csv.gz", optional=("omega_load",)).between(0, 0.15)
    pars = model.parameters()
    for name in ("r", "L", "A_p", "m_eq", "p_crank"):
        pars[name].set(vary=True)
    fit = ce.estimate(model, data, parameters=pars, progress=False)
    assert fit.status == "converged"
    assert fit.iterations <= 100
    assert any("r" in direction.text and "m_eq" in direction.text for direction in fit.undetermined)
    assert fit.stderr["r"] is None
