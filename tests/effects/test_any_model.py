"""The library at models that are no engines: an effect acts, or says by name why it cannot."""

from types import SimpleNamespace
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy import screen
from casadi_engine.effects import Amplitude
from casadi_engine.errors import EffectError
from casadi_engine.model.port_side import check_side
from casadi_engine.model.term import NotApplicable, ports_for
from casadi_engine.report.result_file import to_result
from casadi_engine.report.schema import faults
from tests.quick import few

FRICTION = {"coulomb_friction", "viscous_friction"}
AT_SPEED = FRICTION | {
    "asymmetric_friction",
    "quadratic_drag",
    "stribeck_friction",
    "constant_torque",
    "load_step",
}


def mass():
    b = ce.Blueprint("mass")
    m = b.parameter("m", 2.0, unit="kg", min=1e-3)
    v, force = b.state("v", unit="m/s"), b.input("F", unit="N")
    slot = b.port("body", "inertia", {"speed": v})
    b.ode("v", (force + slot) / m)
    b.output("speed", v, unit="m/s")
    return b.model()


def pendulum():
    b = ce.Blueprint("pendulum")
    g = b.parameter("w2", 9.81, unit="rad2/s2", min=0)
    q, w = b.state("q", unit="rad"), b.state("w", unit="rad/s")
    slot = b.port("pivot", "inertia", {"speed": w, "angle": q})
    b.ode("q", w)
    b.ode("w", slot - g * ca.sin(q))
    b.output("angle", q, unit="rad")
    return b.model()


def cart():
    b = ce.Blueprint("cart")
    m, c = b.parameter("m", 1.0, unit="kg", min=0.1), b.parameter("c", 0.2, unit="N s/m", min=0)
    x, v = b.state("x", unit="m"), b.state("v", unit="m/s")
    slot = b.port("wheels", "inertia", {"speed": v})
    b.ode("x", v)
    b.ode("v", (b.input("F", unit="N") + slot - c * v) / m)
    b.output("place", x, unit="m")
    return b.model()


def circuit():
    b = ce.Blueprint("circuit")
    tau = b.parameter("tau", 0.2, unit="s", min=1e-3)
    u = b.state("u", unit="V")
    b.ode("u", (b.input("source", unit="V") - u) / tau)
    b.output("voltage", u, unit="V")
    return b.model()


def tank():
    b = ce.Blueprint("tank")
    k, h = b.parameter("k", 0.3, min=0), b.state("h", unit="m")
    slot = b.port("inflow", "internal")
    b.ode("h", b.input("q", unit="m/s") + slot - k * ca.sqrt(ca.fabs(h) + 1e-3))
    b.output("level", h, unit="m")
    return b.model()


def thermal():
    b = ce.Blueprint("thermal")
    g, temperature = b.parameter("g", 0.1, unit="1/s", min=0), b.state("T", unit="K", scale=300)
    slot = b.port("body", "inertia", {"temperature": temperature})
    b.ode("T", slot + b.input("heat", unit="K/s") - g * (temperature - 293))
    b.output("T_meas", temperature, unit="K")
    return b.model()


def duffing(signals=("stretch",), sign=-1, unit=None):
    b = ce.Blueprint("duffing")
    k, q, v = b.parameter("k", 4.0, unit="N/m", min=0), b.state("q", unit="m"), b.state("v", unit="m/s")
    known = {"stretch": q, "twist": q, "twist_rate": v, "stiffness": k, "stretch_rate": v}
    slot = b.port("spring", "coupling", {name: known[name] for name in signals}, unit=unit)
    b.ode("q", v)
    b.ode("v", b.input("F", unit="N") - k * q - 0.1 * v + sign * slot)
    b.output("position", q, unit="m")
    return b.model()


def several():
    """A port with signals that no effect knows, and two of one kind."""
    b = ce.Blueprint("several")
    a, c, f = b.state("a", unit="rad/s"), b.state("c", unit="rad/s"), b.input("T", unit="N m")
    k = b.parameter("k", 1.0, unit="N m s/rad", min=0)
    first = b.port("first", "inertia", {"speed": a, "power": f * a, "oil": a**2})
    second = b.port("second", "inertia", {"speed": c})
    b.ode("a", f + first - k * (a - c))
    b.ode("c", second - k * (c - a))
    b.output("w", c, unit="rad/s")
    return b.model()


SENSORS = {"sensor_offset", "sensor_drift", "sensor_delay", "sensor_lag", "sensor_gain"}
CASES = {
    "mass": (mass(), {"body": AT_SPEED}),
    "pendulum": (pendulum(), {"pivot": AT_SPEED}),
    "cart": (cart(), {"wheels": AT_SPEED}),
    "circuit": (circuit(), {}),
    "tank": (tank(), {}),
    "thermal": (thermal(), {"body": {"constant_torque", "load_step"}}),
    "stretch alone": (duffing(), {}),
    "twist": (duffing(("twist",)), {"spring": {"cubic_stiffness"}}),
    "twist and more": (
        duffing(("twist", "twist_rate", "stiffness")),
        {"spring": FRICTION | {"cubic_stiffness", "quadratic_drag", "backlash"}},
    ),
    "several": (several(), {"first": AT_SPEED, "second": AT_SPEED}),
}


@pytest.mark.parametrize("name", few(CASES, "several", *list(CASES)[::3]))
def test_every_effect_acts_or_says_why_it_cannot(name):
    model, expected = CASES[name]
    rng = np.random.default_rng(0)
    for effect in ce.effects.library():
        for port in model.ports:
            own = expected.get(port.name, set())
            acts = effect.name in own
            acts = acts or (
                effect.name
                in ("ambient_loss", "radiation", "hidden_storage", "ground_spring", "orifice_leak", "relief")
                and port.kind == "inertia"
                and "viscous_friction" in own
            )
            acts = acts or (effect.name == "relaxation" and "cubic_stiffness" in own)
            acts = acts or (port.kind == "sensor" and effect.name in SENSORS)
            acts = acts or (port.kind == "parameter" and effect.name == "wrong_value")
            acts = acts or (port.kind == "input" and "input" in effect.attaches)
            assert (port in ports_for(model, effect)) == acts, (effect.name, port.name)
            if not acts:
                with pytest.raises(EffectError, match=f"{effect.name} cannot act at the port {port.name}"):
                    model.with_effect(effect, at=port.name)
                continue
            for sharp in (False, True):
                made = model.with_effect(effect, at=port.name, sharp=sharp)
                values = {made.effects[-1].amplitude: 0.1}
                f = ca.Function("f", [made.x, made.u, made.t, made.p], [made.closed_ode, made.closed_outputs])
                point = (rng.uniform(0.1, 1, made.x.numel()), rng.uniform(0.1, 1, made.u.numel()), 0.3)
                ode, out = f(*point, made.parameter_vector(values))
                assert np.isfinite(np.array(ode)).all()
                assert np.isfinite(np.array(out)).all()


def test_amplitudes_have_the_units_of_their_port():
    def units(model, effect, at):
        made = model.with_effect(ce.effects.library(effect)[0], at=at)
        return {n.rpartition(".")[2]: made.parameters()[n].unit for n in made.parameter_names if effect in n}

    assert units(mass(), "coulomb_friction", "body") == {"torque": "N", "width": "m/s"}
    assert units(mass(), "viscous_friction", "body") == {"coefficient": "N s/m"}
    assert units(mass(), "quadratic_drag", "body") == {"coefficient": "N s2/m2", "width": "m/s"}
    assert units(mass(), "stribeck_friction", "body") == {"torque": "N", "fading": "m/s", "width": "m/s"}
    assert units(duffing(("twist",)), "cubic_stiffness", "spring") == {"stiffness": "N/m3"}
    assert units(pendulum(), "viscous_friction", "pivot") == {"coefficient": "1/s"}  # the ode is per inertia
    assert units(thermal(), "constant_torque", "body") == {"torque": "K/s"}  # it is added to a rate
    assert units(duffing(("twist",), unit="kN"), "cubic_stiffness", "spring") == {"stiffness": "kN/m3"}
    assert "spring           coupling   N     twist" in str(duffing(("twist",)).ports)


def test_a_missing_signal_is_named_with_its_cure():
    with pytest.raises(EffectError) as caught:
        duffing().with_effect(ce.effects.Backlash(), at="spring")
    assert str(caught.value) == (
        "backlash cannot act at the port spring, which has no signal stiffness, twist; "
        "seen: spring has the signals stretch; allowed: stretch; do: give the port what the law reads where the "
        "model is written: b.port('spring', 'coupling', {'stiffness': ..., 'twist': ...})"
    )


def test_a_slot_that_acts_the_other_way_round_is_refused():
    wrong = duffing(("twist", "twist_rate"), sign=1)
    for name in ("coulomb_friction", "cubic_stiffness"):
        with pytest.raises(
            EffectError, match=r"acts the other way round.*exchange the sign of the slot of spring"
        ):
            wrong.with_effect(ce.effects.library(name)[0], at="spring")
    with pytest.raises(EffectError, match="acts the other way round"):
        duffing(("twist",), sign=1).with_effect(ce.effects.CubicStiffness(), at="spring")


def test_what_a_user_s_own_subclass_declares_as_needed_does_no_harm():
    class Old(ce.effects.ViscousFriction):
        name, needs = "old", ("speed",)

    assert mass().with_effect(Old(), at="body").parameter_names[-1] == "body.old.coefficient"


class Broken(ce.Effect):
    name, attaches, amplitude = "broken", ("inertia",), ce.effects.Amplitude("size")
    result = "text"

    def law(self, port, p, math):
        if self.result == "raises":
            return p.size * (1 / (1 - 1))
        made = {
            "text": "text",
            "nan": p.size * float("nan"),
            "infinite": p.size / 0,
            "vector": p.size * ca.DM([1, 2]),
        }
        return made[self.result]


def record(model, n=300, seed=0, **values):
    """Noisy outputs of a model under its inputs."""
    t, rng = np.arange(n) * 0.02, np.random.default_rng(seed)
    inputs = {u.name: 2 * np.sin(1.3 * t) + np.sin(3.1 * t) for u in model.inputs}
    units = {v.name: v.unit for v in (*model.inputs, *model.outputs)}
    exp = ce.Experiment.from_arrays("run", time=t, units={n: units[n] for n in inputs}, **inputs)
    run = ce.simulate(model, exp, parameters=values, initial={s.name: 0.3 for s in model.states})
    out = {o.name: run[o.name].values + 0.01 * rng.standard_normal(n) for o in model.outputs}
    return ce.Experiment.from_arrays("run", time=t, units=units, **inputs, **out)


@pytest.mark.parametrize(
    ("result", "message"),
    [
        ("text", "is not a scalar expression; seen: str"),
        ("vector", r"is not a scalar expression; seen: SX \(2, 1\)"),
        ("nan", "is not a number; seen: a constant in it that is nan or infinite"),
        ("infinite", "is not a number; seen: a constant in it that is nan or infinite"),
        ("raises", "fails; seen: ZeroDivisionError"),
    ],
)
def test_a_broken_law_of_ones_own_is_named_and_listed(result, message):
    effect = Broken()
    effect.result = result
    with pytest.raises(EffectError, match=f"^the law of broken at body {message}"):
        mass().with_effect(effect, at="body")
    with pytest.raises(EffectError, match=f"^the law of broken at body {message}"):
        ce.repair(mass(), record(mass()), effects=effect, progress=False)
    fit = ce.estimate(mass(), record(mass()), noise=ce.Noise(speed=0.01), progress=False)
    screened = screen(fit, [*ce.effects.library("viscous_friction", "constant_torque"), effect])
    assert {one.effect for one in screened.candidates} == {"viscous_friction", "constant_torque"}
    why = {one.effect: one.why for one in screened.not_applicable}["broken"]
    assert why.startswith("the law of broken at body ")


def test_a_mass_that_a_search_has_made_negative_is_no_fault_of_a_slot():
    """It had ended a search: friction beside a wrong mass of -2 kg would drive."""
    b = ce.Blueprint("sledge")
    v, m = b.state("v", unit="m/s"), b.parameter("m", 2.0, unit="kg", vary=False)
    b.ode("v", (b.input("u", unit="N") + b.port("runner", "inertia", {"speed": v})) / m)
    b.output("v", v, unit="m/s")
    wrong = b.model().with_effect(ce.effects.WrongValue(), at="parameter_m", values={"share": -2.0})
    made = wrong.with_effect(ce.effects.CoulombFriction(), at="runner")
    assert [one.key for one in made.effects] == ["parameter_m.wrong_value", "runner.coulomb_friction"]


def test_a_search_leaves_out_what_cannot_act_and_lists_it():
    model = duffing(("stretch", "twist", "twist_rate"))
    data = record(model)
    noise = ce.Noise(position=0.01)
    screened = screen(ce.estimate(model, data, noise=noise, progress=False))
    assert {one.port for one in screened.candidates} == {
        "spring",
        "sensor_position",
        "input_F",
        "F_to_sensor_position",
    }
    left_out = {one.effect: one for one in screened.not_applicable}
    assert left_out["backlash"] == NotApplicable(
        "backlash", "spring", ("stiffness",), ("stretch", "twist", "twist_rate"), "the port has no stiffness"
    )
    assert left_out["stribeck_friction"].why == "the model has no port of the kind inertia"
    assert "Not applicable: backlash at spring: the port has no stiffness" in str(screened)


def test_a_pair_that_cannot_act_is_an_error_by_name():
    for request in ({"effects": [("cubic_stiffness", "spring")]}, {"effects": ["cubic_stiffness"]}):
        with pytest.raises(EffectError, match=r"cubic_stiffness.*at.*spring.*has no.*twist"):
            ce.repair(duffing(), record(duffing()), progress=False, **request)


@pytest.mark.parametrize("make", few([duffing, circuit], circuit))
def test_a_search_without_ports_to_act_at_claims_no_physics(make):
    model = make()
    data = record(model)
    name = model.outputs[0].name
    moved = data[name].values + 0.1
    data = ce.Experiment.from_arrays(
        "run",
        time=data[name].time,
        units={v.name: v.unit for v in (*model.inputs, *model.outputs)},
        **{u.name: data[u.name].values for u in model.inputs},
        **{name: moved},
    )
    found = ce.repair(model, data, noise=ce.Noise(**{name: 0.01}), starts=1, progress=False)
    assert found.verdict == "unnamed"
    assert found.effects == ()
    assert "no physical effect could be tested against it" in found.unknown.sentence
    lines = str(found).splitlines()
    assert "no physical effect could be looked for" in lines[0]
    assert lines[1].startswith(
        ("The model has no port at which", "No effect of the library can act at the ports")
    )
    assert "Where the model is written, give " in " ".join(" ".join(lines).split())
    assert found.blind
    written = to_result(found, command="repair", arguments={}, seconds=1.0, seed=0)
    assert not list(faults(written))
    listed = [one for one in written["not_applicable"] if one["at"]]
    assert [one["name"] for one in listed] == [one.effect for one in found.not_applicable if one.at]
    assert ("Not applicable: coulomb_friction at spring: the port has no twist_rate" in str(found)) == bool(
        listed
    )
    asked = ce.repair(
        model, data, effects=["sensor_offset"], noise=ce.Noise(**{name: 0.01}), starts=1, progress=False
    )
    assert asked.verdict == "named"


class Idle(ce.effects.ViscousFriction):
    name = "idle_friction"

    def idle(self, port):
        return 1 / len(port.courses("speed"))


class Hooked(ce.effects.ViscousFriction):
    name = "hooked"
    wrong = "oil"

    def sizes(self, port, values):
        return (port.oil,) if self.wrong == "oil" else (1 / len(port.courses("speed")),)


def test_other_methods_of_an_effect_that_fail_are_named():
    model, data = mass(), record(mass())
    skipped = []
    assert ce.effects.candidates(model, [Hooked()], data, skipped=skipped) == ()
    assert skipped == [NotApplicable("hooked", "body", ("oil",), ("speed",), "the port has no oil")]
    with pytest.raises(EffectError, match="hooked cannot act at the port body, which has no signal oil"):
        ce.effects.candidates(model, [Hooked()], data)
    with pytest.raises(EffectError, match=r"a method of idle_friction fails at body.*allowed: idle, fitted"):
        ce.effects.candidates(model, [Idle()], data)
    broken = Hooked()
    broken.wrong = "division"
    with pytest.raises(EffectError, match="a method of hooked fails at body; seen: ZeroDivisionError"):
        ce.effects.candidates(model, [broken], data)


@pytest.mark.parametrize("make", [ce.one_inertia, ce.two_mass, ce.crankshaft])
def test_the_slots_of_the_builders_act_the_right_way_round(make):
    model = make()
    checked = [port for port in model.ports if port.kind in ("inertia", "coupling")]
    assert checked
    for port in checked:
        check_side(model, port)


def test_an_effect_of_ones_own_acts_at_an_internal_port():
    """What a search finds to be a function of a signal there is refitted as such an effect."""

    class Cubed(ce.Effect):
        name, attaches, amplitude = "cubed", ("internal",), Amplitude("size", unit=None)
        nuisance: ClassVar = {}

        def law(self, port, p, math):
            return p.size * port.command**3

    b = ce.Blueprint("motor")
    torque, command = b.state("torque"), b.input("command")
    missing = b.port("motor", "internal", {"command": command})
    b.ode("torque", command - torque + missing)
    b.output("shown", torque)
    model = b.model().with_effect(Cubed(), at="motor", values={"size": 0.5})
    time = np.arange(200) * 0.05
    data = ce.Experiment.from_arrays("step", time=time, units={"command": "1"}, command=np.full(200, 2.0))
    run = ce.simulate(model, data, initial={"torque": 0.0})
    np.testing.assert_allclose(run["shown"].values, 6 * (1 - np.exp(-time)), atol=1e-6)


def test_a_slot_whose_side_hangs_on_a_state_is_not_refused():
    """A compliance that falls with the pressure over a reference of 2: below it the slot would act the other way."""
    b = ce.Blueprint("cavity")
    pressure = b.state("P", unit="mmHg")
    acts = b.port("cavity", "inertia", {"speed": pressure})
    b.ode("P", 0.2 * (pressure - 2.0) * (1.0 - pressure / 8.0 + acts))
    b.output("P", pressure, unit="mmHg")
    assert b.model().with_effect(ce.effects.LoadStep(), at="cavity").effects[0].at == "cavity"


def test_a_spring_that_is_none_has_no_play():
    """A stiffness that a fit took to zero was a ZeroDivisionError in what could not be applied."""
    port = SimpleNamespace(number=lambda *_: 0.0)
    assert ce.effects.Backlash().sizes(port, {}) == ()


def test_a_slot_on_the_wrong_side_is_refused_where_some_states_have_no_equations():
    """A level has no root below zero."""
    b = ce.Blueprint("tank")
    level = b.state("h", unit="m")
    acts = b.port("tank", "inertia", {"speed": level})
    b.ode("h", -0.1 * ca.sqrt(level) - acts * ca.sqrt(level))
    b.output("h", level, unit="m")
    with pytest.raises(EffectError, match="acts the other way round"):
        b.model().with_effect(ce.effects.LoadStep(), at="tank")


@pytest.mark.parametrize("rate", [False, True])
@pytest.mark.parametrize("sign", [1, -1])
def test_side_of_a_slot_that_moves_the_twist_itself(rate, sign):
    # a spring and a damper without mass: the slot stands in the first derivative of the twist, not in the second
    b = ce.Blueprint("dashpot")
    k, c = b.parameter("k", 50.0, unit="N/m", min=0), b.parameter("c", 3.0, unit="N s/m", min=1e-3)
    x, force = b.state("x", unit="m"), b.input("F", unit="N")
    signals = {"twist": x, "stiffness": k} | ({"twist_rate": (force - k * x) / c} if rate else {})
    slot = b.port("spring", "coupling", signals)
    b.ode("x", (force - k * x - sign * slot) / c)
    b.output("x_m", x, unit="m")
    effect = ce.effects.library("backlash")[0]
    if sign > 0:
        assert b.model().with_effect(effect, at="spring").effects
        return
    with pytest.raises(EffectError, match="acts the other way round"):
        b.model().with_effect(effect, at="spring")


def test_a_speed_that_follows_what_drives_it_at_once_says_nothing_of_the_side():
    # a motor whose coil has no inductance: a voltage in its circuit raises the current, which falls as the motor turns
    b = ce.Blueprint("motor")
    k, r = b.parameter("k", 0.05, unit="V s/rad", min=0), b.parameter("R", 0.6, unit="ohm", min=0.01)
    w, volts = b.state("w", unit="rad/s", scale=100), b.input("U", unit="V")
    drop = b.port("armature", "inertia", {"speed": (volts - k * w) / r}, unit="V")
    b.ode("w", k * (volts - k * w + drop) / r / b.parameter("J", 2e-4, unit="kg m2", vary=False))
    b.output("n", w, unit="rad/s")
    for name in ("coulomb_friction", "constant_torque"):
        assert b.model().with_effect(ce.effects.library(name)[0], at="armature").effects


@pytest.mark.parametrize("sign", [1, -1])
def test_an_offset_of_an_input_gives_way_only_to_a_constant_that_is_looked_for(sign):
    b = ce.Blueprint("sledge")
    v, force, m = b.state("v", unit="m/s"), b.input("F", unit="N"), b.parameter("m", 2.0, unit="kg")
    b.ode("v", (force - 3 * v + sign * b.port("runner", "inertia", {"speed": v}, unit="N")) / m)
    b.output("v_seen", v, unit="m/s")
    skipped = []
    found = ce.effects.candidates(
        b.model(),
        [ce.effects.InputOffset()],
        ce.Experiment.from_arrays(
            "run",
            time=np.arange(9.0),
            units={"F": "N", "v_seen": "m/s"},
            F=np.arange(9.0),
            v_seen=np.zeros(9),
        ),
        skipped=skipped,
    )
    assert [one.why for one in skipped] == (["constant_torque at runner does the same"] if sign > 0 else [])
    assert len(found) == (0 if sign > 0 else 1)
