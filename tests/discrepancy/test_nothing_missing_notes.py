"""What is said beside "nothing missing", where that may hide something."""

import importlib
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

import casadi_engine as ce
from casadi_engine.discrepancy.verdict_words import headline, next_step
from tests.effects.test_storage import heated, heating


def swing(noise):
    t = np.arange(len(noise)) * 0.01
    plain = ce.Experiment.from_arrays("swing", time=t, units={"T": "N m"}, T=80 * np.sin(1.5 * t))
    speed = ce.simulate(ce.one_inertia(), plain, initial={"omega_eng": 0.0})["omega"].values + noise
    return ce.Experiment.from_arrays(
        "swing", time=t, units={"T": "N m", "omega": "rad/s"}, T=plain["T"].values, omega=speed
    )


def nothing_of(data, **options):
    return ce.repair(
        ce.one_inertia(), data, effects=["sensor_delay"], starts=1, holdout=0.0, progress=False, **options
    )


def test_an_effect_may_hide_in_coloured_noise():
    white = np.random.default_rng(3).standard_normal(600)
    found = nothing_of(swing(0.1 * lfilter([1.0], [1, -0.9], white)))
    assert found.verdict == "nothing missing"
    assert found.noise.colour
    assert headline(found) == (
        "no effect of the library is missing that these data could show; the residual is coloured, and others may hide "
        "in it"
    )
    assert next_step(found) == "use the model; larger effects than those listed are excluded, others are not"
    assert found.messages[-1] == (
        "what the noise is taken to be is coloured: an effect that the library lacks may hide in it; a level of the "
        "noise that is stated, ce.Noise(...), or colour=False has it judged"
    )


def test_values_count_on_what_is_fixed():
    """What is fixed at a wrong value leaves no gap where others make up for it."""
    pars = ce.one_inertia().parameters()
    pars.fix("J_eng")
    found = nothing_of(swing(0.1 * np.random.default_rng(3).standard_normal(600)), parameters=pars)
    assert found.verdict == "nothing missing"
    assert next_step(found).endswith("are excluded; its values count on what is fixed: J_eng")


def test_a_parameter_at_a_bound_is_told_where_nothing_was_added():
    pars = ce.one_inertia().parameters()
    pars["J_eng"].set(max=float(pars["J_eng"].value) * 0.9998, value=float(pars["J_eng"].value) * 0.9)
    found = nothing_of(swing(0.1 * np.random.default_rng(4).standard_normal(600)), parameters=pars)
    assert found.verdict == "nothing missing"
    assert (
        "J_eng went to a bound: the model may not describe these data, whatever was tested" in found.messages
    )


def test_a_first_fit_that_asks_for_one_more_step_is_given_it(monkeypatch):
    module, asked = importlib.import_module("casadi_engine.discrepancy.first_fit"), []
    real = module.estimate

    def estimate(*arguments, **options):
        fit = real(*arguments, **options)
        asked.append(options.get("warm"))
        why = "not converged: one more step would still lower chi-squared by 0.00124, more than 0.001"
        return replace(fit, status=why) if len(asked) == 1 else fit

    monkeypatch.setattr(module, "estimate", estimate)
    found = nothing_of(swing(0.1 * np.random.default_rng(4).standard_normal(600)))
    assert found.verdict == "nothing missing"
    assert asked[0] is None
    assert asked[1].status.startswith("not converged")


def test_fresh_data_that_four_samples_cannot_describe_are_said():
    """Four samples exclude nothing; that fresh data are far from what they say has to be in the headline."""
    data, fresh = heating(1, "data", 8.0), heating(2, "fresh", 8.0)
    power, warm = data["P"], data["y"]
    short = ce.Experiment.from_arrays(
        "data", time=warm.time[:4], units={"P": "W", "y": "K"}, P=power.values[:4], y=warm.values[:4]
    )
    found = ce.repair(heated(), short, fresh=fresh, effects=["coulomb_friction"], progress=False)
    assert found.verdict == "nothing missing"
    assert headline(found).startswith(
        "nothing is missing that these data could show, but the model does not describe the fresh data, and these "
        "records are too short to say why: chi2/N "
    )
    assert next_step(found).startswith(
        "record more before you use the model, or give the fresh records as data"
    )
