"""The errors of a repair's numbers go through the checks of every fit."""

from dataclasses import replace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.checked_errors import (
    no_smaller_errors,
    with_checked_errors,
    with_errors_of_rounding,
)
from casadi_engine.discrepancy.repaired import FoundEffect, Repair, Unknown

TIME = np.linspace(0, 1, 50)
SIZE = np.sqrt((TIME**2).sum())


def bent():
    """Two outputs p**2 t and p t: the answers of all p lie on a parabola."""
    b = ce.Blueprint("bent")
    p = b.parameter("p", 1.0, min=-5, max=5)
    x, w = b.state("x"), b.state("w")
    b.ode("x", p**2)
    b.ode("w", p)
    b.output("y1", x)
    b.output("y2", w)
    return b.model()


def noise_of(square, line):
    return ce.Noise(y1=SIZE / square, y2=SIZE / line)


def repaired(square, line, truth=1.0):
    """A repair whose effect has the amplitude p, with the errors of the quadratic."""
    data = ce.Experiment.from_arrays(
        "r", time=TIME, units={"y1": "1", "y2": "1"}, y1=truth**2 * TIME, y2=truth * TIME
    )
    fit = ce.estimate(
        bent(), data, noise=noise_of(square, line), initial={"x": 0.0, "w": 0.0}, errors="quadratic", progress=False
    )  # fmt: skip
    own = {"p": fit.estimates["p"]}
    effect = FoundEffect("bend", "engine", "", {}, own, {}, 9.0, 1e-9, 50.0, 1.0, {}, {}, None, ())
    return Repair("answered", "named", None, fit, fit, 0.01, effects=(effect,), messages=("said before",))


def checked(made, square, line, **options):
    options = {"initial": {"x": 0.0, "w": 0.0}, **options}
    return with_checked_errors(made, noise_of(square, line), options, in_places=False)


def test_an_error_that_the_likelihood_does_not_bear_out_is_replaced_by_its_interval():
    made = repaired(1.5, 2.0)
    assert made.effects[0].amplitude.stderr == pytest.approx(1 / np.hypot(3.0, 2.0), rel=1e-4)
    found = checked(made, 1.5, 2.0)
    usual = ce.estimate(
        bent(), made.fit.data, noise=noise_of(1.5, 2.0), initial={"x": 0.0, "w": 0.0}, progress=False
    )
    for one in (found.effects[0].amplitude, found.fit.estimates["p"]):
        assert one.stderr is None
        assert one.interval == pytest.approx(usual.estimates["p"].interval, rel=1e-3)
        assert one.value == made.fit.values["p"]
    assert found.messages == (
        "said before",
        "no symmetric error describes p: the likelihood is not quadratic there",
    )


def test_where_no_profile_tells_the_interval_it_says_what_to_call():
    found = checked(repaired(3.0, 2.0, truth=0.1), 3.0, 2.0)
    assert found.effects[0].amplitude.stderr is None
    assert found.effects[0].amplitude.interval is None
    assert found.messages[1].endswith("for p call ce.profile(repair.fit), or ce.posterior(repair.fit)")


def test_an_error_that_holds_is_kept():
    made = repaired(30.0, 30.0)
    found = checked(made, 30.0, 30.0)
    assert found.effects[0].parameters == made.effects[0].parameters
    assert found.messages == made.messages


def test_errors_that_could_not_be_checked_are_said_to_be_unchecked():
    made = repaired(1.5, 2.0)
    for options in ({"max_iterations": 0}, {"initial": {"nothing": 1.0}}):
        found = checked(made, 1.5, 2.0, **options)
        assert found.effects[0].parameters == made.effects[0].parameters
        assert found.messages[1] == (
            "the standard errors are those of the curvature at the optimum; they were not checked"
        )


def test_without_an_effect_there_is_nothing_to_check():
    made = replace(repaired(1.5, 2.0), effects=())
    assert checked(made, 1.5, 2.0) is made


def test_errors_of_a_fit_are_no_smaller_than_those_that_know_the_colour():
    found = repaired(10, 20).fit
    own = found.estimates["p"]
    wide = replace(found, estimates={"p": replace(own, stderr=2 * own.stderr)})
    assert no_smaller_errors(found, wide).estimates["p"].stderr == 2 * own.stderr
    assert no_smaller_errors(wide, found).estimates["p"].stderr == 2 * own.stderr
    told = replace(own, stderr=None, quadratic=own.stderr, interval=(own.value - 1, own.value + 2))
    doubted = no_smaller_errors(replace(found, estimates={"p": told}), wide).estimates["p"]
    assert doubted.quadratic == 2 * own.stderr
    np.testing.assert_allclose(doubted.interval, (own.value - 2, own.value + 4))


@pytest.mark.parametrize("felt", [3.0, np.nan])
def test_a_search_that_was_ended_before_corners_were_sharp_prints_no_errors(felt):
    made = repaired(1.5, 200.0)
    made = replace(made, unknown=Unknown("an unknown torque", {}))
    found = with_errors_of_rounding(made, felt, ended=True)
    for one in (found.effects[0].amplitude, found.fit.estimates["p"]):
        assert (one.value, one.stderr, one.interval) == (made.fit.values["p"], None, None)
        assert "before corners were as sharp" in one.why
    assert found.messages[-1].startswith("what is still unexplained may come of rounded corners")


def test_a_rounding_whose_effect_is_known_makes_errors_larger():
    made = repaired(1.5, 200.0)
    found = with_errors_of_rounding(made, 3.0, ended=False)
    assert found.effects[0].amplitude.stderr == pytest.approx(2 * made.effects[0].amplitude.stderr)
    assert found.messages == made.messages


def test_what_two_widths_say_of_a_parameter_counts_with_its_own_error():
    made = repaired(1.5, 200.0)
    own = made.effects[0].amplitude.stderr
    found = with_errors_of_rounding(made, 20.0, {"p": 0.75 * own}, ended=False)
    assert found.effects[0].amplitude.stderr == pytest.approx(1.25 * own)
    assert found.fit.estimates["p"].stderr == pytest.approx(1.25 * own)


@pytest.mark.parametrize(("felt", "ended"), [(0.0, True), (0.0, False), (np.nan, False)])
def test_a_rounding_that_is_not_felt_changes_nothing(felt, ended):
    made = repaired(1.5, 200.0)
    assert with_errors_of_rounding(made, felt, ended=ended) is made
