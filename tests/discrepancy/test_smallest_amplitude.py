"""Amplitudes that the data bound from below alone; refits that are interrupted; initial states that no output shows."""

from dataclasses import replace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.deadline import Deadline, TimeUp
from casadi_engine.discrepancy.answer_words import at_bounds
from casadi_engine.discrepancy.fresh import _power
from casadi_engine.discrepancy.fresh_fits import _misfit, _unseen_from
from casadi_engine.discrepancy.noise_model import Colour, NoiseModel
from casadi_engine.discrepancy.refit import Refitter, _determined, addition, merit
from casadi_engine.discrepancy.screening import screen
from casadi_engine.discrepancy.start import Start
from casadi_engine.effects import Amplitude, Effect

NOISE = ce.Noise(omega=0.05, omega_load=0.1)


class Clutch(Effect):
    """A torque of 2 N m that is there in full from a size of a few hundredths on: larger sizes are all alike."""

    name, attaches, kin = "clutch", ("inertia",), ()
    sentence = "a clutch on {port}"
    amplitude = Amplitude("size", unit="rad", min=0)

    def law(self, port, p, math):
        del port
        return -2.0 * (1 - math.exp(-p.size / 0.02))


@pytest.fixture(scope="module")
def case(shaft):
    data = shaft.data(hidden=lambda t, x: np.array([0, -2.0 * (t > 0.4)]))
    fit = ce.estimate(shaft.model, data, noise=NOISE, progress=False)
    refitter = Refitter(shaft.model, shaft.model.parameters(), (data,), NOISE, {})
    return fit, refitter, screen(fit, [Clutch()], at="load", colour=False)


def test_what_is_bounded_from_below_alone_is_as_small_as_the_data_are_content_with(case):
    fit, refitter, screened = case
    one = addition(screened.candidates[0], 3.0)
    model = refitter.extended([one])
    pars = refitter.parameters_of(model, [one])
    pars[one.amplitude].set(3.0)
    large = refitter._try(model, pars, Start.of(fit))
    assert large.values[one.amplitude] > 1
    assert not _determined(large.estimates[one.amplitude])
    small = refitter._smallest(large, [one], [one])
    assert small.converged
    assert 0.02 < small.values[one.amplitude] < 0.3
    assert merit(small) <= merit(large) + 1.0
    half = pars.copy()
    half.fix(one.amplitude, small.values[one.amplitude] / 2)
    assert merit(refitter._try(model, half, Start.of(small))) > merit(large) + 1.0


class Bent(Clutch):
    """The same, that says at which sizes it is to be tested beside its slope."""

    def sizes(self, port, values):
        del port, values
        return (0.2,)


def test_twice_as_much_that_explains_as_well_leaves_an_amplitude_open_above(case, shaft):
    fit, refitter, screened = case
    bent = screen(fit, [Bent()], at="load", colour=False)
    for own, is_open in ((bent, True), (screened, False)):  # a law that says nothing of its bend is not asked
        one = addition(own.candidates[0], 0.2)
        model = refitter.extended([one])
        held = refitter.parameters_of(model, [one])
        held.fix(one.amplitude, 0.2)
        found = refitter._try(model, held, Start.of(fit))
        assert refitter._open_above(found, [one], one) is is_open


def test_an_amplitude_with_an_error_stays(case):
    fit, refitter, _ = case
    torque = screen(fit, ["constant_torque"], at="load", colour=False)
    one = addition(torque.candidates[0], -1.0)
    whole = refitter(fit, [one], start=Start.of(fit))
    assert whole.estimates[one.amplitude].stderr > 0
    assert refitter._smallest(whole, [one], [one]) is whole


def test_the_end_of_the_time_in_a_refit_ends_the_search(case):
    """It passes for no model that fails."""
    fit, refitter, screened = case
    one = addition(screened.candidates[0], 0.1)
    with Deadline(work=100.0) as deadline, pytest.raises(TimeUp):
        refitter(fit, [one], start=Start.of(fit))
    assert deadline.over


def test_states_that_no_output_shows_start_as_in_the_records_of_the_fit(case):
    fit, _, _ = case
    (record,) = fit.initial
    own = fit.initial[record]
    moved = {state: replace(one, value=one.value + 5.0) for state, one in own.items()}
    start = _unseen_from(fit, replace(fit, initial={"fresh": moved}))
    assert start.initial["fresh"]["twist"] == own["twist"].value
    assert start.initial["fresh"]["omega_eng"] == own["omega_eng"].value + 5.0


def test_fresh_records_have_the_colour_of_those_that_were_searched():
    slow = Colour((np.ones(1), np.array([1.0, -0.8])), np.array([1 / (1 - 0.8**2), 1.0]))
    noise = NoiseModel({"omega": 0.1, "speed": 0.1}, {("run", "omega"): slow})
    assert _power(noise, "run", "omega") == pytest.approx(1 / 0.36)
    assert _power(noise, "fresh", "omega") == pytest.approx(1 / 0.36)
    assert _power(noise, "fresh", "speed") == 1.0
    assert _power(noise, "run", "speed") == 1.0


def test_what_is_said_of_estimatesat_bounds():
    assert at_bounds([], []) == []
    assert at_bounds(["coupling.backlash.gap", "C_el", "J_load"], ["coupling.backlash.gap"]) == [
        "coupling.backlash.gap is known from below alone: larger ones explain these data as well",
        "in the repaired model C_el, J_load is at a bound",
    ]


def test_a_misfit_is_counted_by_the_levels_that_are_given(case):
    fit, _, _ = case
    own = _misfit(fit, NoiseModel({"omega": 0.05, "omega_load": 0.1}))
    assert own == pytest.approx(fit.cost / fit.n, rel=1e-6)
    assert _misfit(fit, NoiseModel({"omega": 0.1, "omega_load": 0.2})) == pytest.approx(own / 4)
