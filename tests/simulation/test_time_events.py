"""Steps cut where equations jump in time: the increment over a step, and its slope in the instant."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.errors import SimulationError
from casadi_engine.simulation.time_events import time_events

T, U, X, P = ca.SX.sym("t"), ca.SX.sym("u"), ca.SX.sym("x"), ca.SX.sym("p", 2)


LATER, EARLIER = ca.gt(T, P[0]), ca.lt(T, P[1])


def increment(rate, *, low=0.0, high=0.0):
    """(begin, length, p) -> the change over a step, and its slope in p; by Simpson's rule in each part."""
    events = time_events(ca.SX(rate), U, T, X)
    begin, length = ca.SX.sym("begin"), ca.SX.sym("length")
    total = ca.SX(0)
    for k in range(events.parts):
        part = ca.DM.zeros(events.parts, 1)
        part[k] = 1
        for node, weight in ((0.0, 1 / 6), (0.5, 4 / 6), (1.0, 1 / 6)):
            total += weight * events.slope(ca.SX(low), ca.SX(high), begin, length, ca.SX(node), ca.SX(part))
    function = ca.Function("increment", [begin, length, P], [total, ca.jacobian(total, P)])
    return lambda *arguments: [np.asarray(part, dtype=float).ravel() for part in function(*arguments)]


LOAD = increment(ca.if_else(LATER, P[1] * T**2, 0))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.floats(-1, 2), st.floats(0.05, 1), st.floats(-1.5, 3.5))
def test_a_load_that_comes_at_an_instant(begin, length, instant):
    value, slope = LOAD(begin, length, [instant, 2.0])
    on, end = np.clip(instant, begin, begin + length), begin + length
    assert value[0] == pytest.approx(2 / 3 * (end**3 - on**3), abs=1e-12)
    if begin < instant < end:
        np.testing.assert_allclose(slope, [-2 * instant**2, (end**3 - on**3) / 3], atol=1e-10)
    elif instant < begin or instant >= end:
        np.testing.assert_allclose(slope, [0, (end**3 - on**3) / 3], atol=1e-12)


BOTH = increment(3 * ca.if_else(LATER, 1, 0) + T * ca.if_else(EARLIER, 1, 0))


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.floats(-0.5, 1.5), st.floats(-0.5, 1.5))
def test_two_instants_in_any_order(first, second):
    value, slope = BOTH(0.0, 1.0, [first, second])
    on, off = np.clip([first, second], 0, 1)
    assert value[0] == pytest.approx(3 * (1 - on) + off**2 / 2, abs=1e-12)
    if first != second:  # where they meet, either of both may come first
        inside = [0 <= first < 1, 0 <= second < 1]
        np.testing.assert_allclose(slope, np.where(inside, [-3, off], 0), atol=1e-10)


def test_a_pulse_within_one_step():
    step = increment(ca.if_else(ca.logic_and(LATER, ca.lt(T, P[0] + P[1])), 1, 0))
    value, slope = step(0.0, 1.0, [0.3, 0.2])
    assert value[0] == pytest.approx(0.2, abs=1e-13)
    np.testing.assert_allclose(slope, [0, 1], atol=1e-12)


def test_an_instant_between_two_steps_has_its_whole_slope_in_one():
    after, before = LOAD(0.5, 0.5, [0.5, 2.0]), LOAD(0.0, 0.5, [0.5, 2.0])
    assert before[0][0] == pytest.approx(0.0, abs=1e-15)
    assert after[0][0] == pytest.approx(2 / 3 * (1 - 0.5**3))
    assert before[1][0] + after[1][0] == pytest.approx(-2 * 0.5**2)


def test_a_step_of_no_length_changes_nothing():
    value, slope = LOAD(0.7, 0.0, [0.2, 1.0])
    np.testing.assert_array_equal(value, 0)
    np.testing.assert_array_equal(slope, 0)


@pytest.mark.parametrize("level", [0.1, 0.5, 0.9])
def test_a_recorded_channel_passes_a_level(level):
    """The channel rises from 0 to 1 over the step; the threshold has a slope."""
    step = increment(ca.if_else(ca.gt(U, P[0]), U, 0), low=0.0, high=1.0)
    value, slope = step(2.0, 4.0, [level, 0.0])
    assert value[0] == pytest.approx(4 * (1 - level**2) / 2, abs=1e-12)
    assert slope[0] == pytest.approx(-4 * level, abs=1e-10)


def test_a_curved_switch_is_met_at_its_root():
    step = increment(ca.if_else(ca.gt(T**3, P[0]), 1, 0))
    value, slope = step(0.0, 1.0, [0.3, 0.0])
    root = 0.3 ** (1 / 3)
    assert value[0] == pytest.approx(1 - root, abs=1e-9)
    assert slope[0] == pytest.approx(-1 / (3 * root**2), rel=1e-6)


@pytest.mark.parametrize(
    "rate", [-X, ca.sin(T) * X, ca.sign(X) * U, ca.fabs(U) * X, ca.fmax(U, 0.2), ca.if_else(X > T, 1, 0)]
)
def test_what_does_not_jump_in_time_is_left_whole(rate):
    assert time_events(rate, U, T, X) is None


def test_a_corner_in_time_is_an_instant_and_one_of_a_state_is_not():
    events = time_events(ca.fabs(T - 1) - ca.fabs(X) * ca.if_else(T > 2, 1, 0), U, T, X)
    assert len(events.switches) == 2
    assert events.parts == 3


def test_too_many_switches_are_refused():
    rate = sum((ca.if_else(ca.gt(T, k), 1, 0) for k in range(7)), ca.SX(0))
    with pytest.raises(SimulationError) as refused:
        time_events(rate, U, T, X)
    assert str(refused.value) == (
        "the equations switch in time in more ways than can be integrated at their instants; "
        "seen: 7 different conditions; allowed: up to 6; do: put the switches into one input channel, "
        "or smooth some of them"
    )
