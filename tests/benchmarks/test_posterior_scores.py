"""Scores at the truth by simulation, small: one state and one parameter."""

import numpy as np
import posterior_scores
import pytest
from posterior_scores import STEP, World, scores

from casadi_engine.posterior.states import StatePrior


def world(size):
    """A state that a parameter turns about in a plane, seen in noise; its prior has the width 5, or wide."""
    angles = np.array([0.0, STEP, -STEP]) / 5.0  # a step in a standard error, of a state of 5
    rows = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None]
    prior = StatePrior(np.zeros((3, 1)), np.array([[[5.0]], [[500.0]], [[5.0]]]))
    return World(rows, np.zeros((3, 2)), prior, {"so large": np.array([[size], [-size]])})


@pytest.mark.parametrize("size", [pytest.param(2.0, marks=pytest.mark.slow), 5.0])
def test_a_known_state_has_the_information_in_its_score(size):
    found = scores([world(size)], "so large", 4000, np.random.default_rng(0))
    square, curvature = found["known"].mean(axis=1)
    assert curvature == pytest.approx((size / 5.0) ** 2, rel=0.1)
    assert square == pytest.approx(curvature, rel=0.1)


def test_a_quiet_state_under_a_wide_prior_has_not():
    """Of a state that is smaller than its prior says the score holds noise that the curvature does not."""
    found = scores([world(0.3)], "so large", 2000, np.random.default_rng(0))
    for name in ("motion", "now"):
        square, curvature = found[name].mean(axis=1)
        assert square > 1.5 * curvature


@pytest.mark.slow
def test_the_truth_has_worlds_of_all_records():
    worlds = posterior_scores.worlds_of(100, 0.1)
    assert len(worlds) == 6
    for one in worlds:
        assert one.rows.shape[:2] == (13, 13)
        assert one.rest.shape == (13, one.rows.shape[2])
        assert set(one.starts) == {"thesis", "running", "anywhere"}
        assert len(one.starts["running"]) == 4
    (found,) = (
        own.sum(axis=1).max() for own in [scores(worlds, "thesis", 1, np.random.default_rng(0))["now"]]
    )
    assert np.isfinite(found)
