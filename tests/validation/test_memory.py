"""How many samples of a residual count for one, and the test of parameters that is divided by it."""

import numpy as np
import pytest
from scipy.signal import lfilter

from casadi_engine.validation.level_tests import memory_of


@pytest.mark.parametrize("share", [0.5, 0.8, 0.9])
def test_the_memory_of_an_autoregression_is_that_of_its_mean(share):
    """(1 + a)/(1 - a) samples of it tell as much of a mean as one of white noise."""
    e = np.random.default_rng(1).standard_normal(20_000)
    assert memory_of(lfilter([1.0], [1.0, -share], e)) == pytest.approx((1 + share) / (1 - share), rel=0.2)


def test_white_noise_and_what_does_not_move_have_none():
    random = np.random.default_rng(2)
    assert np.mean([memory_of(random.standard_normal(200)) > 1 for _ in range(500)]) < 0.02
    assert memory_of(np.zeros(50)) == 1.0
    assert memory_of(np.ones(2)) == 1.0
