"""The spectrum of a residual names the frequencies at which the model lacks something."""

import numpy as np
import pytest

from casadi_engine.estimation.fit import Trace
from casadi_engine.report.panels import Subject, draw_spectrum
from casadi_engine.report.sketch import Panel

RATE, SIGMA = 2000.0, 0.1


def named(tones, *, seed=0):
    """The frequencies written over the spectrum of tones (Hz, amplitude) in white noise."""
    time = np.arange(8000) / RATE
    noise = np.random.default_rng(seed).normal(0, SIGMA, time.size)
    residual = noise + sum(amplitude * np.sin(2 * np.pi * hz * time) for hz, amplitude in tones)
    trace = Trace(time, residual, np.ones(time.size, bool), np.zeros(time.size))
    panel = Panel(slice(1), slice(1))
    draw_spectrum(panel, trace, Subject("run", "omega", "rad/s", SIGMA))
    return [float(mark.values[2].removesuffix(" Hz")) for mark in panel.marks if mark.kind == "write"]


def test_lines_above_the_noise_are_named_the_strongest_first():
    found = named([(330.0, 0.2), (70.0, 0.1)])
    assert found == pytest.approx([330, 70], abs=RATE / 1000)


@pytest.mark.parametrize("seed", range(5))
def test_white_noise_has_no_lines(seed):
    assert named([], seed=seed) == []


def test_not_more_than_can_be_read():
    assert len(named([(100.0 * k, 0.2) for k in range(1, 9)])) == 4
