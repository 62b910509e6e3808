"""Jumps of the equations that are rounded."""

import importlib

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.model.corners import with_rounded_jumps
from casadi_engine.model.jumps import jumps_in
from casadi_engine.model.port_view import PortView


def slide(law, scale=1.0):
    """A slide whose friction is law(v, force)."""
    b = ce.Blueprint("slide")
    v, force = b.state("v", unit="m/s", scale=scale), b.parameter("force", 2.0, unit="N", min=0)
    b.ode("v", -law(v, force))
    b.output("v", v, unit="m/s")
    return b.model()


def rate(model, speed):
    function = ca.Function("rate", [model.x, model.p], [model.closed_ode])
    return float(function(speed, [one.value for one in model.declarations]))


LAWS = {
    "sign": lambda v, f: f * ca.sign(v),
    "choice": lambda v, f: ca.if_else(v > 0.1, 3 * f, -f),
    "both": lambda v, f: ca.if_else(ca.logic_and(v > -0.5, v < 0.5), f, 0.1 * v),
    "either": lambda v, f: ca.if_else(ca.logic_or(v < -0.5, v >= 0.5), f, 0.1 * v),
    "not": lambda v, f: ca.if_else(ca.logic_not(v > 0), f, -f),
    "of a jump": lambda v, f: f * ca.sign(v + 0.1 * ca.sign(v)),
    "kink beside": lambda v, f: f * ca.sign(v) + ca.fabs(v) + ca.fmin(v, 0.3),
}


@pytest.mark.parametrize("name", LAWS)
def test_a_rounded_model_is_the_given_one_but_near_its_jumps(name):
    model = slide(LAWS[name])
    rounded = with_rounded_jumps(model)
    assert not jumps_in(rounded.closed_ode, rounded.x)
    for speed in (-2.0, -0.9, -0.3, -0.05, 0.05, 0.2, 0.7, 2.0):
        assert rate(rounded, speed) == pytest.approx(rate(model, speed), abs=1e-6)


def test_the_width_is_a_share_of_what_is_known_to_be_large():
    (corner,) = with_rounded_jumps(slide(LAWS["sign"], scale=4.0)).corners
    assert with_rounded_jumps(slide(LAWS["sign"], scale=4.0)).parameters()[corner.width].value == 0.02
    known = with_rounded_jumps(slide(LAWS["sign"]), {"v": 100.0})
    assert known.parameters()[corner.width].value == 0.5
    assert not known.parameters()[corner.width].vary


def test_a_smooth_model_is_itself_and_whole_numbers_stay():
    smooth = slide(lambda v, f: f * ca.tanh(v))
    assert with_rounded_jumps(smooth) is smooth
    stepped = with_rounded_jumps(slide(lambda v, f: f * ca.floor(3 * v)))
    assert jumps_in(stepped.closed_ode, stepped.x)
    assert rate(stepped, 0.5) == rate(slide(lambda v, f: f * ca.floor(3 * v)), 0.5)


@pytest.mark.slow  # a spring that is, is repaired in test_own_jumps.py
def test_repair_takes_friction_that_is_written_as_a_sign():
    """What is hidden beside it is found, and both have their sizes."""
    t = np.arange(400) * 0.01
    push = 3.0 * np.sin(2 * np.pi * 0.7 * t) + 2.0 * np.sin(2 * np.pi * 1.9 * t)

    def model(offset):
        b = ce.Blueprint("slide")
        m, fc = b.parameter("m", 0.2, unit="kg", min=0.01), b.parameter("Fc", 0.3, unit="N", min=0)
        v, force = b.state("v", unit="m/s"), b.input("F", unit="N")
        slot = b.port("slide", "inertia", {"speed": v})
        b.ode("v", (force - fc * ca.sign(v) - offset + slot) / m)
        b.output("v", v, unit="m/s")
        return b.model()

    units = {"F": "N", "v": "m/s"}
    drive = ce.Experiment.from_arrays("pushed", time=t, units={"F": "N"}, F=push)
    true = model(0.4)  # sharp, and met by events
    run = ce.simulate(true, drive, parameters={"m": 0.15, "Fc": 0.5}, initial={"v": 0.0})
    noise = 0.02 * np.random.default_rng(1).standard_normal(len(t))
    record = ce.Experiment.from_arrays("pushed", time=t, units=units, F=push, v=run["v"].values + noise)
    found = ce.repair(
        model(0.0), record, effects=["constant_torque", "quadratic_drag"], holdout=0.0, starts=1,
        progress=False,
    )  # fmt: skip
    assert [one.key for one in found.effects] == ["slide.constant_torque"]
    assert found.effects[0].amplitude.value == pytest.approx(-0.4, abs=0.02)
    assert found.fit.values["Fc"] == pytest.approx(0.5, abs=0.03)
    assert any("tanh stands in place of their jumps" in one for one in found.messages)


def test_friction_beside_a_rounded_sign_is_no_constant_torque():
    b = ce.Blueprint("slide")
    v, force = b.state("v", unit="m/s"), b.parameter("force", 2.0, unit="N", min=0)
    b.ode("v", b.port("slide", "inertia", {"speed": v}) - force * ca.sign(v))
    b.output("v", v, unit="m/s")
    rounded = with_rounded_jumps(b.model())
    assert not PortView(rounded, rounded.ports["slide"], free=("force",)).has_free_constant
    pushed = ce.Blueprint("pushed")
    v, force = pushed.state("v", unit="m/s"), pushed.parameter("force", 2.0, unit="N", min=0)
    pushed.ode("v", pushed.port("slide", "inertia", {"speed": v}) - force)
    pushed.output("v", v, unit="m/s")
    model = pushed.model()
    assert PortView(model, model.ports["slide"], free=("force",)).has_free_constant


def test_what_drives_a_corner_counts_in_its_width():
    # a mass on a belt is slow where it is seen, and slides as fast as the belt
    b = ce.Blueprint("belt")
    v, belt = b.state("v", unit="m/s", scale=0.1), b.input("v_belt", unit="m/s")
    b.ode("v", -b.parameter("F", 3.0, unit="m/s2") * ca.sign(v - belt))
    b.output("v_seen", v, unit="m/s")
    model = b.model()
    assert with_rounded_jumps(model).declarations[-1].value == pytest.approx(5e-4)
    known = with_rounded_jumps(model, {"v_belt": 0.25})
    assert known.declarations[-1].value == pytest.approx(5e-3 * 0.35, rel=0.05)  # in two digits
    repair = importlib.import_module("casadi_engine.discrepancy.repair")
    units = {"v_belt": "m/s", "v_seen": "m/s"}
    t = np.arange(4.0)
    record = ce.Experiment.from_arrays(
        "run", time=t, units=units, v_belt=-0.1 * t, v_seen=[0.0, np.nan, -0.2, 0.1]
    )
    assert repair._largest(model, [record]) == pytest.approx({"v": 0.2, "v_belt": 0.3})


def test_an_output_that_shows_an_input_at_once_needs_its_rate_and_rounds_all_the_same():
    """A motor without inductance whose current is an output: a bare ValueError."""
    b = ce.Blueprint("motor")
    w, volts = b.state("w", unit="rad/s"), b.input("U", unit="V")
    current = (volts - 0.02 * w) / b.parameter("R", 0.5, unit="Ohm")
    b.ode("w", 400 * current - 1400 * ca.sign(w))
    b.output("I", current, unit="A")
    model = b.model()
    assert model.rates
    assert with_rounded_jumps(model, {"w": 200.0}).declarations[-1].value == pytest.approx(1.0)


def test_corners_may_be_wider():
    b = ce.Blueprint("slide")
    v = b.state("v", unit="m/s")
    b.ode("v", -2 * ca.sign(v))
    b.output("v", v, unit="m/s")
    assert with_rounded_jumps(b.model(), share=0.1).declarations[-1].value == pytest.approx(0.1)
