"""Candidates: their parts against differences of the extended models, grids over records, and wrong requests."""

import sys

import casadi as ca
import numpy as np
import pytest

from casadi_engine import Experiment, effects
from casadi_engine.effects.protocol import Amplitude, Effect
from casadi_engine.errors import EffectError
from casadi_engine.model import crankshaft, one_inertia, two_mass
from casadi_engine.model.term import read_terms
from tests.quick import few

MODELS = {
    "two": two_mass(outputs=("omega", "omega_load")),
    "two linear": two_mass(reciprocating_speed="measured"),
    "two variable": two_mass(reciprocating_inertia="variable"),
    "seven": crankshaft(),
    "seven linear": crankshaft(reciprocating_speed="measured"),
}
CYCLES = {"first": 1, "last": 2}


class InputGain(Effect):
    name, attaches = "input_gain", ("input",)
    amplitude = Amplitude("gain")

    def law(self, port, p, math):
        return p.gain * port.value


class Drift(Effect):
    name, attaches = "drift", ("parameter",)
    amplitude = Amplitude("slope")

    def law(self, port, p, math):
        return p.slope * port.time


EVERYTHING = [*effects.library(), InputGain(), Drift()]


def point(model, seed=0):
    rng = np.random.default_rng(seed)
    x = [s.scale * (1.2 + 0.1 * rng.standard_normal()) if s.unit == "rad/s" else 1e-2 * rng.standard_normal()
         for s in model.states]  # fmt: skip
    sizes = {"theta": 7.3, "T_load": 57.0, "omega": 125.0}
    u = [sizes.get(v.name, 1e6 * (1 + rng.uniform())) for v in model.inputs]
    return np.array(x), np.array(u), 0.3


@pytest.mark.parametrize("name", few(MODELS, "two", "two linear"))
def test_the_closed_forms_are_slopes_of_the_extended_model(name):
    model = MODELS[name]
    x, u, t = point(model)
    for effect in EVERYTHING:
        for port in effects.ports_for(model, effect)[:9]:
            values = CYCLES if effect.name == "misfire" else None
            one = effects.candidate(model, effect, port, values)
            wide = one.extended()
            f = ca.Function("f", [wide.x, wide.u, wide.t, wide.p], [wide.closed_ode, wide.closed_outputs])
            key = f"{port.name}.{effect.name}.{effect.amplitude.name}"
            bent = dict.fromkeys(
                ("drift", "input_gain", "input_lag", "input_delay"), 1e-5
            )  # in the crank's angle
            step = {"backlash": 1e-7, "sensor_delay": 1e-6, **bent}.get(effect.name, 1e-3)
            own = ca.vertcat(ca.SX(0, 1), *[state.symbol for state in one.states])
            behind = 0.3 * np.ones(own.numel())
            every = np.concatenate([x, behind])
            # a sensor that shows a channel at once knows its rate too
            given = np.concatenate([u, np.zeros(wide.u.numel() - len(u))])
            low, high = (f(every, given, t, wide.parameter_vector({key: value})) for value in (-step, step))
            g = ca.Function("g", [model.x, model.u, model.t, model.p, own], [one.ode, one.output])
            found = g(x, u, t, model.parameter_vector(), behind)
            for slope, down, up in zip(found, low, high, strict=True):
                expected = (up.full() - down.full()).ravel()[: slope.numel()] / (2 * step)
                scale = np.abs(expected).max() + 1e-12
                np.testing.assert_allclose(slope.full().ravel(), expected, atol=2e-6 * scale + 1e-5)


def test_the_open_parts_are_torques_drives_and_outputs():
    model = MODELS["two"]
    x, u, t = point(model)
    d = np.arange(1.0, 6.0)
    p = model.parameter_vector()
    slots = [port.name for port in model.ports.with_slot]
    coulomb = effects.candidate(model, effects.CoulombFriction(), "coupling", sharp=True)
    torque, drives, outputs = (part.full().ravel() for part in coulomb.function(x, u, d, t, p))
    expected = np.zeros(len(slots))
    expected[slots.index("coupling")] = np.sign(x[1] - x[0])
    np.testing.assert_array_equal(torque, expected)
    assert not drives.any()
    assert not outputs.any()
    offset = effects.candidate(model, effects.SensorOffset(), "sensor_omega_load")
    torque, drives, outputs = (part.full().ravel() for part in offset.function(x, u, d, t, p))
    np.testing.assert_array_equal(outputs, [0.0, 1.0])
    assert not torque.any()
    gain = effects.candidate(model, InputGain(), "input_T_load")
    torque, drives, outputs = (part.full().ravel() for part in gain.function(x, u, d, t, p))
    np.testing.assert_array_equal(drives, [0, 0, 0, 0, 57.0])
    step = effects.candidate(model, effects.LoadStep(), "load", {"time": 0.1}, sharp=True)
    for moment, on in ((0.05, 0.0), (0.2, -1.0)):
        assert step.function(x, u, d, moment, p)[0].full().ravel()[slots.index("load")] == on


def test_backlash_has_a_one_sided_slope_and_secants_that_bend():
    model = MODELS["two"]
    x = ca.SX.sym("x", 3)
    row = [port.name for port in model.ports.with_slot].index("coupling")
    gap = 4e-3
    for twist in (-0.02, -0.003, 0.001, 0.03):
        at = [125.0, 125.0, twist], np.zeros(6), np.zeros(5), 0.0, model.parameter_vector()
        slope = effects.candidate(model, effects.Backlash(), "coupling", sharp=True).function(*at)[0]
        assert float(slope[row]) == pytest.approx(-1992 * np.sign(twist), rel=1e-9)
        secant = effects.candidate(model, effects.Backlash(), "coupling", size=gap, sharp=True).function(*at)[
            0
        ]
        spring = 1992 * (np.sign(twist) * max(abs(twist) - gap, 0) - twist)
        assert float(secant[row]) == pytest.approx(spring / gap, rel=1e-12)
    assert x.numel() == 3
    one = effects.candidate(model, effects.Backlash(), "coupling", size=gap)
    assert one.label == "coupling.backlash(gap=0.004)"
    assert one.amplitude.one_sided == 1


def record(cycles=3.0, start=0.0):
    time = np.arange(0, cycles * 0.1, 1e-4)
    theta = start + 125.66 * time
    columns = {f"p{k}": np.full_like(time, 1e5) for k in (1, 2, 3, 4)}
    offsets = {1: 0.0, 2: 3.0, 3: 1.0, 4: 2.0}
    for k in columns:
        local = np.mod(theta - offsets[int(k[1])] * np.pi + 2 * np.pi, 4 * np.pi) - 2 * np.pi
        columns[k] = np.asarray(effects.Motored(0.6e5, 1.3, 11.0).trace(local, 0.043 / 0.145))
    return Experiment.from_arrays(
        "made",
        time=time,
        units={"theta": "rad", **dict.fromkeys(columns, "Pa"), "T_load": "N m", "omega": "rad/s"},
        theta=theta,
        T_load=np.full_like(time, 57.0),
        omega=np.full_like(time, 125.66),
        **columns,
    )


def test_all_candidates_of_a_record():
    model = MODELS["two"].with_effect(effects.CoulombFriction(), at="coupling")
    made = effects.candidates(model, effects.library(), record())
    keys = [one.key for one in made]
    assert "coupling.coulomb_friction" not in keys
    assert "load.coulomb_friction" in keys
    labels = [one.label for one in made]
    assert len(set(labels)) == len(labels)
    misfires = [dict(one.values) for one in made if one.key == "cylinder_1.misfire"]
    assert misfires == [{"first": k, "last": k} for k in (1.0, 2.0, 3.0)] + [{"first": 2.0, "last": 3.0}]
    steps = [one.values["time"] for one in made if one.key == "load.load_step"]
    assert len(steps) == 49
    end = record().span[1]
    assert (steps[0], steps[-1]) == (pytest.approx(0.02 * end), pytest.approx(0.98 * end))
    slope, *secants = [one.size for one in made if one.key == "coupling.backlash"]
    assert slope is None
    assert np.array(secants) * 1992 == pytest.approx([4, 8, 16, 32, 64])
    fading = [one.values["fading"] for one in made if one.key == "load.stribeck_friction"]
    assert (fading[0], fading[-1]) == (pytest.approx(25.0), pytest.approx(250.0))


def test_laws_that_were_read_are_used_again_also_for_a_model_with_an_effect_more(monkeypatch):
    read = []

    def counted(model, effect, port, *rest, **options):
        read.append((effect.name, port.name))
        return read_terms(model, effect, port, *rest, **options)

    monkeypatch.setattr(sys.modules["casadi_engine.effects.candidate"], "read_terms", counted)
    known, names = {}, ("coulomb_friction", "stribeck_friction", "misfire", "backlash")
    chosen = [one for name in names for one in effects.library(name)]
    first = effects.candidates(MODELS["two"], chosen, record(), known=known)
    places = {("coulomb_friction", "coupling"), ("misfire", "cylinder_1"), ("backlash", "coupling")}
    assert len(read) == len(set(read))
    assert places < set(read)
    read.clear()
    again = effects.candidates(MODELS["two"], chosen, record(), known=known)
    assert all(one.slots is other.slots for one, other in zip(again, first, strict=True))
    larger = MODELS["two"].with_effect(effects.CoulombFriction(), at="coupling")
    made = effects.candidates(larger, chosen, record(), known=known)
    assert read == []
    plain = effects.candidates(larger, chosen, record())
    assert [one.label for one in made] == [one.label for one in plain]
    x, u, t = point(larger)
    p = larger.parameter_vector()
    for own, fresh in zip(made, plain, strict=True):
        assert own.model is larger
        for one, other in zip(own.function(x, u, 0, t, p), fresh.function(x, u, 0, t, p), strict=True):
            assert np.array(one) == pytest.approx(np.array(other), rel=1e-12, abs=1e-12)


def test_an_effect_that_may_have_changed_is_read_anew():
    class Fan(Effect):
        name, attaches = "fan", ("inertia",)
        amplitude = Amplitude("coefficient")
        power = 2

        def law(self, port, p, math):
            return -p.coefficient * port.speed**self.power

    fan, known = Fan(), {}
    square = effects.candidates(MODELS["two"], [fan], record(), known=known)
    fan.power = 3
    cube = effects.candidates(MODELS["two"], [fan], record(), known=known)
    x, u, t = point(MODELS["two"])
    p = MODELS["two"].parameter_vector()
    sizes = [np.array(one[0].function(x, u, 0, t, p)[0]).min() for one in (square, cube)]
    assert sizes == pytest.approx([-(x[0] ** 2), -(x[0] ** 3)])


def test_motored_traces_are_pegged_on_the_record():
    model = MODELS["two"]
    for one in effects.candidates(model, effects.library("cylinder_imbalance"), record()):
        if one.at == "cylinders":
            assert one.effect.motored is None
        else:
            assert one.effect.motored.pressure == pytest.approx(0.6e5, rel=1e-5)
            assert one.effect.motored.compression_ratio == pytest.approx(11.0)
            # a cylinder that does not burn has nothing to lose
            x, u, t = point(model)
            u[0], u[2] = 3 * np.pi + 0.3, float(effects.Motored(0.6e5, 1.3, 11.0).trace(0.3, 0.043 / 0.145))
            if one.at == "cylinder_2":
                torque = one.function(x, u, np.zeros(5), t, model.parameter_vector())[0]
                assert np.abs(torque.full()).max() < 1e-3


@pytest.mark.parametrize(
    ("start", "length", "expected"),
    [
        (0.0, 2.0, {1: (1, 2), 2: (1, 2)}),
        (8.0 * np.pi, 2.0, {1: (3, 4), 2: (3, 4)}),
        (1.0, 1.0, {1: (2,), 2: (1,)}),
    ],
)
def test_cycles_are_those_whose_combustion_is_in_the_record(start, length, expected):
    model, values = MODELS["two"], {}
    data = record(length, start)
    for number, cycles in expected.items():
        view = effects.port_view(model, f"cylinder_{number}")
        assert effects.cycles_of(view, data, values) == cycles


def test_a_record_without_a_compression_leaves_the_usual_trace():
    model = MODELS["two"]
    short = record(0.3)  # from the combustion of cylinder 1 to before that of cylinder 3
    view = effects.port_view(model, "cylinder_1")
    numbers = dict(zip(model.parameter_names, model.parameter_vector(), strict=True))
    assert effects.CylinderImbalance().fitted(view, short, numbers).motored is None
    view = effects.port_view(model, "cylinder_3")
    assert effects.CylinderImbalance().fitted(view, short, numbers).motored.pressure == pytest.approx(0.6e5)


def test_wrong_requests_are_refused():
    model = MODELS["two"]
    with pytest.raises(EffectError, match="the amplitude of a secant is not acceptable"):
        effects.candidate(model, effects.Backlash(), "coupling", size=0.0)
    with pytest.raises(
        EffectError, match="backlash is to act at a port that the model two_mass does not have"
    ):
        effects.candidate(model, effects.Backlash(), "clutch")
    blind = Experiment.from_arrays("blind", time=[0.0, 0.1], units={"T": "N m"}, T=[0.0, 0.0])
    with pytest.raises(EffectError, match=r"no crank angle to count engine cycles by.*without theta"):
        effects.candidates(model, effects.library("misfire"), blind)


def test_effects_that_count_cycles_are_not_applicable_without_a_crank_angle():
    blind, skipped = record().only("T_load", "omega"), []
    found = effects.candidates(
        MODELS["two"], effects.library("misfire", "constant_torque"), blind, skipped=skipped
    )
    assert {one.effect.name for one in found} == {"constant_torque"}
    assert {(one.effect, one.at) for one in skipped} == {("misfire", f"cylinder_{k}") for k in (1, 2, 3, 4)}
    assert "no crank angle" in skipped[0].why


def test_a_model_without_ports_for_an_effect_has_no_candidates():
    blind = Experiment.from_arrays("run", time=[0.0, 0.1], units={"T": "N m"}, T=[0.0, 0.0])
    assert effects.candidates(one_inertia(), effects.library("backlash", "misfire"), blind) == ()


def test_the_library_by_name():
    assert [e.name for e in effects.library()] == [
        "coulomb_friction", "viscous_friction", "quadratic_drag", "stribeck_friction", "asymmetric_friction",
        "constant_torque",
        "ground_spring", "cubic_stiffness", "backlash", "end_stop", "lower_end_stop", "relief",
        "ambient_loss", "radiation", "hidden_storage", "relaxation",
        "misfire", "cylinder_imbalance", "load_step", "sensor_offset", "sensor_drift", "sensor_delay",
        "sensor_lag",
            "sensor_gain", "cross_sensitivity",
        "input_gain",
        "input_offset", "input_lag", "input_delay", "input_path",
        "transfer",
        "overflow",
        "orifice_leak",
        "wrong_value",
    ]  # fmt: skip
    assert [e.name for e in effects.library("misfire", "backlash")] == ["misfire", "backlash"]
    with pytest.raises(EffectError, match=r"the library has no such effect.*nearest: backlash"):
        effects.library("backlesh")
    known = {e.name for e in effects.library()}
    for effect in effects.library():
        assert set(effect.kin) <= known
        assert "{port}" in effect.sentence
