"""Two inertias fitted to the records of seven: the lumped values, and the residual that says what they lack.

The crankshaft's first mode is at 20.45 Hz, the next ones at 335.2 and 548 Hz (Table 4.13). Lumped rigidly it is
1/(J1 + 4 J2 + J6) = 2.6534 and 20.46 Hz; the records hold white noise of 0.1 rad/s.
"""

from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.model import reduce

FOLDER = Path(__file__).resolve().parents[2] / "data" / "crankshaft"
SIGMA, RATE = 0.1, 14402.0


@pytest.fixture(scope="module")
def record():
    return ce.read_experiment(FOLDER / "misfire_1200rpm.csv.gz", optional=("omega_load",))


@pytest.fixture(scope="module")
def expected():
    """The lumped model of the true crankshaft."""
    return reduce(ce.crankshaft(reciprocating_speed="measured"), dof=2).model


@pytest.fixture(scope="module")
def two(record):
    """Two masses, all five parameters and the noise free, from values 30 % off."""
    model = ce.two_mass(reciprocating_speed="measured")
    pars = model.parameters()
    for name, factor in (("J_eng", 1.3), ("J_load", 0.75), ("K_el", 0.8), ("C_el", 1.3), ("C_eng", 0.8)):
        pars[name].set(factor * pars[name].value)
    return ce.estimate(model, record, parameters=pars, progress=False)


def periodogram(residual):
    """Frequencies [Hz], and power over that of white noise of the records' sigma: exponential of mean 1 for noise."""
    power = np.abs(np.fft.rfft(residual - residual.mean())) ** 2 / (residual.size * SIGMA**2)
    return np.fft.rfftfreq(residual.size, 1 / RATE), power


def band(hz, power, low, high):
    return power[(hz >= low) & (hz < high)].mean()


def test_the_lumped_values_are_recovered(two, expected):
    assert two.converged
    truth = dict(zip(expected.parameter_names, expected.parameter_vector(), strict=True))
    assert 1 / truth["J1to6"] == pytest.approx(2.6534, abs=1e-4)
    # what the lumping leaves out biases them by a few tenths of a per cent: more than their standard errors say
    for name, lumped, tolerance in (
        ("J_eng", "J1to6", 0.005), ("J_load", "J7", 0.01), ("K_el", "K76", 0.006), ("C_el", "C76", 0.01),
        ("C_eng", "C1to6", 0.002),
    ):  # fmt: skip
        assert two.values[name] == pytest.approx(truth[lumped], rel=tolerance), name
    assert 1 / two.values["J_eng"] == pytest.approx(2.653, abs=0.012)


def test_the_first_natural_frequency_is_recovered(two, expected):
    found = two.model.natural_frequency(1, two.parameters)
    assert found == pytest.approx(expected.natural_frequency(1), abs=0.02)
    assert found == pytest.approx(20.3, abs=0.2)


def test_the_residual_tests_say_that_something_is_missing(two):
    checked = ce.validate(two)
    found = checked.records["misfire_1200rpm"]["omega"]
    assert not checked.passed
    assert found.whiteness.p_value < 1e-12
    # the torques at both ends of the crankshaft turn it most against itself
    assert max(found.cross[drive].p_value for drive in ("T_1", "T_4")) < 1e-12
    assert found.rmse > 1.05 * SIGMA


def test_the_spectrum_of_the_residual_says_at_which_frequencies(two, record):
    hz, power = periodogram(two.traces[record.name]["omega"].residual)
    above = hz > 200
    strongest = hz[above][np.argmax(power[above])]
    # the half orders are 10 Hz apart: the strongest is the one beside the mode at 335.2 Hz that two inertias lack
    assert abs(strongest - 335.2) < 10
    assert power[above].max() > 100
    assert band(hz, power, 300, 400) > 4
    for low, high in ((600, 800), (800, 1500), (1500, 7000)):  # there, nothing was excited
        assert band(hz, power, low, high) == pytest.approx(1, abs=0.12)
    # below, the rigid crankshaft is off by the per cents that `reduce` foretells, of much larger amplitudes
    assert 1 < band(hz, power, 200, 300) < band(hz, power, 300, 400)


def test_seven_inertias_leave_noise(record):
    """The same record against the crankshaft itself: no line is left, so the ones above are what was lumped."""
    run = ce.simulate(ce.crankshaft(reciprocating_speed="measured"), record)
    residual = record["omega"].values - run["omega"].values
    assert residual.std() == pytest.approx(SIGMA, rel=0.02)
    hz, power = periodogram(residual)
    assert power.max() < 20  # of 7200 exponentials of mean 1 the largest is about 9
    assert band(hz, power, 300, 400) == pytest.approx(1, abs=0.4)
