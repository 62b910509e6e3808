"""A function held against the colour that it leaves itself: noise has none that it would take."""

from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.discrepancy import law_rival
from casadi_engine.discrepancy.evidence import digest
from casadi_engine.discrepancy.law_rival import Rival, beside_it, counted_with, is_told, with_own_colour
from casadi_engine.discrepancy.priors import priors_of
from casadi_engine.discrepancy.random_families import family_candidates, family_columns
from casadi_engine.discrepancy.unknown_law import _members


def odds(shaft, name, *data):
    """The log odds of a function of the shaft's in the place of no effect."""
    null = shaft.null(*data)
    candidates, families = family_candidates(null)
    columns = family_columns(null, candidates)
    family = next(one for one in families if one.name == name)
    priors = priors_of(null, shaft.model.parameters(), ())
    beside = beside_it(null, _members(columns, family))
    made = counted_with(beside, priors, family, frozenset(), None)
    rival = Rival(0.0, family, beside, made, made)
    return with_own_colour(rival, null, digest(null, priors), frozenset())


@pytest.mark.parametrize("seed", range(4))
def test_white_noise_has_no_law(shaft, seed):
    """Functions that were free in each record took what chance left, and counted by a prior that held them near none:
    three of 53 records of white noise had "an unknown force"."""
    data = [shaft.data(f"run {k}", seed=2 * seed + k) for k in range(2)]
    assert odds(shaft, "a function of twist at coupling", *data) < 1.0


def test_a_law_is_far_more_probable(shaft):
    def hidden(t, x):
        return 0.8 * np.sin(25 * x[2]) * np.array([1, -1])

    data = shaft.data(hidden=hidden, n=900, seed=3)
    assert odds(shaft, "a function of twist at coupling", data) > 50


@pytest.mark.parametrize(
    ("linear", "told"), [(23_000.0, True), (1_100.0, True), (1_000.0, False), (790.0, False)]
)
def test_slopes_that_make_up_for_an_effect_of_any_size_say_nothing_of_what_takes_its_place(linear, told):
    """A pressure alone tells no scale of capacities, resistances and flows: by its slopes they made up for a load that
    chi-squared rises by 23 000 without, and a course of almost no size was a hundred times as probable as the load."""
    assert is_told(linear, 792.0, 24_291.0) is told


def test_a_model_without_its_effects_has_the_priors_of_what_is_left():
    null = SimpleNamespace(parameters=("m",))
    seen = {}

    def made(bare, priors, **more):
        seen.update(priors=priors, **more)
        return bare

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(law_rival, "digest", made)
        assert law_rival.bare_digest(null, {"m": 1, "load": 2}, frozenset("k"), None) is null
    assert seen == {"priors": {"m": 1}, "random": None, "held": frozenset("k")}
