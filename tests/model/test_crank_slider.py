"""Crank-slider kinematics against the geometry itself, and the torques against virtual work."""

import math

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from casadi_engine.errors import ModelError
from casadi_engine.model.crank_slider import (
    Geometry,
    cylinder_torque,
    indicated_torque,
    inertia_force,
    mean_square_factor,
    piston_travel,
    reciprocating_torque,
    torque_factor,
    torque_factor_slope,
)

angles = st.floats(-30, 30)
ratios = st.floats(0, 0.9)
STEP = 1e-30  # complex steps lose no digits, however small


def travel(angle, ratio):
    """s/r from the law of cosines, ratio > 0; independent of the package."""
    return 1 + 1 / ratio - (np.cos(angle) + np.sqrt(1 / ratio**2 - np.sin(angle) ** 2))


@given(angles, st.floats(0.01, 0.9))
def test_piston_travel_is_the_law_of_cosines(angle, ratio):
    assert piston_travel(angle, ratio) == pytest.approx(travel(angle, ratio), abs=1e-11)


@given(angles, ratios)
def test_factor_is_the_derivative_of_the_travel(angle, ratio):
    slope = np.imag(piston_travel(angle + 1j * STEP, ratio)) / STEP
    assert torque_factor(angle, ratio) == pytest.approx(slope, abs=1e-12)


@given(angles, ratios)
def test_slope_is_the_derivative_of_the_factor(angle, ratio):
    slope = np.imag(torque_factor(angle + 1j * STEP, ratio)) / STEP
    assert torque_factor_slope(angle, ratio) == pytest.approx(slope, rel=1e-10, abs=1e-11)


@given(angles, ratios)
def test_factor_is_odd_and_periodic(angle, ratio):
    assert torque_factor(-angle, ratio) == pytest.approx(-torque_factor(angle, ratio), abs=1e-15)
    assert torque_factor(angle + 2 * math.pi, ratio) == pytest.approx(torque_factor(angle, ratio), abs=1e-12)


@given(ratios)
def test_mean_square_agrees_with_quadrature(ratio):
    grid = 2 * math.pi * np.arange(4096) / 4096  # the trapezoidal rule is spectrally exact on a period
    assert mean_square_factor(ratio) == pytest.approx(np.mean(torque_factor(grid, ratio) ** 2), rel=1e-12)


def test_travel_reaches_twice_the_radius():
    assert piston_travel(0.0, 0.3) == 0
    assert piston_travel(math.pi, 0.3) == pytest.approx(2)
    assert piston_travel(math.pi, 0.0) == pytest.approx(2)


def test_mean_reciprocating_inertia_of_the_thesis():
    geometry = Geometry()
    mean = geometry.m_eq * geometry.r**2 * mean_square_factor(geometry.ratio)
    assert mean == pytest.approx(6.6e-4, rel=0.01)


def test_indicated_torque_by_virtual_work():
    geometry = Geometry(r=0.04, L=0.13, A_p=0.005, m_eq=0.5, p_crank=1.1e5)
    angle, h = 0.7, 1e-6
    rise = geometry.r * (travel(angle + h, 0.04 / 0.13) - travel(angle - h, 0.04 / 0.13)) / (2 * h)
    expected = (3e6 - 1.1e5) * 0.005 * rise
    assert indicated_torque(3e6, angle, geometry) == pytest.approx(expected, rel=1e-8)
    assert indicated_torque(3e6, 0.7, geometry) > 0  # gas pushes the crank on after TDC
    assert indicated_torque(3e6, -0.7, geometry) < 0  # and back before it


def test_inertia_force_opposes_the_acceleration_along_a_motion():
    geometry = Geometry()
    ratio, speed, acceleration = geometry.ratio, 120.0, 900.0

    def position(t):
        return geometry.r * travel(0.4 + speed * t + 0.5 * acceleration * t**2, ratio)

    h = 1e-6
    second = (position(h) - 2 * position(0) + position(-h)) / h**2
    force = inertia_force(0.4, speed, acceleration, geometry)
    assert force == pytest.approx(-geometry.m_eq * second, rel=1e-4)


def test_reciprocating_torque_is_the_force_at_constant_speed_times_its_lever():
    geometry = Geometry()
    lever = geometry.r * torque_factor(1.1, geometry.ratio)
    expected = inertia_force(1.1, 130.0, 0.0, geometry) * lever
    assert reciprocating_torque(1.1, 130.0, geometry) == pytest.approx(expected, rel=1e-14)


def test_cylinder_torque_is_the_sum():
    geometry = Geometry()
    whole = cylinder_torque(2e6, 0.9, 125.0, geometry)
    parts = indicated_torque(2e6, 0.9, geometry) + reciprocating_torque(0.9, 125.0, geometry)
    assert whole == pytest.approx(parts, rel=1e-15)


def test_numbers_arrays_and_symbols_agree():
    angle = ca.SX.sym("angle")
    function = ca.Function("f", [angle], [cylinder_torque(2e6, angle, 125.0, Geometry())])
    grid = np.linspace(-3, 3, 7)
    expected = [cylinder_torque(2e6, float(a), 125.0, Geometry()) for a in grid]
    np.testing.assert_allclose(cylinder_torque(2e6, grid, 125.0, Geometry()), expected, rtol=1e-14)
    np.testing.assert_allclose(function(grid).full().ravel(), expected, rtol=1e-13)


def test_defaults_are_table_4_2():
    assert Geometry() == Geometry(0.043, 0.145, 0.0058, 0.7, 1.0e5)


def test_geometry_from_bore_and_stroke():
    geometry = Geometry.from_bore(0.0677, stroke=0.055, rod=0.0842, mass=0.25, p_crank=0.0)
    assert geometry.A_p * 0.055 == pytest.approx(198e-6, rel=0.01)  # about the 196 cc of that engine
    assert (geometry.r, geometry.L, geometry.m_eq, geometry.p_crank) == (0.0275, 0.0842, 0.25, 0.0)


@pytest.mark.parametrize(
    ("changes", "name", "seen"),
    [
        ({"r": 0.0}, "r", "0.0"),
        ({"L": math.inf}, "L", "inf"),
        ({"A_p": -1.0}, "A_p", "-1.0"),
        ({"m_eq": -0.1}, "m_eq", "-0.1"),
        ({"p_crank": math.nan}, "p_crank", "nan"),
    ],
)
def test_geometry_refuses_bad_numbers(changes, name, seen):
    with pytest.raises(ModelError, match=f"the geometry's {name} is not acceptable; seen: {seen}") as caught:
        Geometry(**changes)
    assert "allowed: a finite number" in str(caught.value)
    assert "do: give lengths in m, areas in m2, masses in kg, pressures in Pa" in str(caught.value)


def test_geometry_refuses_a_short_rod():
    with pytest.raises(
        ModelError, match=r"not longer than the crank radius; seen: r = 0.2, L = 0.145"
    ) as caught:
        Geometry(r=0.2)
    assert "do: give r as half of the stroke" in str(caught.value)


def test_geometry_reads_a_mapping():
    assert Geometry.read({"m_eq": 0.6}) == Geometry(m_eq=0.6)
    assert Geometry.read(None) == Geometry()
    with pytest.raises(ModelError, match=r"no such quantity; seen: 'bore'") as caught:
        Geometry.read({"bore": 0.08})
    assert "allowed: r, L, A_p, m_eq, p_crank" in str(caught.value)
    assert "Geometry.from_bore helps" in str(caught.value)
