"""Short refits against whole ones."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.chi_squared import chi_squared
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.discrepancy.quick_refit import ShortRefits, _closed, _ended
from casadi_engine.discrepancy.refit import Refitter, addition
from casadi_engine.discrepancy.screening import screen

LEVELS = {"omega": 0.05, "omega_load": 0.1}


@pytest.fixture(scope="module")
def case(shaft):
    data = shaft.data(hidden=lambda t, x: 0.8 * np.sign(x[1] - x[0]) * np.array([1, -1]))
    model = shaft.model
    pars = model.parameters()
    pars["C_el"].set(max=0.3)
    noise = ce.Noise(**LEVELS)
    fit = ce.estimate(model, data, parameters=pars, noise=noise, progress=False)
    refitter = Refitter(model, pars, (data,), noise, {})
    screened = screen(fit, ["coulomb_friction", "cubic_stiffness"])
    return fit, refitter, screened


@pytest.fixture(scope="module")
def whole(case):
    """The refit to the end with friction in the coupling."""
    fit, refitter, screened = case
    return refitter(fit, [added(screened, "coulomb_friction", "coupling")])


def added(screened, effect, port, size=None):
    k = next(k for k, c in enumerate(screened.candidates) if c.key == (effect, port))
    amplitude = float(screened.scores.amplitude[k]) if size is None else size
    return addition(screened.candidates[k], amplitude, float(screened.scores.drop[k]))


def test_a_short_refit_ends_where_a_whole_one_does(case, whole):
    fit, refitter, screened = case
    one = added(screened, "coulomb_friction", "coupling")
    short = ShortRefits(refitter, LEVELS)([one], fit, 30)
    assert short.settled
    assert short.cost == pytest.approx(whole.cost, abs=0.5)
    assert short.values[one.amplitude] == pytest.approx(whole.values[one.amplitude], rel=0.02)


def test_it_starts_from_the_parameters_own_values_too(case, whole):
    _, refitter, screened = case
    one = added(screened, "coulomb_friction", "coupling", size=0.1)
    shorts = ShortRefits(refitter, LEVELS)
    first = shorts([one], None, 6)
    on = shorts([one], first, 30)
    assert on.settled
    assert on.cost <= first.cost + 0.5
    assert on.cost == pytest.approx(whole.cost, abs=0.5)


def test_its_cost_is_that_of_the_simulation_from_its_first_states(case):
    fit, refitter, screened = case
    one = added(screened, "cubic_stiffness", "coupling")
    shorts = ShortRefits(refitter, LEVELS)
    short = shorts([one], fit, 2)
    assert chi_squared(shorts.null_at([one], short), LEVELS) == pytest.approx(short.cost, rel=1e-4)


def test_a_fit_at_a_bound_is_where_its_null_model_is(case):
    fit, _, _ = case
    assert chi_squared(null_model(fit), LEVELS) == pytest.approx(fit.cost, rel=1e-4)
    assert {name for name in fit.free if fit.estimates[name].at_bound is not False} == {"C_el"}


def test_a_model_that_fails_gives_none(case):
    _, refitter, screened = case
    one = added(screened, "cubic_stiffness", "coupling", size=1e30)
    assert ShortRefits(refitter, LEVELS)([one], None, 3) is None


def test_a_hopeless_one_gives_up(case):
    fit, refitter, screened = case
    one = added(screened, "cubic_stiffness", "coupling")
    shorts = ShortRefits(refitter, LEVELS)
    assert not shorts([one], None, 20, worst=1e-3).settled
    assert shorts([one], fit, 20, worst=fit.cost).settled


def test_a_long_record_is_not_integrated_in_any_number_of_steps(case, whole, monkeypatch):
    """A friction so large at the start that it asks for many steps is started from less, and found all the same."""
    _, refitter, screened = case
    refitter = Refitter(
        refitter.model, refitter.parameters, refitter.data, refitter.noise
    )  # no corner narrowed yet
    one = added(screened, "coulomb_friction", "coupling", size=300.0)
    monkeypatch.setattr("casadi_engine.discrepancy.quick_refit._LONG", 100)
    monkeypatch.setattr("casadi_engine.discrepancy.quick_refit._STEPS", 1600)  # 4 to a sample
    shorts = ShortRefits(refitter, LEVELS)
    assert shorts.long
    search = shorts._search([one])
    x = search._start(search.pmap.start, first=True)
    with pytest.raises(FloatingPointError, match="more integration steps than are allowed"):
        search.problem.at(x)
    short = shorts([one], None, 30)
    assert search.records[0].propagator.substeps <= 4
    assert search.records[0].single().propagator.most == 4
    assert short.cost == pytest.approx(whole.cost, abs=0.5)
    plain = ShortRefits(refitter, LEVELS)
    monkeypatch.setattr("casadi_engine.discrepancy.quick_refit._LONG", 4000)
    assert not plain.long
    assert not plain._search([one]).records[0].limited


def test_gaps_of_a_settled_point_are_closed_and_the_simulation_is_as_good(case):
    """Small gaps at the nodes add up along the record; from the simulated nodes a few steps more reach the optimum."""
    fit, refitter, screened = case
    one = added(screened, "coulomb_friction", "coupling")
    shorts = ShortRefits(refitter, LEVELS)
    short = shorts([one], fit, 30)
    search = shorts._search([one])
    x = short.x.copy()
    x[search.problem.nv :] += 1e-5 * np.random.default_rng(0).standard_normal(len(x) - search.problem.nv)
    assert search.problem.at(x).gap > 1e-6
    closed, settled = _closed(search, x)
    assert settled
    assert _ended(search, closed, settled).cost == pytest.approx(short.cost, abs=0.5)
