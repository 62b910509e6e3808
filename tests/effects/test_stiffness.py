"""Springs that a model does not have: what they do to the equations, and that one to the ground is named."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects.stiffness import GroundSpring
from casadi_engine.model.port_view import PortView


def door(*, place=False):
    b = ce.Blueprint("door")
    m, damping = b.parameter("m", 20.0, unit="kg", min=1), b.parameter("c", 8.0, unit="N s/m", min=0)
    x, v, force = b.state("x", unit="m"), b.state("v", unit="m/s"), b.input("F", unit="N")
    panel = b.port("panel", "inertia", {"speed": v, "position": x} if place else {"speed": v})
    b.ode("x", v)
    b.ode("v", (force - damping * v + panel) / m)
    b.output("y", v, unit="m/s")
    return b.model()


def swung(seed, name, spring=30.0):
    """By SciPy: 15 kg, 10 N s/m, a spring to the ground; it begins 0.2 m off where the spring rests."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 12, 401)
    force = 40.0 * (np.sin(1.3 * time + seed) + np.sin(3.1 * time + 2 * seed))

    def ode(t, s):
        return [s[1], (np.interp(t, time, force) - 10 * s[1] - spring * s[0]) / 15]

    found = solve_ivp(ode, (0, 12), [0.2, 0.0], t_eval=time, rtol=1e-9, atol=1e-10, max_step=0.03).y[1]
    y = found + 0.02 * rng.standard_normal(len(time))
    return ce.Experiment.from_arrays(name, time=time, units={"F": "N", "y": "m/s"}, F=force, y=y)


def test_a_spring_to_the_ground_pulls_back_by_the_speed_added_up():
    wider = door().with_effect(GroundSpring(first=0.3), at="panel")
    values = {"panel.ground_spring.stiffness": 12.0}
    rates = ca.Function("rates", [wider.x, wider.u, wider.t, wider.p], [wider.closed_ode])
    p = [values.get(one.name, one.value) for one in wider.declarations]
    none, some = (np.array(rates([0, 0.0, place], 0, 0, p)).ravel() for place in (0.0, 0.5))
    assert (some - none)[1] == pytest.approx(-12.0 * 0.5 / 20.0)
    assert np.array(rates([0, 0.7, 0.0], 0, 0, p)).ravel()[-1] == pytest.approx(0.7)
    assert wider.parameters()["panel.ground_spring.stiffness"].unit == "N/m"


def test_it_begins_where_the_port_says():
    def begun(model):
        known = {"x": 0.3, "v": 0.7}
        view = PortView(
            model, model.ports["panel"], lambda own: [np.full(5, known[str(own)]), np.full(5, np.nan)]
        )
        return GroundSpring().fitted(view, swung(1, "data"), {}).first

    assert begun(door(place=True)) == 0.3
    assert begun(door()) == 0.0


def test_nothing_that_neither_turns_nor_moves_has_one():
    b = ce.Blueprint("room")
    c, t = b.parameter("C", 1e5, unit="J/K"), b.state("T", unit="K")
    b.ode("T", b.port("walls", "inertia", {"speed": t}) / c)
    b.output("y", t, unit="K")
    view = ce.effects.port_view(b.model(), "walls")
    assert GroundSpring().idle(view) == "a spring holds what turns or moves"
    assert GroundSpring().idle(ce.effects.port_view(door(), "panel")) == ""


def test_a_return_spring_is_found_and_named():
    """It was "the sensor drifts with time": over short windows a spring moves next to nothing."""
    found = ce.repair(door(), swung(1, "data"), fresh=swung(2, "fresh"), starts=1, progress=False)
    assert found.verdict == "named"
    assert found.confirmed
    (one,) = found.effects
    assert (one.name, one.at) == ("ground_spring", "panel")
    assert one.amplitude.value == pytest.approx(30.0, abs=3 * one.amplitude.stderr)
    assert one.amplitude.stderr < 1.0


def test_none_is_found_where_there_is_none():
    found = ce.repair(door(), swung(3, "data", 0.0), fresh=swung(4, "fresh", 0.0), starts=1, progress=False)
    assert found.verdict == "nothing missing"


def test_a_spring_that_pushes_away_is_none():
    """The weight of a hoist's rope was "a spring between sheave and the ground" of -85 N m/rad."""
    port = door().ports["panel"]
    assert GroundSpring().worded_for(port, 80.0) == "a spring between panel and the ground"
    said = GroundSpring().worded_for(port, -85.0)
    assert said.endswith("that pushes away with its displacement: a negative stiffness, as a weight has")
