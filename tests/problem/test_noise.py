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


def test_innovations_of_some_outputs():
    noise = Noise(omega="innovations", omega_load=0.2)
    assert noise.innovations == ("omega",)
    assert [noise.level(name) for name in noise.outputs] == ["estimate", 0.2]
    assert repr(noise) == "Noise(omega='innovations', omega_load=0.2)"


def test_only_what_predicts_does():
    predicting = (Noise(omega="innovations"), Noise(process="estimate"), Noise(gain=1.0))
    assert [noise.predicts for noise in (*predicting, Noise(omega=0.1), Noise())] == [True] * 3 + [False] * 2


def test_process_noise_is_a_copy_that_cannot_change():
    given = {"omega_eng": 0.05, "omega_load": "estimate"}
    noise = Noise(omega=0.1, process=given)
    given["omega_eng"] = 9.0
    assert dict(noise.process) == {"omega_eng": 0.05, "omega_load": "estimate"}
    with pytest.raises(TypeError):
        noise.process["omega_eng"] = 1.0
    assert repr(noise) == "Noise(omega=0.1, process={'omega_eng': 0.05, 'omega_load': 'estimate'})"
    assert repr(Noise(process="estimate")) == "Noise(process='estimate')"


@pytest.mark.parametrize(
    "process", [{}, {"x": 0.0}, {"x": -1.0}, {"x": math.nan}, {"x": "known"}, 0.1, "all", True]
)
def test_process_noise_that_is_none(process):
    with pytest.raises(EstimationError, match="the process noise is not acceptable") as caught:
        Noise(process=process)
    text = str(caught.value)
    assert 'state -> a standard deviation > 0 per square root of a second, or "estimate"' in text
    assert 'Noise(omega=0.1, process={"omega_eng": "estimate"})' in text


@pytest.mark.parametrize(
    ("given", "seen"),
    [
        ({"gain": 1.0, "process": "estimate"}, "gain and process"),
        ({"omega": "innovations", "process": {"x": 1.0}}, 'process and "innovations"'),
        ({"omega": "innovations", "gain": 1.0}, 'gain and "innovations"'),
    ],
)
def test_a_gain_that_is_asked_for_twice(given, seen):
    with pytest.raises(EstimationError, match="in more ways than one") as caught:
        Noise(**given)
    assert f"seen: {seen}; " in str(caught.value)
    assert 'one of gain=, process= and output="innovations"' in str(caught.value)


@pytest.mark.parametrize("level", [np.float32(0.5), np.float64(0.5), np.array(0.5)])
def test_numbers_of_numpy_are_levels(level):
    assert Noise(omega=level).level("omega") == 0.5
    assert type(Noise(omega=level).level("omega")) is float
    assert Noise(omega=0.1, process={"omega_eng": level}).process == {"omega_eng": 0.5}


@pytest.mark.parametrize("given", [np.array([0.1, 0.2]), 10**400, b"x", {}, object()])
def test_what_is_no_number_is_refused_in_words(given):
    with pytest.raises(EstimationError, match="the noise level of omega is not acceptable"):
        Noise(omega=given)
    with pytest.raises(EstimationError, match="the process noise is not acceptable"):
        Noise(process=given)


def test_a_gain_too_large_for_a_number():
    with pytest.raises(EstimationError, match="the gain of the predictor is not acceptable"):
        Noise(gain=10**400)
