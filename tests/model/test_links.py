"""What joins two ports: only what has a difference."""

import pytest

import casadi_engine as ce


@pytest.mark.parametrize(("second", "linked"), [("V", True), ("mV", False), ("-", False)])
def test_a_pipe_joins_what_has_one_unit(second, linked):
    """A battery had a current from its voltage to its state of charge, as either takes one."""
    b = ce.Blueprint("battery")
    first, other = b.state("v", unit="V"), b.state("s", unit=second) if second != "-" else b.state("s")
    for name, state in (("rc", first), ("charge", other)):
        b.ode(state.name(), b.port(name, "inertia", {"speed": state}, unit="A") / 100.0)
    b.output("y", first, unit="V")
    assert [one.name for one in b.model().ports.links] == (["rc_and_charge"] if linked else [])
