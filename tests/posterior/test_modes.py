"""Searches for optima that end when they meet nothing new."""

import numpy as np
import pytest

from casadi_engine.estimation.levenberg_marquardt import Squares
from casadi_engine.posterior.modes import IDLE, _Searches, inverse


class Wells:
    """Wells of one parameter at whole numbers, ``higher`` each than the one before it; counts nothing else."""

    nv, low, high = 1, np.array([-100.0]), np.array([100.0])

    def __init__(self, higher):
        self._higher = higher

    def squares(self, v):
        place = np.round(v)
        return Squares(float(50 * (v - place) @ (v - place) + self._higher * abs(place[0])), 100 * (v - place),
                       100 * np.eye(1))  # fmt: skip

    def steep_of(self, points):
        return [self.squares(v) for v in points]

    def met(self, v):
        return v, np.zeros((1, 1))


def test_they_end_where_all_end_alike():
    searches = _Searches(Wells(1.0))
    searches.until_idle([np.array([0.1])] * 40)
    assert searches.tried == 1 + IDLE
    assert searches.ended == [1 + IDLE]


def test_they_go_on_while_new_optima_are_near():
    searches = _Searches(Wells(1.0))
    searches.until_idle([np.array([k + 0.1]) for k in range(40)])
    assert searches.tried == 10 + IDLE
    assert len(searches.found) == 10 + IDLE
    assert searches.near(9.5)
    assert not searches.near(10.5)


def test_the_best_may_come_last():
    searches = _Searches(Wells(1.0))
    searches.until_idle([np.array([place + 0.1]) for place in (5.0, 3.0, 0.0)])
    assert sorted(cost for _, _, cost in searches.found) == pytest.approx([0, 3, 5], abs=1e-3)


def test_a_direction_without_information_stays_out_of_the_inverse():
    """Curvature that underflows beside a slope that does not: an overflow was warned of."""
    matrix = np.array([[4.0, 0.0, 1e-5], [0.0, 0.0, 1e-5], [1e-5, 1e-5, -1e-9]])
    assert inverse(matrix) == pytest.approx(np.diag([0.25, 0.0, 0.0]))
    full = np.array([[4.0, 1.0], [1.0, 1e8]])
    assert inverse(full) == pytest.approx(np.linalg.inv(full))
