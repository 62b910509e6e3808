"""A declared term that stood for a missing effect is said to be as good as zero."""

import math
from types import SimpleNamespace

import pytest
from scipy.integrate import quad

from casadi_engine.discrepancy.vanishing import may_vanish, odds_without


def fit(value, stderr, low=0.0, high=math.inf, start=0.3, **more):
    """A fit of one parameter c beside an effect's amplitude."""
    estimate = SimpleNamespace(value=value, stderr=stderr, fixed=False, **more)
    return SimpleNamespace(
        parameters={"c": SimpleNamespace(min=low, max=high, value=start)},
        estimates={"c": estimate, "rotor.drag.size": estimate},
        free=("c", "rotor.drag.size"),
        model=SimpleNamespace(effects=[SimpleNamespace(at="rotor", effect=SimpleNamespace(name="drag"))]),
    )


@pytest.mark.parametrize(
    ("value", "low", "high"), [(0.02, 0.0, 2.0), (0.0, -1.0, 1.0), (-0.03, 0.0, 1.0), (0.1, 0.0, 3.0)]
)
def test_odds_are_the_ratio_of_two_integrated_likelihoods(value, low, high):
    error = 0.04
    likelihood = lambda c: math.exp(-0.5 * ((c - value) / error) ** 2)  # noqa: E731
    anywhere = quad(likelihood, low, high, points=[max(low, value)], limit=200)[0] / (high - low)
    assert odds_without(fit(value, error, low, high), "c") == pytest.approx(
        likelihood(0) / anywhere, rel=1e-6
    )


def test_without_bounds_it_may_be_ten_times_its_start():
    wide = 0.3 * 10 * math.sqrt(12)
    assert odds_without(fit(0.01, 0.02, -math.inf), "c") == pytest.approx(
        odds_without(fit(0.01, 0.02, -wide / 2, wide / 2), "c")
    )


@pytest.mark.parametrize("made", [fit(0.1, None), fit(0.1, 0.2, low=0.05), fit(0.1, 0.0)])
def test_nothing_is_said_where_zero_is_not_allowed_or_no_error_known(made):
    assert odds_without(made, "c") is None
    assert may_vanish(made) == []


def test_a_term_is_told_where_the_data_do_without_it():
    (said,) = may_vanish(fit(0.01, 0.02, 0.0, 3.0))
    assert said.startswith("c may be left out of the repaired model: the data are ")
    assert may_vanish(fit(0.1, 0.02, 0.0, 3.0)) == []
