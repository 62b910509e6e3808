"""The smooth estimate of the spectral radius: its value against eigenvalues, its derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest

from casadi_engine.simulation import jets
from casadi_engine.simulation.stability import log_decay


def family(seed, n, d):
    """A random jet of the second order and the quadratic function that has it."""
    rng = np.random.default_rng(seed)
    jet = rng.normal(size=(jets.count(d, 2), n, n)) / np.sqrt(n)
    i, j = jets.pairs(d)

    def at(z):
        factor = np.where(i == j, 0.5, 1.0) * z[i] * z[j]
        return jet[0] + np.tensordot(z, jet[1 : 1 + d], 1) + np.tensordot(factor, jet[1 + d :], 1)

    return jet, at


def directly(f, m):
    """The definition, with the powers written out."""
    powers = [np.linalg.matrix_power(f, k) for k in range(m + 1)]
    total = sum(p @ p.T for p in powers[:m])
    return np.log(np.trace(powers[m] @ total @ powers[m].T) / np.trace(total)) / (2 * m)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("n", [1, 2, 5, 13])
@pytest.mark.parametrize("radius", [0.8, 1.0, 1.2])
def test_it_tends_to_the_spectral_radius(seed, n, radius):
    f = np.random.default_rng(seed).normal(size=(n, n))
    f *= radius / np.abs(np.linalg.eigvals(f)).max()
    for k in (0, 1, 3):
        assert log_decay(f[None], 0, k)[0] == pytest.approx(directly(f, 2**k), rel=1e-10, abs=1e-12)
    off = [abs(log_decay(f[None], 0, k)[0] - np.log(radius)) for k in (4, 9, 14)]
    assert off[1] < 0.02
    assert off[2] < 0.001


@pytest.mark.parametrize("seed", range(20))
def test_its_sign_tells_stable_from_unstable(seed):
    f = np.random.default_rng(seed).normal(size=(4, 4))
    f /= np.abs(np.linalg.eigvals(f)).max()
    assert log_decay(f[None] * 0.999, 0, 14)[0] < 0
    assert log_decay(f[None] * 1.001, 0, 14)[0] > 0


@pytest.mark.parametrize("doublings", [0, 3, 9])
def test_derivatives_equal_differences(doublings):
    jet, at = family(0, 4, 3)
    found, e = log_decay(jet, 3, doublings), 1e-6
    pairs = dict(zip(zip(*jets.pairs(3), strict=True), found[4:], strict=True))

    def moved(z):
        """A jet at another point, for the slope there."""
        slope = np.array([jet[1 + k] for k in range(3)])
        for (a, b), second in zip(zip(*jets.pairs(3), strict=True), jet[4:], strict=True):
            slope[a] += z[b] * second
            slope[b] += z[a] * second * (a != b)
        return np.concatenate([at(z)[None], slope])

    for k, step in enumerate(e * np.eye(3)):
        high, low = (log_decay(moved(s), 3, doublings) for s in (step, -step))
        assert found[1 + k] == pytest.approx((high[0] - low[0]) / (2 * e), rel=1e-5, abs=1e-8)
        for other in range(3):
            key = (min(k, other), max(k, other))
            assert pairs[key] == pytest.approx(
                (high[1 + other] - low[1 + other]) / (2 * e), rel=1e-4, abs=1e-6
            )


def test_it_is_smooth_where_eigenvalues_meet_and_change_places():
    # a pair of real eigenvalues that meets at t = 0 and goes off the axis: the spectral radius has an infinite slope
    values = []
    for t in (-1e-8, 0.0, 1e-8):
        f = np.array([[[0.9, 1.0], [-t, 0.9]], [[0.0, 0.0], [-1.0, 0.0]]])
        values.append(log_decay(f, 1, 10))
    assert np.isfinite(values).all()
    assert values[2][1] == pytest.approx(values[0][1], rel=1e-2)
    assert (values[2][0] - values[0][0]) / 2e-8 == pytest.approx(values[1][1], rel=1e-4)


def test_powers_beyond_the_range_of_numbers():
    assert log_decay(np.diag([1e-8, 1e-9])[None], 0, 20)[0] == pytest.approx(np.log(1e-8), rel=1e-6)
    assert log_decay(np.diag([1e8, 1.0])[None], 0, 20)[0] == pytest.approx(np.log(1e8), rel=1e-6)
    gone = log_decay(np.array([[[0.0, 1.0], [0.0, 0.0]], [[1.0, 0.0], [0.0, 0.0]]]), 1, 3)
    assert gone[0] == -np.inf
    assert not gone[1:].any()
