"""Models with effects: the old equations at amplitude 0, the linear core, print, several effects, wrong ports."""

import casadi as ca
import numpy as np
import pytest

from casadi_engine.effects import (
    Backlash,
    ConstantTorque,
    CoulombFriction,
    CubicStiffness,
    CylinderImbalance,
    LoadStep,
    Misfire,
    QuadraticDrag,
    SensorDelay,
    SensorOffset,
    ViscousFriction,
    library,
    ports_for,
)
from casadi_engine.effects.protocol import Amplitude, Effect
from casadi_engine.errors import EffectError
from casadi_engine.model import crankshaft, one_inertia, two_mass

CYCLES = {"first": 1, "last": 2}
MODELS = {
    "one": one_inertia(load="measured"),
    "one with a cylinder": one_inertia(cylinders=1, friction_torque=0.8),
    "two": two_mass(outputs=("omega", "omega_load")),
    "two linear": two_mass(reciprocating_speed="measured"),
    "two variable": two_mass(reciprocating_inertia="variable"),
    "seven": crankshaft(),
    "seven linear": crankshaft(reciprocating_speed="measured"),
    "two cylinders, own angle": crankshaft(cylinders=2, angle="state"),
}


def values_of(effect):
    return CYCLES if effect.name == "misfire" else None


def point(model, seed=0):
    """A state, channels and parameters as in a running engine."""
    rng = np.random.default_rng(seed)
    x = [s.scale * (1.2 + 0.1 * rng.standard_normal()) if s.unit == "rad/s" else 1e-2 * rng.standard_normal()
         for s in model.states]  # fmt: skip
    sizes = {"theta": 7.3, "T_load": 57.0, "omega": 125.0, "T": 60.0}
    u = [sizes.get(v.name, 1e6 * (1 + rng.uniform())) for v in model.inputs]
    return np.array(x), np.array(u), 0.3


def closed(model, like=None, **values):
    """Rates of the states and outputs; of the states of ``like``, where those of effects come behind them."""
    x, u, t = point(like or model)
    count, x = len(x), np.concatenate([x, np.full(model.x.numel() - len(x), 0.2)])
    u = np.concatenate([u, np.zeros(model.u.numel() - len(u))])  # rates of what a sensor shows at once by now
    function = ca.Function(
        "f", [model.x, model.u, model.t, model.p], [model.closed_ode, model.closed_outputs]
    )
    ode, out = function(x, u, t, model.parameter_vector(values))
    return ode.full().ravel()[:count], out.full().ravel()


@pytest.mark.parametrize(
    ("name", "sharp"),
    [
        # the larger models take long, and are alike
        pytest.param(
            name,
            sharp,
            marks=pytest.mark.slow
            if name not in ("two", "two linear") or (sharp and name == "two linear")
            else (),
        )
        for name in MODELS
        for sharp in (False, True)
    ],
)
def test_at_amplitude_zero_the_model_is_the_old_one_and_keeps_its_linear_core(name, sharp):
    base = MODELS[name]
    old_ode, old_out = closed(base)
    core = None if base.linear is None else ca.Function("core", [base.p], list(base.linear.matrices))
    old = [] if core is None else [part.full() for part in core(base.parameter_vector())]
    tried = 0
    for effect in library():
        for port in ports_for(base, effect):
            if name.startswith("seven") and port.name[-1] in "1356":
                continue  # alike
            model = base.with_effect(effect, at=port, values=values_of(effect), sharp=sharp)
            ode, out = closed(model, base)
            np.testing.assert_allclose(ode, old_ode, rtol=1e-13, atol=1e-9)
            np.testing.assert_allclose(out, old_out, rtol=1e-13)
            # an output that shows the time itself has no constant core
            assert (model.linear is None) == (base.linear is None or effect.name == "sensor_drift")
            if model.linear is not None:
                new = ca.Function("core", [model.p], list(model.linear.matrices))(model.parameter_vector())
                for old_part, part in zip(old, new, strict=True):
                    rows, columns = old_part.shape
                    np.testing.assert_allclose(part.full()[:rows, :columns], old_part, rtol=1e-13, atol=1e-12)
            tried += 1
    assert tried >= 5


def test_a_linear_model_stays_linear_where_the_term_allows():
    base = MODELS["two linear"]
    for effect, at in (
        (ViscousFriction(), "load"),
        (ViscousFriction(), "coupling"),
        (ConstantTorque(), "engine"),
        (LoadStep(), "load"),
        (CylinderImbalance(), "cylinder_3"),
        (Misfire(), "cylinder_2"),
        (SensorOffset(), "sensor_omega"),
        (SensorDelay(), "sensor_omega"),
    ):
        model = base.with_effect(effect, at=at, values=values_of(effect))
        assert model.linear is not None, effect.name
        assert not model.has_slot_laws, effect.name
    for effect, at in (
        (CoulombFriction(), "coupling"),
        (CubicStiffness(), "coupling"),
        (QuadraticDrag(), "load"),
    ):
        model = base.with_effect(effect, at=at)
        assert model.linear is not None
        assert model.has_slot_laws


def test_the_linear_core_of_an_affine_effect_holds_its_parameter():
    model = MODELS["two linear"].with_effect(ViscousFriction(), at="load", values={"coefficient": 0.3})
    core = ca.Function("A", [model.p], [model.linear.A])(model.parameter_vector()).full()
    plain = MODELS["two linear"]
    before = ca.Function("A", [plain.p], [plain.linear.A])(plain.parameter_vector()).full()
    assert core[1, 1] - before[1, 1] == pytest.approx(-0.3 * 5.646)
    assert np.count_nonzero(core != before) == 1


@pytest.mark.parametrize(
    ("effect", "at", "values", "torques"),
    [
        # torques on engine and load by hand, at the state of `point`
        (CoulombFriction(width=1e-6), "coupling", {"torque": 5.0}, lambda x: (5 * np.sign(x[1] - x[0]), None)),
        (CoulombFriction(width=1e-6), "load", {"torque": 5.0}, lambda x: (0.0, -5.0)),
        (ViscousFriction(), "engine", {"coefficient": 0.2}, lambda x: (-0.2 * x[0], 0.0)),
        (ViscousFriction(), "coupling", {"coefficient": 0.2}, lambda x: (0.2 * (x[1] - x[0]), None)),
        (QuadraticDrag(width=1e-6), "load", {"coefficient": 1e-3}, lambda x: (0.0, -1e-3 * x[1] ** 2)),
        (library("stribeck_friction")[0], "load", {"torque": 4.0, "fading": 100.0},
         lambda x: (0.0, -4 * np.exp(-((x[1] / 100) ** 2)))),
        (ConstantTorque(), "engine", {"torque": -2.0}, lambda x: (-2.0, 0.0)),
        (CubicStiffness(), "coupling", {"stiffness": 1e6}, lambda x: (1e6 * x[2] ** 3, None)),
        (Backlash(width=1e-6), "coupling", {"gap": 1e-4}, lambda x: (-1992 * 1e-4 * np.sign(x[2]), None)),
        (Backlash(width=1e-6), "coupling", {"gap": 0.2}, lambda x: (-1992 * x[2], None)),
        (LoadStep(), "load", {"torque": 3.0, "time": 0.2}, lambda x: (0.0, -3.0)),
        (LoadStep(), "load", {"torque": 3.0, "time": 0.4}, lambda x: (0.0, 0.0)),
    ],
)  # fmt: skip
def test_the_torques_are_those_worked_out_by_hand(effect, at, values, torques):
    base = MODELS["two"]
    model = base.with_effect(effect, at=at, values=values)
    change = (closed(model)[0] - closed(base)[0])[:2] * [1 / 2.557, 1 / 5.646]
    engine, load = torques(point(base)[0])
    np.testing.assert_allclose(change, [engine, -engine if load is None else load], rtol=1e-6, atol=1e-8)


def test_names_settings_and_extension_of_parameters():
    base = MODELS["two"]
    pars = base.parameters()
    pars["J_eng"].set(0.4, min=0.1)
    pars.fix("C_el", 2.0)
    model = base.with_effect(CoulombFriction(), at="coupling").with_effect(LoadStep(), at="load")
    wide = pars.extended(model)
    assert wide.names[-4:] == (
        "coupling.coulomb_friction.torque",
        "coupling.coulomb_friction.width",
        "load.load_step.torque",
        "load.load_step.time",
    )
    assert [wide[name].vary for name in wide.names[-4:]] == [True, False, True, True]
    assert model.parameters()["coupling.coulomb_friction.width"].value == 0.02
    assert wide["J_eng"].value == 0.4
    assert not wide["C_el"].vary
    assert wide["coupling.coulomb_friction.torque"].min == 0.0
    assert [one.key for one in model.effects] == ["coupling.coulomb_friction", "load.load_step"]
    assert model.effects[0].amplitude == "coupling.coulomb_friction.torque"
    assert base.effects == ()
    assert (
        model.with_effect(SensorOffset(), at="sensor_omega")
        .parameters()["sensor_omega.sensor_offset.offset"]
        .unit
        == "rad/s"
    )


def test_print_shows_the_terms():
    model = MODELS["two"].with_effect(CoulombFriction(), at="coupling")
    model = model.with_effect(CubicStiffness(), at="coupling").with_effect(SensorOffset(), at="sensor_omega")
    lines = model.equations().splitlines()
    law = next(line for line in lines if line.startswith("w_coupling"))
    friction, spring = law.removeprefix("w_coupling = ").split(" + ")
    assert (
        friction
        == "coupling.coulomb_friction.torque*tanh((omega_load - omega_eng)/coupling.coulomb_friction.width)"
    )
    assert spring in (f"coupling.cubic_stiffness.stiffness*{cube}" for cube in ("twist**3", "twist*twist**2"))
    assert "omega = omega_eng + sensor_omega.sensor_offset.offset" in lines
    assert any("w_coupling" in line for line in lines if line.startswith("d(omega_load)"))
    assert r"w_{\mathrm{coupling}} &= " in model.latex()
    assert r"\tanh" in model.latex()
    assert "coupling.coulomb_friction.torque" in model.table()


def test_a_delayed_sensor_prints_when_it_shows_what():
    text = MODELS["two linear"].with_effect(SensorDelay(), at="sensor_omega").equations()
    assert "omega(t + sensor_omega.sensor_delay.delay) = omega_eng" in text.splitlines()
    assert "w_" not in text


def test_the_order_in_which_effects_are_added_does_not_matter():
    base = MODELS["two variable"]
    both = [
        (CoulombFriction(), "coupling", {"torque": 4.0}),
        (ViscousFriction(), "load", {"coefficient": 0.1}),
        (SensorDelay(), "sensor_omega", {"delay": 1e-4}),
        (CylinderImbalance(), "cylinder_2", {"share": -0.1}),
        (SensorOffset(), "sensor_omega", {"offset": 0.5}),
        (LoadStep(), "engine", {"torque": 2.0, "time": 0.1}),
    ]
    results = []
    for order in (range(6), (2, 5, 0, 4, 1, 3), (5, 4, 3, 2, 1, 0)):
        model = base
        for k in order:
            effect, at, values = both[k]
            model = model.with_effect(effect, at=at, values=values)
        results.append(closed(model))
    for ode, out in results[1:]:
        np.testing.assert_allclose(ode, results[0][0], rtol=1e-12)
        np.testing.assert_allclose(out, results[0][1], rtol=1e-12)
    # the delay sees the rate with all effects in it
    ode, out = results[0]
    assert out[0] == pytest.approx(point(base)[0][0] + 0.5 - 1e-4 * ode[0], rel=1e-12)


class InputGain(Effect):
    name, attaches = "input_gain", ("input",)
    amplitude = Amplitude("gain")

    def law(self, port, p, math):
        return p.gain * port.value


class Drift(Effect):
    name, attaches = "drift", ("parameter",)
    amplitude = Amplitude("slope", unit=None)

    def law(self, port, p, math):
        return p.slope * port.time


def test_an_effect_at_an_input_changes_the_channel_everywhere():
    base = MODELS["two"]
    model = base.with_effect(InputGain(), at="input_p1", values={"gain": 0.1})
    x, u, t = point(base)
    louder = u.copy()
    louder[[v.name for v in base.inputs].index("p1")] *= 1.1
    function = ca.Function("f", [base.x, base.u, base.t, base.p], [base.closed_ode])
    expected = function(x, louder, t, base.parameter_vector()).full().ravel()
    np.testing.assert_allclose(closed(model)[0], expected, rtol=1e-12)
    twice = model.with_effect(CylinderImbalance(), at="cylinder_1", values={"share": 1.0})
    signal = ca.Function("s", [base.u, base.p], [base.ports["cylinder_1"].signals["combustion_torque"]])
    burned = float(signal(louder, base.parameter_vector()))
    assert (closed(twice)[0] - expected)[0] == pytest.approx(burned * 2.557, rel=1e-9)
    assert model.linear is not None


def test_a_drifting_parameter_makes_the_model_general():
    base = MODELS["two linear"]
    model = base.with_effect(Drift(), at="parameter_K_el", values={"slope": 100.0})
    assert model.linear is None
    assert model.parameters()["parameter_K_el.drift.slope"].unit == "N m/rad"
    np.testing.assert_allclose(closed(model)[0], closed(base, K_el=1992.0 + 30.0)[0], rtol=1e-12)


def test_an_effect_twice_at_a_port_is_refused():
    model = MODELS["two"].with_effect(CoulombFriction(), at="coupling")
    with pytest.raises(EffectError, match="has coulomb_friction at coupling already") as caught:
        model.with_effect(CoulombFriction(width=0.1), at="coupling")
    assert "another port" in str(caught.value)
    model.with_effect(CoulombFriction(), at="load")


def test_a_port_that_does_not_exist_is_refused_with_the_right_ports():
    with pytest.raises(EffectError) as caught:
        MODELS["two"].with_effect(CoulombFriction(), at="couplng")
    assert "a port that the model two_mass does not have" in str(caught.value)
    assert "engine, load, coupling (nearest: coupling)" in str(caught.value)


def test_a_port_of_a_wrong_kind_is_refused_with_the_right_ports():
    with pytest.raises(EffectError) as caught:
        MODELS["two"].with_effect(CubicStiffness(), at="load")
    assert "cubic_stiffness cannot act at the port load" in str(caught.value)
    assert "a port of the kind inertia" in str(caught.value)
    assert caught.value.allowed == "coupling"
    with pytest.raises(
        EffectError, match="misfire cannot act at the port cylinders, which has no signal firing_offset"
    ):
        MODELS["two"].with_effect(Misfire(), at="cylinders", values=CYCLES)
    with pytest.raises(EffectError, match="a port of the kind internal"):
        MODELS["two variable"].with_effect(ConstantTorque(), at="variable_inertia")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"tork": 1.0}, "has no such parameter.*nearest: torque"),
        ({"torque": "much"}, "the value of torque .* is not acceptable"),
        ({"torque": float("nan")}, "the value of torque .* is not acceptable"),
    ],
)
def test_values_that_do_not_fit_are_refused(values, message):
    with pytest.raises(EffectError, match=message):
        MODELS["two"].with_effect(CoulombFriction(), at="coupling", values=values)


@pytest.mark.parametrize("values", [None, {"first": 1}, {"first": 1.5, "last": 2}])
def test_cycles_of_a_misfire_are_whole_numbers(values):
    with pytest.raises(EffectError, match="misfire needs a whole number for"):
        MODELS["two"].with_effect(Misfire(), at="cylinder_1", values=values)


def test_cycles_of_a_misfire_are_in_order():
    with pytest.raises(EffectError, match=r"in the wrong order.*first = 3, last = 2"):
        MODELS["two"].with_effect(Misfire(), at="cylinder_1", values={"first": 3, "last": 2})


def test_an_input_effect_may_not_use_states():
    class Wrong(InputGain):
        def law(self, port, p, math):
            return p.gain * MODELS["two"].x[0]

    with pytest.raises(EffectError, match=r"omega_eng \(one of the states\)"):
        MODELS["two"].with_effect(Wrong(), at="input_p1")
