"""Ctrl-C is noted, handed on to the one outside, and raises the second time."""

import os
import signal

import pytest

from casadi_engine.estimation.interrupts import Interrupts


@pytest.fixture(autouse=True)
def as_at_a_prompt():
    """Python's own handler, whatever was there: a shell's background jobs ignore the signal."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def press():
    os.kill(os.getpid(), signal.SIGINT)


def test_the_first_is_noted_and_the_second_raises():
    asked = []
    with Interrupts(lambda: asked.append(1)) as outer:
        press()
        assert (outer.stopped, asked) == (True, [1])
        with pytest.raises(KeyboardInterrupt):
            press()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_inner_one_hands_it_on_when_it_closes():
    asked = []
    with Interrupts(lambda: asked.append(1)) as outer:
        with Interrupts() as inner:
            press()
            assert (inner.stopped, outer.stopped, asked) == (True, False, [])
        assert (outer.stopped, asked) == (True, [1])
        assert not outer.twice
        with pytest.raises(KeyboardInterrupt):
            press()
        assert outer.twice
    assert asked == [1]


def test_a_second_press_in_an_inner_one_is_the_second_of_the_outer_one():
    with Interrupts() as outer:
        press()
        with Interrupts() as inner:
            press()  # noted, as in a fit that keeps its best point
            assert (inner.stopped, inner.twice) == (True, False)
        assert outer.twice


def test_two_presses_in_an_inner_one_are_two():
    with Interrupts() as outer:
        with pytest.raises(KeyboardInterrupt), Interrupts():  # noqa: PT012 (the second is the one that raises)
            press()
            press()
        assert (outer.stopped, outer.twice) == (True, True)


def test_without_a_press_nothing_is_handed_on():
    with Interrupts() as outer, Interrupts():
        pass
    assert not outer.stopped
