"""Coordinates without bounds."""

import numpy as np
import pytest

from casadi_engine.posterior.box import Box
from casadi_engine.posterior.importance import sample

BOX = Box(np.array([0.0, -np.inf, 2.0]), np.array([1.0, 5.0, 1e6]))


def test_they_lead_there_and_back():
    u = np.array([[0.2, -3.0, 2.001], [1 - 1e-9, 4.0, 9e5]])
    np.testing.assert_allclose(BOX.back(BOX.of(u)), u, rtol=1e-9)
    far = BOX.back(np.array([[-900.0, 0.0, 900.0]]))
    np.testing.assert_array_equal(far, [[0.0, 0.0, 1e6]])


def test_the_slope_is_that_of_the_way_back():
    y, step = np.array([0.3, 1.0, -9.0]), 1e-6
    slopes = [(BOX.back(y + step * e) - BOX.back(y - step * e)) @ e / (2 * step) for e in np.eye(3)]
    assert BOX.log_slope(y) == pytest.approx(np.log(slopes).sum(), abs=1e-6)


def test_only_bounds_that_are_near_are_taken_away():
    box = Box.about(np.array([0.1, 0.5]), np.diag([0.01, 0.01]), np.zeros(2), np.ones(2))
    u = np.array([0.2, 0.3])
    assert box.of(u)[1] == 0.3
    assert box.of(u)[0] == pytest.approx(np.log(0.2 / 0.8))


def test_a_corner_is_drawn_from():
    """A density that falls from a corner of four bounds: one of 16 normal draws about it would be inside."""
    box, scale = Box(np.zeros(4), np.ones(4)), np.full(4, 0.02)

    def density(u):
        inside = ((u >= 0) & (u <= 1)).all(axis=1)
        return np.where(inside, -(u / scale).sum(axis=1), -np.inf)

    start = box.mixture(np.ones(1), np.zeros((1, 4)), 1e-3 * np.eye(4)[None])
    found = sample(box.density(density), start, np.random.default_rng(0))
    assert found.trusted
    assert found.log_evidence == pytest.approx(np.log(scale).sum(), abs=0.1)
    mean = found.weight @ box.back(found.x)
    np.testing.assert_allclose(mean, scale, rtol=0.15)
