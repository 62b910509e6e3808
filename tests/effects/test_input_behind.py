"""Inputs that act behind what is recorded, or later, against SciPy's own solutions."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import InputDelay, InputLag
from casadi_engine.errors import EffectError
from casadi_engine.model.port_view import PortView

TIME = np.arange(0, 40, 0.1)
STEPS = np.repeat(np.random.default_rng(0).uniform(0.3, 1.5, 20), 20)


def tank(power=1.0, drive="u", outflow=1.0):
    """A tank into which u flows (to a power), and out of which its level to another drives."""
    b = ce.Blueprint("tank")
    area = b.parameter("A", 2.0, min=0.1, max=20)
    k = b.parameter("k", 0.5, min=0.01, max=10)
    level, u = b.state("h", unit="m"), b.input("u", unit="m3/s")
    slot = b.port("tank", "inertia", {"speed": level}, unit="m3/s")
    flow = {"u": u**power, "kh": u**power * level}[drive]
    b.ode("h", (flow - k * level**outflow + slot) / area)
    b.output("h", level, unit="m")
    return b.model()


def record(u=STEPS, level=None, name="r"):
    channels = {"u": u, "h": np.zeros_like(u) if level is None else level}
    return ce.Experiment.from_arrays(name, time=TIME, units={"u": "m3/s", "h": "m"}, hold="zero", **channels)


def by_steps(rate, first, extra=0):
    """Solutions (N,) of the first state, from step to step of the input."""
    x, found = np.array([*first, *[0.0] * extra]), [first[0]]
    for u in STEPS[:-1]:
        x = solve_ivp(lambda _, y, u=u: rate(y, u), (0, 0.1), x, rtol=1e-10, atol=1e-12).y[:, -1]
        found.append(x[0])
    return np.array(found)


def simulated(model, effect, values, **first):
    at = {f"input_u.{effect.name}.{name}": value for name, value in values.items()}
    wider = model.with_effect(effect, at="input_u")
    states = {f"input_u_{effect.name}_{name}": value for name, value in first.items()}
    return wider, ce.simulate(wider, record(), parameters=at, initial={"h": 1.0, **states})["h"].values


@pytest.mark.parametrize(
    ("power", "drive", "outflow"),
    [(1.0, "u", 1.0), (1.0, "u", 1.5), (2.0, "u", 1.0), (1.0, "kh", 1.0), (2.0, "kh", 1.5)],
)
def test_a_lag_is_that_of_its_equation(power, drive, outflow):
    """Where the input is affine, squared, or times a state; linear models stay so where they can."""

    def rate(y, u):
        level, acts = y
        flow = (0.4 * u + 0.6 * acts) ** power * (level if drive == "kh" else 1.0)
        return [(flow - 0.5 * level**outflow) / 2, (u - acts) / 1.3]

    wanted = by_steps(rate, (1.0, STEPS[0]))
    model, found = simulated(
        tank(power, drive, outflow), InputLag(), {"share": 0.6, "time": 1.3}, acts=STEPS[0]
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
    assert (model.linear is not None and not model.has_slot_laws) == (
        power == 1.0 and drive == "u" and outflow == 1.0
    )


def test_without_a_share_the_model_is_what_it_was():
    _, found = simulated(tank(), InputLag(), {"share": 0.0, "time": 1.3}, acts=0.2)
    plain = ce.simulate(tank(), record(), initial={"h": 1.0})["h"].values
    np.testing.assert_allclose(found, plain, rtol=1e-9)


def test_a_delay_is_nearly_that_of_the_input():
    late = np.concatenate([np.full(10, STEPS[0]), STEPS[:-10]])
    wanted = ce.simulate(tank(), record(late), initial={"h": 1.0})["h"].values
    _, found = simulated(
        tank(), InputDelay(), {"share": 1.0, "time": 1.0}, passes=STEPS[0], rate=0.0, bend=0.0
    )
    plain = ce.simulate(tank(), record(), initial={"h": 1.0})["h"].values
    assert np.sqrt(np.mean((found - wanted) ** 2)) < 0.05 * np.sqrt(np.mean((plain - wanted) ** 2))


def test_times_are_those_that_a_record_can_show():
    view = PortView(tank(), tank().ports["input_u"])
    lag, delay = (effect.fitted(view, record(), {}) for effect in (InputLag(), InputDelay()))
    assert (lag.span, delay.span) == ((0.05, 10.0), (0.2, 10.0))
    assert lag.first == delay.first == STEPS[0]
    assert InputLag(span=(1.0, 2.0)).fitted(view, record(), {}).span == (1.0, 2.0)


def test_an_input_that_lacks_its_first_samples_begins_at_the_first_that_is_known():
    view = PortView(tank(), tank().ports["input_u"])
    late = record(np.where(TIME < 0.35, np.nan, STEPS + TIME))
    found = InputLag().fitted(view, late, {}).first
    assert found == pytest.approx(STEPS[4] + TIME[4])


def test_a_delay_may_end_below_the_shortest_that_is_searched():
    """1.4 samples: a lag of more than all of the input led in its place, at its bound."""
    view = PortView(tank(), tank().ports["input_u"])
    lag, delay = (effect.fitted(view, record(), {}) for effect in (InputLag(), InputDelay()))
    for effect, least in ((lag, 0.05), (delay, 0.05)):
        wider = tank().with_effect(effect, at="input_u")
        assert wider.parameters()[f"input_u.{effect.name}.time"].min == pytest.approx(least)
    assert delay.nuisance["time"].start == pytest.approx(0.2)


def test_a_constant_input_is_not_looked_at():
    model = tank()
    candidates = ce.effects.candidates(
        model, [InputLag(), InputDelay()], record(np.full(400, 0.7)), courses=lambda _: [np.full(400, 0.7)]
    )
    assert candidates == ()


def test_a_sensor_has_none():
    with pytest.raises(EffectError):
        tank().with_effect(InputLag(), at="sensor_h")


@pytest.mark.parametrize(
    ("effect", "tau"),
    [("input_lag", 1.2), ("input_delay", 1.0), ("input_delay", 0.15), ("input_delay", 0.05)],
)
def test_repair_names_it_at_one_of_two_inputs(effect, tau):
    """Both flow into a tank whose outflow bends; one of them acts late, by all of it: how much of it and by how long is
    hardly told where that is a sample and a half."""
    b = ce.Blueprint("two")
    k = b.parameter("k", 0.4, min=0.01, max=10)
    level, u, v = b.state("h", unit="m"), b.input("u", unit="m3/s"), b.input("v", unit="m3/s")
    slot = b.port("tank", "inertia", {"speed": level}, unit="m3/s")
    b.ode("h", u + v - k * level * ca.fabs(level) + slot)
    b.output("h", level, unit="m")
    records = []
    for seed in (1, 2):
        random = np.random.default_rng(seed)
        u, v = (np.repeat(random.uniform(0.1, 1.0, 40), 10) for _ in range(2))
        behind = round(20 * tau) if effect == "input_delay" else None  # half samples
        x, rows = np.array([1.0, v[0]]), [1.0]
        for k in range(798):
            acts = None if behind is None else v[max(k - behind, 0) // 2]

            def rate(_, y, j=k // 2, acts=acts, u=u, v=v):
                now = y[1] if acts is None else acts
                return [u[j] + now - 0.5 * y[0] ** 2, (v[j] - y[1]) / tau]

            x = solve_ivp(rate, (0, 0.05), x, rtol=1e-9, atol=1e-11).y[:, -1]
            if k % 2:
                rows.append(x[0])
        h = np.array(rows) + 0.005 * random.standard_normal(400)
        records.append(
            ce.Experiment.from_arrays(
                f"r{seed}", time=TIME, units={"u": "m3/s", "v": "m3/s", "h": "m"}, hold="zero", u=u, v=v, h=h
            )
        )
    repair = ce.repair(b.model(), records[0], fresh=records[1], progress=False)
    (found,) = repair.effects
    assert found.at == "input_v"
    if tau < 0.1:  # a lag does the same
        assert {member.name for member in found.members} == {"input_lag", "input_delay"}
        assert found.parameters[f"input_v.{found.name}.time"].value == pytest.approx(tau, rel=0.2)
        return
    assert found.name == effect
    assert found.amplitude.value == 1.0
    assert found.amplitude.fixed
    time = found.parameters[f"input_v.{effect}.time"]
    assert time.value == pytest.approx(tau, rel=0.1)
    if time.stderr is None:  # of whole samples: a stair and a line have another slope on either side
        assert time.interval[0] - 0.004 < tau < time.interval[1] + 0.004
    else:
        assert abs(time.value - tau) < 3 * time.stderr
    if effect == "input_delay":  # exactly
        assert repair.fit.cost / repair.fit.n < 1.1
        assert len(repair.fit.model.states) == 1
        assert f"v_late = v(t - input_v.{effect}.time)" in repair.equation.text
    assert repair.confirmed
