"""Gains that no sensor has, and ratios of units that are taken for one another."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.exchanged_units import exchanges, impossible, impossible_gain, more_than_whole
from casadi_engine.effects.protocol import Grid


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
    [
        (0.05, False),
        (-0.4, False),
        (0.6, True),
        (82.8, True),
        (8.55, False),
        (-0.895, False),
        (-1.7, True),
        (1.0, False),
        (3.0, False),
        (-2.0, False),
        (2.0, True),
    ],
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


@pytest.mark.parametrize(
    ("gain", "impossible"),
    [(28.05, True), (3.5, False), (-1.0, False), (-2.0, False), (-1.6, True), (999.0, False), (4.5, True)],
)
def test_an_input_acts_the_way_it_says_within_reason_unless_its_unit_is_another(gain, impossible):
    """A torque of which twenty-nine times as much acts, as if a weight were nothing beside it."""
    b = ce.Blueprint("spin")
    w, torque = b.state("w", unit="rad/s"), b.input("T", unit="N m")
    b.ode("w", torque - w)
    b.output("w", w, unit="rad/s")
    candidate = SimpleNamespace(effect="input_gain", port="input_T")
    one = SimpleNamespace(candidate=candidate, amplitude="input_T.input_gain.gain")
    assert impossible_gain([one], {one.amplitude: gain}, b.model()) is impossible


def test_exchanged_units_of_a_sensor_are_in_a_class_with_the_gain_of_an_input_that_does_the_same():
    """A speed in km/h given as m/s, the mass known: the force may as well be so much larger."""
    rng = np.random.default_rng(0)
    t = np.arange(0, 12, 0.03)
    force = 5 * np.sin(0.9 * t) + 3 * np.sin(2.3 * t + 1)
    run = solve_ivp(
        lambda s, v: (np.interp(s, t, force) - 1.3 * v) / 2,
        (0, t[-1]),
        [0],
        t_eval=t,
        rtol=1e-8,
        max_step=0.02,
    )
    speed = 3.6 * (run.y[0] + 0.03 * rng.standard_normal(len(t)))
    data = ce.Experiment.from_arrays("a", time=t, units={"F": "N", "v": "m/s"}, F=force, v=speed)
    b = ce.Blueprint("cart")
    m, d = b.parameter("m", 2.0, unit="kg", vary=False), b.parameter("d", 1.0, unit="N s/m", min=0, max=20)
    v = b.state("v", unit="m/s", scale=1.0)
    port = b.port("cart", "inertia", {"speed": v}, unit="N")
    b.ode("v", (b.input("F", unit="N", scale=5) - d * v + port) / m)
    b.output("v", v, unit="m/s", scale=1.0)
    found = ce.repair(
        b.model(), data, effects=["sensor_gain", "input_gain", "quadratic_drag"], progress=False
    )
    (one,) = found.effects
    assert {member.name for member in one.members} == {"sensor_gain", "input_gain"}
    assert one.amplitude.value == pytest.approx(2.6, abs=0.05)


@pytest.mark.parametrize(("delay", "too_late"), [(0.1, False), (2.4, False), (2.6, True), (-2.6, True)])
def test_no_sensor_is_late_by_most_of_a_record(delay, too_late):
    """An arm that falls for 0.72 s and a sensor that shows it 0.66 s early: no time of the record was left."""
    data = [SimpleNamespace(duration=5.0), SimpleNamespace(duration=9.0)]
    effect = SimpleNamespace(retards=True)
    candidate = SimpleNamespace(effect="sensor_delay", port="sensor_w", source=SimpleNamespace(effect=effect))
    one = SimpleNamespace(candidate=candidate, amplitude="sensor_w.sensor_delay.delay")
    assert impossible([one], {one.amplitude: delay}, None, data) is too_late


@pytest.mark.parametrize("effect", ["input_lag", "input_delay"])
@pytest.mark.parametrize(
    ("share", "time", "told"),
    [
        (0.06, 0.5, True),
        (0.6, 0.5, False),
        (1.0, 0.5, False),
        (1.4, 0.5, False),
        (1.8, 0.5, True),
        (0.06, 0.2, False),
        (1.8, 0.2, True),
    ],
)
def test_an_input_is_late_with_all_of_it(effect, share, time, told):
    """A share of the shortest time that is searched, 0.2, stands for a shorter one."""
    one = SimpleNamespace(
        candidate=SimpleNamespace(effect=effect, port="input_u", source=SimpleNamespace(effect=None)),
        amplitude="input_u.share",
        key="input_u",
        nuisance={"time": Grid(0.2, 10, steps=6, log=True)},
    )
    data = [SimpleNamespace(duration=10.0)]
    assert impossible([one], {one.amplitude: share, "input_u.time": time}, None, data) is told


@pytest.mark.parametrize(
    ("share", "error", "clearly"),
    [(1.05, 0.001, False), (1.14, 0.083, False), (1.3, 0.083, True), (1.3, None, True)],
)
def test_a_sensor_lags_with_more_than_all_of_its_signal_where_its_error_says_so(share, error, clearly):
    """A thermocouple's lag of 60 s had come out with 1.14 +- 0.08 of the signal, and as a filter of higher order."""
    one = SimpleNamespace(candidate=SimpleNamespace(effect="sensor_lag"), amplitude="share")
    assert more_than_whole([one], {"share": share}, {"share": error}) is clearly
    other = SimpleNamespace(candidate=SimpleNamespace(effect="input_lag"), amplitude="share")
    assert not more_than_whole([other], {"share": share}, {"share": error})


@pytest.mark.parametrize(
    ("port", "delay", "share", "told"),
    [
        ("sensor_i", -0.034, 1.0, True),
        ("sensor_i", -0.003, 1.0, False),
        ("sensor_i", -0.003, 0.02, True),  # of the lag that there is
        ("sensor_i", 0.034, 1.0, False),
        ("sensor_z", -0.034, 1.0, False),
    ],
)
def test_no_sensor_is_behind_and_early(port, delay, share, told):
    """A motor behind an elastic chain had been a gain of its voltage, a lag of its current sensor and a lead of it."""
    lag, early = (
        SimpleNamespace(
            candidate=SimpleNamespace(effect=effect, port=at, source=SimpleNamespace(effect=None)),
            amplitude=f"{at}.{effect}.{size}",
            key=f"{at}.{effect}",
            nuisance={"time": Grid(0.01, 1, steps=6, log=True)},
        )
        for effect, at, size in (("sensor_lag", "sensor_i", "share"), ("sensor_delay", port, "delay"))
    )  # fmt: skip
    values = {lag.amplitude: share, "sensor_i.sensor_lag.time": 0.035, early.amplitude: delay}
    assert impossible([lag, early], values, None, [SimpleNamespace(duration=24.0)]) is told
