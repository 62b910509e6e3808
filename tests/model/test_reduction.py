"""Reduction by rigid lumping: sums, receptances by mass matrices, limits of stiff couplings, and simulations."""

import json
import math

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import ModelError
from casadi_engine.model import (
    Blueprint,
    Coupling,
    Driven,
    Inertia,
    declare_chain,
    receptance,
    reduce,
    write_chain,
)

ALL_OF_THE_ENGINE = tuple(f"coupling_{i + 1}{i}" for i in range(1, 6))
# Table 4.12 and the fixed values of the listing.
J = np.array([1 / 33.39, *[1 / 22.3] * 4, 1 / 5.968, 1 / 5.646])
K = np.array([241.8e3, *[1270e3] * 3, 1427e3, 1992.0])
C = np.array([15.0, *[2.5] * 5])
GROUND = np.array([0, *[0.1541 / 4] * 4, 0, 0])


def by_mass_matrices(hz, groups):
    """(N, 1, 5) θ̇1 over the four cylinders' and the load's torque, with `groups[i]` the body that inertia i is in."""
    e = np.diff(np.eye(7), axis=0)
    together = np.zeros((7, max(groups) + 1))
    together[range(7), groups] = 1
    mass, damping, stiffness = (
        together.T @ part @ together
        for part in (np.diag(J), e.T @ np.diag(C) @ e + np.diag(GROUND), e.T @ np.diag(K) @ e)
    )
    torques = np.zeros((7, 5))
    torques[[1, 2, 3, 4, 6], range(5)] = 1, 1, 1, 1, -1
    w = 2 * np.pi * np.asarray(hz, dtype=float)[:, None, None]
    angles = np.linalg.solve(-(w**2) * mass + 1j * w * damping + stiffness, together.T @ torques + 0 * w)
    return (1j * w * angles)[:, [groups[0]]]


def relative(found, exact):
    return np.linalg.norm(found - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))


@pytest.fixture(scope="module")
def crank():
    return ce.crankshaft(reciprocating_speed="measured")


@pytest.fixture(scope="module")
def two(crank):
    return reduce(crank, dof=2)


# ---- receptances


def test_receptances_are_those_of_mass_damping_and_stiffness_matrices(crank):
    hz = np.geomspace(0.5, 2000, 60)
    found = receptance(crank, hz)
    assert found.torques == ("T_1", "T_2", "T_3", "T_4", "T_load")
    assert (found.outputs, found.units) == (("omega",), ("rad/s",))
    np.testing.assert_allclose(found.values, by_mass_matrices(hz, range(7)), rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("options", [{}, {"angle": "state"}])
def test_the_nonlinear_forms_have_the_same_receptances(crank, options):
    hz = np.geomspace(5, 500, 20)
    model = ce.crankshaft(**options)
    torques = ("cylinder_1", "cylinder_2", "cylinder_3", "cylinder_4", "T_load")
    found, usual = receptance(model, hz, torques=torques), receptance(crank, hz)
    np.testing.assert_allclose(found.values, usual.values, rtol=1e-9)
    assert sorted(receptance(model, hz).torques) == sorted(torques if options else usual.torques)


def test_static_receptance_of_a_free_pair_of_inertias_is_their_sum():
    found = receptance(ce.two_mass(), 0.01, {"C_eng": 0.0})
    total = 1 / 2.557 + 1 / 5.646
    assert found.values[0, 0, 0] == pytest.approx(1 / (2j * np.pi * 0.01 * total), rel=1e-4)


def test_a_resonance_without_dampers_is_finite():
    model = ce.two_mass()
    hz = model.natural_frequency(1, {"C_el": 0.0, "C_eng": 0.0})
    assert np.isfinite(receptance(model, hz, {"C_el": 0.0, "C_eng": 0.0}).values).all()


def test_receptances_refuse(crank):
    with pytest.raises(ModelError, match="the frequencies are not acceptable") as caught:
        receptance(crank, [0.0, 1.0])
    assert "allowed: one or more finite numbers > 0, in Hz; do: give numpy.geomspace" in str(caught.value)
    with pytest.raises(ModelError, match="there is no such torque; seen: 'T_5'") as caught:
        receptance(crank, 1.0, torques=["T_5"])
    assert "do: name drives, or ports that take a torque" in str(caught.value)
    b = Blueprint("cubic")
    x = b.state("x")
    b.ode("x", -(x**3))
    b.output("y", x)
    with pytest.raises(ModelError, match="the model cubic has no receptances") as caught:
        receptance(b.model(), 1.0)
    assert "do: move the nonlinear terms into laws of ports" in str(caught.value)


# ---- the lumped model


def test_seven_inertias_lumped_to_two_are_the_thesis_s_two(two):
    assert two.groups == (tuple(f"inertia_{i}" for i in range(1, 7)), ("inertia_7",))
    assert two.rigid == ALL_OF_THE_ENGINE
    assert two.sums == {"J1to6": "J1 + J2 + J3 + J4 + J5 + J6", "C1to6": "C2 + C3 + C4 + C5"}
    values = dict(zip(two.model.parameter_names, two.model.parameter_vector(), strict=True))
    assert 1 / values["J1to6"] == pytest.approx(2.6534, abs=5e-5)
    assert values["C1to6"] == pytest.approx(0.1541)
    assert (values["K76"], values["C76"], 1 / values["J7"]) == pytest.approx((1992, 2.5, 5.646))
    assert [state.name for state in two.model.states] == ["omega_1to6", "omega_7", "twist_76"]
    assert two.model.natural_frequency(1) == pytest.approx(20.46, abs=0.01)
    assert two.frequencies[0] == pytest.approx((20.45, 20.46), abs=0.01)
    assert two.frequencies[1][1] is None
    assert [v.name for v in two.model.inputs] == ["theta", "p1", "p2", "p3", "p4", "omega", "T_load"]


def test_the_lumped_crankshaft_is_the_two_mass_model(two):
    """The same matrices from the other builder, all symbolic in the parameters."""
    other = ce.two_mass(reciprocating_speed="measured")
    names = {"J_eng": "J1to6", "J_load": "J7", "K_el": "K76", "C_el": "C76", "C_eng": "C1to6"}
    values = {name: 1.7 + k for k, name in enumerate(names.values())}
    same = {own: values[name] for own, name in names.items()}
    for which in ("A", "B", "C"):
        one, two_mass = (
            ca.Function("m", [m.p], [getattr(m.linear, which)])(m.parameter_vector(v)).full()
            for m, v in ((two.model, values), (other, same))
        )
        np.testing.assert_allclose(one, two_mass, rtol=1e-14)


def off_the_other_builder(refined, **options):
    """Speed [rad/s] of the lumped crankshaft less that of two_mass at 300 times, sampled ``refined`` times finer."""
    time = np.arange(299 * refined + 1) * 1e-4 / refined
    inputs = {"theta": 125 * time, "T_load": np.full(len(time), 50.0)}
    inputs |= {f"p{k}": 1e5 + 2e6 * np.exp(np.cos(62.5 * time - k) - 1) for k in range(1, 5)}
    units = {name: "Pa" for name in inputs if name[0] == "p"} | {"theta": "rad", "T_load": "N m"}
    data = ce.Experiment.from_arrays("made", time=time, units=units, **inputs)
    lumped = reduce(ce.crankshaft(**options), dof=2).model
    start = {"omega_1to6": 125.0, "omega_7": 125.0, "twist_76": -0.02} | ({"theta_1": 0.0} if options else {})
    values = {"J_eng": lumped.parameter_vector()[0], "C_eng": 0.1541}
    run = ce.simulate(lumped, data, initial=start)
    if options:  # the model's own angle, as a channel for the other builder
        inputs["theta"] = run["theta"].values
        data = ce.Experiment.from_arrays("made", time=time, units=units, **inputs)
    usual = ce.simulate(
        ce.two_mass(), data, parameters=values, initial={"omega_eng": 125.0, "omega_load": 125.0, "twist": -0.02}
    )  # fmt: skip
    assert np.ptp(run["omega"].values) > 1
    return (run["omega"].values - usual["omega"].values)[::refined]


def test_a_lumped_nonlinear_form_simulates_as_the_other_builder():
    """Laws and drives of the cylinders see the group's speed and angle."""
    np.testing.assert_allclose(off_the_other_builder(1), 0, atol=1e-8)


def test_a_lumped_form_with_its_own_angle_simulates_as_the_other_builder():
    """Between samples two_mass holds the torque to first order; the model with its own angle works it out.

    That differs by the square of the step, 1.8e-4 rad/s here: a quarter of it at half the step. What is left when
    that error is extrapolated away is as small as for the angle of a channel.
    """
    options = {"angle": "state", "outputs": ("omega", "theta")}
    coarse, fine = off_the_other_builder(1, **options), off_the_other_builder(2, **options)
    assert np.abs(coarse).max() / np.abs(fine).max() == pytest.approx(4, rel=0.01)
    np.testing.assert_allclose((4 * fine - coarse) / 3, 0, atol=1e-8)


def test_what_cancels_in_a_lumped_law_is_gone():
    """The gas torque of the first group's cylinders is all in the drive: its angle is the channel's."""
    laws = reduce(ce.crankshaft(), dof=2).model.slot_laws
    assert "p1" not in {symbol.name() for symbol in ca.symvar(laws)}
    full = ce.crankshaft()
    assert "p1" in {symbol.name() for symbol in ca.symvar(full.slot_laws)}


def test_stiff_couplings_are_the_limit(crank):
    """A coupling a million times stiffer moves as a rigid one: an oracle for any grouping."""
    hz = np.geomspace(2, 800, 40)
    for rigid in (
        ("coupling_32",),
        ("coupling_21", "coupling_65"),
        ("coupling_43", "coupling_54", "coupling_76"),
    ):
        made = reduce(crank, rigid=rigid)
        values = {name.replace("coupling_", "K"): 1e12 for name in rigid}
        found = receptance(made.model, hz, torques=made.exact.torques)
        np.testing.assert_allclose(found.values, receptance(crank, hz, values).values, rtol=1e-4)
        assert made.dof == 7 - len(rigid)


def test_branches_and_loads_stay_in_place():
    driven = (Driven(behind=1, stiffness=3e4, description="pump"), Driven(behind=6, load="T_load"))
    model = ce.crankshaft(driven=driven, outputs=("omega", "omega_load"), reciprocating_speed="measured")
    made = reduce(model, rigid=ALL_OF_THE_ENGINE)
    assert made.groups[0] == tuple(f"inertia_{i}" for i in range(1, 7))
    assert made.sums["J1to6"].count("+") == 5
    hz = np.geomspace(2, 60, 20)
    stiff = receptance(model, hz, {f"K{i + 1}{i}": 1e12 for i in range(1, 6)})
    found = receptance(made.model, hz, torques=stiff.torques)
    np.testing.assert_allclose(found.values, stiff.values, rtol=1e-4)
    end = reduce(model, rigid=("coupling_71",))
    assert end.groups[0] == ("inertia_1", "inertia_7")
    assert end.sums == {"J1and7": "J1 + J7"}
    np.testing.assert_allclose(
        receptance(end.model, hz).values, receptance(model, hz, {"K71": 1e12}).values, rtol=1e-4
    )


def drag_chain():
    """Three inertias; drag on the first two, a hardening first coupling, and one parameter for two inertias."""
    b = Blueprint("drag")
    j, big, k, c = (
        b.parameter(name, value) for name, value in (("J", 0.1), ("B", 0.3), ("k", 900.0), ("c", 1.0))
    )
    quadratic, cubic = b.parameter("quadratic", 0.02), b.parameter("cubic", 5.0)
    bodies = [Inertia(f"disc_{i}", f"speed_{i}", inertia) for i, inertia in enumerate((j, j, big), start=1)]
    chain = declare_chain(
        b, bodies, [Coupling("first", "twist_1", k, c), Coupling("second", "twist_2", 2 * k + 5, c)]
    )
    torque = b.input("T", unit="N m")
    write_chain(b, chain, [torque, 0, 0])
    for i in (1, 2):
        b.law(f"disc_{i}", -quadratic * chain.speeds[i - 1] ** 2)
    b.law("first", cubic * chain.twists[0] ** 3)
    b.output("speed", chain.speeds[0])
    return b.model()


def test_laws_on_members_add_up_and_inner_ones_vanish():
    made = reduce(drag_chain(), rigid=("first",))
    assert made.sums == {"J1and2": "2*J"}
    assert made.groups == (("disc_1", "disc_2"), ("disc_3",))
    assert made.model.parameter_names == ("J1and2", "B", "k", "c", "quadratic")
    f = ca.Function("f", [made.model.x, made.model.u, made.model.p], [made.model.closed_ode])
    v, w, twist, torque = 3.0, 2.0, 0.1, 7.0
    expected = [
        ((2 * 900 + 5) * twist + (w - v) - 2 * 0.02 * v**2 + torque) / 0.2,
        (-(2 * 900 + 5) * twist - (w - v)) / 0.3,
        w - v,
    ]
    np.testing.assert_allclose(
        f([v, w, twist], torque, made.model.parameter_vector()).full().ravel(), expected, rtol=1e-12
    )


def test_variable_inertia_is_lumped_only_apart_from_the_cylinders():
    model = ce.crankshaft(reciprocating_inertia="variable")
    made = reduce(model, rigid=("coupling_76",))
    assert made.sums == {"J6and7": "J6 + J7"}
    assert made.model.has_slot_laws
    with pytest.raises(ModelError, match="a law needs what the lumping takes away") as caught:
        reduce(model, rigid=("coupling_32",))
    assert "variable_inertia_" in str(caught.value)
    assert 'do: build it with reciprocating_inertia="mean", or keep that inertia apart' in str(caught.value)


# ---- parameters


def test_parameters_of_the_sums_follow_the_original_ones(crank, two):
    given = ce.model.thesis_ties(crank.parameters())
    given["J2"].set(0.05)
    pars = two.parameters(given)
    values = pars.as_dict()
    assert values["J1to6"] == pytest.approx(1 / 33.39 + 4 * 0.05 + 1 / 5.968)
    assert pars["J1to6"].tie == "J1 + J2 + J3 + J4 + J5 + J6"
    free = [name for name in pars if pars[name].vary and not pars[name].tie]
    assert free == ["J1", "J2", "J6"]  # K21, K32, K65 are no longer felt
    two.model.parameter_vector(pars)
    assert "J1to6" not in given
    usual = two.parameters()
    assert usual.as_dict()["J1to6"] == pytest.approx(two.model.parameter_vector()[0])


def test_sums_have_the_bounds_and_values_of_their_terms(crank):
    made = reduce(crank, dof=2, parameters={"J2": 0.5, "C3": 0.4})
    pars = made.model.parameters()
    assert pars["J1to6"].value == pytest.approx(1 / 33.39 + 0.5 + 3 / 22.3 + 1 / 5.968)
    assert (pars["J1to6"].min, pars["J1to6"].max) == pytest.approx((6e-6, 6e3))
    assert pars["C1to6"].value == pytest.approx(0.4 + 3 * 0.1541 / 4)
    assert made.parameters().as_dict()["J1to6"] == pytest.approx(pars["J1to6"].value)
    assert pars["J1to6"].unit == "kg m2"
    assert not pars["r"].vary


# ---- how many are needed


def test_the_count_of_resonances(crank):
    modes = crank.modes()
    assert [modes.needed(hz) for hz in (10, 21, 300, 336, 600, 2000)] == [1, 2, 2, 3, 4, 7]
    assert modes.needed(300, margin=1.5) == 3
    assert ce.one_inertia().modes().needed(500) == 1


@pytest.mark.parametrize(
    ("options", "text"),
    [({"up_to_hz": 0}, "the option up_to_hz is not acceptable; seen: 0"),
     ({"up_to_hz": 9, "margin": math.inf}, "the option margin is not acceptable; seen: inf")],
)  # fmt: skip
def test_the_count_refuses(crank, options, text):
    with pytest.raises(ModelError) as caught:
        crank.modes().needed(**options)
    assert text in str(caught.value)
    assert "allowed: a finite number > 0; do: give needed(300, margin=1.5)" in str(caught.value)


def test_errors_are_those_of_the_mass_matrices(crank, two):
    hz = np.linspace(1.0, 98.0, 400)
    exact = by_mass_matrices(hz, range(7))
    error = relative(by_mass_matrices(hz, [0, 0, 0, 0, 0, 0, 1]), exact).max()
    found = reduce(crank, dof=2, up_to_hz=98.0)
    assert found.error == pytest.approx(error, rel=1e-3)
    assert (found.steps[-2].dof, found.steps[-2].error) == (2, pytest.approx(found.error, rel=1e-9))
    # within 10 % up to 98 Hz, a third of 335 Hz
    assert two.limit_hz == pytest.approx(98.3, abs=2.0)
    at_limit = [by_mass_matrices([two.limit_hz], groups) for groups in ([0, 0, 0, 0, 0, 0, 1], range(7))]
    assert 0.09 < relative(*at_limit)[0] < 0.1


def test_the_fewest_within_the_error_are_found(crank):
    found = reduce(crank, up_to_hz=120)
    assert (found.dof, found.error) == (4, pytest.approx(found.steps[3].error))
    assert found.error <= 0.1 < found.steps[4].error
    assert reduce(crank, up_to_hz=120, within=0.2).dof < 4
    assert reduce(crank, up_to_hz=90).dof == 2
    assert reduce(crank, up_to_hz=3).dof == 1
    assert reduce(crank, up_to_hz=3000).dof == 7


def test_the_greedy_order_is_near_the_best_of_all_groupings(crank):
    """All 2⁶ groupings by mass matrices: none with as few inertias is within the error much further."""
    hz = np.geomspace(1, 400, 500)
    exact = by_mass_matrices(hz, range(7))
    best = dict.fromkeys(range(1, 7), 0.0)
    for code in range(1, 64):
        soft = [(code >> i) & 1 for i in range(6)]
        wrong = np.flatnonzero(relative(by_mass_matrices(hz, np.cumsum([0, *soft])), exact) > 0.1)
        if sum(soft) < 6:
            best[1 + sum(soft)] = max(best[1 + sum(soft)], hz[wrong[0]])
    best[1] = hz[np.flatnonzero(relative(by_mass_matrices(hz, [0] * 7), exact) > 0.1)[0]]
    for step in reduce(crank, dof=2).steps[1:]:
        assert step.limit_hz > 0.85 * best[step.dof]


def test_it_prints_and_serialises(two):
    text = str(two)
    assert "crankshaft: 7 degrees of freedom lumped to 2" in text
    assert "J1to6 = J1 + J2 + J3 + J4 + J5 + J6" in text
    assert "any frequency" in text
    stored = json.loads(json.dumps(two.to_dict(), allow_nan=False))
    assert stored["parameters"]["J1to6"]["sum"] == two.sums["J1to6"]
    assert stored["parameters"]["K76"] == {"value": 1992.0, "sum": None}
    assert stored["steps"][0]["limit_hz"] is None
    assert stored["steps"][-1]["groups"] == ["1to7"]


def test_small_models():
    assert reduce(ce.two_mass(), dof=1).sums == {"J_engine_load": "J_eng + J_load"}
    same = reduce(ce.one_inertia(), dof=1)
    assert (same.error, same.limit_hz, same.sums) == (0.0, math.inf, {})


@pytest.mark.parametrize(
    ("options", "texts"),
    [
        ({}, ("it is not clear how far to reduce the model", "up_to_hz=None, dof=None, rigid=None", "up_to_hz alone")),
        ({"dof": 2, "rigid": ()}, ("it is not clear how far", "do: give up_to_hz=100")),
        ({"dof": 8}, ("the number of degrees of freedom is not acceptable", "from 1 to 7", "give dof=2")),
        ({"dof": 2.5}, ("the number of degrees of freedom is not acceptable", "seen: 2.5")),
        ({"up_to_hz": -1.0}, ("the option up_to_hz is not acceptable", "a frequency > 0, in Hz", "up_to_hz=100")),
        ({"dof": 2, "within": 1.0}, ("the option within is not acceptable", "between 0 and 1", "within=0.1 for 10 %")),
        ({"rigid": "coupling_21"}, ("are not a sequence of names", "nearest: coupling_21", 'rigid=("coupling_21",)')),
        ({"rigid": 5}, ("the rigid couplings are not a sequence of names", "seen: 5")),
        ({"rigid": ["coupling_12"]}, ("there is no such coupling", "(nearest: coupling_32", "print(model.ports)")),
    ],
)  # fmt: skip
def test_options_that_do_not_fit(crank, options, texts):
    with pytest.raises(ModelError) as caught:
        reduce(crank, **options)
    for text in texts:
        assert text in str(caught.value)


def loop():
    b = Blueprint("loop")
    v = [b.state(f"v{i}") for i in (1, 2)]
    twists = [b.state(f"twist{i}") for i in (1, 2)]
    bodies, springs = [], []
    for i in (0, 1):
        bodies.append(b.port(f"body_{i}", "inertia", {"speed": v[i]}))
        springs.append(b.port(f"spring_{i}", "coupling", {"twist": twists[i], "twist_rate": v[1] - v[0]}))
    for i in (0, 1):
        b.ode(f"v{i + 1}", (sum(twists) + sum(springs)) * (1 - 2 * i) + bodies[i])
        b.ode(f"twist{i + 1}", v[1] - v[0])
    b.output("y", v[0])
    return b.model()


def odd(case):
    """Chains that are none: a quantity that is no sum, a spring outside the couplings, a twist against the order."""
    b = Blueprint("odd")
    radius = b.parameter("radius", 2.0)
    v = [b.state(f"v{i}") for i in (1, 2)]
    twist = b.state("twist")
    slots = [b.port(f"body_{i}", "inertia", {"speed": speed}) for i, speed in enumerate(v)]
    spring = b.port("spring", "coupling", {"twist": twist, "twist_rate": v[1] - v[0]})
    inertia = radius**2 if case == "square" else radius
    torque = (-3 if case == "backwards" else 3) * twist + spring
    b.ode("v1", (slots[0] + torque) / inertia)
    b.ode("v2", (slots[1] - torque - (twist if case == "more" else 0)) / 2)
    b.ode("twist", v[0] - v[1] if case == "backwards" else v[1] - v[0])
    b.output("y", v[0])
    return b.model()


@pytest.mark.parametrize(
    ("make", "seen"),
    [
        (loop, "2 inertias, 2 couplings with a state twist"),
        (lambda: odd("square"), "an inertia, stiffness or damper that is no sum of parameters"),
        (lambda: odd("more"), "dampers or springs that belong to no coupling port"),
        (lambda: odd("backwards"), "d(twist)/dt is no difference of a later and an earlier speed"),
    ],
)
def test_models_that_are_no_chains(make, seen):
    with pytest.raises(ModelError, match="cannot be read as inertias joined by couplings") as caught:
        reduce(make(), dof=1)
    assert f"seen: {seen}" in str(caught.value)
    assert "do: build it by crankshaft(...), two_mass(...) or declare_chain(...)" in str(caught.value)


def test_a_general_model_is_no_chain():
    b = Blueprint("cubic")
    x = b.state("x")
    b.ode("x", -(x**3))
    b.output("y", x)
    with pytest.raises(ModelError, match="cannot be read as inertias") as caught:
        reduce(b.model(), dof=1)
    assert "seen: a model without linear core" in str(caught.value)
