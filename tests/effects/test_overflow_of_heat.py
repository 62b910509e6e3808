"""What is filled runs over an edge: vessels and circuits, no temperatures."""

import pytest

import casadi_engine as ce
from casadi_engine.effects import Overflow
from casadi_engine.model.port_view import port_view


@pytest.mark.parametrize(
    ("unit", "flow", "idle"), [("K", "W", True), ("degC", "W", True), ("m", "m3/s", False)]
)
def test_a_temperature_has_no_edge(unit, flow, idle):
    b = ce.Blueprint("two")
    for k in (1, 2):
        level = b.state(f"h_{k}", unit=unit)
        b.ode(f"h_{k}", b.port(f"body_{k}", "inertia", {"level": level}, unit=flow) / 0.5)
    b.output("level", level, unit=unit)
    found = Overflow().idle(port_view(b.model(), "body_1_and_body_2"))
    assert found == ("a temperature does not run over an edge" if idle else "")
