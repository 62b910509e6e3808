"""Errors of integration that are carried along, and those of a motion that no run follows."""

import numpy as np

from casadi_engine.simulation.carried_errors import carried_on, unstable


def test_an_error_is_carried_by_what_intervals_make_of_their_start():
    ends = np.array([[[0.5]], [[2.0]], [[-1.0]], [[1.0]]])
    own = np.array([[1.0], [0.0], [0.5], [7.0]])
    np.testing.assert_allclose(carried_on(ends, own)[:, 0], [0, 1, 2, -1.5])


def test_along_an_unstable_motion_it_begins_anew_before_it_is_beyond_all_numbers():
    ends, own = np.full((40, 1, 1), 10.0), np.full((40, 1), 1e-6)
    assert unstable(ends)
    found = carried_on(ends, own)
    assert 1e-3 < found.max() < 2e-2
    plain = carried_on(ends[:6], own[:6])
    np.testing.assert_allclose(plain[:, 0], 1e-6 * np.array([0, 1, 11, 111, 1111, 11111]))


def test_what_is_no_number_is_not_called_unstable():
    assert not unstable(np.full((40, 1, 1), np.nan))
    assert not unstable(np.zeros((40, 1, 1)))
    assert not unstable(np.zeros((0, 1, 1)))
