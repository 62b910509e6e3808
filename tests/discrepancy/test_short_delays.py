"""Delays of inputs as members of the class of what does the same, by stand-ins for fits."""

import math
from types import SimpleNamespace as stub

import pytest

from casadi_engine.discrepancy import short_delays as module
from casadi_engine.discrepancy.repaired import FoundEffect, Member
from casadi_engine.effects.protocol import Grid
from casadi_engine.estimation import Estimate


def found(name, at, time):
    size = Estimate(time if name == "sensor_delay" else 1.0, 0.01, "s")
    members = (Member(name, at, 1.0, 1.0),)
    return FoundEffect(name, at, "", {}, {"size": size}, {}, 9.0, 1e-9, 50.0, 1.0, {}, {}, None, members)


def classes(monkeypatch, one, merits, *, near=True):
    """The class of an effect beside fits with the delay at these ports, by their chi-squared; the lead has 100."""
    late = {at: stub(effect="input_delay", port=at, key=("input_delay", at)) for at in ("input_u", "input_v")}
    monkeypatch.setattr(
        module,
        "addition",
        lambda candidate, _: stub(key=candidate.port, nuisance={"time": Grid(0.2, 10, log=True)}),
    )
    monkeypatch.setattr(module, "merit", lambda fit: fit.merit)
    monkeypatch.setattr(module, "is_near", lambda _: near)
    asked = []

    def with_all(effects, other, time, _):
        asked.append((other.key, time, len(effects)))
        return stub(merit=merits[other.key])

    values = {f"{one.key}.time": 0.05} if one.name == "input_lag" else {}
    last = stub(fit=stub(values=values, merit=100.0), effects=[stub(key=one.key), stub(key="another")])
    screened = stub(candidates=[*late.values(), stub(effect="drag", port="input_u", key=("drag", "input_u"))])
    (made,) = module.with_short_delays([one], last, stub(with_all=with_all), screened)
    return {member.label: member.probability for member in made.members}, asked


def test_a_short_lag_has_the_delay_of_its_input(monkeypatch):
    made, asked = classes(monkeypatch, found("input_lag", "input_u", 0.05), {"input_u": 98.0})
    share = math.e / (1 + math.e)
    assert made == pytest.approx({"input_lag at input_u": 1 - share, "input_delay at input_u": share})
    assert asked == [("input_u", 0.05, 2)]


def test_a_sensor_that_is_late_has_every_input(monkeypatch):
    one = found("sensor_delay", "sensor_y", 0.05)
    made, _ = classes(monkeypatch, one, {"input_u": 100.0, "input_v": 130.0})
    assert made == pytest.approx({"sensor_delay at sensor_y": 0.5, "input_delay at input_u": 0.5}, rel=1e-5)
    assert sum(made.values()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "time", "merit", "near"),
    [
        pytest.param("sensor_delay", 0.05, 130.0, True, id="excluded"),
        pytest.param("sensor_delay", 0.05, 98.0, False, id="no optimum"),
        pytest.param("sensor_delay", 0.3, 98.0, True, id="long enough to be searched"),
        pytest.param("sensor_delay", -0.05, 98.0, True, id="early"),
        pytest.param("quadratic_drag", 0.05, 98.0, True, id="something else"),
    ],
)
def test_what_no_short_delay_does_stays_alone(monkeypatch, name, time, merit, near):
    one = found(name, "sensor_y", time)
    made, _ = classes(monkeypatch, one, {"input_u": merit, "input_v": merit}, near=near)
    assert made == {f"{name} at sensor_y": 1.0}
