"""A large effect colours the residual of the model that lacks it: on a long record its refit tells sooner than a search
for the colour, and where the noise itself is coloured that search goes on."""

import numpy as np
import pytest
from scipy.signal import lfilter

import casadi_engine as ce
from casadi_engine.discrepancy.noise_choice import _LONG, noise_left
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.discrepancy.refit import Refitter
from casadi_engine.discrepancy.screening import coloured, screen, screen_in_turn
from casadi_engine.discrepancy.search import Search
from casadi_engine.experiment.decimation import decimated

EFFECTS = ["coulomb_friction", "quadratic_drag", "constant_torque"]
SAMPLES = 2400


def record(friction, noise):
    t = np.arange(len(noise)) * 0.01
    torque = 80 * np.sin(1.5 * t)
    plain = ce.Experiment.from_arrays("swing", time=t, units={"T": "N m"}, T=torque)
    model = ce.one_inertia().with_effect(
        ce.effects.CoulombFriction(), at="engine", values={"torque": friction}
    )
    speed = ce.simulate(model, plain, initial={"omega_eng": 0.0})["omega"].values + noise
    return ce.Experiment.from_arrays(
        "swing", time=t, units={"T": "N m", "omega": "rad/s"}, T=torque, omega=speed
    )


def white(count=SAMPLES, seed=0):
    return 0.1 * np.random.default_rng(seed).standard_normal(count)


def slow(count=SAMPLES, seed=1):
    return 0.1 * lfilter([np.sqrt(1 - 0.9**2)], [1, -0.9], np.random.default_rng(seed).standard_normal(count))


def fitted(data, **noise):
    return ce.estimate(ce.one_inertia(), data, noise=ce.Noise(**noise), progress=False)


def search_of(fit, noise):
    said = []
    refitter = Refitter(fit.model, fit.model.parameters(), fit.data, noise)
    found = Search(refitter, lambda f: screen_in_turn(f, EFFECTS), 4, said.append)
    found.run(fit)
    return found, said


@pytest.mark.parametrize("level", [0.1, "estimate"])
def test_a_large_effect_in_white_noise_needs_no_colour(level):
    fit = fitted(record(3.0, white()), omega=level)
    assert screen_in_turn(fit, EFFECTS).choice.waits
    search, said = search_of(fit, ce.Noise(omega=level))
    assert [e.candidate.key for e in search.stations[-1].effects] == [("coulomb_friction", "engine")]
    assert "the colour of the noise" not in said
    first = search.stations[0].screened
    assert not first.noise.colour
    assert not first.choice.waits
    # the level is that of the refit, not that of a residual which the effect is part of
    assert first.noise.sigma["omega"] == pytest.approx(0.1, rel=0.05)


def test_coloured_noise_is_still_looked_for():
    data = record(1.0, slow())
    search, said = search_of(fitted(data, omega="estimate"), ce.Noise(omega="estimate"))
    assert "the colour of the noise" in said
    assert search.stations[0].screened.noise.colour or search._equal


def test_the_colour_that_waited_is_the_one_that_screening_finds():
    fit = fitted(record(1.0, slow()), omega="estimate")
    waiting, at_once = screen_in_turn(fit, EFFECTS), screen(fit, EFFECTS)
    assert waiting.choice.waits
    assert not at_once.choice.waits
    later = coloured(waiting, fit)
    assert not later.choice.waits
    assert later.noise.sigma == pytest.approx(at_once.noise.sigma)
    assert later.scores.z == pytest.approx(at_once.scores.z)


def test_short_records_do_not_wait():
    fit = fitted(record(3.0, white(1000)), omega=0.1)
    assert not screen_in_turn(fit, EFFECTS).choice.waits


def test_a_record_of_a_lower_rate_waits_as_the_one_it_was_made_of():
    data = decimated(record(3.0, white(6000)), ("T",), ("omega",), 4)
    assert len(data["omega"].time) < _LONG
    assert screen_in_turn(fitted(data, omega="estimate"), EFFECTS).choice.waits


def test_white_residuals_do_not_wait():
    fit = fitted(record(0.0, white()), omega=0.1)
    assert not screen_in_turn(fit, EFFECTS).choice.waits


def test_noise_that_is_left_is_white_and_no_larger_than_stated():
    plain = fitted(record(0.0, white()), omega="estimate")
    null = null_model(plain)
    level = float(np.std(null.records[0].residual["omega"]))
    found = noise_left(null, {"omega": (1.0, True)}, 3)
    assert found.sigma["omega"] == pytest.approx(level, rel=2e-3)
    assert found.freedom["omega"] == SAMPLES - 3
    known = noise_left(null, {"omega": (0.1, False)}, 3)
    assert known.sigma == {"omega": 0.1}
    assert known.source == "known"
    assert noise_left(null, {"omega": (0.08, False)}, 3) is None
    loud = null_model(fitted(record(0.0, slow()), omega="estimate"))
    assert noise_left(loud, {"omega": (1.0, True)}, 3) is None
