"""Residuals of two sensors: independent noise of any colour is no alarm, what both show is."""

from types import SimpleNamespace as stub

import numpy as np
import pytest
from scipy.signal import lfilter

from casadi_engine.discrepancy.certificate import unknown_of
from casadi_engine.discrepancy.common_noise import common_tests
from casadi_engine.discrepancy.leftover import Leftover

COUNT = 400


def record(*outputs, shift=0):
    index = {name: np.arange(COUNT) + shift * k for k, name in enumerate(outputs)}
    slopes = np.column_stack([np.ones(COUNT), np.linspace(-1, 1, COUNT)])
    return stub(
        name="run", outputs=outputs, index=index, length=dict.fromkeys(outputs, COUNT + shift),
        time={name: 0.01 * own for name, own in index.items()}, slopes=dict.fromkeys(outputs, slopes),
    )  # fmt: skip


def noise(rng, memory):
    e = lfilter([1.0], [1.0, -memory], rng.standard_normal(COUNT + 200))[200:]
    q, _ = np.linalg.qr(np.column_stack([np.ones(COUNT), np.linspace(-1, 1, COUNT)]))
    return e - q @ (q.T @ e)  # what the slopes explain is taken out


def p_of(rng, memories, common=0.0):
    shared = noise(rng, 0.9)
    left = {name: noise(rng, own) + common * shared for name, own in zip("ab", memories, strict=True)}
    ((name, p),) = common_tests([record("a", "b")], {"run": left})
    assert name == "run/a/beside b"
    return p


@pytest.mark.parametrize("memories", [(0.0, 0.0), (0.9, 0.9), (0.0, 0.95)])
def test_independent_noise_is_no_alarm(memories):
    rng = np.random.default_rng(7)
    found = np.array([p_of(rng, memories) for _ in range(200)])
    assert np.mean(found < 0.02) <= 0.055  # 4 expected; beyond 11 of 200 lies one in 700


def test_what_both_show_is_seen_in_noise_of_any_colour():
    rng = np.random.default_rng(8)
    assert np.mean([p_of(rng, (0.9, 0.9), common=1.0) < 1e-3 for _ in range(40)]) > 0.9


def test_outputs_of_different_times_are_not_held_against_each_other():
    rng = np.random.default_rng(9)
    left = {"run": {name: noise(rng, 0.0) for name in "ab"}}
    assert list(common_tests([record("a", "b", shift=1)], left)) == []


def test_it_is_said_in_words():
    screened = stub(leftover=Leftover({"run/a/beside b": 1e-9, "run/a/whiteness": 0.5}, 1e-3))
    assert unknown_of(screened).sentence == (
        "the residuals of a and b in run are correlated, which the noise of two sensors is not"
    )
