"""A line is found in white and in coloured noise, and coloured noise has none more often than the test says."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter
from scipy.signal.windows import dpss

import casadi_engine as ce
from casadi_engine.discrepancy.certificate import unknown_of
from casadi_engine.discrepancy.spectral_line import _tapers, strongest_line

SAMPLES = 600


def noise(seed, *, memory=0.0, count=SAMPLES):
    white = np.random.default_rng(seed).standard_normal(count + 500)
    return lfilter([np.sqrt(1 - memory**2)], [1, -memory], white)[500:]


def line(residual):
    return strongest_line(residual, np.ones(len(residual), dtype=bool))


@pytest.mark.parametrize("count", [64, 601])
def test_the_tapers_are_those_of_scipy(count):
    found, wanted = _tapers(count), dpss(count, 4.0, 7)
    signs = np.sign((found * wanted).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(signs * found, wanted, rtol=0, atol=1e-10)


@pytest.mark.parametrize("memory", [0.0, 0.9])
@pytest.mark.parametrize("frequency", [0.015, 0.031, 0.2])
def test_a_sine_is_found_at_its_frequency(frequency, memory):
    t = np.arange(SAMPLES)
    found = line(2.0 * np.sin(2 * np.pi * frequency * t + 0.4) + noise(3, memory=memory))
    assert found.p < 1e-3
    assert found.frequency == pytest.approx(frequency, abs=0.7 / SAMPLES)


@pytest.mark.parametrize(
    "memory", [pytest.param(0.0, marks=pytest.mark.slow), pytest.param(0.8, marks=pytest.mark.slow), 0.95]
)
def test_noise_of_any_smooth_colour_has_a_line_as_often_as_it_is_said(memory):
    p = np.array([line(noise(seed, memory=memory)).p for seed in range(400)])
    assert (p < 0.05).mean() < 0.08
    assert (p < 0.001).sum() <= 3


def test_nothing_is_said_of_few_samples_or_a_residual_that_never_moves():
    residual = noise(1)
    assert line(residual[:60]) is None
    assert strongest_line(residual, np.arange(SAMPLES) % 50 > 0) is None
    assert strongest_line(residual, np.zeros(SAMPLES, dtype=bool)) is None
    assert line(np.ones(SAMPLES)) is None


def test_of_a_record_with_a_hole_the_longer_part_counts():
    t = np.arange(SAMPLES)
    residual = 2 * np.sin(2 * np.pi * 0.05 * t) + noise(2)
    valid = t != 200
    residual[200] = np.nan
    found = strongest_line(residual, valid)
    assert found == line(residual[201:])
    assert found.frequency == pytest.approx(0.05, abs=0.002)
    assert found.p < 1e-3


def test_samples_that_are_missing_at_the_ends_are_left_out():
    t = np.arange(SAMPLES)
    residual = np.sin(2 * np.pi * 0.05 * t) + noise(2)
    valid = np.ones(SAMPLES, dtype=bool)
    valid[:10] = valid[-5:] = False
    residual[~valid] = 1e6
    assert strongest_line(residual, valid).frequency == pytest.approx(0.05, abs=0.001)


@pytest.mark.parametrize(
    ("hole", "options"),
    [
        (False, {}),
        *(
            pytest.param(hole, options, marks=pytest.mark.slow)
            for hole, options in (
                (True, {}),
                (False, {"colour": False}),
                (False, {"noise": ce.Noise(omega=0.01)}),
            )
        ),
    ],
)
def test_a_torque_that_comes_back_is_not_called_noise(hole, options):
    """Of 0.4 N m at 1.7 Hz, which no effect of the library is, nor a function of the speed."""
    t = np.arange(700) * 0.01
    torque = 2 + np.sin(2.1 * t + 0.2 * t**2)
    run = solve_ivp(
        lambda s, w: (np.interp(s, t, torque) + 0.4 * np.sin(2 * np.pi * 1.7 * s) - 0.3 * w) / 0.5,
        (0, t[-1]), [5.0], t_eval=t, rtol=1e-9, atol=1e-9, max_step=0.01,
    )  # fmt: skip
    speed = run.y[0] + np.random.default_rng(4).normal(0, 0.01, t.size)
    if hole:
        speed[60] = np.nan
    data = ce.Experiment.from_arrays(
        "run", time=t, units={"T": "N m", "omega": "rad/s"}, T=torque, omega=speed
    )
    found = ce.repair(
        ce.one_inertia(), data, effects=["coulomb_friction"], starts=1, progress=False, **options
    )
    assert found.verdict == "unnamed"
    assert "the spectrum of the residual of omega in run has a line at 1.7" in found.unknown.sentence
    assert "something acts, or is picked up by the sensor, at that frequency" in found.unknown.sentence


@pytest.mark.parametrize(("slower", "own", "words"), [
    (1, 0.91, "at which phi itself swings: something changes how it is driven or dies out"),
    (1, 0.2, "has a line at 0.90 Hz: something acts, or is picked up by the sensor, at that frequency"),
    (10, 0.2, "has a line at 0.090 Hz, once in about 11 s: something acts, or is picked up by the sensor, at that"),
])  # fmt: skip
def test_a_line_where_the_output_itself_swings_is_no_foreign_one(slower, own, words):
    """As of a pendulum whose friction is another one: nothing acts at its own frequency."""
    t = np.arange(0, 17, 0.02)
    measured = np.exp(-0.1 * t) * np.cos(2 * np.pi * own * t)
    path = SimpleNamespace(grid=SimpleNamespace(measured={"phi": SimpleNamespace(values=measured)}))
    record = SimpleNamespace(name="run", time={"phi": slower * t}, path=path)
    name = "run/phi/line at 0.90 Hz" if slower == 1 else "run/phi/line at 0.090 Hz"
    found = SimpleNamespace(alarms={name: 1e-9}, line=name, family=None, course=None)
    null = SimpleNamespace(records=[record], model=SimpleNamespace(time_unit="s"))
    screened = SimpleNamespace(leftover=found, null=null)
    assert words in unknown_of(screened).sentence
