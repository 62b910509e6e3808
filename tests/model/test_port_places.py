"""A slot stands where something can act: in an ode, and not in the one that says what a speed is."""

import math

import pytest

import casadi_engine as ce
from casadi_engine.errors import ModelError

PER_TURN = 2 * math.pi / 60


def shaft(place, *, units=("rad", "rad/s"), unit=None, turns=1.0, kind="inertia", law=None):
    """A torsional pendulum; ``place`` says where its slot goes: angle, speed, both, law, none, creep."""
    b = ce.Blueprint("shaft")
    J, k = b.parameter("J", 0.5, unit="kg m2"), b.parameter("k", 4.0, unit="N m/rad")
    angle, speed = b.state("angle", unit=units[0]), b.state("speed", unit=units[1])
    signals = {"speed": speed, "angle": angle} if kind == "inertia" else {"twist": angle, "twist_rate": speed}
    slot = b.port("shaft", kind, signals, unit=unit)
    torque = b.input("T", unit="N m")
    other = 0
    if place == "law":
        other = b.port("other", "internal")
        b.law("other", 2 * slot)
    decay = k * angle / b.parameter("c", 1.0, unit="N m s/rad") if place == "creep" else 0
    b.ode("angle", turns * speed - decay + (slot if place in ("angle", "both", "creep") else 0))
    b.ode("speed", (torque - k * angle + other + (slot if place in ("speed", "both") else 0)) / J / turns)
    b.output("y", speed, unit=units[1])
    return b.model()


@pytest.mark.parametrize("turns", [1.0, PER_TURN])
@pytest.mark.parametrize("kind", ["inertia", "coupling"])
@pytest.mark.parametrize("place", ["angle", "both"])
@pytest.mark.parametrize("units", [("rad", "rad/s"), ("-", "-"), ("m", "m/s")])
def test_a_slot_that_is_added_to_a_speed_is_refused(place, kind, turns, units):
    with pytest.raises(ModelError) as caught:
        shaft(place, kind=kind, turns=turns, units=units)
    text = str(caught.value)
    assert (
        "the slot of the port shaft is added to a speed: it stands in the ode of the position angle" in text
    )
    assert "d(angle)/dt = " in text
    assert "move it from b.ode('angle', ...) into the ode of the speed" in text


def test_a_torque_stated_for_that_slot_does_not_make_it_one():
    with pytest.raises(ModelError, match="is added to a speed"):
        shaft("angle", unit="N m")


def test_a_slip_that_is_stated_as_a_speed_may_stand_there():
    assert shaft("angle", unit="rad/s").ports["shaft"].unit == "rad/s"


def test_a_rate_that_is_more_than_a_speed_takes_a_slot():
    assert shaft("creep").ports["shaft"].slot is not None
    b = ce.Blueprint("damped")
    x, c = b.state("x", unit="m"), b.parameter("c", 2.0, unit="N s/m")
    slot = b.port("body", "inertia", {"speed": x})
    b.ode("x", (b.input("F", unit="N") - b.parameter("k", 1.0, unit="N/m") * x + slot) / c)
    b.output("y", x, unit="m")
    assert b.model().ports["body"].unit == "N"


def test_a_tank_filled_by_a_flow_that_is_a_state_takes_a_slot():
    b = ce.Blueprint("tank")
    flow, volume = b.state("flow", unit="m3/s"), b.state("volume", unit="m3")
    b.ode("flow", -flow / b.parameter("tau", 2.0, unit="s"))
    b.ode("volume", flow + b.port("leak", "inertia", {"speed": volume}))
    b.output("y", volume, unit="m3")
    assert b.model().ports["leak"].unit == "m3/s"


def test_a_slot_in_no_ode_is_refused_with_the_line_that_mends_it():
    with pytest.raises(ModelError) as caught:
        shaft("none")
    text = str(caught.value)
    assert "the slot of the port shaft stands in no ode: what is added there would do nothing" in text
    assert "in none of the odes of angle, speed" in text
    assert 'b.ode("speed", (... + slot) / ...)' in text


def test_a_slot_may_stand_in_the_law_of_another_port_that_stands_in_an_ode():
    assert shaft("law").ports["shaft"].slot is not None
    b = ce.Blueprint("idle")
    x = b.state("x")
    first = b.port("first", "inertia", {"speed": x})
    b.port("second", "internal")
    b.law("second", first)
    b.ode("x", -x)
    b.output("y", x)
    with pytest.raises(ModelError, match="the slot of the port first stands in no ode"):
        b.model()
