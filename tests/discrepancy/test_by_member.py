"""Values beside another name of a class."""

from types import SimpleNamespace

import pytest

from casadi_engine.discrepancy.by_member import told_by_member, told_by_priors
from casadi_engine.discrepancy.repaired import Member

GAIN, RESISTANCE, OTHER = ("sensor_gain", "i"), ("wrong_value", "Re"), ("load_step", "coil")


def found(*members):
    return SimpleNamespace(name=GAIN[0], at=GAIN[1], members=(Member(*GAIN, 1.0, 0.5), *members))


def fit(**values):
    return SimpleNamespace(
        estimates={
            name: SimpleNamespace(value=value, stderr=error, unit="g")
            for name, (value, error) in values.items()
        },
        parameters=dict.fromkeys(values, SimpleNamespace(min=0.0, max=100.0)),
    )


def test_what_another_name_makes_of_the_parameters_is_told():
    """The refits' difference is added to the value of the fit, whose corners may be sharper."""
    values = {
        frozenset({GAIN}): {"M": 16.70, "K": 2.0},
        frozenset({RESISTANCE}): {"M": 13.94, "K": 2.01},
    }
    one = fit(M=(16.77, 0.03), K=(2.0, 0.01))
    (words,) = told_by_member([found(Member(*RESISTANCE, -1.0, 0.5))], frozenset({GAIN}), values, one)
    place = "with wrong_value at Re in the place of sensor_gain at i"
    assert words == f"values and ± hold only for the names that lead: {place} M is 14.01 g"


def test_what_lies_beyond_a_bound_is_that_of_the_refit():
    """Along a flat valley two refits differ by more than the value of the fit."""
    values = {frozenset({GAIN}): {"M": 60.0}, frozenset({RESISTANCE}): {"M": 20.0}}
    (words,) = told_by_member(
        [found(Member(*RESISTANCE, -1.0, 0.5))], frozenset({GAIN}), values, fit(M=(5.0, 1.0))
    )
    assert words.endswith("M is 20 g")


def test_two_in_the_place_of_one():
    values = {frozenset({GAIN}): {"M": 1.0}, frozenset({RESISTANCE, OTHER}): {"M": 2.0}}
    members = [found(Member(*RESISTANCE, 1.0, 0.5, " with load_step at coil"))]
    (words,) = told_by_member(members, frozenset({GAIN}), values, fit(M=(1.0, 0.1)))
    assert words.endswith("with wrong_value at Re with load_step at coil M is 2 g")


@pytest.mark.parametrize("more", ["", " in place of it and load_step at coil"])
def test_nothing_is_said_of_what_is_alike_or_not_known(more):
    values = {frozenset({GAIN}): {"M": 1.0}}
    if not more:
        values[frozenset({RESISTANCE})] = {"M": 1.01}
    members = [found(Member(*RESISTANCE, 1.0, 0.5, more))]
    assert told_by_member(members, frozenset({GAIN}), values, fit(M=(1.0, 0.1))) == []
    assert told_by_member(members, frozenset({OTHER}), values, fit(M=(1.0, 0.1))) == []


def left(cost, fresh=0.0):
    return SimpleNamespace(evidence=SimpleNamespace(cost=cost), fresh=fresh)


@pytest.mark.parametrize(
    ("cost", "fresh", "told"), [(1000.1, 0.0, True), (1004.0, 0.0, False), (1000.0, -3.0, False)]
)
def test_odds_that_no_data_made_are_said_to_be_none_of_theirs(cost, fresh, told):
    """A lag of a sensor was 99 %, and the storage that does exactly the same 1 %, by what may be large before data."""
    pool = {frozenset({GAIN}): left(1000.0), frozenset({RESISTANCE}): left(cost, fresh)}
    said = told_by_priors([found(Member(*RESISTANCE, 1.0, 0.01))], frozenset({GAIN}), pool)
    assert bool(said) is told
    if told:
        assert said[0].startswith("sensor_gain at i and wrong_value at Re explain all data alike")
    assert told_by_priors([found()], frozenset({GAIN}), pool) == []
