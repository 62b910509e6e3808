"""The blueprint: users' own equations, and a named error for everything that does not fit."""

import math

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import ModelError, ParameterError
from casadi_engine.model import Blueprint


def duffing(*, cubic_in_slot):
    b = Blueprint("duffing", description="mass on a hardening spring")
    m, c = b.parameter("m", 1.5, unit="kg", min=1e-3), b.parameter("c", 0.1, unit="N s/m")
    k, k3 = b.parameter("k", 4.0, unit="N/m"), b.parameter("k3", 2.0, unit="N/m3")
    q, v = b.state("q", unit="m", scale=0.1), b.state("v", unit="m/s")
    force = b.input("F", unit="N")
    cubic = -k3 * q**3
    if cubic_in_slot:
        spring = b.port("spring", "coupling", {"stretch": q})
        b.law("spring", cubic)
        cubic = spring
    b.ode("q", v)
    b.ode("v", (force - c * v - k * q + cubic) / m)
    b.output("position", q, unit="m")
    return b.model()


def closed(model, x, u, t=0.0):
    function = ca.Function("f", [model.x, model.u, model.t, model.p], [model.closed_ode])
    return function(x, u, t, model.parameter_vector()).full().ravel()


def test_duffing_is_general_when_written_plainly():
    model = duffing(cubic_in_slot=False)
    assert model.linear is None
    assert not model.has_slot_laws
    assert [drive.name for drive in model.drives] == ["F"]
    np.testing.assert_allclose(closed(model, [0.3, -0.2], 0.7), duffing_by_hand(0.3, -0.2, 0.7), rtol=1e-14)


def test_duffing_keeps_a_linear_core_with_its_cubic_spring_in_a_slot():
    model = duffing(cubic_in_slot=True)
    assert model.has_slot_laws
    core = ca.Function("core", [model.p], list(model.linear.matrices))
    a, b, g, e, c, d, c0 = (part.full() for part in core(model.parameter_vector()))
    np.testing.assert_allclose(a, [[0, 1], [-4 / 1.5, -0.1 / 1.5]])
    np.testing.assert_allclose(b, [[0], [1 / 1.5]])
    np.testing.assert_allclose(g, [[0], [1 / 1.5]])
    np.testing.assert_allclose(np.concatenate([e, c.T, d, c0]).ravel(), [0, 0, 1, 0, 0, 0])
    np.testing.assert_allclose(closed(model, [0.3, -0.2], 0.7), duffing_by_hand(0.3, -0.2, 0.7), rtol=1e-14)


def duffing_by_hand(q, v, force):
    return [v, (force - 0.1 * v - 4 * q - 2 * q**3) / 1.5]


def test_tank_with_outflow():
    b = Blueprint("tank")
    area, valve = b.parameter("area", 0.5, unit="m2", min=1e-3), b.parameter("valve", 0.02, unit="m2.5/s")
    level, inflow = b.state("level", unit="m"), b.input("inflow", unit="m3/s")
    b.ode("level", (inflow - valve * ca.sqrt(level)) / area)
    b.output("level", level, unit="m")
    model = b.model()
    assert model.linear is None
    assert closed(model, [4.0], 0.1) == pytest.approx((0.1 - 0.02 * 2) / 0.5)
    with pytest.raises(
        ModelError, match="the model tank has no modes, because it has no linear core"
    ) as caught:
        model.modes()
    assert "allowed: a model with model.linear; do: move the nonlinear terms into laws" in str(caught.value)


def test_constant_terms_go_into_the_offsets():
    b = Blueprint("offset")
    g = b.parameter("g", 9.81)
    v = b.state("v")
    b.ode("v", -v + g)
    b.output("y", 2 * v + 3)
    linear = b.model().linear
    assert str(linear.e) == "g"
    assert float(linear.c) == 3
    assert float(linear.C) == 2


def test_time_in_an_ode_makes_a_model_general_and_in_a_drive_does_not():
    def model(driven):
        b = Blueprint("ramp")
        x = b.state("x")
        ramp = b.drive("ramp", 2 * b.time, unit="1") if driven else 2 * b.time
        b.ode("x", ramp - x)
        b.output("x", x)
        return b.model()

    assert model(driven=False).linear is None
    assert model(driven=True).linear is not None
    assert closed(model(driven=True), [1.0], [], t=3.0) == pytest.approx(5.0)


def test_channel_used_directly_reuses_a_drive_that_passes_it_on():
    b = Blueprint("direct")
    x, u = b.state("x"), b.input("u")
    passed = b.drive("torque", u)
    b.ode("x", passed - x + u)
    b.output("y", x + u)
    model = b.model()
    assert [drive.name for drive in model.drives] == ["torque"]
    assert float(model.linear.B) == 2
    assert float(model.linear.D) == 1
    assert str(model.closed_outputs) == "(x+u)"


def test_channel_used_directly_and_a_different_drive_of_its_name():
    b = Blueprint("clash")
    x, u = b.state("x"), b.input("u")
    b.drive("u", 2 * u)
    b.ode("x", u - x)
    b.output("y", x)
    with pytest.raises(ModelError, match="channel u is used directly, and a drive of its name") as caught:
        b.model()
    assert "do: use the drive's symbol in the equations, or rename the drive" in str(caught.value)


def test_a_parameter_as_a_drive_stays_a_parameter_in_the_ode():
    b = Blueprint("constant")
    x, p = b.state("x"), b.parameter("p", 2.0)
    drive = b.drive("push", p)
    b.ode("x", drive - p * x)
    b.output("y", x)
    assert str(b.model().linear.A) == "(-p)"


def test_laws_may_use_other_slots():
    b = Blueprint("two_slots")
    x = b.state("x")
    first, second = b.port("first", "inertia", {"speed": x}), b.port("second", "internal")
    b.law("first", -(x**2))
    b.law("second", 0.5 * first)
    b.ode("x", first + second)
    b.output("y", x)
    model = b.model()
    assert closed(model, [2.0], []) == pytest.approx(-6.0)
    assert not ca.depends_on(model.slot_laws, model.w)


def test_laws_in_a_circle():
    b = Blueprint("circle")
    x = b.state("x")
    first, second = b.port("first", "inertia"), b.port("second", "inertia")
    b.law("first", second + x)
    b.law("second", first)
    b.ode("x", first + second)
    b.output("y", x)
    with pytest.raises(ModelError, match=r"depend on each other in a circle; seen: first, second") as caught:
        b.model()
    assert "do: solve the laws for each other on paper" in str(caught.value)


def small():
    b = Blueprint("small")
    return b, b.state("x"), b.parameter("p", 1.0)


def test_missing_ode():
    b, x, _ = small()
    b.state("z")
    b.ode("x", x)
    b.output("y", x)
    with pytest.raises(ModelError, match=r'a state has no ode; seen: z; .*do: b.ode\("z", expression\)'):
        b.model()


def test_model_without_states_or_outputs():
    with pytest.raises(ModelError, match=r"the model empty has no states; seen: none; allowed: one or more"):
        Blueprint("empty").model()
    b, x, _ = small()
    b.ode("x", x)
    with pytest.raises(ModelError, match=r"the model small has no outputs; .*do: b.output"):
        b.model()


def test_undeclared_symbol_is_named():
    b, x, _ = small()
    b.ode("x", x + ca.SX.sym("stranger"))
    b.output("y", x)
    with pytest.raises(ModelError, match="the ode of x uses a symbol that was not declared") as caught:
        b.model()
    assert "seen: stranger; allowed: x" in str(caught.value)
    assert "do: declare it with state, input, drive, port or parameter" in str(caught.value)


def test_symbol_where_it_may_not_be_used():
    b, x, p = small()
    b.drive("T", x * p)
    b.ode("x", -x)
    b.output("y", x)
    with pytest.raises(ModelError, match="the drive T uses a symbol that may not be used there") as caught:
        b.model()
    assert "seen: x (one of the states); allowed: channels, time, parameters; do: move" in str(caught.value)


def test_a_drive_may_not_use_slots_and_an_output_may():
    b, x, _ = small()
    slot = b.port("body", "inertia")
    b.ode("x", slot)
    b.output("good", x + slot)
    assert b.model().outputs[0].name == "good"
    b.drive("bad", slot)
    with pytest.raises(ModelError, match=r"the drive bad uses .*seen: w_body \(one of the slots\)"):
        b.model()


@pytest.mark.parametrize("declare", ["state", "input"])
def test_repeated_name(declare):
    b, _, _ = small()
    for name in ("x", "p"):
        with pytest.raises(
            ModelError, match=f"the {declare} {name} is declared twice or its name is"
        ) as caught:
            getattr(b, declare)(name)
        assert "allowed: names unique among states, channels and parameters" in str(caught.value)


def test_repeated_drive_output_port_law_and_ode():
    b, x, p = small()
    b.drive("T", p)
    b.output("y", x)
    b.port("body", "inertia")
    b.law("body", -x)
    b.ode("x", -x)
    for again in (
        lambda: b.drive("T", p),
        lambda: b.output("y", x),
        lambda: b.port("body", "inertia"),
        lambda: b.law("body", x),
        lambda: b.ode("x", x),
        lambda: b.parameter("x", 1.0),
    ):
        with pytest.raises(ModelError, match="is declared twice or its name is taken"):
            again()


def test_port_name_that_the_blueprint_makes_itself():
    b, x, _ = small()
    b.ode("x", b.port("sensor_y", "inertia") - x)
    b.output("y", x)
    with pytest.raises(ModelError, match="the port sensor_y is declared twice"):
        b.model()


def test_ode_and_law_of_unknown_names():
    b, x, _ = small()
    with pytest.raises(ModelError, match=r"there is no state of that name; seen: 'X'; .*nearest: x"):
        b.ode("X", x)
    b.port("valve", "sensor", {"value": x})
    with pytest.raises(ModelError, match=r"there is no port that takes a torque of that name; seen: 'valve'"):
        b.law("valve", x)


@pytest.mark.parametrize("name", ["2x", "a b", "lambda", "", None])
def test_names_must_be_identifiers(name):
    with pytest.raises(ModelError, match="the name of a state is not acceptable") as caught:
        small()[0].state(name)
    assert f"seen: {name!r}; allowed: an identifier" in str(caught.value)


def test_parameter_numbers_are_checked():
    with pytest.raises(ParameterError):
        small()[0].parameter("q", math.nan)


@pytest.mark.parametrize("expression", [ca.SX.sym("v", 2), ca.MX.sym("m"), "x + 1", True, None, np.zeros(2)])
def test_equations_must_be_scalar(expression):
    b, _, _ = small()
    with pytest.raises(ModelError, match="the ode of x is not a scalar expression") as caught:
        b.ode("x", expression)
    assert "allowed: a number, or a scalar CasADi SX expression" in str(caught.value)
    assert "do: write one equation for each quantity" in str(caught.value)


def test_constants_that_are_no_numbers_are_refused():
    """The sine of Python's math module of a symbol was nan, and the model said to be linear."""
    b, x, _ = small()
    with pytest.raises(ModelError, match="the ode of x holds a constant that is no number") as caught:
        b.ode("x", math.nan * ca.cos(x))
    assert "do: write casadi.sin(x) in place of math.sin(x)" in str(caught.value)
    with pytest.raises(ModelError, match="the output y holds a constant"):
        b.output("y", x + math.sin(x))


def test_numbers_are_equations_too():
    b, x, _ = small()
    b.ode("x", 1.5)
    b.output("y", x)
    model = b.model()
    assert float(model.linear.e) == 1.5


def test_a_blueprint_can_be_finished_twice():
    b, x, p = small()
    b.ode("x", -p * x)
    b.output("y", x)
    first = b.model()
    b.output("z", 2 * x)
    assert (len(first.outputs), len(b.model().outputs)) == (1, 2)


@pytest.mark.parametrize("given", [None, "1", [1.0], 10**400, True, 1j])
def test_a_scale_of_another_kind(given):
    with pytest.raises(ModelError, match="the scale of x is not acceptable"):
        Blueprint("m").state("x", scale=given)


@pytest.mark.parametrize("given", [None, 1, ["rad"], "", " "])
def test_a_unit_of_another_kind(given):
    with pytest.raises(ModelError, match="the unit of x is not acceptable"):
        Blueprint("m").input("x", unit=given)


@pytest.mark.parametrize("given", [[], {}, None])
def test_a_kind_of_port_of_another_kind(given):
    with pytest.raises(ModelError, match="the kind of port x is not known"):
        Blueprint("m").port("x", given)


@pytest.mark.parametrize(("unit", "cure"), [("mm", r"write 1000\*x"), ("km", r"write 0.001\*x")])
def test_an_output_that_is_a_state_in_another_unit_is_refused(unit, cure):
    b = ce.Blueprint("slide")
    x = b.state("x", unit="m")
    b.ode("x", -x)
    b.output("seen", x, unit=unit)
    with pytest.raises(ModelError, match=rf"the output seen is the state x as it stands.*{cure}"):
        b.model()


@pytest.mark.parametrize(("own", "other"), [("rad/s", "rad"), ("m/s", "m"), ("K", "m"), ("rad", "1/s")])
def test_an_output_that_is_a_state_counts_what_the_state_counts(own, other):
    b = ce.Blueprint("shaft")
    x = b.state("x", unit=own)
    b.ode("x", -x)
    b.output("seen", x, unit=other)
    with pytest.raises(ModelError, match=rf"counts something else; seen: seen in {other}, x in {own}"):
        b.model()


def test_the_cure_of_a_temperature_in_another_unit_can_be_followed():
    def room(output):
        b = ce.Blueprint("room")
        temperature = b.state("T", unit="degC")
        b.ode("T", -temperature)
        b.output("seen", output(temperature), unit="K")
        return b.model()

    with pytest.raises(ModelError, match=r"write T \+ 273\.15, or declare the output in degC"):
        room(lambda T: T)
    assert room(lambda T: T + 273.15).outputs[0].unit == "K"


def test_an_output_that_is_a_state_may_name_its_unit_otherwise():
    b = ce.Blueprint("slide")
    v = b.state("v", unit="m/s")
    b.ode("v", -v)
    b.output("seen", v, unit="m s-1")
    assert b.model().outputs[0].name == "seen"
