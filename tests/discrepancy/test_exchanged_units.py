"""Gains that no sensor has, and ratios of units that are taken for one another."""

from types import SimpleNamespace

import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.exchanged_units import exchanges, impossible_gain


def shown(gain, unit="rad/s", effect="sensor_gain"):
    b = ce.Blueprint("spin")
    w = b.state("w", unit="rad/s")
    b.ode("w", -w)
    b.output("w", w, unit=unit)
    candidate = SimpleNamespace(effect=effect, port="sensor_w")
    one = SimpleNamespace(candidate=candidate, amplitude="sensor_w.sensor_gain.gain")
    return impossible_gain([one], {one.amplitude: gain}, b.model())


def test_the_units_of_a_channel_are_exchanged_both_ways():
    found = {(right, label): share for right, label, share in exchanges("rad/s")}
    assert found["rpm", "rad/s"] == pytest.approx(9.549, rel=1e-3)
    assert found["rad/s", "rpm"] == pytest.approx(1 / 9.549, rel=1e-3)
    assert all("rad/s" in pair for pair in found)
    assert list(exchanges("-")) == []


@pytest.mark.parametrize(
    ("gain", "impossible"),
    [(0.05, False), (-0.4, False), (0.6, True), (82.8, True), (8.55, False), (-0.895, False), (-1.7, True)],
)
def test_a_large_gain_is_a_ratio_of_units_or_none(gain, impossible):
    assert shown(gain) is impossible


def test_other_effects_may_be_of_any_size():
    assert not shown(82.8, effect="sensor_offset")


@pytest.mark.parametrize(
    ("share", "impossible"),
    [(-1.4, True), (-0.7, False), (3.5, False), (7.9, True), (-0.9, True), (999.0, False)],
)
def test_a_stated_value_keeps_its_sign_and_its_size_unless_its_unit_is_another(share, impossible):
    b = ce.Blueprint("spin")
    w, torque = b.state("w", unit="rad/s"), b.parameter("torque", 3.0, unit="N m", vary=False)
    b.ode("w", torque - w)
    b.output("w", w, unit="rad/s")
    candidate = SimpleNamespace(effect="wrong_value", port="parameter_torque")
    one = SimpleNamespace(candidate=candidate, amplitude="parameter_torque.wrong_value.share")
    assert impossible_gain([one], {one.amplitude: share}, b.model()) is impossible
