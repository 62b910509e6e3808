"""What is left out of the likelihood is foreseen by a quadratic where that holds."""

import numpy as np
import pytest

from casadi_engine.posterior.drawn import Drawn
from casadi_engine.posterior.left_out import foresee, with_all_data


def test_a_quadratic_is_foreseen():
    random = np.random.default_rng(0)
    x, others = random.standard_normal((60, 3)), random.standard_normal((5, 3))

    def value(at):
        return 2 + at @ [1.0, -2.0, 0.5] + (at @ [1.0, 1.0, 0.0]) ** 2

    found, error, _ = foresee(x, value(x), others)
    np.testing.assert_allclose(found, value(others))
    assert error < 1e-10


def test_how_far_it_is_off_is_said():
    random = np.random.default_rng(1)
    x, others = random.standard_normal((400, 2)), random.standard_normal((2000, 2))
    found, error, beyond = foresee(x, np.sin(2 * x[:, 0]), others)
    off = (found - np.sin(2 * others[:, 0]))[~beyond]
    assert beyond.mean() < 0.02
    assert error == pytest.approx(np.sqrt(np.mean(off**2)), rel=0.3)


def test_too_few_points_foresee_nothing():
    assert foresee(np.eye(3), np.ones(3), np.eye(3))[1] == np.inf


class Known:
    """A density whose left-out part is known; counts its evaluations."""

    def __init__(self, more):
        self._more, self.evaluations = more, 0
        self.likelihood = self
        self.bins = (1, 2)

    def full(self, u):
        self.evaluations += len(u)
        return self._more(u)


def drawn(count):
    u = np.random.default_rng(2).standard_normal((count, 2))
    ones = np.ones(2)
    return Drawn(u, np.zeros(count), "importance", "", 0.0, 0.0, None, count * ones, count * ones, 0.1)


@pytest.mark.parametrize(
    ("more", "evaluations"),
    [
        (lambda u: 0.5 * u[:, 0], (200, 300)),
        (lambda u: 0.5 * np.sign(u[:, 0]), (4000, 4000)),
        (lambda u: 0.01 * u[:, 0], (200, 200)),
    ],
)
def test_only_what_is_not_foreseen_is_evaluated(more, evaluations):
    target = Known(more)
    found, scatter = with_all_data(target, drawn(4000), np.random.default_rng(0))
    assert evaluations[0] <= target.evaluations <= evaluations[1]
    expected = np.mean(np.exp(more(np.random.default_rng(3).standard_normal((400_000, 2)))))
    assert found.log_evidence == pytest.approx(np.log(expected), abs=0.04)
    if scatter > 0.1:  # the draws have moved
        assert found.u[:, 0].mean() > 0.3


def test_nothing_is_foreseen_far_from_where_it_was_looked_at():
    """A few draws in a far mode, where a quadratic through the others would foretell e^40 times their weight."""

    def more(u):
        return 0.3 * np.where(np.abs(u[:, 0]) < 6, u[:, 0] ** 2, -3.0)

    own = drawn(4000)
    own.u[np.random.default_rng(0).choice(4000, 200, replace=False)[0] - 1] = [12.0, 0.0]
    found, _ = with_all_data(Known(more), own, np.random.default_rng(0))
    assert found.log_evidence == pytest.approx(-0.5 * np.log(1 - 2 * 0.3), abs=0.1)
    assert len(np.unique(found.u[:, 0])) > 1000


def test_draws_are_seen_with_more_of_the_data_where_a_quadratic_does_not_hold():
    """A step that less is left out of: what is still left out then is foretold."""

    def step(u):
        return 0.5 * np.sign(u[:, 0])

    class Nearer(Known):
        seen = 0

        def log_density(self, u):
            self.seen += len(u)
            return step(u)

    target = Nearer(lambda u: step(u) + 0.3 * u[:, 1])
    found, _ = with_all_data(
        target, drawn(4000), np.random.default_rng(0), lambda: setattr(target, "bins", (1, 1))
    )
    assert target.seen == 4000
    assert 200 <= target.evaluations <= 300
    assert found.log_evidence == pytest.approx(np.log(np.cosh(0.5)) + 0.045, abs=0.04)
    assert found.u[:, 0].mean() > 0.3
    assert found.u[:, 1].mean() == pytest.approx(0.3, abs=0.05)
