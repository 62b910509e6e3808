"""How many samples a residual is worth, and how often half-samples agree."""

import numpy as np
import pytest

from casadi_engine.discrepancy.compression import compress
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.selection import effective_samples, selection_frequency


def test_effective_samples_of_an_autoregression():
    rng = np.random.default_rng(0)
    white = rng.standard_normal(40_000)
    slow = np.empty_like(white)
    slow[0] = white[0]
    for k in range(1, len(white)):
        slow[k] = 0.8 * slow[k - 1] + white[k]
    assert effective_samples(white) == pytest.approx(40_000, rel=0.1)
    assert effective_samples(slow) == pytest.approx(40_000 * 0.2 / 1.8, rel=0.2)
    assert effective_samples(np.zeros(10)) == 10


def test_half_samples_of_cycles_choose_a_strong_effect_every_time(shaft):
    size = 0.8

    def hidden(t, x):
        return size * np.sign(x[1] - x[0]) * np.array([1, -1])

    candidates = shaft.candidates(shaft.model)[:10]
    strong = compress(shaft.null(shaft.data(hidden=hidden, n=800)), candidates, NoiseModel(shaft.sigma))
    found = selection_frequency(strong, halves=20)
    assert next(iter(found)) == ("coulomb_friction", "coupling")
    assert found["coulomb_friction", "coupling"] > 0.7
    noise = compress(shaft.null(shaft.data(n=800)), candidates, NoiseModel(shaft.sigma))
    assert max(selection_frequency(noise, halves=20).values()) < 0.9
    assert sum(found.values()) == pytest.approx(1)


def test_too_few_cycles_have_no_halves(shaft):
    made = compress(shaft.null(shaft.data(n=60)), shaft.candidates(shaft.model)[:2], NoiseModel(shaft.sigma))
    assert selection_frequency(type(made)(**{**vars(made), "parts": made.parts[:3]})) == {}
