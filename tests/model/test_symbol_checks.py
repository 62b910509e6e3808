"""Symbols stand where they may be used, and a fault says what to write instead."""

import pytest

import casadi_engine as ce
from casadi_engine.errors import ModelError


def cart(*, lag=None):
    """A cart of which an accelerometer shows the acceleration, behind a lag [s] or at once."""
    b = ce.Blueprint("cart")
    v, mass, force = b.state("v", unit="m/s"), b.parameter("m", 2.0, unit="kg"), b.input("F", unit="N")
    acting = force + b.port("body", "inertia", {"speed": v})
    b.ode("v", acting / mass)
    if lag is None:
        b.output("acc", acting / mass, unit="m/s2")
        return b.model()
    shown = b.state("a", unit="m/s2")
    b.ode("a", (acting - mass * shown) / (mass * lag))
    b.output("acc", shown, unit="m/s2")
    return b.model()


def test_an_accelerometer_is_told_how_to_show_what_a_port_adds():
    with pytest.raises(ModelError, match=r"the output acc uses a symbol that may not.*w_body") as caught:
        cart()
    assert "a state that follows the acceleration with a short lag" in str(caught.value)


def test_what_is_told_can_be_written():
    model = cart(lag=1e-3)
    assert model.with_effect(ce.effects.library("coulomb_friction")[0], at="body").outputs[0].name == "acc"
