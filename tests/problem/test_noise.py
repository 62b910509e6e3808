"""Noise: levels that are known or estimated, and the predictor's gain."""

from __future__ import annotations

import math

import numpy as np
import pytest

from casadi_engine.errors import EstimationError
from casadi_engine.problem import Noise


def test_levels():
    noise = Noise(omega=0.1, omega_load="estimate")
    assert noise.outputs == ("omega", "omega_load")
    assert [noise.level(name) for name in ("omega", "omega_load", "other")] == [0.1, "estimate", "estimate"]
    assert repr(noise) == "Noise(omega=0.1, omega_load='estimate')"


@pytest.mark.parametrize("level", [0, -1.0, math.nan, math.inf, "known", True, None, [0.1]])
def test_levels_that_are_none(level):
    with pytest.raises(EstimationError) as caught:
        Noise(omega=level)
    text = str(caught.value)
    assert "the noise level of omega is not acceptable" in text
    assert "a standard deviation > 0" in text
    assert 'Noise(omega="estimate")' in text


def test_gain_is_a_copy_that_cannot_change():
    given = np.array([[1.0], [0.5]])
    noise = Noise(gain=given, omega=0.1)
    given[0, 0] = 9.0
    assert noise.gain.tolist() == [[1.0], [0.5]]
    assert not noise.gain.flags.writeable
    assert "gain=[[1.0], [0.5]]" in repr(noise)
    assert Noise(gain=1.0).gain.shape == (1, 1)


@pytest.mark.parametrize("gain", [[[math.nan]], "one", [[1.0], [1.0, 2.0]], np.ones((2, 2, 2))])
def test_gains_that_are_none(gain):
    with pytest.raises(EstimationError, match="the gain of the predictor is not acceptable") as caught:
        Noise(gain=gain)
    assert "states by outputs" in str(caught.value)
