"""Records at a lower rate: white noise stays white, low frequencies pass, and a linear system passes the filter on."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from casadi_engine import Experiment
from casadi_engine.experiment.decimation import REACH, _kernel, decimated, rows_at_lower_rate

FACTORS = (4, 6, 8, 12, 16, 24, 32)


@pytest.mark.parametrize("factor", FACTORS)
def test_the_filter_is_orthogonal_to_itself_shifted_by_its_period(factor):
    kernel = _kernel(factor, False, False)
    lags = range(factor, 2 * REACH * factor, factor)
    products = [float(kernel[:-lag] @ kernel[lag:]) for lag in lags]
    assert np.abs(products).max() < 1e-3 * float(kernel @ kernel)


@pytest.mark.parametrize("factor", FACTORS)
def test_frequencies_to_a_fifth_of_the_lower_rate_keep_their_information(factor):
    kernel = _kernel(factor, False, False)
    lag = np.arange(len(kernel)) - len(kernel) // 2
    for share in (0.0, 0.05, 0.1, 0.15, 0.2):
        gain = float(kernel @ np.cos(2 * np.pi * share / factor * lag))
        kept = gain**2 / (factor * float(kernel @ kernel))
        assert abs(kept - 1) < 3e-3


@settings(max_examples=20, deadline=None)
@given(slope=st.floats(-1e3, 1e3), start=st.floats(-1e3, 1e3), factor=st.sampled_from(FACTORS))
def test_straight_lines_pass_unchanged_up_to_the_ends(slope, start, factor):
    time = np.arange(40 * factor + 1) * 1e-3
    record = Experiment.from_arrays(
        "line", time=time, units={"u": "1", "y": "1"}, u=start + slope * time, y=time
    )
    made = decimated(record, ("u",), ("y",), factor)
    expected = start + slope * made["u"].time
    assert made["u"].values == pytest.approx(expected, abs=1e-9 * (1 + abs(slope) + abs(start)))
    fine = made.decimation.sampled(record["u"].values, len(made["u"]), late=False, sharp=True)
    assert fine == pytest.approx(expected, abs=1e-9 * (1 + abs(slope) + abs(start)))


def test_a_value_that_holds_until_the_next_sample_stands_for_the_middle_of_its_step():
    factor, step = 8, 1e-3
    time = np.arange(2001) * step
    late = np.sin(2 * np.pi * 3 * time)
    record = Experiment.from_arrays(
        "stairs", time=time, units={"u": "1", "y": "1"}, hold={"u": "zero", "y": "first"}, u=late, y=late
    )
    made = decimated(record, ("u",), ("y",), factor)
    inner = slice(REACH, -REACH)
    assert made["u"].hold == "first"
    shown = np.sin(2 * np.pi * 3 * (made["u"].time - step / 2))
    assert made["u"].values[inner] == pytest.approx(shown[inner], abs=1e-3)
    assert made["y"].values[inner] == pytest.approx(np.sin(2 * np.pi * 3 * made["y"].time)[inner], abs=1e-3)


def test_outputs_are_missing_where_the_filter_does_not_fit():
    time = np.arange(1001) * 1e-3
    record = Experiment.from_arrays("ends", time=time, units={"u": "1", "y": "1"}, u=time, y=time)
    made = decimated(record, ("u",), ("y",), 10)
    assert len(made["y"]) == 101
    assert made["y"].mask.tolist() == [False] * REACH + [True] * (101 - 2 * REACH) + [False] * REACH
    assert made["u"].mask.all()
    assert made.begin == 0.0


@pytest.mark.parametrize("factor", [6, 12, 24])
def test_a_linear_system_passes_the_filter_on(factor):
    """The system's answer to the lines between filtered inputs is its filtered answer."""
    step, rng = 1e-3, np.random.default_rng(1)
    time = np.arange(12_001) * step
    bands = rng.uniform(0.1, 0.1 / (factor * step), 12)
    drive = sum(np.sin(2 * np.pi * f * time + rng.uniform(0, 6)) for f in bands)
    system = signal.lti([200.0], [1.0, 2.0, 900.0])
    _, answer, _ = signal.lsim(system, drive, time)
    record = Experiment.from_arrays("mass", time=time, units={"u": "1", "y": "1"}, u=drive, y=answer)
    made = decimated(record, ("u",), ("y",), factor)
    corners = made.decimation.sampled(drive, len(made["u"]), late=False, sharp=True)
    coarse = made["u"].time
    # far from the start, whose initial state is not the filtered one's
    _, found, _ = signal.lsim(system, corners, coarse)
    later = made["y"].mask & (coarse > 8.0)
    error = found[later] - made["y"].values[later]
    assert np.sqrt(np.mean(error**2)) < 2e-3 * np.std(made["y"].values[later])


def test_white_noise_keeps_its_size_and_stays_white():
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((40, 12_001))
    thin = rows_at_lower_rate(noise, 12, 1001)[:, REACH:-REACH]
    assert thin.var() == pytest.approx(1.0, abs=4 / np.sqrt(thin.size))
    for lag in (1, 2, 3):
        assert abs(np.mean(thin[:, lag:] * thin[:, :-lag])) < 4 / np.sqrt(thin.size)
