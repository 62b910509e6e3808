"""Trials of every effect: what the linearisation in an effect's place promises, against refits; swaps."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.chi_squared import chi_squared
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.discrepancy.quick_refit import ShortRefits
from casadi_engine.discrepancy.refit import Refitter, addition
from casadi_engine.discrepancy.screening import screen
from casadi_engine.discrepancy.search import Search, Station
from casadi_engine.discrepancy.start import Start
from casadi_engine.discrepancy.trials import _Maker, driven, make_trials, trials_beside

LEVELS = {"omega": 0.05, "omega_load": 0.1}
NOISE = ce.Noise(**LEVELS)
EFFECTS = ["coulomb_friction", "viscous_friction", "quadratic_drag", "constant_torque", "cubic_stiffness"]


def prepared(shaft, hidden, effects, **bounds):
    """fit without effects, refitter, scores."""
    data = shaft.data(hidden=hidden)
    pars = shaft.model.parameters()
    for name, bound in bounds.items():
        pars[name].set(**bound)
    fit = ce.estimate(shaft.model, data, parameters=pars, noise=NOISE, progress=False)
    return fit, Refitter(shaft.model, pars, (data,), NOISE, {}), screen(fit, effects)


@pytest.fixture(scope="module")
def drag(shaft):
    """A drag of the load so large that the fit without it goes to a bound."""
    return prepared(shaft, lambda t, x: np.array([0, -2e-3 * x[1] * abs(x[1])]), EFFECTS, K_el={"max": 160})


@pytest.fixture(scope="module")
def tried(drag):
    fit, refitter, screened = drag
    return make_trials(screened, fit, (), ShortRefits(refitter, LEVELS))


def test_the_fit_without_the_effect_is_wrong(drag):
    fit, _, _ = drag
    assert fit.cost / fit.n > 2


def test_the_best_trial_is_the_truth(drag, tried):
    fit, _, _ = drag
    best = tried.order[0]
    assert best.added.candidate.key == ("quadratic_drag", "load")
    assert best.short.values[best.added.amplitude] == pytest.approx(2e-3, rel=0.05)
    assert best.cost < fit.n + 4 * np.sqrt(2 * fit.n)
    assert tried.base == pytest.approx(fit.cost, rel=1e-4)


def test_what_is_promised_in_the_place_of_the_best_is_what_refits_bring(shaft):
    fit, refitter, screened = prepared(
        shaft, lambda t, x: np.array([0, 1.0 * (t > 0.8)]), ["load_step", "constant_torque", "sensor_offset"]
    )
    tried = make_trials(screened, fit, (), ShortRefits(refitter, LEVELS))
    best = tried.order[0]
    assert best.added.candidate.effect == "load_step"
    others = [one for one in tried.order if one is not best and one.added.candidate.effect != "load_step"]
    assert len(others) == 2
    for one in others:
        whole = refitter(fit, [one.added], start=one.short)
        promised = tried.foreseen[one.added.candidate.key]
        assert promised - best.cost == pytest.approx(whole.cost - best.cost, rel=0.1, abs=3)


def test_a_trial_that_ended_elsewhere_is_not_sure(tried):
    best = tried.order[0]
    assert tried.sure(best)
    assert tried.least(best) == best.cost
    for one in tried.best.values():
        assert tried.least(one) <= one.cost
        assert tried.sure(one) or not one.short.settled or one.cost > tried.foreseen[one.added.candidate.key]


def test_a_law_that_bends_does_not_promise_others_too_much(shaft):
    # a dead zone: its slope at its size takes away less than it explains
    fit, refitter, screened = prepared(
        shaft,
        lambda t, x: -120.0 * np.clip(x[2], -0.03, 0.03) * np.array([1, -1]),
        ["backlash", "coulomb_friction", "cubic_stiffness", "constant_torque"],
    )
    tried = make_trials(screened, fit, (), ShortRefits(refitter, LEVELS))
    best = tried.order[0]
    assert best.added.candidate.key == ("backlash", "coupling")
    far = [one for one in tried.best.values() if one.cost > best.cost + 100]
    assert all(tried.least(one) > best.cost + 20 for one in far)


def test_one_right_effect_replaces_two_wrong_ones(shaft):
    fit, refitter, screened = prepared(
        shaft,
        lambda t, x: 0.8 * np.sign(x[1] - x[0]) * np.array([1, -1]),
        ["coulomb_friction", "cubic_stiffness", "sensor_delay"],
    )

    def added(effect, port):
        k = next(k for k, c in enumerate(screened.candidates) if c.key == (effect, port))
        scores = screened.scores
        return k, addition(screened.candidates[k], float(scores.amplitude[k]), float(scores.drop[k]))

    (k, one), (_, two) = added("cubic_stiffness", "coupling"), added("sensor_delay", "sensor_omega")
    first = refitter(fit, [one])
    both = refitter(first, [one, two])
    search = Search(
        refitter, lambda f: screen(f, ["coulomb_friction", "cubic_stiffness", "sensor_delay"]), 4, str
    )
    search._shorts = ShortRefits(refitter, LEVELS)
    search.stations = [Station(fit, (), screened), Station(first, (one,), search.screen(first), k)]
    pair = Station(both, (one, two), search.screen(both))
    assert search._swapped(pair)
    assert len(search.stations) == 2
    last = search.stations[-1]
    assert [e.candidate.key for e in last.effects] == [("coulomb_friction", "coupling")]
    assert last.fit.values["coupling.coulomb_friction.torque"] == pytest.approx(0.8, rel=0.1)
    assert search.rounds[-1].dropped == (one.label, two.label)


def test_two_right_effects_are_not_replaced_by_one(shaft):
    effects = ["coulomb_friction", "load_step", "sensor_offset"]
    fit, refitter, _ = prepared(
        shaft,
        lambda t, x: np.array([1, -1]) * 0.8 * np.sign(x[1] - x[0]) + np.array([0, 1.5 * (t > 0.8)]),
        effects,
    )
    search = Search(refitter, lambda f: screen(f, effects), 4, lambda _: None)
    search.run(fit)
    keys = {e.candidate.effect for e in search.stations[-1].effects}
    assert keys == {"coulomb_friction", "load_step"}


def test_trials_beside_a_point_keep_the_better_ones(drag, tried):
    fit, refitter, screened = drag
    best = tried.order[0]
    whole = refitter(fit, [best.added], start=best.short)
    shorts = ShortRefits(refitter, LEVELS)
    again = trials_beside(tried, screened, fit, (), shorts, whole, [best.added])
    assert {key: one.cost for key, one in again.best.items() if one.cost > tried.best[key].cost} == {}
    assert chi_squared(null_model(whole), LEVELS) == pytest.approx(best.cost, abs=1)


def test_a_long_record_is_tried_less_and_finds_the_same(shaft, monkeypatch):
    """From the parameters' own values first, where the null is at a bound; rivals in the place of the best alone."""
    hidden = lambda t, x: np.array([0, -2e-3 * x[1] * abs(x[1])])  # noqa: E731
    fit, refitter, screened = prepared(shaft, hidden, EFFECTS, K_el={"min": 115})
    assert driven(fit)
    tried = make_trials(screened, fit, (), ShortRefits(refitter, LEVELS))
    monkeypatch.setattr("casadi_engine.discrepancy.quick_refit._LONG", 100)
    monkeypatch.setattr("casadi_engine.discrepancy.trials._FEW", 1)
    shorts = ShortRefits(refitter, LEVELS)
    asked = []

    def counted(effects, warm, steps, **options):
        asked.append((effects[-1].candidate.key, warm))
        return ShortRefits.__call__(shorts, effects, warm, steps, **options)

    class Counted:
        def __getattr__(self, name):
            return getattr(shorts, name)

        __call__ = staticmethod(counted)

    made = make_trials(screened, fit, (), Counted())
    assert asked[0][1] is None
    # one from there explains all: none starts from the optimum at a bound
    assert not any(warm is fit for _, warm in asked)
    assert made.order[0].added.candidate.key == tried.order[0].added.candidate.key
    assert made.order[0].cost == pytest.approx(tried.order[0].cost, abs=0.5)

    def alike(trials):
        limit = trials.order[0].cost + 12
        return {key for key, one in trials.best.items() if trials.least(one) < limit}

    assert alike(made) == alike(tried)


def test_what_explains_all_at_one_port_is_tried_at_the_others_from_there(drag):
    fit, refitter, screened = drag
    shorts = ShortRefits(refitter, LEVELS)
    made = _Maker(screened, fit, (), shorts, chi_squared(screened.null, LEVELS))
    made.from_own_values()
    best = min(made.best.values(), key=lambda one: one.cost)
    assert best.added.candidate.key == ("quadratic_drag", "load")
    made.best = {best.added.candidate.key: best}
    made._siblings()
    assert set(made.best) == {("quadratic_drag", "load"), ("quadratic_drag", "engine")}
    other = made.best["quadratic_drag", "engine"]
    assert other.short.values[other.added.amplitude] > 0
    assert other.cost > best.cost


def test_unsettled_trials_are_tried_from_the_best_where_no_promise_counts(drag, tried):
    fit, refitter, screened = drag
    shorts = ShortRefits(refitter, LEVELS)
    made = _Maker(screened, fit, (), shorts, tried.base)
    best = tried.order[0]
    made.best = {best.added.candidate.key: best}
    seen = made.foreseen(made.own_values(), shorts.first_states(()))
    made._unsettled_from(seen, Start(best.short.values), best.added.candidate.key)
    assert len(made.best) > 3
    assert made.best[best.added.candidate.key] is best
    assert all(one.cost >= best.cost for one in made.best.values())
