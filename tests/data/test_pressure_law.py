"""The analytic pressure and the crank slider, against finite differences and hand calculation."""

import math

import numpy as np
import pytest
from simulator import geometry, identical_cylinders, unequal_cylinders
from simulator.engine import Engine, burn_factors
from simulator.pressure import (
    BURNED_EXPONENT,
    DEGREE,
    EXHAUST,
    INTAKE,
    MOTORED_EXPONENT,
    SEAM,
    burned,
    event_number,
    pressure,
)

CIRCLE = np.linspace(-2.5 * np.pi, 1.5 * np.pi, 721)


def central(function, angle, step=1e-5):
    return (function(angle + step) - function(angle - step)) / (2.0 * step)


def test_volume_grows_by_area_times_crank_slider_factor():
    factor, slope = geometry.slider(CIRCLE)
    grown = central(geometry.volume, CIRCLE)
    np.testing.assert_allclose(grown, 0.0058 * 0.043 * factor, rtol=0, atol=1e-12)
    np.testing.assert_allclose(central(lambda a: geometry.slider(a)[0], CIRCLE), slope, atol=1e-9)


def test_swept_volume_and_compression_ratio():
    swept = geometry.volume(np.pi) - geometry.volume(0.0)
    assert swept == pytest.approx(2 * 0.043 * 0.0058)
    assert geometry.volume(np.pi) / geometry.volume(0.0) == pytest.approx(10.0)


def test_torque_at_a_right_angle_by_hand():
    ratio = 0.043 / 0.145
    slope = -ratio / math.sqrt(1.0 - ratio**2)
    by_hand = (9e5 - 1e5) * 0.0058 * 0.043 - 0.7 * 0.043**2 * slope * 100.0**2
    assert geometry.cylinder_torque(np.pi / 2, 100.0, 9e5) == pytest.approx(by_hand, rel=1e-12)


def test_firing_order_is_1_3_4_2():
    np.testing.assert_allclose(geometry.tdc_angles(), [0.0, 3 * np.pi, np.pi, 2 * np.pi])


def test_motored_trace_follows_one_polytrope_up_and_down():
    for side in (-1, 1):
        angle = side * np.linspace(20, 85, 40) * DEGREE
        exponent = np.polyfit(np.log(geometry.volume(angle)), np.log(pressure(angle, 0.0)), 1)[0]
        assert exponent == pytest.approx(-MOTORED_EXPONENT, abs=2e-4)
    assert pressure(0.0, 0.0) == pytest.approx(10.5e5, rel=0.05)
    angle = np.linspace(1, 100, 50) * DEGREE
    np.testing.assert_allclose(pressure(angle, 0.0), pressure(-angle, 0.0), rtol=1e-3)


def test_what_combustion_adds_expands_on_its_own_polytrope():
    angle = np.linspace(80, 110, 40) * DEGREE
    added = (pressure(angle, 2e6) - pressure(angle, 0.0)) / burned(angle)
    exponent = np.polyfit(np.log(geometry.volume(angle)), np.log(added), 1)[0]
    assert exponent == pytest.approx(-BURNED_EXPONENT, abs=1e-3)


def test_pressure_is_linear_in_the_burn_strength():
    one, two = (pressure(CIRCLE, strength) - pressure(CIRCLE, 0.0) for strength in (1e6, 2e6))
    np.testing.assert_allclose(two, 2.0 * one, atol=1e-6)
    assert one.min() > -1e-6


def test_gas_exchange_pressures():
    assert pressure(240 * DEGREE, 2e6) == pytest.approx(EXHAUST, rel=1e-3)
    assert pressure(-250 * DEGREE, 2e6) == pytest.approx(INTAKE, rel=1e-3)
    assert pressure(330 * DEGREE, 2e6) == pytest.approx(EXHAUST, rel=2e-3)


def test_burn_curve_is_complete_before_the_exhaust_opens():
    assert burned(-40 * DEGREE) < 1e-30
    assert burned(140 * DEGREE) == pytest.approx(1.0, abs=1e-6)
    angle = np.linspace(-60, 120, 18001) * DEGREE
    ten, ninety = np.interp([0.1, 0.9], burned(angle), angle) / DEGREE
    assert ninety - ten == pytest.approx(27.8, abs=0.2)


def test_no_kink_anywhere_and_none_at_the_seam_between_events():
    step = 0.02 * DEGREE
    angle = np.arange(-10, 11) * step
    for centre in (SEAM, SEAM - geometry.CYCLE, 2 * np.pi, 0.0, np.pi):
        trace = pressure(centre + angle, 2e6)
        assert np.abs(np.diff(trace, 4)).max() < 1e-2
    assert pressure(SEAM - 1e-9, 2.0e6) == pytest.approx(pressure(SEAM + 1e-9, 2.4e6), abs=2e-2)


def test_cycle_repeats_after_two_turns():
    np.testing.assert_allclose(
        pressure(CIRCLE[:-1], 1e6), pressure(CIRCLE[:-1] + geometry.CYCLE, 1e6), rtol=1e-9
    )


def test_events_are_counted_from_the_combustion_of_the_cylinder():
    angles = np.array([-np.pi, 0.0, SEAM - 1e-6, SEAM + 1e-6, geometry.CYCLE, -3 * np.pi])
    np.testing.assert_array_equal(event_number(angles), [1, 1, 1, 2, 2, 0])


def test_scalar_and_array_formulas_agree():
    by_array = pressure(CIRCLE, 2e6, 1.01, 0.01)
    one_by_one = [pressure(float(angle), 2e6, 1.01, 0.01, math) for angle in CIRCLE]
    np.testing.assert_allclose(one_by_one, by_array, rtol=1e-12)


def test_fast_torque_law_equals_the_array_form():
    cylinders = unequal_cylinders()
    engine = Engine(cylinders, burn_factors(cylinders, cycles=2, seed=5), 2.4e6)
    law = engine.torque_law()
    generator = np.random.default_rng(1)
    angles, speeds = generator.uniform(0, 8 * np.pi, (4, 50)), generator.uniform(100, 150, (4, 50))
    fast = np.array([law(angles[:, k].tolist(), speeds[:, k].tolist()) for k in range(50)]).T
    np.testing.assert_allclose(fast, engine.torques(angles, speeds), rtol=1e-10, atol=1e-9)


def test_mean_torque_is_the_work_of_the_pressure_over_the_cycle():
    cylinders = identical_cylinders()
    engine = Engine(cylinders, burn_factors(cylinders, cycles=1, scatter=0.0), 2.4e6)
    angle = np.linspace(0.0, geometry.CYCLE, 20001)
    work = np.trapezoid(pressure(angle, 2.4e6) - 1e5, geometry.volume(angle))
    assert engine.mean_torque(2.4e6) == pytest.approx(4 * work / geometry.CYCLE, rel=1e-5)
    assert engine.mean_torque(engine.strength_for(76.0)) == pytest.approx(76.0, rel=1e-9)


def test_cylinders_differ_by_about_three_percent():
    strength = unequal_cylinders().strength
    assert strength.mean() == pytest.approx(1.0)
    assert 0.02 < strength.std(ddof=1) < 0.04
    assert np.ptp(unequal_cylinders().intake) < 0.015


def test_scatter_is_two_percent_and_has_no_mean():
    factors = burn_factors(identical_cylinders(), cycles=500, seed=8)
    inside = factors[:, 1:-1]
    assert inside.mean() == pytest.approx(1.0, abs=1e-12)
    assert inside.std() == pytest.approx(0.02, rel=0.05)
    np.testing.assert_array_equal(factors[:, 0], 1.0)


def test_misfire_silences_the_chosen_events_alone():
    factors = burn_factors(unequal_cylinders(), cycles=6, seed=8, misfire={2: "all", 3: [2, 5]})
    np.testing.assert_array_equal(factors[1], 0.0)
    np.testing.assert_array_equal(np.flatnonzero(factors[2] == 0.0), [2, 5])
    assert (factors[[0, 3]] > 0.9).all()


@pytest.mark.parametrize(
    ("misfire", "message"),
    [
        ({5: "all"}, r"cylinder 5: there are cylinders 1\.\.4"),
        ({2: "some"}, r"cylinder 2 in 'some': give 'all' or a list of 1\.\.6"),
        ({2: [0]}, r"cylinder 2 in \[0\]: give 'all' or a list of 1\.\.6"),
        ({2: [7]}, r"cylinder 2 in \[7\]: give 'all' or a list of 1\.\.6"),
    ],
)
def test_impossible_misfires_are_refused(misfire, message):
    with pytest.raises(ValueError, match=message):
        burn_factors(unequal_cylinders(), cycles=6, misfire=misfire)
