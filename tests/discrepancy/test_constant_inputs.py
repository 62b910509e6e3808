"""A constant that is the same as an offset of an input: its size there, and degrees Celsius read as kelvin."""

from types import SimpleNamespace

import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.constant_inputs import constant_inputs


def plate():
    b = ce.Blueprint("plate")
    c = b.parameter("C", 100.0, unit="J/K", min=1)
    g = b.parameter("G", 2.0, unit="W/K", min=0)
    power, around = b.input("P", unit="W"), b.input("T_amb", unit="K")
    temperature = b.state("T", unit="K")
    slot = b.port("plate", "inertia", {"speed": temperature})
    b.ode("T", (power - g * (temperature - around) + slot) / c)
    b.output("T_out", temperature, unit="K")
    return b.model()


def found(size, error=None, name="constant_torque", at="plate"):
    one = SimpleNamespace(name=name, at=at, amplitude=SimpleNamespace(value=size, stderr=error))
    fit = SimpleNamespace(values={"C": 90.0, "G": 4.0})
    return SimpleNamespace(null_fit=SimpleNamespace(model=plate()), fit=fit, effects=(one,))


def test_the_size_is_that_of_the_input_by_the_values_of_the_fit():
    power, around = constant_inputs(found(8.0, 0.4))
    assert power.startswith(
        "constant_torque at plate is one and the same as an offset of the input P by 8.00 ± 0.40 W"
    )
    assert "the input T_amb by 2.00 ± 0.10 K: no data of these outputs tell which" in around
    assert "degC" not in around


@pytest.mark.parametrize(("size", "said"), [(273.0, True), (-273.15, True), (290.0, False)])
def test_degrees_celsius(size, said):
    assert ("its column may be in degC" in constant_inputs(found(4 * size))[1]) == said


def test_nothing_is_said_of_other_effects():
    assert constant_inputs(found(8.0, name="load_step")) == []
    assert constant_inputs(found(8.0, at="elsewhere")) == []
