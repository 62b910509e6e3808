"""The effect protocol: amplitudes, grids, laws, and the errors of effects that break it."""

import math

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.effects.functions import Sharp, Smooth
from casadi_engine.effects.protocol import Amplitude, Effect, Grid, Law, check_effect
from casadi_engine.errors import EffectError
from casadi_engine.model import Blueprint, two_mass
from casadi_engine.model.declarations import Port
from casadi_engine.model.port_view import PortView


class FanTorque(Effect):
    name, attaches, kin = "fan_torque", ("inertia",), ("quadratic_drag", "coulomb_friction")
    sentence = "a fan on {port} that engages above a speed"
    amplitude = Amplitude("coefficient", unit="N m s2/rad2", min=0)
    nuisance = {"engage": Grid(80, 180, steps=11, unit="rad/s")}  # noqa: RUF012

    def law(self, port, p, math):
        on = math.step(port.speed - p.engage, width=2.0)
        return -p.coefficient * on * port.speed**2


def law_values(model, name, **given):
    """Torque in the slot of port `name`, states and parameters by name."""
    row = [port.name for port in model.ports.with_slot].index(name)
    function = ca.Function("w", [model.x, model.p], [model.slot_laws[row]])
    x = [given.get(state.name, 0.0) for state in model.states]
    return float(
        function(
            x, [given.get(n, v) for n, v in zip(model.parameter_names, model.parameter_vector(), strict=True)]
        )
    )


@pytest.mark.parametrize("sharp", [False, True])
def test_a_fan_in_ten_lines(sharp):
    model = two_mass().with_effect(FanTorque(), at="load", values={"engage": 120.0}, sharp=sharp)
    assert model.parameter_names[-2:] == ("load.fan_torque.coefficient", "load.fan_torque.engage")
    declared = model.parameters()
    assert declared["load.fan_torque.coefficient"].value == 0.0
    assert declared["load.fan_torque.coefficient"].min == 0.0
    assert declared["load.fan_torque.coefficient"].unit == "N m s2/rad2"
    engage = declared["load.fan_torque.engage"]
    assert (engage.value, engage.min, engage.max) == (120.0, 80.0, 180.0)
    size = {"load.fan_torque.coefficient": 1e-3}
    for speed in (100.0, 119.0, 121.0, 150.0):
        on = float(speed > 120) if sharp else 0.5 * (1 + math.tanh((speed - 120) / 2))
        found = law_values(model, "load", omega_load=speed, **size)
        assert found == pytest.approx(-1e-3 * on * speed**2, rel=1e-12)
    assert "w_load = " in model.equations()
    assert "load.fan_torque.coefficient" in model.equations()
    assert r"\mathrm{load}" in model.latex()
    assert model.description.endswith("; with fan_torque at load")
    assert FanTorque().describe("load") == "a fan on load that engages above a speed"


def test_smooth_functions_are_the_sharp_ones_away_from_their_corners():
    x = ca.SX.sym("x")
    pairs = {
        "sign": (lambda m: m.sign(x, 1e-3), np.sign),
        "step": (lambda m: m.step(x, 1e-3), lambda v: (v > 0).astype(float)),
        "abs": (lambda m: m.abs(x, 1e-3), np.abs),
        "positive": (lambda m: m.positive(x, 1e-3), lambda v: np.maximum(v, 0)),
        "dead_zone": (
            lambda m: m.dead_zone(x, 0.4, 1e-3),
            lambda v: np.sign(v) * np.maximum(np.abs(v) - 0.4, 0),
        ),
    }
    values = np.linspace(-1.05, 1.05, 22)
    for make, truth in pairs.values():
        for maths, tolerance in ((Smooth, 2e-5), (Sharp, 1e-15)):
            function = ca.Function("f", [x], [make(maths)])
            np.testing.assert_allclose(np.array(function(values)).ravel(), truth(values), atol=tolerance)


def test_smooth_dead_zone_vanishes_at_no_play_and_has_a_sign_as_slope():
    x, half = ca.SX.sym("x"), ca.SX.sym("half")
    change = Smooth.dead_zone(x, half, 0.01) - x
    function = ca.Function("f", [x, half], [change, ca.jacobian(change, half)])
    for value in (-3.0, -0.5, 0.2, 2.0):
        none, slope = function(value, 0.0)
        assert float(none) == 0.0
        assert float(slope) == pytest.approx(-np.sign(value), abs=2e-3)


def test_amplitudes_say_whether_they_are_one_sided():
    assert Amplitude("a", min=0).one_sided == 1
    assert Amplitude("a", max=0).one_sided == -1
    assert Amplitude("a").one_sided == 0


@pytest.mark.parametrize(("low", "high"), [(1.0, 2.0), (-2.0, -1.0), (0.0, 0.0)])
def test_an_amplitude_that_cannot_be_zero_is_refused(low, high):
    with pytest.raises(EffectError, match="do not hold its null"):
        Amplitude("a", min=low, max=high)


def test_grids():
    assert Grid(1, 3, steps=3).values() == (1.0, 2.0, 3.0)
    assert Grid(1, 100, steps=3, log=True).values() == pytest.approx((1, 10, 100))
    assert Grid(0.25, 2.5, steps=1, log=True, of="speed").values(magnitude=100.0)[0] == pytest.approx(
        79.0569415
    )
    assert Grid(0.1, 0.9, steps=2, over="time").values(time=(1.0, 3.0)) == pytest.approx((1.2, 2.8))
    assert Grid(over="cycle", whole=True).values(cycles=(2, 3, 4)) == (2.0, 3.0, 4.0)
    assert Grid(1, 4, steps=7, whole=True).values() == (1.0, 2.0, 3.0, 4.0)


@pytest.mark.parametrize(
    "arguments",
    [
        {"start": 2, "stop": 1},
        {"start": 0, "stop": 1, "log": True},
        {"start": 0, "stop": math.inf},
        {"steps": 0},
        {"steps": 2.5},
    ],
)
def test_bad_grids_are_refused(arguments):
    with pytest.raises(EffectError, match="the grid of a nuisance parameter is not acceptable"):
        Grid(**arguments)


def test_a_grid_over_something_unknown_is_refused():
    with pytest.raises(EffectError, match=r"runs over something unknown.*time"):
        Grid(over="times")


def variant(**changes):
    return type("Variant", (FanTorque,), changes)()


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (FanTorque, "an effect is needed, not its class.*FanTorque"),
        ("drag", r"an effect is needed, not its name; seen: 'drag'.*write ce.effects.library\('drag'\)\[0\]"),
        (object(), "lacks an attribute.*no name"),
        (variant(name="fan torque"), "the name of the effect Variant is not acceptable.*'fan torque'"),
        (variant(attaches="inertia"), "kinds of ports that do not exist.*a tuple"),
        (variant(attaches=("shaft",)), "kinds of ports that do not exist"),
        (variant(attaches=()), "kinds of ports that do not exist"),
        (variant(amplitude=3.0), "has no amplitude"),
        (variant(nuisance={"engage": 3.0}), "nuisance parameter engage .* is not acceptable"),
        (variant(nuisance={"coefficient": Grid()}), "another name than the amplitude's"),
        (variant(nuisance={"engage speed": Grid()}), "a nuisance parameter of the effect fan_torque is not"),
    ],
)
def test_effects_that_break_the_protocol_are_refused(effect, message):
    with pytest.raises(EffectError, match=message):
        check_effect(effect)


def with_law(law):
    return variant(law=law, nuisance={})


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (
            lambda _s, port, p, _m: p.coefficient * port.speeed,
            r"cannot act at the port load, which has no signal speeed.*nearest: speed",
        ),
        (lambda _s, port, p, _m: p.coeficient * port.speed, r"has no such parameter.*nearest: coefficient"),
        (lambda _s, port, p, _m: port.speed * (1 + p.coefficient), "does not vanish at amplitude 0"),
        (lambda _s, port, p, _m: ca.SX.sym("z") * p.coefficient, r"z \(not of this model\)"),
        (lambda _s, port, p, _m: ca.vertcat(p.coefficient, 0), "is not a scalar expression.*SX"),
        (lambda _s, port, p, _m: None, "is not a scalar expression.*NoneType"),
        (lambda _s, port, p, _m: p.coefficient * port.state("z"), "used: z; given: none"),
    ],
)
def test_laws_that_do_not_fit_are_refused(law, message):
    with pytest.raises(EffectError, match=message):
        two_mass().with_effect(with_law(law), at="load")


def test_a_law_that_fails_is_an_effect_error_that_tells_why():
    class Fails(FanTorque):
        def law(self, port, p, math):
            return p.coefficient * math.sgn(port.speed)

    with pytest.raises(
        EffectError, match=r"the law of fan_torque at load fails; seen: AttributeError: .*sgn"
    ):
        two_mass().with_effect(Fails(), at="load")


def test_the_base_class_has_no_law():
    with pytest.raises(NotImplementedError):
        Effect().law(None, None, None)


def test_typical_magnitudes_come_from_the_scales_of_states_and_channels():
    model = two_mass()
    view = PortView(model, model.ports["coupling"])
    assert view.typical("twist") == pytest.approx(0.1)
    assert view.typical("twist_rate") == pytest.approx(math.hypot(100, 100))
    assert PortView(model, model.ports["input_p1"]).typical("value") == pytest.approx(1e6)
    assert PortView(model, model.ports["cylinder_1"]).typical("gas_torque") == 1.0
    assert view.number("stiffness", {"K_el": 7.0}) == 7.0
    b = Blueprint("slow")
    v = b.state("v", unit="m/s", scale=0.25)
    b.ode("v", b.port("axis", "inertia", {"speed": 2 * v}))
    b.output("v", v)
    slow = b.model()
    assert PortView(slow, slow.ports["axis"]).typical("speed") == pytest.approx(0.5)


class Hysteresis(Effect):
    """Bouc-Wen: a torque a z with dz/dt = r − β |r| z − γ r |z|, r the twist rate."""

    name, attaches = "hysteresis", ("coupling",)
    amplitude = Amplitude("torque", unit="N m")
    nuisance = {"sharpness": Grid(10, 1000, steps=3, log=True)}  # noqa: RUF012

    def law(self, port, p, math):
        z, rate = port.state("z"), port.twist_rate
        curve = 200 * rate - p.sharpness * (math.abs(rate, width=0.01) * z + rate * math.abs(z, width=1e-3))
        return Law(p.torque * z, states={"z": (0.0, curve)})


def test_an_effect_may_have_states_of_its_own_and_the_core_stays_linear():
    base = two_mass(reciprocating_speed="measured")
    model = base.with_effect(Hysteresis(), at="coupling")
    assert [state.name for state in model.states][-1] == "coupling_hysteresis_z"
    assert model.linear is not None
    core = ca.Function("A", [model.p], [model.linear.A])
    there = core(model.parameter_vector()).full()
    before = ca.Function("A", [base.p], [base.linear.A])(base.parameter_vector()).full()
    np.testing.assert_array_equal(there[:3, :3], before)
    np.testing.assert_array_equal(there[3], 0.0)
    ode = ca.Function("f", [model.x, model.u, model.t, model.p], [model.closed_ode])
    values = {"coupling.hysteresis.torque": 3.0, "coupling.hysteresis.sharpness": 50.0}
    p = model.parameter_vector(values)
    x, u = np.array([100.0, 103.0, 0.01, 0.4]), np.zeros(len(model.inputs))
    found = ode(x, u, 0.0, p).full().ravel()
    expected = 200 * 3.0 - 50.0 * (math.hypot(3.0, 0.01) * 0.4 + 3.0 * math.hypot(0.4, 1e-3))
    assert found[3] == pytest.approx(expected)
    at_null = ode(x, u, 0.0, model.parameter_vector({"coupling.hysteresis.sharpness": 50.0})).full().ravel()
    torque = (found - at_null)[:2] * [1 / 2.557, 1 / 5.646]
    np.testing.assert_allclose(torque, [3.0 * 0.4, -3.0 * 0.4], rtol=1e-9)


def test_two_effects_of_a_port_have_states_of_their_own_names():
    class Other(Hysteresis):
        name = "other"

    model = two_mass(reciprocating_speed="measured")
    for effect in (Hysteresis(), Other()):
        model = model.with_effect(effect, at="coupling")
    names = [variable.name for variable in model.states]
    assert names[-2:] == ["coupling_hysteresis_z", "coupling_other_z"]
    assert [model.x[row].name() for row in range(len(names))] == names
    text = model.equations()
    assert "coupling.hysteresis.torque*coupling_hysteresis_z" in text
    assert "coupling.other.torque*coupling_other_z" in text


@pytest.mark.parametrize("states", [3, {"q": 3}, {"q": ("a", 0)}, {"q": (float("nan"), 0)}, {"q": (True, 0)}])
def test_states_of_a_law_that_cannot_be_are_refused(states):
    class Strange(ce.effects.CoulombFriction):
        def law(self, port, p, math):
            return ce.effects.Law(p.torque * port.state("q"), states)

    with pytest.raises(EffectError, match="the states of the law of coulomb_friction are not acceptable"):
        ce.two_mass().with_effect(Strange(), at="coupling")


def test_values_that_are_no_mapping_are_refused():
    with pytest.raises(
        EffectError, match="the values of the effect coulomb_friction are not a mapping; seen: 3"
    ):
        ce.two_mass().with_effect(ce.effects.CoulombFriction(), at="coupling", values=3)


class Plain(ce.Effect):
    """An effect that words itself for every kind of port."""

    name, attaches = "plain", ("inertia",)
    sentence, neutral = "a {effort} at {port} by {motion}", "a {effort} in {port} by {motion}"
    amplitude = ce.effects.Amplitude("size")

    def law(self, port, p, math):
        return p.size * port.speed


class Own(Plain):
    def describe(self, port):
        return f"mine at {port}"


@pytest.mark.parametrize(
    ("unit", "speed", "words"),
    [
        ("N m", "rad/s", "a torque at here by speed"), ("N", "m/s", "a force at here by speed"),
        ("rad/s2", "rad/s", "an angular acceleration at here by speed"), ("W", "K", "a power in here by T - T_a"),
        ("-", "K", "a term in here by T - T_a"), ("mg/(L h)", "mg/L", "a rate in here by T - T_a"),
    ],
)  # fmt: skip
def test_an_effect_words_itself_by_what_acts_at_its_port(unit, speed, words):
    read = ca.SX.sym("T") - ca.SX.sym("T_a")
    port = Port("here", "inertia", signals={"speed": read}, unit=unit, units={"speed": speed})
    assert Plain().worded(port) == words
    assert Own().worded(port) == "mine at here"


def test_a_long_signal_goes_by_its_name():
    x = ca.SX.sym("x")
    port = Port("here", "inertia", signals={"speed": ca.sqrt(ca.fabs(x) + 1) * x * x}, unit="W")
    assert Plain().worded(port) == "a power in here by speed"


def test_no_sentence_of_the_library_speaks_of_torques_in_a_room():
    room = Port("room", "inertia", signals={"speed": ca.SX.sym("T")}, unit="W", units={"speed": "K"})
    ends = Port("a_and_b", "pipe", unit="W", ends=("a", "b"))
    for effect in ce.effects.library():
        port = room if "inertia" in effect.attaches else ends if "pipe" in effect.attaches else None
        if port is not None:
            words = effect.worded(port)
            assert not any(w in words for w in ("torque", "friction", "speed", "load ", "{")), words


@pytest.mark.parametrize("width", [-1.0, math.nan, math.inf])
def test_a_width_that_would_turn_a_law_round_is_refused(width):
    """Dry friction with a width below 0 drove, without a word."""
    for effect in (ce.effects.CoulombFriction(width=width), ce.effects.OrificeLeak(width=width)):
        with pytest.raises(
            EffectError, match=r"corners of the effect \w+ are rounded is not acceptable; seen: (-1|nan|inf)"
        ):
            check_effect(effect)
    check_effect(ce.effects.LoadStep(width=0.0))  # at once
