"""Storages that a model does not have: their laws against closed forms, and found in data of SciPy."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import HiddenStorage, Relaxation, candidates
from casadi_engine.effects.sensor import time_constants


def heated():
    """A heated body: its capacity and its loss are not known."""
    b = ce.Blueprint("heater")
    capacity = b.parameter("C", 1500.0, unit="J/K", min=10.0, max=1e5)
    loss = b.parameter("G", 6.0, unit="W/K", min=0.1, max=100.0)
    above, power = b.state("T", unit="K"), b.input("P", unit="W")
    body = b.port("body", "inertia", {"speed": above}, unit="W")
    b.ode("T", (power - loss * above + body) / capacity)
    b.output("y", above, unit="K")
    return b.model()


def sprung():
    b = ce.Blueprint("mount")
    k = b.parameter("k", 50.0, unit="N/m")
    place, speed, force = b.state("x", unit="m"), b.state("v", unit="m/s"), b.input("F", unit="N")
    body = b.port("body", "inertia", {"speed": speed}, unit="N")
    rubber = b.port("rubber", "coupling", {"twist": place, "twist_rate": speed, "stiffness": k}, unit="N")
    b.ode("x", speed)
    b.ode("v", force + body - k * place - rubber)
    b.output("y", place, unit="m")
    return b.model()


def heating(seed, name, wall=0.0):
    """By SciPy: 2000 J/K, 5 W/K, and behind it a wall of 40 s at ``wall`` W/K."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 600, 301)
    power = 200.0 * (np.sin(time / 60 + seed) + np.sin(time / 17 + 2 * seed) + 2.0)

    def ode(t, x):
        passed = wall * (x[0] - x[1])
        return [(np.interp(t, time, power) - 5 * x[0] - passed) / 2000, (x[0] - x[1]) / 40]

    found = solve_ivp(ode, (0, 600), [30.0, 30.0], t_eval=time, rtol=1e-9, atol=1e-9, max_step=2.0).y[0]
    units = {"P": "W", "y": "K"}
    y = found + 0.2 * rng.standard_normal(len(time))
    return ce.Experiment.from_arrays(name, time=time, units=units, P=power, y=y)


@pytest.mark.parametrize(
    ("model", "port", "effect", "size", "state"),
    [
        (heated(), "body", HiddenStorage(), "body.hidden_storage.conductance", "T"),
        (sprung(), "rubber", Relaxation(), "rubber.relaxation.stiffness", "x"),
    ],
)
def test_it_acts_by_what_it_is_behind_and_follows_with_its_time_constant(model, port, effect, size, state):
    wider = model.with_effect(effect, at=port)
    values = {size: 3.0, size.rpartition(".")[0] + ".time": 4.0}
    rates = ca.Function("rates", [wider.x, wider.u, wider.t, wider.p], [wider.closed_ode])
    names = [one.name for one in wider.states]
    x = np.zeros(len(names))
    x[names.index(state)], x[-1] = 2.0, 0.5
    with_it, without = (
        rates(x, 0.0, 0.0, wider.parameter_vector({**values, size: amplitude})).full().ravel()
        for amplitude in (3.0, 0.0)
    )
    assert with_it[-1] == pytest.approx((2.0 - 0.5) / 4.0)
    acted = (with_it - without)[:-1]
    inertia = wider.parameters()["C"].value if state == "T" else 1.0
    assert acted[np.argmax(np.abs(acted))] == pytest.approx(-3.0 * 1.5 / inertia)


def test_a_wall_follows_a_temperature_not_how_far_it_is_above_an_ambient_that_moves():
    """A collector whose ambient moved had a second storage to take that back, an input that lags, both confirmed."""
    b = ce.Blueprint("collector")
    c, loss = b.parameter("C", 2000.0, unit="J/K"), b.parameter("UA", 5.0, unit="W/K")
    around, power, t = b.input("Ta", unit="K"), b.input("P", unit="W"), b.state("T", unit="K")
    body = b.port("body", "inertia", {"speed": t - around})
    b.ode("T", (power - loss * (t - around) + body) / c)
    b.output("y", t, unit="K")
    wider = b.model().with_effect(HiddenStorage(), at="body")
    last = wider.closed_ode[-1]
    assert not ca.depends_on(last, wider.u)
    assert ca.depends_on(last, wider.x[0])
    view = ce.effects.port_view(b.model(), "body")
    assert str(view.stored("speed")) == "T"
    assert view.stored("speed").shape == (1, 1)


def test_what_is_stored_is_the_signal_where_its_shares_cannot_be_told_apart():
    b = ce.Blueprint("vessel")
    around, x, y = b.input("pa", unit="Pa"), b.state("x", unit="m3"), b.state("y", unit="Pa")
    square = b.port("square", "inertia", {"speed": x**2 - around, "both": x * y, "other": y})
    b.ode("x", square)
    b.ode("y", -y)
    b.output("x", x, unit="m3")
    model = b.model()
    view = ce.effects.port_view(model, "square")
    square_of = ca.Function("stored", [model.x, model.u], [view.stored("speed")])
    assert float(square_of([3.0, 0.0], 7.0) - square_of([2.0, 0.0], 1.0)) == pytest.approx(5.0)
    assert str(view.stored("both")) == str(view.both)
    assert str(view.stored("other")) == "y"


def test_a_shaft_or_a_mass_has_none():
    data = ce.Experiment.from_arrays(
        "run", time=np.arange(40) * 0.1, units={"F": "N", "y": "m"}, F=np.ones(40), y=np.ones(40)
    )
    skipped = []
    found = candidates(sprung(), [HiddenStorage(), Relaxation()], data, skipped=skipped)
    assert {one.effect.name for one in found} == {"relaxation"}
    assert [(one.effect, one.at) for one in skipped] == [("hidden_storage", "body")]
    assert "no shaft or mass has a storage" in skipped[0].why


def test_it_may_be_as_slow_as_the_records_are_long():
    time = np.arange(101) * 0.5
    assert time_constants(time) == pytest.approx((0.25, 12.0), rel=0.1)
    assert time_constants(time, most=1.0) == pytest.approx((0.25, 50.0))
    data = heating(1, "data")
    effect = HiddenStorage().fitted(ce.effects.port_view(heated(), "body"), data, {})
    assert effect.span == pytest.approx((1.0, 600.0))


def test_a_wall_is_found_and_named():
    data, fresh = heating(1, "data", wall=8.0), heating(2, "fresh", wall=8.0)
    found = ce.repair(heated(), data, fresh=fresh, starts=1, progress=False)
    assert found.verdict == "named"
    assert found.confirmed
    (one,) = found.effects
    assert (one.name, one.at) == ("hidden_storage", "body")
    low, high = one.amplitude.interval
    assert low < 8.0 < high
    assert high - low < 6.0
    low, high = found.fit.estimates["body.hidden_storage.time"].interval
    assert low < 40.0 < high


def test_no_wall_is_found_where_there_is_none():
    found = ce.repair(heated(), heating(3, "data"), fresh=heating(4, "fresh"), starts=1, progress=False)
    assert found.verdict == "nothing missing"


def test_what_is_stored_begins_where_the_signal_goes_in_the_records():
    """Else a storage of 1e14 K behind next to no conductance is any load that fades."""
    seen = [np.array([30.0, 52.0, 41.0]), np.array([34.0, np.nan, 20.0])]
    found = candidates(heated(), [HiddenStorage()], heating(1, "one"), courses=lambda expression: seen)
    assert {(one.effect.reach, one.effect.first) for one in found} == {(32.0, 32.0)}
    assert {one.effect.reach for one in candidates(heated(), [HiddenStorage()], heating(1, "one"))} == {0.0}
