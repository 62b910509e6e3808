"""An input that acts at a further port: where it is offered, its unit, and a side force that a model lacks."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import InputPath, ports_for
from casadi_engine.errors import EffectError, ModelError
from casadi_engine.model.declarations import Port

TIME = np.arange(600) * 0.1


def bridge(unit="N"):
    """A deck that a force excites, with an absorber on it."""
    b = ce.Blueprint("bridge")
    big, small = b.parameter("M", 200.0, unit="kg", vary=False), b.parameter("m", 10.0, unit="kg", vary=False)
    k = b.parameter("k", 70.0, unit="N/m", min=1)
    c = b.parameter("c", 6.0, unit="N s/m", min=0.1)
    x, v, y, w = (b.state(name, unit=u) for name, u in (("x", "m"), ("v", "m/s"), ("y", "m"), ("w", "m/s")))
    force = b.input("F", unit=unit)
    deck, absorber = b.port("deck", "inertia", {"speed": v}), b.port("absorber", "inertia", {"speed": w})
    between = k * (x - y) + c * (v - w)
    b.ode("x", v)
    b.ode("v", (force - 1500 * x - 20 * v - between + deck) / big)
    b.ode("y", w)
    b.ode("w", (between + absorber) / small)
    b.output("speed", v, unit="m/s")
    return b.model()


def force(t, phase):
    return 100 * (np.sin(2.1 * t + phase) + np.sin(2.9 * t + 2 * phase) + np.sin(0.7 * t))


def run(seed, gain):
    """By SciPy; so much of the force acts at the absorber."""

    def rate(t, z):
        x, v, y, w = z
        f = np.interp(t, TIME, force(TIME, seed))
        between = 80.0 * (x - y) + 5.0 * (v - w)
        return [v, (f - 1500 * x - 20 * v - between) / 200, w, (between + gain * f) / 10]

    z = solve_ivp(rate, (0, TIME[-1]), [0, 0, 0, 0], t_eval=TIME, rtol=1e-9, atol=1e-12, max_step=0.1).y
    noise = 0.004 * np.random.default_rng(seed).standard_normal(len(TIME))
    units = {"F": "N", "speed": "m/s"}
    return ce.Experiment.from_arrays(
        f"run {seed}", time=TIME, units=units, F=force(TIME, seed), speed=z[1] + noise
    )


def room(unit="W/m2"):
    b = ce.Blueprint("room")
    capacity = b.parameter("C", 1e5, unit="J/K", min=1e3)
    b.input("sun", unit=unit)
    heater, ambient = b.input("P", unit="W"), b.input("Ta", unit="K")
    temperature = b.state("T", unit="K")
    slot = b.port("air", "inertia", {"speed": temperature - ambient}, unit="W")
    b.ode("T", (heater - 80 * (temperature - ambient) + slot) / capacity)
    b.output("shown", temperature, unit="K")
    return b.model()


def test_it_is_offered_to_inputs_of_the_unit_of_what_acts_there_and_to_those_that_act_on_nothing():
    def offered(model):
        return [port.name for port in ports_for(model, InputPath())]

    assert offered(bridge()) == ["F_to_absorber"]  # at the deck it is a wrong gain of the input
    assert offered(bridge("kN")) == ["F_to_absorber"]
    assert offered(bridge("-")) == []
    assert offered(room()) == ["sun_to_air"]
    wider = bridge().with_effect(InputPath(), at="F_to_absorber", values={"gain": 0.5})
    assert "F_to_deck" not in offered(wider)
    assert "F_to_absorber" not in bridge().ports.names
    with pytest.raises(
        EffectError, match="input_path is to act at a port that the model bridge does not have"
    ):
        bridge().with_effect(InputPath(), at="F_to_nowhere")
    with pytest.raises(
        EffectError, match=r"no signal difference.*give deck what the law reads: a first signal"
    ):
        bridge().with_effect(ce.effects.library("transfer")[0], at="F_to_deck")
    with pytest.raises(ModelError, match=r"the port p is a path without an end.*the path is called u_to_a"):
        Port("p", "path")


HOUR = 3600.0
DAYS = np.arange(0, 96, 0.25) * HOUR


def house(air=1.0, floor=0.0):
    """Air and floor; the sun, in W/m2, acts by an area on the air, or on both."""
    b = ce.Blueprint("house")
    capacity = b.parameter("C_a", 6e5, unit="J/K", min=1e4)
    area = b.parameter("A", 6.0, unit="m2", min=0)
    sun, outside = b.input("sun", unit="W/m2"), b.input("T_out", unit="K")
    a, f = b.state("T_air", unit="K"), b.state("T_floor", unit="K")
    at_air = b.port("air", "inertia", {"speed": a - outside}, unit="W")
    at_floor = b.port("floor", "inertia", {"speed": f - outside}, unit="W")
    between = 150 * (a - f)
    b.ode("T_air", (air * area * sun - 180 * (a - outside) - between + at_air) / capacity)
    b.ode("T_floor", (floor * area * sun + between - 60 * (f - 283.0) + at_floor) / 4e6)
    b.output("shown", a, unit="K")
    return b.model()


def test_an_input_is_offered_where_as_it_acts_at_another_port_of_that_unit():
    def offered(model):
        return [port.name for port in ports_for(model, InputPath()) if port.name.startswith("sun")]

    assert offered(house()) == ["sun_to_floor"]
    assert offered(house(0.0, 1.0)) == ["sun_to_air"]
    assert offered(house(0.5, 0.5)) == ["sun_to_air", "sun_to_floor"]
    assert house().with_effect(InputPath(), at="sun_to_floor").declarations[-1].unit == "m2"


def warm_days(name, phase):
    """By SciPy: 8 m2 of the sun act on the air, and 12 m2 on the floor."""
    shown = np.maximum(0, 600 * np.sin(2 * np.pi * (DAYS / HOUR - 6) / 24)) * (
        1 + 0.5 * np.sin(DAYS / 1e4 + phase)
    )
    outside = 278 + 5 * np.sin(2 * np.pi * (DAYS / HOUR - 9) / 24)

    def rate(t, z):
        sun, out = np.interp(t, DAYS, shown), np.interp(t, DAYS, outside)
        between = 150 * (z[0] - z[1])
        return [
            (8 * sun - 180 * (z[0] - out) - between) / 5e5,
            (12 * sun + between - 60 * (z[1] - 283)) / 4e6,
        ]

    z = solve_ivp(rate, (0, DAYS[-1]), [285, 285], t_eval=DAYS, method="LSODA", rtol=1e-8, max_step=900.0).y
    noise = 0.2 * np.random.default_rng(int(10 * phase)).standard_normal(len(DAYS))
    units = {"sun": "W/m2", "T_out": "K", "shown": "K"}
    return ce.Experiment.from_arrays(
        name, time=DAYS, units=units, sun=shown, T_out=outside, shown=z[0] + noise
    )


def test_repair_names_the_sun_on_the_floor_and_not_a_late_one():
    effects = ("input_path", "input_lag", "input_delay", "hidden_storage", "constant_torque", "input_gain")
    found = ce.repair(
        house(), warm_days("a", 0.3), fresh=warm_days("b", 1.1), effects=effects, progress=False
    )
    assert [(one.name, one.at) for one in found.effects] == [("input_path", "sun_to_floor")]
    gain = found.fit.estimates["sun_to_floor.input_path.gain"]
    assert abs(gain.value - 12) < 4 * gain.stderr < 2


@pytest.mark.parametrize(
    ("model", "at", "unit"),
    [(bridge(), "F_to_absorber", "1"), (room(), "sun_to_air", "m2"), (bridge("-"), "F_to_absorber", "N")],
)
def test_its_gain_has_the_unit_of_what_acts_by_that_of_the_input(model, at, unit):
    made = model.with_effect(InputPath(), at=at, values={"gain": 0.5})
    assert made.parameters()[f"{at}.input_path.gain"].unit == unit
    assert made.linear is not None


def test_it_adds_gain_times_input_at_the_port_alone():
    made = bridge().with_effect(InputPath(), at="F_to_absorber", values={"gain": 0.5})
    rate = ca.Function("rate", [made.x, made.u, made.t, made.p], [made.closed_ode])
    slope = rate(0, 8.0, 0, made.parameter_vector())
    np.testing.assert_allclose(slope.full().ravel(), [0, 8.0 / 200, 0, 0.5 * 8.0 / 10])


def test_a_share_of_the_force_at_the_absorber_is_named_beside_the_whole_library():
    found = ce.repair(bridge(), run(1, 0.08), fresh=run(2, 0.08), starts=1, progress=False)
    assert [one.key for one in found.effects] == ["F_to_absorber.input_path"], found
    gain = found.effects[0].amplitude
    assert found.confirmed
    assert abs(gain.value - 0.08) < 3 * gain.stderr < 0.01
    assert "the input F acts at absorber" in str(found)


def buffer():
    b = ce.Blueprint("buffer")
    c = b.parameter("C", 4e5, unit="J/K", min=1e4)
    ambient, heat = b.input("Ta", unit="K"), b.input("P", unit="W")
    b.input("cellar", unit="K")
    b.input("pressure", unit="bar")
    t = b.state("T", unit="K", scale=300)
    loss = b.parameter("G", 20.0, unit="W/K", min=0)
    b.ode(
        "T", (heat - loss * (t - ambient) + b.port("tank", "inertia", {"speed": t - ambient}, unit="W")) / c
    )
    b.output("shown", t, unit="K")
    return b.model()


def heated(seed):
    """By SciPy; the tank loses 12 W/K to a cellar beside the room."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 86400, 120.0)
    power = np.repeat(rng.uniform(0, 3000, 36), 20)
    ambient = 293 + 3 * np.sin(2 * np.pi * time / 86400 + seed)
    cellar = 285 + 4 * np.sin(2 * np.pi * time / 30000 + 2 * seed)

    def rate(t, y):
        at = [np.interp(t, time, one) for one in (power, ambient, cellar)]
        return (at[0] - 30 * (y - at[1]) - 12 * (y - at[2])) / 5e5

    y = solve_ivp(rate, (0, time[-1]), [310.0], t_eval=time, rtol=1e-9, atol=1e-9, max_step=120).y[0]
    channels = {
        "P": power,
        "Ta": ambient,
        "cellar": cellar,
        "pressure": 2 + 0.1 * rng.standard_normal(len(time)),
    }
    shown = y + 0.1 * rng.standard_normal(len(time))
    units = {"P": "W", "Ta": "K", "cellar": "K", "pressure": "bar", "shown": "K"}
    return ce.Experiment.from_arrays(f"day {seed}", time=time, units=units, **channels, shown=shown)


def test_a_loss_to_a_temperature_that_was_recorded_is_named_beside_the_whole_library():
    found = ce.repair(buffer(), heated(1), fresh=heated(2), starts=1, progress=False)
    assert [one.key for one in found.effects] == ["cellar_to_tank.transfer"], found
    size = found.effects[0].amplitude
    assert found.confirmed
    assert size.unit == "W/K"
    assert abs(size.value - 12) < 3 * size.stderr < 2
    assert "between cellar and tank" in str(found)


def test_a_transfer_asks_for_an_input_of_the_unit_of_the_ports_own_signal():
    transfer = ce.effects.library("transfer")[0]
    assert [port.name for port in ports_for(buffer(), transfer)] == [
        "cellar_to_tank"
    ]  # Ta has friction at the tank
    assert [port.name for port in ports_for(bridge(), transfer) if port.kind == "path"] == []


def heater():
    """A heater and the air around it; water thrown on the heater is recorded, and the model knows nothing of it."""
    b = ce.Blueprint("heater")
    b.input("w", unit="kg/s")
    power = b.input("P", unit="W")
    air, stones = b.state("Ta", unit="K"), b.state("Ts", unit="K")
    into, out = (
        b.port("air", "inertia", {"speed": air}, unit="W"),
        b.port("stones", "inertia", {"speed": stones - air}, unit="W"),
    )
    b.ode("Ta", (60 * (stones - air) - 70 * air + into) / 4e4)
    b.ode("Ts", (power - 60 * (stones - air) + out) / 6e4)
    b.output("T", air, unit="K")
    return b.model()


def test_an_input_that_acts_at_one_port_may_act_at_another_one_too():
    """What it does in the model is what it does without what was found: steam leaves the stones and heats the air."""
    wider = heater().with_effect(InputPath(), at="w_to_air", values={"gain": 2e6})
    assert {port.name for port in ports_for(wider, InputPath())} >= {"w_to_air", "w_to_stones"}
    assert (heater().idle_inputs, heater().unused_inputs) == (("w",), ("w",))
    assert (wider.idle_inputs, wider.unused_inputs) == (("w",), ())


@pytest.mark.parametrize(("level", "about"), [(101325.0, 101300.0), (3.0, None)])
def test_an_input_that_hardly_varies_acts_by_its_variation(level, about):
    """The mean of an air pressure is a constant, and was named as what the pressure does."""
    w = level + 2.0 * np.sin(TIME) * (100.0 if about else 1.0)
    units = {"w": "kg/s", "P": "W", "T": "K"}
    data = ce.Experiment.from_arrays("r", time=TIME, units=units, w=w, P=0 * w, T=0 * w)
    found = ce.effects.candidates(heater(), [InputPath()], data)
    assert {one.effect.about for one in found if one.at == "w_to_air"} == {about}
    made = heater().with_effect(InputPath(about=2.0), at="w_to_air", values={"gain": 5.0})
    rate = ca.Function("rate", [made.x, made.u, made.t, made.p], [made.closed_ode])
    slope = rate(0, ca.vertcat(3.0, 0.0), 0, made.parameter_vector()).full().ravel()
    np.testing.assert_allclose(slope, [5.0 / 4e4, 0.0])


def test_what_is_an_output_too_is_no_cause():
    """A measured speed by which the equations are evaluated: a stiff enough viscous friction between it and a shaft
    led through every sample of a crankshaft, was "confirmed on fresh data", and told nothing of the drag that lacked.
    """
    b = ce.Blueprint("shaft")
    w = b.state("w", unit="rad/s")
    push, seen = b.input("T", unit="N m"), b.input("omega", unit="rad/s")
    slot = b.port("disc", "inertia", {"speed": w}, unit="N m")
    b.ode("w", (push - 1e-3 * seen**2 - 0.1 * w + slot) / 0.2)
    b.output("omega", w, unit="rad/s")
    model = b.model()
    for effect in (InputPath(), ce.effects.Transfer()):
        assert "omega_to_disc" not in [port.name for port in ports_for(model, effect)]
