"""Variables, declarations and the list of ports."""

import casadi as ca
import pytest

from casadi_engine.errors import ModelError, ParameterError
from casadi_engine.model import ParameterDeclaration, Port, Ports, Variable, two_mass


@pytest.mark.parametrize("scale", [0.0, -1.0, float("inf"), float("nan")])
def test_scale_must_be_positive(scale):
    with pytest.raises(ModelError, match="the scale of omega is not acceptable") as caught:
        Variable("omega", "rad/s", scale=scale)
    assert f"seen: {scale!r}; allowed: a finite number > 0; do: give the typical magnitude" in str(
        caught.value
    )


def test_declaration_is_checked_when_made():
    with pytest.raises(ParameterError):
        ParameterDeclaration("K", 5.0, min=6.0)


def test_declaration_gives_fresh_parameters():
    declared = ParameterDeclaration("r", 0.043, "m", 0.0, 1.0, False, "crank radius")
    first, second = declared.parameter(), declared.parameter()
    assert first is not second
    assert (first.value, first.unit, first.min, first.max, first.vary) == (0.043, "m", 0.0, 1.0, False)


def test_unknown_kind_of_port():
    with pytest.raises(ModelError, match=r"kind of port engine is not known; seen: 'inertial'") as caught:
        Port("engine", "inertial")
    assert "nearest: inertia" in str(caught.value)
    assert "do: choose the kind by what is attached there" in str(caught.value)


def test_signals_cannot_be_changed():
    port = Port("engine", "inertia", signals={"speed": ca.SX.sym("omega")})
    with pytest.raises(TypeError):
        port.signals["speed"] = 0


def test_ports_by_name_and_position():
    ports = two_mass().ports
    assert ports["coupling"] is ports[2]
    assert ports[0].name == "engine"
    assert [port.name for port in ports[:2]] == ["engine", "load"]
    assert "load" in ports
    assert ports["load"] in ports
    assert "flywheel" not in ports
    assert len(ports) == len(ports.names) == len(list(ports))


def test_unknown_port_names_the_nearest():
    with pytest.raises(ModelError, match=r"no such port; seen: 'cupling'") as caught:
        two_mass().ports["cupling"]
    assert "nearest: coupling" in str(caught.value)
    assert "do: print(model.ports) lists them" in str(caught.value)


def test_ports_print_as_a_table():
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    ports = Ports(
        [Port("engine", "inertia", "", {"speed": a}, b), Port("sensor_y", "sensor", "", {"value": a})]
    )
    assert str(ports).splitlines() == [
        "port      kind     slot  signals",
        "engine    inertia  N m   speed",
        "sensor_y  sensor   -     value",
    ]
    assert repr(ports) == "Ports(engine, sensor_y)"
    assert str(ports["engine"]) == "engine (inertia): speed"


def test_slots_are_in_the_order_of_w():
    model = two_mass()
    assert [port.slot.element_hash() for port in model.ports.with_slot] == [
        model.w[row].element_hash() for row in range(model.w.numel())
    ]
