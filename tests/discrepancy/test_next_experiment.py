"""What is proposed to tell the members of a class apart: sensors, and changes that an input may have."""

from types import SimpleNamespace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.next_experiment import _proposals as proposals
from casadi_engine.discrepancy.next_experiment import next_experiment

T = np.arange(50) * 1.0


def proposed(model, **channels):
    """The changes proposed for a model on a record with these channels."""
    units = {one.name: one.unit for one in (*model.inputs, *model.outputs)}
    record = ce.Experiment.from_arrays("run", time=T, units=units, **channels)
    station = SimpleNamespace(fit=SimpleNamespace(model=model, data=(record,)))
    return {change: (made, data) for change, made, data in proposals(station)}


def room():
    b = ce.Blueprint("room")
    c, r = b.parameter("C", 2e5, unit="J/K", min=1), b.parameter("R", 0.01, unit="K/W", min=1e-4)
    inside, wall = b.state("T", unit="K"), b.state("T_w", unit="K")
    heat, outside = b.input("P", unit="W"), b.input("T_a", unit="K")
    b.ode("T", (heat - (inside - wall) / r) / c)
    b.ode("T_w", (b.port("wall", "inertia", {"speed": wall}) - (wall - outside) / r) / c)
    b.output("T_room", inside, unit="K")
    return b.model()


def test_a_room_is_heated_otherwise_and_its_wall_is_measured():
    found = proposed(room(), P=1500.0 * (T % 10 > 5), T_a=280 + np.sin(T), T_room=290 + 0 * T)
    assert list(found) == [
        "measure T_w too (with noise in proportion to that of T_room)",
        "measure while P steps to half of its value during the record",
        "measure while P swings by half of its value during the record",
    ]
    model, data = found["measure T_w too (with noise in proportion to that of T_room)"]
    assert (model.outputs[-1].unit, len(data)) == ("K", 1)
    _, data = found["measure while P steps to half of its value during the record"]
    assert [one.name for one in data] == ["run", "run_next"]
    first, then = (one["P"].values for one in data)
    assert np.array_equal(then[T > 25], 0.5 * first[T > 25])


@pytest.mark.parametrize(("volts", "reversed_too"), [(np.sin(T), True), (1.5 + np.sin(T), False)])
def test_an_input_is_reversed_that_acts_both_ways(volts, reversed_too):
    b = ce.Blueprint("circuit")
    u, tau = b.state("u", unit="V"), b.parameter("tau", 1.0, unit="s", min=0.1)
    b.ode("u", (b.input("source", unit="V") - u) / tau)
    b.output("voltage", u, unit="V")
    found = proposed(b.model(), source=volts, voltage=0 * T)
    assert not any("too" in change for change in found)  # all is measured
    assert ("measure while source reverses during the record" in found) == reversed_too


def test_a_constant_torque_may_be_varied_too():
    found = proposed(ce.one_inertia(), T=50 + 0 * T, omega=0 * T)
    assert "measure while T reverses during the record" in found


def test_an_engine_keeps_its_crank_angle_and_pressures():
    model = ce.two_mass(reciprocating_speed="model")
    channels = {one.name: np.sin(T) for one in (*model.inputs, *model.outputs)}
    assert {change.split()[2] for change in proposed(model, **channels) if "while" in change} == {"T_load"}


def test_a_state_that_no_sensor_shows_is_measured_at_its_own_size():
    b = ce.Blueprint("prey", time_unit="d")
    x, y = b.state("hares", unit="1", scale=40), b.state("lynxes", unit="1", scale=20)
    b.ode("hares", b.port("field", "inertia", {"speed": x}) - x * y)
    b.ode("lynxes", x * y - y)
    b.output("seen", x, unit="1", scale=40)
    (model, _), *others = proposed(b.model(), seen=0 * T).values()
    assert others == []
    assert (model.outputs[-1].name, model.outputs[-1].scale) == ("next_lynxes", 20)


@pytest.mark.slow
def test_the_speed_of_a_pendulum_helps_to_tell_dry_friction_from_what_fades(pendulum):
    record = pendulum.decay(lambda t, angle, rate: -0.6 * np.tanh(rate / 0.02), samples=300)
    found = ce.repair(
        pendulum.model, record, effects=["coulomb_friction", "stribeck_friction"], noise=ce.Noise(y=pendulum.level),
        starts=1, progress=False,
    )  # fmt: skip
    assert found.verdict == "class"
    assert found.next_experiment.change.startswith(
        "measure the speed of pivot too (with noise in proportion to"
    )
    assert found.next_experiment.expected_separation > found.next_experiment.separation_now
    assert found.next_experiment.change in " ".join(str(found).split())


def test_members_that_were_not_tested_before_are_not_split():
    """An effect that stands in the place of two was no candidate beside one of them."""

    def member(name):
        return SimpleNamespace(name=name, at="wall", rho=0.5, more=())

    screened = SimpleNamespace(
        candidates=[SimpleNamespace(key=("leak", "wall"))], scores=SimpleNamespace(statistic=np.ones(1))
    )
    before = SimpleNamespace(screened=screened)
    for names in (["leak", "drag"], ["drag", "leak"]):
        after = SimpleNamespace(members=[member(name) for name in names])
        assert next_experiment(before, after) is None
