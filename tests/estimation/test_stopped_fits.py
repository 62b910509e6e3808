"""Ctrl-C after the search of a fit: what it was to do then is left out, and that is said."""

import os
import signal
import sys
import time

import pytest

import casadi_engine as ce
from casadi_engine.deadline import ask


@pytest.fixture(autouse=True)
def as_at_a_prompt():
    """Python's own handler, whatever was there: a shell's background jobs ignore the signal."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("step", ["follow_delays", "follow_motion", "told_from_their_bounds"])
def test_it_ends_what_follows_the_search(step, line, line_data, monkeypatch):
    def pressed(*_):
        os.kill(os.getpid(), signal.SIGINT)
        until = time.perf_counter() + 5.0
        while time.perf_counter() < until:
            ask()
        raise AssertionError("nobody told it")

    monkeypatch.setattr(sys.modules["casadi_engine.estimation.estimate"], step, pressed)
    fit = ce.estimate(line(), line_data().data, progress=False)
    assert fit.status == "interrupted"
    assert "interrupted by the user" in fit.messages[0]
    assert fit.values["p1"] == pytest.approx(1.5, abs=0.1)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
