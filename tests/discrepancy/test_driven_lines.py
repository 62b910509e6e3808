"""Lines of a residual that the inputs bring are told from those of something else."""

import numpy as np
import pytest
from scipy.signal import lfilter

from casadi_engine.discrepancy.driven_lines import driven_by

SAMPLES = 1000
T = np.arange(SAMPLES)
FREQUENCIES = np.array([0.0083, 0.0147, 0.0231, 0.0411, 0.0723])


def sines(frequencies=FREQUENCIES, seed=0):
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(frequencies))
    return sum(np.sin(2 * np.pi * f * T + p) for f, p in zip(frequencies, phase, strict=True))


def broad(seed, kind):
    """Without lines: white, coloured, or in random steps."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal(SAMPLES + 500)
    if kind == "white":
        return white[500:]
    if kind == "coloured":
        return lfilter([1.0], [1, -0.95], white)[500:]
    return np.repeat(rng.uniform(-1, 1, SAMPLES // 20), 20)


@pytest.mark.parametrize("frequency", FREQUENCIES)
def test_a_line_at_a_sine_of_an_input_is_its_own(frequency):
    inputs = {"noise": broad(1, "white"), "u": 40 + sines(), "still": np.full(SAMPLES, 3.0)}
    assert driven_by(frequency + 0.4 / SAMPLES, inputs) == ("u",)


def test_an_angle_that_goes_on_has_the_lines_of_its_swinging_alone():
    angle = 0.5 * T + 0.01 * np.sin(2 * np.pi * 0.05 * T)
    assert driven_by(0.05, {"theta": angle}) == ("theta",)
    assert driven_by(0.1273, {"theta": angle}) == ()


@pytest.mark.parametrize(
    ("frequency", "names"),
    [(0.06, ("u",)), (0.09, ("u",)), (0.148, ("u", "v")), (0.088, ("u", "v")), (0.2, ()), (0.02, ())],
)
def test_multiples_and_sums_of_sines_are_those_of_what_answers(frequency, names):
    """Of 0.03 in one input and 0.118 in another one."""
    inputs = {"u": sines([0.03]), "v": 2 * sines([0.118])}
    assert driven_by(frequency, inputs) == names


@pytest.mark.parametrize("kind", ["white", "coloured", "steps"])
def test_a_foreign_line_is_hardly_ever_one_of_an_input_without_lines(kind):
    """One in a thousand is what the test allows; 400 inputs, at a frequency where they have power."""
    told = sum(bool(driven_by(0.0153, {"u": broad(seed, kind)})) for seed in range(400))
    assert told <= 4


def test_a_foreign_line_beside_many_sines_is_one_of_them_in_a_tenth_at_most():
    rng = np.random.default_rng(5)
    inputs = {"u": sines()}
    foreign = [f for f in rng.uniform(0.003, 0.25, 300) if np.abs(f - FREQUENCIES).min() > 2 / SAMPLES]
    assert len(foreign) > 250
    assert np.mean([bool(driven_by(f, inputs)) for f in foreign]) < 0.1
