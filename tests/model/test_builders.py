"""The builders against equations worked out by hand in numpy, from the geometry and from energies."""

import math

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.errors import ModelError, ParameterError
from casadi_engine.model import Geometry, one_inertia, two_mass

PI = math.pi
OFFSETS = {1: 0.0, 2: 3 * PI, 3: PI, 4: 2 * PI}  # firing order 1-3-4-2
R, L, A_P, M_EQ, P_CRANK = 0.043, 0.145, 0.0058, 0.7, 1.0e5
J_ENG, J_LOAD, K_EL, C_EL, C_ENG = 1 / 2.557, 1 / 5.646, 1992.0, 2.5, 0.1541
STEP = 1e-30


def piston(angle):
    """Way from TDC [m] by the law of cosines."""
    return R + L - R * np.cos(angle) - np.sqrt(L**2 - (R * np.sin(angle)) ** 2)


def piston_slope(angle):
    """ds/dθ [m/rad] by a complex step."""
    return np.imag(piston(angle + 1j * STEP)) / STEP


def piston_curvature(angle, h=1e-5):
    """d²s/dθ² [m/rad²], Richardson-extrapolated differences of the exact slope."""

    def central(step):
        return (piston_slope(angle + step) - piston_slope(angle - step)) / (2 * step)

    return (4 * central(h) - central(2 * h)) / 3


def gas_torque(theta, pressures, offsets):
    return sum((p - P_CRANK) * A_P * piston_slope(theta - offsets[k]) for k, p in pressures.items())


def mass_torque(theta, speed, offsets):
    return sum(
        -M_EQ * piston_slope(theta - o) * piston_curvature(theta - o) * speed**2 for o in offsets.values()
    )


def closed(model, x, u, **changes):
    """f(x, u, p) of the model, channels by name."""
    channels = [u[variable.name] for variable in model.inputs]
    function = ca.Function("f", [model.x, model.u, model.t, model.p], [model.closed_ode])
    return function(x, channels, 0.0, model.parameter_vector(changes)).full().ravel()


def by_hand(x, torque, load):
    eng, rel, twist = x[0], x[1] - x[0], x[2]
    return [
        (-C_ENG * eng + K_EL * twist + C_EL * rel + torque) / J_ENG,
        (-K_EL * twist - C_EL * rel - load) / J_LOAD,
        rel,
    ]


thetas = st.floats(0, 40)
speeds = st.floats(60, 320)
pressures = st.lists(st.floats(5e4, 6e6), min_size=4, max_size=4)


def channels(theta, cylinder_pressures, load, **more):
    named = {f"p{k}": p for k, p in enumerate(cylinder_pressures, start=1)}
    return {"theta": theta, **named, "T_load": load, **more}


@settings(max_examples=40, deadline=None)
@given(thetas, speeds, pressures)
def test_two_mass_is_equation_4_1(theta, speed, p):
    model = two_mass()
    x = [speed, speed + 3.0, 0.03]
    torque = gas_torque(theta, dict(enumerate(p, start=1)), OFFSETS) + mass_torque(theta, speed, OFFSETS)
    result = closed(model, x, channels(theta, p, 57.0))
    np.testing.assert_allclose(result, by_hand(x, torque, 57.0), rtol=1e-6, atol=1e-3)


@settings(max_examples=20, deadline=None)
@given(thetas, speeds, pressures)
def test_linear_form_is_equation_4_3(theta, speed, p):
    model = two_mass(reciprocating_speed="measured")
    assert not model.has_slot_laws
    x = [speed - 2.0, speed + 3.0, 0.03]
    torque = gas_torque(theta, dict(enumerate(p, start=1)), OFFSETS) + mass_torque(theta, speed, OFFSETS)
    result = closed(model, x, channels(theta, p, 57.0, omega=speed))
    np.testing.assert_allclose(result, by_hand(x, torque, 57.0), rtol=1e-6, atol=1e-3)


def test_names_units_and_defaults_of_two_mass():
    model = two_mass()
    assert [v.name for v in model.states] == ["omega_eng", "omega_load", "twist"]
    assert [v.name for v in model.inputs] == ["theta", "p1", "p2", "p3", "p4", "T_load"]
    assert [v.name for v in model.drives] == ["T_1", "T_2", "T_3", "T_4", "T_load"]
    assert [v.name for v in model.outputs] == ["omega"]
    assert model.parameter_names == (
        "J_eng", "J_load", "K_el", "C_el", "C_eng", "r", "L", "A_p", "m_eq", "p_crank",
    )  # fmt: skip
    parameters = model.parameters()
    free = [name for name in parameters if parameters[name].vary]
    assert free == ["J_eng", "J_load", "K_el", "C_el", "C_eng"]
    np.testing.assert_allclose(
        model.parameter_vector(), [J_ENG, J_LOAD, K_EL, C_EL, C_ENG, R, L, A_P, M_EQ, P_CRANK]
    )
    assert parameters["K_el"].unit == "N m/rad"
    linear_form = two_mass(reciprocating_speed="measured")
    assert [v.name for v in linear_form.inputs][-2:] == ["omega", "T_load"]


def test_parameters_are_fresh_each_time():
    model = two_mass()
    model.parameters()["J_eng"].set(0.5)
    assert model.parameters()["J_eng"].value == J_ENG


def test_linear_core_of_two_mass():
    for model in (two_mass(), two_mass(reciprocating_speed="measured")):
        core = ca.Function("core", [model.p], list(model.linear.matrices))
        a, b, g, e, c, d, c0 = (part.full() for part in core(model.parameter_vector()))
        expected = [
            [-(C_ENG + C_EL) / J_ENG, C_EL / J_ENG, K_EL / J_ENG],
            [C_EL / J_LOAD, -C_EL / J_LOAD, -K_EL / J_LOAD],
            [-1, 1, 0],
        ]
        np.testing.assert_allclose(a, expected, rtol=1e-14)
        np.testing.assert_allclose(b[:, :4], np.outer([1 / J_ENG, 0, 0], np.ones(4)))
        np.testing.assert_allclose(b[:, 4], [0, -1 / J_LOAD, 0])
        slots = dict(zip((port.name for port in model.ports.with_slot), g.T, strict=True))
        np.testing.assert_allclose(slots["engine"], [1 / J_ENG, 0, 0])  # positive accelerates
        np.testing.assert_allclose(slots["load"], [0, 1 / J_LOAD, 0])
        np.testing.assert_allclose(slots["coupling"], [1 / J_ENG, -1 / J_LOAD, 0])  # first side, opposite
        np.testing.assert_allclose(slots["cylinders"], [1 / J_ENG, 0, 0])
        np.testing.assert_allclose(slots["cylinder_3"], [1 / J_ENG, 0, 0])
        np.testing.assert_allclose(c, [[1, 0, 0]])
        assert not e.any()
        assert not d.any()
        assert not c0.any()
        assert not ca.depends_on(
            ca.vertcat(*map(ca.vec, model.linear.matrices)), ca.vertcat(model.u, model.x)
        )


def test_laws_act_only_in_the_cylinders_slots():
    model = two_mass()
    acting = [
        port.name for port, law in zip(model.ports.with_slot, ca.vertsplit(model.slot_laws), strict=True)
        if not law.is_zero()
    ]  # fmt: skip
    assert acting == ["cylinder_1", "cylinder_2", "cylinder_3", "cylinder_4"]


def test_uneven_firing_of_two_cylinders():
    uneven = {1: 0.0, 2: math.radians(450)}
    model = two_mass(cylinders=2, firing_offsets=tuple(uneven.values()))
    x, p = [150.0, 151.0, 0.01], [2e6, 4e5]
    torque = gas_torque(5.0, dict(enumerate(p, start=1)), uneven) + mass_torque(5.0, 150.0, uneven)
    result = closed(model, x, channels(5.0, p, 20.0))
    np.testing.assert_allclose(result, by_hand(x, torque, 20.0), rtol=1e-7)


def test_both_outputs():
    model = two_mass(outputs=("omega", "omega_load"))
    linear = ca.Function("c", [model.p], [model.linear.C])(model.parameter_vector()).full()
    np.testing.assert_array_equal(linear, [[1, 0, 0], [0, 1, 0]])
    assert [v.unit for v in model.outputs] == ["rad/s", "rad/s"]


@settings(max_examples=30, deadline=None)
@given(thetas, speeds, pressures)
def test_variable_inertia_is_the_direct_derivation(theta, speed, p):
    """Lagrange: (J + Σ(m s'² − mean)) θ̈ + Σ m s' s'' θ̇² = T."""
    model = two_mass(reciprocating_inertia="variable")
    x = [speed, speed - 4.0, -0.02]
    grid = 2 * PI * np.arange(512) / 512
    mean = M_EQ * np.mean(piston_slope(grid) ** 2)
    change = sum(M_EQ * piston_slope(theta - o) ** 2 - mean for o in OFFSETS.values())
    torque = gas_torque(theta, dict(enumerate(p, start=1)), OFFSETS) + mass_torque(theta, speed, OFFSETS)
    expected = by_hand(x, torque, 40.0)
    expected[0] *= J_ENG / (J_ENG + change)
    np.testing.assert_allclose(closed(model, x, channels(theta, p, 40.0)), expected, rtol=1e-6, atol=1e-3)


def test_variable_inertia_leaves_the_core_constant():
    plain, variable = two_mass(), two_mass(reciprocating_inertia="variable")
    difference = [
        ca.Function("a", [model.p], [model.linear.A])(model.parameter_vector()).full()
        for model in (plain, variable)
    ]
    np.testing.assert_array_equal(*difference)
    assert variable.ports["variable_inertia"].kind == "internal"
    assert not ca.depends_on(variable.slot_laws, variable.w)


def test_kinetic_energy_is_kept_without_losses():
    """No gas, no friction, no load: ½ (J + Σ(m s'² − mean)) ω² is constant along the motion."""
    model = one_inertia(cylinders=1, reciprocating_inertia="variable")
    channel = {"theta": 0.0, "p1": P_CRANK}
    mean = M_EQ * np.mean(piston_slope(2 * PI * np.arange(512) / 512) ** 2)
    for theta in np.linspace(0.1, 12.0, 25):
        speed = 140.0
        channel["theta"] = theta
        rate = closed(model, [speed], channel, C_eng=0.0, J_eng=0.02)[0]
        inertia = 0.02 + M_EQ * piston_slope(theta) ** 2 - mean
        inertia_rate = 2 * M_EQ * piston_slope(theta) * piston_curvature(theta) * speed
        assert inertia * speed * rate + 0.5 * inertia_rate * speed**2 == pytest.approx(0, abs=1e-4 * 140**2)


def test_one_inertia_is_equation_2_37():
    model = one_inertia()
    assert model.parameter_names == ("J_eng", "C_eng")
    assert [v.name for v in model.inputs] == [v.name for v in model.drives] == ["T"]
    assert closed(model, [120.0], {"T": 30.0}) == pytest.approx((30 - C_ENG * 120) / J_ENG)
    assert [str(part) for part in (model.linear.A, model.linear.B)] == ["(-(C_eng/J_eng))", "(1./J_eng)"]


def test_one_inertia_with_measured_torque_and_load():
    model = one_inertia(load="measured")
    assert [v.name for v in model.drives] == ["T", "T_load"]
    result = closed(model, [120.0], {"T": 30.0, "T_load": 8.0})
    assert result == pytest.approx((30 - C_ENG * 120 - 8) / J_ENG)


def test_run_down_with_cylinder_pressure():
    """One cylinder, friction as a parameter, pressure relative to an unknown offset (p_crank)."""
    geometry = Geometry(r=R, L=L, A_p=A_P, m_eq=M_EQ)
    model = one_inertia(cylinders=1, geometry=geometry, friction_torque=0.85, load="constant")
    assert [v.name for v in model.inputs] == ["theta", "p1"]
    parameters = model.parameters()
    assert parameters["T_f"].value == 0.85
    assert parameters["T_f"].vary
    assert not parameters["p_crank"].vary
    changes = {"J_eng": 0.0225, "C_eng": 1e-3, "T_load": 2.0, "p_crank": -3e4}
    result = closed(model, [250.0], {"theta": 7.0, "p1": 4e5}, **changes)
    gas = (4e5 + 3e4) * A_P * piston_slope(7.0)
    torque = gas + mass_torque(7.0, 250.0, {1: 0.0}) - 0.85 - 2.0 - 1e-3 * 250
    assert result == pytest.approx(torque / 0.0225, rel=1e-7)
    assert model.linear is not None


def test_one_inertia_in_the_linear_form():
    model = one_inertia(cylinders=4, reciprocating_speed="measured")
    assert not model.has_slot_laws
    assert [v.name for v in model.inputs] == ["theta", "p1", "p2", "p3", "p4", "omega"]


def test_ports_of_two_mass():
    model = two_mass()
    kinds = {port.name: port.kind for port in model.ports}
    assert kinds["engine"] == kinds["load"] == "inertia"
    assert kinds["coupling"] == "coupling"
    assert kinds["cylinder_4"] == kinds["cylinders"] == "cylinder"
    assert kinds["input_T_load"] == "input"
    assert kinds["sensor_omega"] == "sensor"
    assert kinds["parameter_K_el"] == "parameter"
    assert set(model.ports["engine"].signals) == {"speed", "angle"}
    assert set(model.ports["coupling"].signals) == {"twist", "twist_rate", "stiffness"}
    assert {"angle", "speed", "pressure", "gas_torque"} <= set(model.ports["cylinder_2"].signals)
    assert set(model.ports["sensor_omega"].signals) == {"value", "rate"}
    assert model.ports["input_p1"].slot is None


def test_signals_of_a_cylinder_are_its_own():
    model = two_mass()
    signals = model.ports["cylinder_2"].signals
    function = ca.Function("s", [model.x, model.u, model.p], [signals["angle"], signals["gas_torque"]])
    u = [channels(1.0, [1e5, 2e6, 1e5, 1e5], 0.0)[v.name] for v in model.inputs]
    angle, torque = (float(part) for part in function([100.0, 100.0, 0.0], u, model.parameter_vector()))
    assert angle == pytest.approx(1.0 - 3 * PI)
    assert torque == pytest.approx((2e6 - P_CRANK) * A_P * piston_slope(1.0 - 3 * PI))


def test_geometry_may_be_a_mapping_and_is_taken_as_default():
    model = two_mass(geometry={"m_eq": 0.5})
    assert model.parameters()["m_eq"].value == 0.5
    assert model.parameters()["r"].value == R


@pytest.mark.parametrize(
    ("options", "problem", "allowed"),
    [
        (
            {"reciprocating_speed": "own"},
            "the option reciprocating_speed is not known",
            '"model" or "measured"',
        ),
        (
            {"reciprocating_inertia": 1},
            "the option reciprocating_inertia is not known",
            '"mean" or "variable"',
        ),
        (
            {"reciprocating_speed": "measured", "reciprocating_inertia": "variable"},
            "the variable reciprocating inertia needs the model's own speed",
            '"variable" with reciprocating_speed="model"',
        ),
        (
            {"outputs": ("speed",)},
            "the outputs are not ones of this model",
            "one or more of omega, omega_load",
        ),
        ({"outputs": "omega"}, "the outputs are not ones of this model", "a sequence of one or more"),
        ({"outputs": ()}, "the outputs are not ones of this model", "a sequence of one or more"),
        ({"outputs": ("omega", "omega")}, "the output omega is declared twice", "names unique"),
        ({"cylinders": 0}, "the number of cylinders is not acceptable", "a whole number, 1 or more"),
        (
            {"cylinders": 3, "firing_order": (1, 3, 4, 2)},
            "the firing order does not fit 3 cylinders",
            "each number",
        ),
        ({"geometry": {"stroke": 0.08}}, "the geometry has no such quantity", "r, L, A_p"),
    ],
)
def test_two_mass_refuses(options, problem, allowed):
    with pytest.raises(ModelError) as caught:
        two_mass(**options)
    assert str(caught.value).startswith(problem)
    assert allowed in caught.value.allowed
    assert caught.value.cure


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"load": "brake"}, "the option load is not known"),
        ({"load": True}, "the option load is not known"),
        ({"firing_order": (1,)}, "options of cylinders are given, but the torque is a channel"),
        ({"geometry": Geometry()}, "options of cylinders are given, but the torque is a channel"),
        ({"reciprocating_speed": "measured"}, "options of cylinders are given, but the torque is a channel"),
        (
            {"reciprocating_inertia": "variable"},
            "options of cylinders are given, but the torque is a channel",
        ),
        ({"cylinders": -1}, "the number of cylinders is not acceptable"),
    ],
)
def test_one_inertia_refuses(options, problem):
    with pytest.raises(ModelError) as caught:
        one_inertia(**options)
    assert str(caught.value).startswith(problem)
    assert caught.value.allowed
    assert caught.value.cure


def test_friction_must_brake():
    with pytest.raises(ParameterError):
        one_inertia(friction_torque=-1.0)


def test_parameter_vector_reads_sets_and_mappings():
    model = one_inertia()
    np.testing.assert_array_equal(model.parameter_vector({"C_eng": 0.2}), [J_ENG, 0.2])
    parameters = model.parameters()
    parameters.add("extra", 0.4, unit="N m s/rad")
    parameters.tie("C_eng", "extra/4")
    np.testing.assert_allclose(model.parameter_vector(parameters), [J_ENG, 0.1])
    with pytest.raises(ModelError, match=r"has no such parameter; seen: 'C_engine'") as caught:
        model.parameter_vector({"C_engine": 1.0})
    assert "nearest: C_eng" in str(caught.value)
    with pytest.raises(
        ModelError, match=r"lacks parameters of the model two_mass; seen: without J_load, K_el"
    ):
        two_mass().parameter_vector(parameters)


def test_building_is_quick():
    """A repair builds many models: in ten times a sum of 100 000 squares, whatever the machine (4 to 5 times)."""
    import time

    two_mass()
    best = min(_timed(two_mass, time.process_time) for _ in range(10))
    assert best < 10 * min(
        _timed(lambda: sum(i * i for i in range(100_000)), time.process_time) for _ in range(10)
    )


def _timed(function, clock):
    start = clock()
    function()
    return clock() - start


@pytest.mark.parametrize("given", [None, "4", 4.0, [4], -1, 10**400, np.array([1, 2])])
@pytest.mark.parametrize("build", [one_inertia, two_mass])
def test_a_number_of_cylinders_of_another_kind(build, given):
    with pytest.raises(ModelError, match="the number of cylinders is not acceptable"):
        build(cylinders=given)


@pytest.mark.parametrize("given", [3, "r", [0.043], np.array([1, 2])])
def test_a_geometry_of_another_kind(given):
    with pytest.raises(ModelError, match="the geometry is of the wrong kind"):
        two_mass(geometry=given)


@pytest.mark.parametrize("given", [np.array(["model", "measured"]), 1, None])
def test_a_word_of_another_kind(given):
    with pytest.raises(ModelError, match="the option reciprocating_speed is not known"):
        two_mass(reciprocating_speed=given)


@pytest.mark.parametrize("given", [3, None, np.array(["omega"]), {"omega": 1}, (1, 2)])
def test_outputs_of_another_kind(given):
    with pytest.raises(ModelError, match="the outputs are not ones of this model"):
        two_mass(outputs=given)


def test_an_array_is_no_option_left_out():
    with pytest.raises(ModelError, match="options of cylinders are given"):
        one_inertia(firing_offsets=np.array([0.0, 1.0]))
