"""Effects that do no more than sharper corners of the others would."""

from types import SimpleNamespace

import pytest

from casadi_engine.discrepancy.only_rounding import without_what_rounding_leaves
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.tried import key_of


def effect(name):
    return SimpleNamespace(candidate=SimpleNamespace(effect=name, port="motor", key=name))


DRY, FADING = effect("coulomb_friction"), effect("stribeck_friction")
WAY = tuple(SimpleNamespace(effects=found) for found in ((), (DRY,), (DRY, FADING)))


@pytest.mark.parametrize(
    ("felt", "gain", "left"),
    [(970.0, 300.0, 2), (970.0, 1200.0, 3), (0.1, 0.0, 3), (float("nan"), 300.0, 3)],
)
def test_a_second_effect_has_to_gain_more_than_sharper_corners_of_the_first(felt, gain, left):
    """A friction that fades below 0.18 rad/s, beside a dry one rounded over 0.085 rad/s: "z = 11.2"."""
    costs = {key_of((DRY,)): 5000.0, key_of((DRY, FADING)): 5000.0 - gain}
    pool = {
        key: SimpleNamespace(effects=(), arrived=SimpleNamespace(cost=cost)) for key, cost in costs.items()
    }
    path = SimpleNamespace(cornered=lambda effects: True, felt_along=lambda effects, arrived: felt)
    assert len(without_what_rounding_leaves(SimpleNamespace(pool=pool, path=path), WAY)) == left


def test_an_effect_alone_and_smooth_ones_stay():
    path = SimpleNamespace(cornered=lambda effects: False, felt_along=lambda effects, arrived: 1e9)
    arrived = SimpleNamespace(effects=(), arrived=SimpleNamespace(cost=1.0))
    refits = SimpleNamespace(pool=dict.fromkeys(map(key_of, [(DRY,), (DRY, FADING)]), arrived), path=path)
    assert without_what_rounding_leaves(refits, WAY) == WAY
    path.cornered = lambda effects: True
    assert without_what_rounding_leaves(refits, WAY[:2]) == WAY[:2]


def test_what_sharper_corners_do_is_measured_along_the_answer_of_a_search_that_was_ended():
    """It was known of friction alone, as sharp as the data feel it; beside a play, 60 times as blunt, 0.0406 +- 0.00014
    N m stood for 0.04."""
    effects = (DRY,)
    tried = SimpleNamespace(effects=effects, arrived=None)
    path = SimpleNamespace(felt=0.0, cornered=lambda one: True, felt_along=lambda one, arrived: 9.0)
    refits = SimpleNamespace(path=path, pool={key_of(effects): tried})
    assert Refits.rounding_felt(refits, effects) == 0.0
    assert Refits.rounding_felt(refits, effects, ended=True) == 9.0
    path.cornered = lambda one: False
    assert Refits.rounding_felt(refits, effects, ended=True) == 0.0
