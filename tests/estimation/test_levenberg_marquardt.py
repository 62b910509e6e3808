"""Least squares from Gram matrices: known minima, bounds, points without a value, and the end of a search."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.estimation.levenberg_marquardt import Squares, driven, minimise, steps_of

WIDE = np.full(2, np.inf)


def problem(residual, jacobian):
    """The Gram form of a problem that is given by rows."""

    def evaluate(x):
        r, j = residual(x), jacobian(x)
        return Squares(0.5 * float(r @ r), j.T @ r, j.T @ j)

    return evaluate


def rosenbrock(x):
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def rosenbrock_slope(x):
    return np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])


ROSENBROCK = problem(rosenbrock, rosenbrock_slope)


def test_a_curved_valley_is_followed_to_its_end():
    found = minimise(ROSENBROCK, np.array([-1.2, 1.0]), -WIDE, WIDE, fall=1e-14)
    assert found.converged
    np.testing.assert_allclose(found.x, [1, 1], rtol=1e-6)
    assert found.steps < 40


def test_bounds_hold_and_the_rest_is_at_its_best():
    found = minimise(ROSENBROCK, np.array([-1.2, 1.0]), -WIDE, np.array([0.5, np.inf]), fall=1e-14)
    assert found.converged
    np.testing.assert_allclose(found.x, [0.5, 0.25], rtol=1e-6)


def test_a_start_beyond_the_bounds_is_moved_to_them():
    found = minimise(ROSENBROCK, np.array([3.0, 9.0]), -WIDE, np.array([0.5, 0.1]), fall=1e-14)
    assert found.converged
    assert (found.x <= [0.5, 0.1]).all()
    slope = ROSENBROCK(found.x).gradient
    assert np.all((np.abs(slope) < 1e-5) | ((found.x == [0.5, 0.1]) & (slope < 0)))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 6))
def test_a_linear_problem_is_solved_in_a_step_or_few(seed, n):
    rng = np.random.default_rng(seed)
    a, b = rng.standard_normal((n + 4, n)), rng.standard_normal(n + 4)
    found = minimise(
        problem(lambda x: a @ x - b, lambda _: a), np.zeros(n), np.full(n, -np.inf), np.full(n, np.inf),
        fall=1e-13, longest=lambda x: np.full(len(x), np.inf),
    )  # fmt: skip
    assert found.converged
    best = np.linalg.lstsq(a, b, rcond=None)[0]
    assert 0.5 * np.sum((a @ (found.x - best)) ** 2) < 1e-11


def test_what_gauss_newton_lacks_is_learnt():
    """A residual so large that Gauss-Newton alone does not contract: (x^2 - 1, x - c) far from zero."""
    strong = problem(
        lambda x: np.array([x[0] ** 2 + 20.0, 3 * (x[0] - 4), x[1]]),
        lambda x: np.array([[2 * x[0], 0.0], [3.0, 0.0], [0.0, 1.0]]),
    )
    calls = []

    def counted(x):
        calls.append(x)
        return strong(x)

    found = minimise(counted, np.array([3.0, 1.0]), -WIDE, WIDE, fall=1e-13)
    assert found.converged
    x = found.x[0]
    assert 2 * x * (x**2 + 20) + 9 * (x - 4) == pytest.approx(0, abs=1e-4)
    assert len(calls) < 20


def test_points_without_a_value_are_stepped_back_from():
    def walled(x):
        return None if x[0] > 0.9 else ROSENBROCK(x)

    found = minimise(walled, np.array([-1.2, 1.0]), -WIDE, WIDE, fall=1e-14)
    assert found.x[0] <= 0.9
    assert found.squares.cost < 0.5 * 0.2**2
    assert minimise(lambda _: None, np.zeros(2), -WIDE, WIDE, fall=1e-14) is None


def test_a_search_ends_with_its_steps_or_when_it_is_told_to():
    short = minimise(ROSENBROCK, np.array([-1.2, 1.0]), -WIDE, WIDE, fall=1e-14, steps=3)
    assert not short.converged
    assert short.steps == 3
    seen = []

    def stop(cost):
        seen.append(cost)
        return len(seen) == 4

    stopped = minimise(ROSENBROCK, np.array([-1.2, 1.0]), -WIDE, WIDE, fall=1e-14, stop=stop)
    assert not stopped.converged
    assert len(seen) == 4
    assert seen == sorted(seen, reverse=True)
    assert stopped.squares.cost == seen[-1]


def test_a_value_that_was_too_low_refuses_no_steps():
    """As one that was taken with gaps open: the first point seems to be worth nothing."""
    start, told = np.array([3.0, -2.0]), []

    def bowl(x):
        return Squares(0.5 * float(x @ x), x, np.eye(2))

    def first_too_low(x):
        exact = bowl(x)
        return Squares(0.0, x, np.eye(2)) if np.array_equal(x, start) else exact

    def anew(x):
        if told:
            return None
        told.append(x.copy())
        return bowl(x)

    stuck = minimise(first_too_low, start, -WIDE, WIDE, fall=1e-10, steps=30)
    np.testing.assert_array_equal(stuck.x, start)
    found = minimise(first_too_low, start, -WIDE, WIDE, fall=1e-10, steps=30, anew=anew)
    np.testing.assert_array_equal(told, [start])
    assert found.converged
    np.testing.assert_allclose(found.x, 0.0, atol=1e-4)


def test_steps_are_no_longer_than_allowed():
    points = []

    def watched(x):
        points.append(x)
        return Squares(0.5 * float((x - 100) @ (x - 100)), x - 100, np.eye(2))

    found = minimise(watched, np.zeros(2), -WIDE, WIDE, fall=1e-12, longest=lambda _: np.array([7.0, 30.0]))
    np.testing.assert_allclose(found.x, 100)
    steps = np.abs(np.diff(points, axis=0))
    assert (steps <= np.array([7.0, 30.0]) * (1 + 1e-12)).all()


def test_what_has_no_slope_stays_where_it_is():
    flat = problem(lambda x: np.array([x[0] - 3.0]), lambda _: np.array([[1.0, 0.0]]))
    found = minimise(flat, np.array([0.0, 5.0]), -WIDE, WIDE, fall=1e-13)
    assert found.converged
    np.testing.assert_allclose(found.x, [3.0, 5.0], rtol=1e-6)


@pytest.mark.parametrize(("steep", "fewer"), [(100.0, 3.0), (1000.0, 5.0)])
def test_a_valley_that_bends_is_gone_along(steep, fewer):
    """Rosenbrock's, of a hundred and a thousand: the optimum in a fraction of the evaluations."""
    asked = {}
    for round_bends in (True, False):
        count = 0

        def squares(v):
            nonlocal count
            count += 1
            r = np.array([steep * (v[1] - v[0] ** 2), 1 - v[0]])
            jacobian = np.array([[-2 * steep * v[0], steep], [-1.0, 0.0]])
            return Squares(0.5 * float(r @ r), jacobian.T @ r, jacobian.T @ jacobian)

        free = np.full(2, np.inf)
        found = minimise(
            squares, np.array([-1.2, 1.0]), -free, free, fall=1e-9, steps=3000, round_bends=round_bends
        )
        assert found.converged
        np.testing.assert_allclose(found.x, 1.0, atol=1e-3)
        asked[round_bends] = count
    assert fewer * asked[True] < asked[False]


def test_searches_that_go_side_by_side_end_where_each_by_itself_does():
    starts = [np.array([-1.2, 1.0]), np.array([2.0, 2.0]), np.array([np.nan, 0.0])]
    asked = []

    def every(points):
        asked.append(len(points))
        return [ROSENBROCK(one) if np.isfinite(one).all() else None for one in points]

    begun = [steps_of(one, -WIDE, WIDE, fall=1e-12) for one in starts]
    ends = driven(begun, every)
    for start, end in zip(starts[:2], ends[:2], strict=True):
        alone = minimise(ROSENBROCK, start, -WIDE, WIDE, fall=1e-12)
        np.testing.assert_array_equal(end.x, alone.x)
        assert end.steps == alone.steps
    assert ends[2] is None
    assert asked[:2] == [3, 2]
    assert driven([], every) == []
