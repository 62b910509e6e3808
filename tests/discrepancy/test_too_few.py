"""Fresh data that tell neither for nor against what was found."""

from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.discrepancy.confirmation import Gap, PairedGain
from casadi_engine.discrepancy.fresh import NOT_CONFIRMED
from casadi_engine.discrepancy.repaired import FoundEffect, Gaps, Repair, Side
from casadi_engine.discrepancy.too_few import held_to_what_fresh_data_tell
from casadi_engine.estimation.fit import Trace

NOISE = SimpleNamespace(sigma={"y": (1.0, True)}, scatter={}, colour={})
SAMPLES = 400


def side(measured, simulated):
    time = np.arange(len(measured)) * 0.1
    trace = Trace(time, measured, np.ones(len(measured), dtype=bool), simulated)
    rms = float(np.sqrt(np.mean((measured - simulated) ** 2)))
    return Side(Gap(rms**2, {"y": rms}, {"y": 50.0}, len(measured)), {}, {"fresh": {"y": trace}})


def repaired(effect, size, *, seed=0, **gain):
    """A repair whose effect changes fresh simulations by ``size`` standard errors, where it is ``effect`` of it."""
    shape = np.sin(np.arange(SAMPLES))
    shape *= size / np.linalg.norm(shape)
    measured = effect * shape + np.random.default_rng(seed).standard_normal(SAMPLES)
    known = side(np.ones(SAMPLES), np.zeros(SAMPLES))
    before, after = side(measured, 0 * shape), side(measured, shape)
    gaps = Gaps(known, known, before, after, PairedGain(0.1, 1.0, 10, False, **gain), "records")
    found = FoundEffect("bend", "engine", "", {}, {}, {}, 9.0, 1e-9, 50.0, 1.0, {}, {}, None, ())
    said = (f"{NOT_CONFIRMED}: the gain is 0.1 ± 1", "said before")
    return Repair(
        "answered", "named", False, None, None, 0.01, effects=(found,), messages=said, gaps=gaps, noise=NOISE
    )


def test_an_effect_that_hardly_shows_there_is_neither_confirmed_nor_refused():
    made = repaired(1.0, 2.0)
    found = held_to_what_fresh_data_tell(made)
    assert found.confirmed is None
    assert found.messages[0].startswith(
        "the fresh data cannot tell: if what was found is right, 2 ln(likelihood)"
    )
    assert "changes there by 4 ± 4" in found.messages[0]
    assert found.messages[1:] == ("said before",)


@pytest.mark.parametrize(
    ("effect", "size"),
    [(1.0, 8.0), (-2.0, 4.0)],
    ids=["one that they would tell", "one of the other sign"],
)
def test_fresh_data_that_can_tell_are_heard(effect, size):
    made = repaired(effect, size)
    assert held_to_what_fresh_data_tell(made) is made


def test_an_effect_that_is_absent_is_refused_as_often_as_two_standard_errors_say():
    """With D = 16 the gain is -16 ± 8 where the effect is absent, and 16 ± 8 where it is there."""
    absent = [held_to_what_fresh_data_tell(repaired(0.0, 4.0, seed=k)).confirmed for k in range(40)]
    there = [held_to_what_fresh_data_tell(repaired(1.0, 4.0, seed=k)).confirmed for k in range(40)]
    assert absent.count(False) >= 38
    assert there.count(None) >= 36
