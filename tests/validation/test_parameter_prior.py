"""The split of a gap into errors of the parameters and the rest, against closed forms of linear regression."""

import math

import numpy as np
import pytest
from scipy import stats

from casadi_engine.estimation.parameter_errors import ParameterErrors
from casadi_engine.validation.parameter_prior import PriorSplit

INF = math.inf


def test_one_parameter_is_the_difference_over_both_errors():
    """Slope 1, noise 1, N samples, prior variance s2: T = mean^2 / (s2 + 1/N)."""
    r = 0.7 + np.random.default_rng(0).standard_normal(50)
    split = PriorSplit.of(r, np.ones((50, 1)), np.array([[1 / 0.3]]), np.zeros(1))
    assert split.value == pytest.approx(r.mean() ** 2 / (0.3**2 + 1 / 50))
    assert (split.dof, split.rank) == (1, 1)
    assert split.share == pytest.approx(0.09 / (0.09 + 0.02))
    assert split.noise == pytest.approx(r - r.mean())
    assert split.step == pytest.approx([r.mean() * 0.09 / (0.09 + 0.02)])
    assert split.covariance == pytest.approx(np.array([[1 / (50 + 1 / 0.09)]]))
    assert split.p_value(INF, INF) == pytest.approx(stats.chi2.sf(split.value, 1))
    welch = 1 / (split.share**2 / 10 + (1 - split.share) ** 2 / 49)
    assert split.p_value(10, 49) == pytest.approx(stats.f.sf(split.value, 1, welch))


def test_several_parameters_beside_initial_states():
    """T = d' (S + V)^-1 d of the free estimates on the fresh data, initial states (no rows) projected out."""
    rng = np.random.default_rng(1)
    slopes, r = rng.standard_normal((80, 5)), rng.standard_normal(80)
    root = rng.standard_normal((3, 3))
    rows = np.hstack([root, np.zeros((3, 2))])
    split = PriorSplit.of(r, slopes, rows, np.zeros(3))
    free = np.linalg.lstsq(slopes, r, rcond=None)[0]
    both = np.linalg.inv(root.T @ root) + np.linalg.inv(slopes.T @ slopes)[:3, :3]
    assert split.value == pytest.approx(free[:3] @ np.linalg.solve(both, free[:3]))
    assert (split.dof, split.rank) == (3, 5)
    assert split.noise == pytest.approx(r - slopes @ free)


def test_directions_that_one_side_alone_tells_are_not_compared():
    rng = np.random.default_rng(2)
    column, r = rng.standard_normal((60, 1)), rng.standard_normal(60)
    slopes = np.hstack([column, 2 * column])  # fresh data tell z1 + 2 z2 alone
    split = PriorSplit.of(r, slopes, np.eye(2), np.zeros(2))
    free = float(column[:, 0] @ r / (column[:, 0] @ column[:, 0]))
    assert split.dof == 1
    assert split.value == pytest.approx(free**2 / (5 + 1 / float(column[:, 0] @ column[:, 0])))
    nothing = PriorSplit.of(r, slopes, np.zeros((0, 2)), np.zeros(0))
    assert (nothing.dof, nothing.p_value(INF, INF)) == (0, None)
    assert nothing.value == pytest.approx(0.0, abs=1e-12)  # rounding, other on other processors


def test_errors_as_a_prior_leave_out_what_is_not_determined():
    covariance = np.diag([4.0, 1e-18, 0.0])
    unknown = np.array([[0.0], [0.0], [1.0]])
    errors = ParameterErrors.of(("a", "b", "c"), covariance, unknown, np.array([1.0, 1e-8, 1.0]), np.zeros(3))
    information = errors.rows.T @ errors.rows
    assert information == pytest.approx(np.diag([0.25, 1e18, 0.0]))
    assert len(errors.held) == 0
    rows, _ = errors.over(("c", "a"))
    assert rows.T @ rows == pytest.approx(np.diag([0.0, 0.25]))


def test_errors_over_some_entries_are_their_marginal():
    root = np.random.default_rng(3).standard_normal((3, 3))
    covariance = root @ root.T
    shift = np.array([1.0, -2.0, 0.5])
    errors = ParameterErrors.of(("a", "b", "c"), covariance, np.zeros((3, 0)), np.ones(3), shift)
    rows, at = errors.over(("c", "new", "a"))
    keep = [2, 0]
    found = (rows.T @ rows)[np.ix_([0, 2], [0, 2])]
    assert np.linalg.inv(found) == pytest.approx(covariance[np.ix_(keep, keep)])
    assert not rows[:, 1].any()
    assert at == pytest.approx(rows[:, [0, 2]] @ shift[keep])


def test_a_direction_that_an_equality_holds_is_held():
    covariance = np.array([[1.0, -1.0], [-1.0, 1.0]])  # a + b is given
    errors = ParameterErrors.of(("a", "b"), covariance, np.zeros((2, 0)), np.ones(2), np.zeros(2))
    assert len(errors.rows) == len(errors.held) == 1
    assert abs(errors.held @ [1, -1]) < 1e-9
    assert abs(errors.rows[0] @ [1, -1]) == pytest.approx(1.0)  # one standard deviation
