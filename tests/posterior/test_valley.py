"""Valleys that lead away from an optimum, of densities that are known."""

import numpy as np
import pytest

from casadi_engine.estimation.levenberg_marquardt import Squares
from casadi_engine.posterior.importance import sample
from casadi_engine.posterior.mixture import Mixture
from casadi_engine.posterior.valley import DEPTH, between, valleys

THIN = 0.1


class Known:
    """exp(-squares / 2) of residuals (m,) of a point with their slopes (m, 2), between bounds."""

    def __init__(self, residuals, width=100.0):
        self._residuals, self.nv, self.start = residuals, 2, np.zeros(2)
        self.low, self.high = -np.full(2, width), np.full(2, width)

    def squares(self, v):
        residual, slopes = self._residuals(v)
        return Squares(0.5 * residual @ residual, slopes.T @ residual, slopes.T @ slopes)

    def log_density(self, u):
        return np.array([-self.squares(v).cost for v in u])


def round_about(v):
    return v, np.eye(2)


def bent(v):
    """A thin valley y = x^2 / 20 along which chi-squared is x^2 near 0 and 3 |x| - 2 far off."""
    x, y = v
    flat = abs(x) < 2
    size = x if flat else np.sign(x) * np.sqrt(3 * abs(x) - 2)
    slope = 1.0 if flat else 1.5 / abs(size)
    return np.array([size, (y - x**2 / 20) / THIN]), np.array([[slope, 0.0], [-x / 10 / THIN, 1 / THIN]])


def two_basins(v):
    """A second optimum at x = 9, between which chi-squared rises to 6.25."""
    x, y = v
    near, far = x, x - 9
    size, slope = (near, 1.0) if x < 2.5 else (2.5 - (x - 2.5) * 2.5 / 4, -0.625) if x < 6.5 else (far, 1.0)
    size, slope = (size, slope) if x < 6.5 else (max(far, 0.0), float(far > 0))
    return np.array([size, y]), np.array([[slope, 0.0], [0.0, 1.0]])


def test_where_the_quadratic_holds_there_is_none():
    found = valleys(Known(round_about), np.zeros(2), np.eye(2), 2)
    assert not found.at
    assert not found.onwards


def test_a_valley_is_followed_to_its_end():
    target = Known(bent)
    found = valleys(target, np.zeros(2), target.squares(np.zeros(2)).matrix, 2)
    x, y = np.array(found.at).T
    np.testing.assert_allclose(y, x**2 / 20, atol=THIN)
    drops = -target.log_density(np.array(found.at))
    assert drops.max() > DEPTH - 4
    assert x.min() == pytest.approx(-x.max())


@pytest.mark.parametrize("followed", [True, False])
def test_draws_reach_where_only_the_valley_leads(followed):
    """8 in 10 000 lie beyond |x| = 5, where the valley has left its tangent by 12 widths. Draws from the optimum's
    quadratic miss them, and their k-hat does not say so."""
    target, at = Known(bent), np.zeros(2)
    information = target.squares(at).matrix
    found = valleys(target, at, information, 2)
    points = np.array([at, *found.at] if followed else [at])
    scale = np.linalg.inv(np.array([information, *found.information])[: len(points)])
    share = np.exp(target.log_density(points)) + 0.3 / len(points)
    drawn = sample(target.log_density, Mixture.of(share, points, scale), np.random.default_rng(0))
    x = np.linspace(0, 5, 20001)
    within = np.trapezoid(np.where(x < 2, np.exp(-0.5 * x**2), np.exp(-1.5 * x + 1)), x)
    beyond = np.exp(-1.5 * 5 + 1) / 1.5
    far = drawn.weight[np.abs(drawn.x[:, 0]) > 5].sum()
    if followed:
        assert drawn.trusted
        assert far == pytest.approx(beyond / (within + beyond), rel=0.5)
    else:
        assert far < 1e-6
        assert drawn.shape < 0.5


def test_a_rise_behind_a_dip_is_a_place_to_search_from():
    target = Known(two_basins)
    found = valleys(target, np.zeros(2), np.eye(2), 2)
    assert max(point[0] for point in found.onwards) > 5


def test_a_bound_ends_it():
    target = Known(bent, width=5.0)
    found = valleys(target, np.zeros(2), target.squares(np.zeros(2)).matrix, 2)
    assert np.abs(found.at).max() <= 5.0


class Saturated(Known):
    """y = 1 / (1 + exp(x)) of the logarithm x of a constant, beside a slope that goes with it: on the lower bound of x
    all is flat, and the tail beyond x = 0 is thin and bends."""

    def __init__(self):
        super().__init__(self._residuals_of)
        self.low, self.high = np.array([-7.0, -3.0]), np.array([4.6, 5.0])

    @staticmethod
    def _residuals_of(v):
        x, y = v
        grown = np.logaddexp(0, x)
        share = 1 / (1 + np.exp(-x))
        return (
            np.array([0.8 * grown, (y - grown) / THIN]),
            np.array([[0.8 * share, 0.0], [-share / THIN, 1 / THIN]]),
        )

    def log_density(self, u):
        inside = ((u >= self.low) & (u <= self.high)).all(axis=1)
        return np.where(inside, super().log_density(u), -np.inf)


def test_from_a_bound_a_flat_arm_is_followed_into_a_tail_that_bends():
    """1.8 % of the mass lies in the tail, of some thousand draws that come from four seeds."""
    target, at = Saturated(), np.array([-7.0, 0.0])
    information = target.squares(at).matrix
    found = valleys(target, at, information, 2)
    x = np.array(found.at)[:, 0]
    assert x.max() > 4
    points = np.array([at, *found.at])
    scale = np.linalg.inv(np.array([information + between(target), *found.information]))
    share = np.exp(target.log_density(points)) + 0.3 / len(points)
    start = Mixture.of(share, points, scale)
    met = []
    for seed in range(4):
        drawn = sample(target.log_density, start, np.random.default_rng(seed))
        assert drawn.trusted
        met.append(drawn.weight[drawn.x[:, 0] > 2].sum())
    x = np.linspace(-7, 4.6, 4001)
    density = np.exp(-0.32 * np.logaddexp(0, x) ** 2)
    beyond = np.trapezoid(density[x > 2], x[x > 2]) / np.trapezoid(density, x)
    assert np.mean(met) == pytest.approx(beyond, rel=0.2)


def plateau_beside_a_flat_direction(v):
    """x is hardly told, and goes with y, along which chi-squared stays at 9 from y = 3 on."""
    x, y = v
    rises = y < 3
    size, slope = (y, 1.0) if rises else (3.0, 1e-3)
    return np.array([size, (x - 0.3 * y) / 8]), np.array([[0.0, slope], [1 / 8, -0.3 / 8]])


class Flat(Known):
    """The bound of x is at two of its standard errors, that of y far along its plateau."""

    def __init__(self):
        super().__init__(plateau_beside_a_flat_direction)
        self.low, self.high = np.array([-40.0, -20.0]), np.array([12.0, 20.0])


def test_a_direction_out_of_the_bounds_is_followed_by_the_parameter_that_it_moves_most():
    """Nothing was said of it: the start across lay outside, and so did every point from there on."""
    target, at = Flat(), np.zeros(2)
    information = target.squares(at).matrix
    points = np.array(valleys(target, at, information, 2).at)
    assert points[:, 0].max() > 10
    assert (points >= target.low).all()
    assert (points <= target.high).all()
    assert points[:, 1].max() > 15  # along the second direction, on the plateau to its end
    far = points[np.argmax(points[:, 1])]
    assert -target.log_density(far[None])[0] == pytest.approx(4.5, abs=0.1)
