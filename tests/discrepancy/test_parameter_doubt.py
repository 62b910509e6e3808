"""At another speed errors of the parameters may be larger than the noise of fresh data: no sign of missing physics."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.deadline import Deadline, TimeUp, ask
from casadi_engine.discrepancy import fresh_fits
from casadi_engine.discrepancy.fresh import residuals, side
from casadi_engine.discrepancy.fresh_fits import held_fit
from casadi_engine.discrepancy.noise_choice import NoiseChoice
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.discrepancy.parameter_doubt import doubted, pooled, within_errors
from casadi_engine.discrepancy.start import Start
from casadi_engine.errors import EstimationError

NOISE = NoiseModel({"omega": 0.1})


def record(name, torque, seed, model=None):
    t = np.arange(600) * 0.01
    plain = ce.Experiment.from_arrays(name, time=t, units={"T": "N m"}, T=torque(t))
    truth = ce.one_inertia() if model is None else model
    speed = ce.simulate(truth, plain, initial={"omega_eng": 0.0})["omega"].values
    speed = speed + 0.1 * np.random.default_rng(seed).standard_normal(600)
    return ce.Experiment.from_arrays(
        name, time=t, units={"T": "N m", "omega": "rad/s"}, T=torque(t), omega=speed
    )


@pytest.fixture(scope="module")
def fit():
    """A fit whose record hardly tells the damping."""
    data = record("fast", lambda t: 4 * np.sin(9 * t), 0)
    return ce.estimate(ce.one_inertia(), data, noise=ce.Noise(omega=0.1), progress=False)


def sides(fit, fresh):
    held = held_fit(fit, fresh, noise=NOISE)
    pairs, choice = [(held, null_model(held))], NoiseChoice(NOISE)
    return tuple(side(pairs, choice, source=source).whiteness_p["fresh"]["omega"] for source in (None, fit))


def test_errors_of_parameters_are_no_colour(fit):
    plain, beside = sides(fit, record("fresh", lambda t: 40 + 0 * t, 1))
    assert plain < 1e-6
    assert beside > 0.05


def misled(fit, monkeypatch):
    """A fresh record, its right fit and first states, and the wrong ones that a search over windows is to end at."""
    fresh = record("fresh", lambda t: 4 * np.sin(9 * t), 1)
    right = held_fit(fit, fresh, noise=NOISE)
    first = {name: one.value for name, one in right.initial["fresh"].items()}
    wrong = Start(right.values, {"fresh": {name: value + 30 for name, value in first.items()}}, {}, True)
    monkeypatch.setattr(fresh_fits, "first_states_on", lambda *_, **__: wrong)
    return fresh, right, first, wrong


def test_first_states_of_another_structure_lead_out_of_a_wrong_optimum(fit, monkeypatch):
    """The search over windows had ended, and said that it had, where a fermenter has no substrate."""
    fresh, right, first, _ = misled(fit, monkeypatch)
    asked, real = [], fresh_fits.estimate

    def estimate(*arguments, **options):
        asked.append(options["warm"])
        if options["warm"] is None:
            raise EstimationError("cold starts fail")
        return real(*arguments, **options)

    monkeypatch.setattr(fresh_fits, "estimate", estimate)
    held = held_fit(fit, fresh, noise=NOISE, known=first)
    assert held.cost == pytest.approx(right.cost, rel=1e-6)
    assert asked[1].initial["fresh"] == first
    # as a step on the way to where an event happens, one start is enough
    asked.clear()
    assert held_fit(fit, fresh, noise=NOISE, known=first, once=True).cost > 10 * right.cost
    assert len(asked) == 1


@pytest.mark.parametrize("outcome", ["fails", "costs too much"])
def test_first_states_that_cannot_be_simulated_from_are_no_start(fit, monkeypatch, outcome):
    """They had taken all the work that was allowed, where those of another structure needed next to none."""
    fresh, right, first, wrong = misled(fit, monkeypatch)
    asked, real = [], fresh_fits.estimate

    def estimate(*arguments, **options):
        asked.append(options["warm"])
        if options["warm"] is not None and options["warm"].initial == wrong.initial:
            if outcome == "fails":
                raise EstimationError("no value there")
            for _ in range(2000):
                ask(1e4)
        return real(*arguments, **options)

    monkeypatch.setattr(fresh_fits, "estimate", estimate)
    with Deadline(work=1e7, best=True) as limit:
        held = held_fit(fit, fresh, noise=NOISE, known=first)
    assert held.cost == pytest.approx(right.cost, rel=1e-6)
    assert asked[1].initial["fresh"] == first
    assert [start.initial for start in asked[1:] if start is not None].count(wrong.initial) == 0
    assert limit.done < 1e7
    with Deadline(work=10.0), pytest.raises(TimeUp):  # nothing is left for another start
        held_fit(fit, fresh, noise=NOISE)


def test_two_searches_that_end_at_one_optimum_need_no_third_but_for_what_no_output_shows(fit, monkeypatch):
    """A run that no first state describes was searched from every start, for two fifths of a repair."""
    lossy = ce.one_inertia().with_effect(ce.effects.CoulombFriction(), at="engine", values={"torque": 3.0})
    fresh = record("fresh", lambda t: 4 * np.sin(9 * t), 1, model=lossy)
    known = {
        name: one.value + 1.0 for name, one in held_fit(fit, fresh, noise=NOISE).initial["fresh"].items()
    }
    asked, real = [], fresh_fits.estimate

    def estimate(*arguments, **options):
        asked.append(options["warm"])
        return real(*arguments, **options)

    monkeypatch.setattr(fresh_fits, "estimate", estimate)
    held = held_fit(fit, fresh, noise=NOISE, known=known)
    assert held.cost > 2 * held.n
    assert asked[1].initial["fresh"] == known  # behind the simulation from where windows had ended
    assert None not in asked
    assert len(asked) == 3


def test_what_no_parameter_explains_is_still_seen(fit):
    model = ce.one_inertia()
    lossy = model.with_effect(ce.effects.CoulombFriction(), at="engine", values={"torque": 3.0})
    _, beside = sides(fit, record("fresh", lambda t: 40 * np.sin(3 * t), 1, lossy))
    assert beside < 1e-6


def test_slopes_are_those_of_the_parameters_and_fresh_initial_states(fit):
    fresh = record("fresh", lambda t: 40 + 0 * t, 1)
    held = held_fit(fit, fresh, noise=NOISE)
    null = doubted(fit, held)
    assert null.turn.shape[1] == len(fit.free)
    slopes = null.records[0].slopes["omega"]
    assert slopes.shape == (600, len(fit.free) + 1)
    name = fit.free[0]
    model = ce.one_inertia()

    def speed(value):
        pars = model.parameters()
        for key, own in fit.values.items():
            pars[key].set(value if key == name else own)
        start = held.initial["fresh"]["omega_eng"].value
        run = ce.simulate(model, fresh, parameters=pars, initial={"omega_eng": start})
        return run["omega"].values

    value, step = fit.values[name], 1e-4 * abs(fit.values[name])
    brute = (speed(value + step) - speed(value - step)) / (2 * step) * null.turn[0, 0]
    assert np.allclose(slopes[:, 0], brute, atol=1e-5 * np.abs(brute).max())


def test_an_event_that_does_not_act_has_no_error(fit):
    model = ce.one_inertia().with_effect(
        ce.effects.LoadStep(), at="engine", values={"torque": 3.0, "time": 2.0}
    )
    data = record("fast", lambda t: 4 * np.sin(9 * t), 0, model)
    found = ce.estimate(model, data, noise=ce.Noise(omega=0.1), progress=False)
    amplitude = next(name for name in found.free if name.endswith(".torque"))
    held = held_fit(
        found,
        record("fresh", lambda t: 40 + 0 * t, 1),
        noise=NOISE,
        idle=[SimpleNamespace(key="engine.load_step", amplitude=amplitude)],
    )
    assert held.values[amplitude] == 0
    assert held.free == ()
    null = doubted(found, held)
    place = found.free.index(amplitude)
    assert not np.any(null.turn[place])


def damped(name, damping, seed):
    """A run-up from rest by the closed form of one inertia of 0.4 kg m2 under 2 N m."""
    t = np.arange(500) * 0.01
    speed = 2 / damping * (1 - np.exp(-damping * t / 0.4)) + 0.1 * np.random.default_rng(
        seed
    ).standard_normal(500)
    return ce.Experiment.from_arrays(
        name, time=t, units={"T": "N m", "omega": "rad/s"}, hold="zero", T=np.full(500, 2.0), omega=speed
    )


def test_a_parameter_that_varies_by_experiment_is_found_on_fresh_data():
    """It was zero there once, with a chi-squared per sample of hundreds of thousands."""
    model = ce.one_inertia()
    pars = model.parameters()
    pars.vary_by_experiment("C_eng")
    data = [damped("a", 0.4, 1), damped("b", 0.6, 2)]
    fit = ce.estimate(model, data, parameters=pars, noise=ce.Noise(omega=0.1), progress=False)
    fresh = held_fit(fit, damped("c", 0.5, 3), noise=NOISE)
    assert fresh.values["C_eng@c"] == pytest.approx(0.5, abs=0.01)
    assert fresh.values["J_eng"] == fit.values["J_eng"]
    assert fresh.cost / fresh.n == pytest.approx(1, abs=0.2)
    known = held_fit(fit, damped("b", 0.6, 4), noise=NOISE)
    assert known.values["C_eng"] == fit.values["C_eng@b"]
    null = doubted(fit, fresh)
    assert null.turn.shape[1] == 2
    split = within_errors(fit, null, residuals([null], NOISE))
    assert split.dof == 1  # of the inertia alone: the damping is free there
    assert pooled([split], 1.0)[1] > 0.001


@pytest.fixture(scope="module")
def gripped():
    """A fit whose integrator takes several steps to a sample, for a corner that is passed quickly, and fresh data."""
    model = ce.one_inertia().with_effect(
        ce.effects.CoulombFriction(width=0.02), at="engine", values={"torque": 3.0}
    )
    first, fresh = (
        record(name, lambda t: 6 * np.sin(3 * t), k, model) for k, name in enumerate(("one", "fresh"))
    )
    fit = ce.estimate(model, first, noise=ce.Noise(omega=0.1), progress=False)
    return fit, held_fit(fit, fresh, noise=NOISE)


def test_fresh_data_are_gone_through_by_the_steps_of_their_fit(gripped):
    """By fewer of them the same equations may have no states at all."""
    fit, held = gripped
    about = held.integration["fresh"]
    finer = replace(held, integration={"fresh": replace(about, substeps=4 * about.substeps)})
    one, other = null_model(finer), doubted(fit, finer)
    assert not np.array_equal(one.records[0].residual["omega"], null_model(held).records[0].residual["omega"])
    np.testing.assert_array_equal(one.records[0].residual["omega"], other.records[0].residual["omega"])


def test_without_slopes_all_of_the_gap_stands_for_itself(gripped, monkeypatch):
    fit, held = gripped
    pairs, choice = [(held, null_model(held))], NoiseChoice(NOISE)

    def fails(*_):
        raise FloatingPointError("the model's state is not finite here")

    monkeypatch.setattr("casadi_engine.discrepancy.fresh.doubted", fails)
    plain, told = side(pairs, choice), side(pairs, choice, source=fit)
    assert told.gap == plain.gap
    assert told.whiteness_p == plain.whiteness_p
    assert told.within_errors is None
