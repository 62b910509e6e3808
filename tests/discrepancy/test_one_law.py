"""Effects that are told together alone."""

from dataclasses import replace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.one_law import told_as_one_law
from casadi_engine.discrepancy.repaired import FoundEffect, Repair
from casadi_engine.estimation import Estimate


def found(*effects):
    made = []
    for name, at, stderr, interval in effects:
        size = Estimate(1.0, stderr, "N", interval=interval)
        made.append(FoundEffect(name, at, "", {}, {"size": size}, {}, 9.0, 1e-9, 50.0, 1.0, {}, {}, None, ()))
    return Repair("answered", "named", True, None, None, 0.01, effects=tuple(made), messages=("said before",))


def test_two_effects_at_a_port_without_sizes_of_their_own_are_one_curve():
    made = told_as_one_law(found(("drag", "tank", None, None), ("fading", "tank", None, None)))
    assert made.messages == (
        "drag and fading at tank are identified as one curve alone, none of their parameters by itself: a law that the "
        "library lacks may be the true one there",
        "said before",
    )
    assert made.unknown.odds == 1.0
    assert made.verdict == "class"


def test_a_law_of_which_no_number_is_known_is_a_curve_too():
    """An outflow by Torricelli was "stribeck_friction at tank", 100 %, both numbers not known."""
    made = found(("fading", "tank", None, None))
    (one,) = made.effects
    assert told_as_one_law(made) is made  # one number, and no shape
    shaped = replace(one, parameters={**one.parameters, "shape": Estimate(0.2, None, "m")})
    told = told_as_one_law(replace(made, effects=(shaped,)))
    assert told.messages[0].startswith(
        "fading at tank is identified as one curve alone, none of its parameters by itself"
    )
    assert told.unknown.port == "tank"
    known = replace(one, parameters={**one.parameters, "shape": Estimate(0.2, 0.01, "m")})
    made = replace(made, effects=(known,))
    assert told_as_one_law(made) is made


@pytest.mark.parametrize(("quadratic", "told"), [(0.2, True), (0.6, False), (None, False)])
def test_a_size_whose_error_is_not_symmetric_is_known_all_the_same(quadratic, told):
    """A lag of 185 s, by a profile 143 to 254 s, was "none of its parameters by itself"; what is held is none."""
    made = found(("lag", "input", None, None))
    (one,) = made.effects
    numbers = {
        "share": Estimate(1.0, None, "1", fixed=True),
        "time": Estimate(1.0, None, "s", quadratic=quadratic),
    }
    made = replace(made, effects=(replace(one, parameters=numbers),))
    assert (told_as_one_law(made) is made) == told


@pytest.mark.parametrize(
    "other",
    [
        ("fading", "tank", 0.1, None),
        ("fading", "tank", None, (0.5, 3.0)),
        ("fading", "pipe", None, None),
    ],
    ids=["an error", "an interval", "another port"],
)
def test_what_has_a_size_of_its_own_or_another_place_is_no_such_curve(other):
    made = found(("drag", "tank", None, None), other)
    assert told_as_one_law(made) is made


@pytest.mark.parametrize(("turned", "curve"), [(False, True), (True, False)])
def test_two_laws_of_a_signal_that_keeps_its_sign_add_up_to_one_curve(turned, curve):
    """A leak by the root of a level is a constant and a proportional one; of a level about zero the constant jumps."""
    b = ce.Blueprint("tank")
    area, level = b.parameter("A", 2.0, unit="m2"), b.state("h", unit="m")
    leak = b.port("tank", "inertia", {"speed": level})
    b.ode("h", (b.input("Q", unit="m3/s") + leak) / area)
    b.output("h_seen", level, unit="m")
    model = b.model()
    for one in ce.effects.library("viscous_friction", "coulomb_friction"):
        model = model.with_effect(one, at="tank")
    time = np.arange(0.0, 20.0, 0.2)
    seen = (0.0 if turned else 3.0) + np.sin(time)
    inflow = 2 * np.cos(time) + 0.1 * seen + 0.05
    data = ce.Experiment.from_arrays(
        "r", time=time, units={"Q": "m3/s", "h_seen": "m"}, Q=inflow, h_seen=seen
    )
    fit = ce.estimate(model, data, noise=ce.Noise(h_seen=0.05), progress=False)
    made = found(("viscous_friction", "tank", 0.01, None), ("coulomb_friction", "tank", 0.01, None))
    told = told_as_one_law(replace(made, fit=fit))
    assert (told.verdict == "class") == curve
    assert ("add up to a curve over speed, which keeps its sign in the records" in told.messages[0]) == curve
    alone = replace(made, fit=fit, effects=made.effects[:1])
    assert told_as_one_law(alone) is alone


@pytest.mark.parametrize("turned", [False, True])
def test_a_law_beside_a_term_of_the_model_over_one_signal_that_keeps_its_sign_is_told_so(turned):
    """A power of 1.35 beside a linear loss comes out as a square beside a larger one, 94 standard errors off."""
    b = ce.Blueprint("head")
    heat, loss = b.parameter("C", 5.0, unit="J/K", min=0.1), b.parameter("G", 0.4, unit="W/K", min=0)
    temperature, ambient = b.state("T", unit="K", scale=50), b.input("T_amb", unit="K")
    slot = b.port("body", "inertia", {"speed": temperature - ambient})
    b.ode("T", (b.input("P", unit="W") - loss * (temperature - ambient) + slot) / heat)
    b.output("T_seen", temperature, unit="K")
    model = b.model().with_effect(ce.effects.library("quadratic_drag")[0], at="body")
    time = np.arange(0.0, 20.0, 0.2)
    seen = 300 + (0.0 if turned else 40.0) + 10 * np.sin(time)
    data = ce.Experiment.from_arrays(
        "r", time=time, units={"P": "W", "T_amb": "K", "T_seen": "K"}, P=0.4 * (seen - 300) + 50 * np.cos(time),
        T_amb=np.full(100, 300.0), T_seen=seen,
    )  # fmt: skip
    fit = ce.estimate(model, data, noise=ce.Noise(T_seen=0.5), progress=False)
    made = found(("quadratic_drag", "body", 0.01, None))
    (one,) = made.effects
    one = replace(one, parameters={"body.quadratic_drag.coefficient": one.amplitude})
    told = told_as_one_law(replace(made, fit=fit, effects=(one,)))
    assert told.verdict == "named"
    words = "quadratic_drag at body and what G does there add up to a curve over speed, which keeps its sign"
    assert any(text.startswith(words) for text in told.messages) == (not turned)


@pytest.mark.parametrize(("turned", "curve"), [(False, True), (True, False)])
def test_laws_at_two_ports_that_add_one_curve_to_an_equation_are_told_so(turned, curve):
    """A head by n^2.3 is an offset of the speed, which acts by its square, and a constant head."""
    b = ce.Blueprint("pump")
    head, loss = b.parameter("a", 4.0, min=0), b.parameter("b", 3.0, min=0)
    flow, speed = b.state("Q"), b.input("n")
    at = b.port("pipe", "inertia", {"speed": flow}, unit="1/s")
    b.ode("Q", head * speed**2 - loss * flow + at)
    b.output("Q_seen", flow)
    model = b.model()
    for one, port in zip(
        ce.effects.library("input_offset", "constant_torque"), ("input_n", "pipe"), strict=True
    ):
        model = model.with_effect(one, at=port)
    time = np.arange(0.0, 20.0, 0.2)
    speed = (0.0 if turned else 2.0) + np.sin(time)
    data = ce.Experiment.from_arrays(
        "r",
        time=time,
        units={"n": "1", "Q_seen": "1"},
        n=speed,
        Q_seen=1.3 * speed**2 + 0.1 * np.cos(3 * time),
    )
    fit = ce.estimate(model, data, noise=ce.Noise(Q_seen=0.1), progress=False)
    made = found(("input_offset", "input_n", 0.01, None), ("constant_torque", "pipe", 0.01, None))
    names = ("input_n.input_offset.offset", "pipe.constant_torque.torque")
    own = [
        replace(one, parameters={name: one.parameters["size"]})
        for one, name in zip(made.effects, names, strict=True)
    ]
    told = told_as_one_law(replace(made, fit=fit, effects=tuple(own)))
    said = (
        "input_offset at input_n and constant_torque at pipe add up to a curve over n, which keeps its sign"
    )
    assert told.messages[0].startswith(said) == curve
    assert told.verdict == ("class" if curve else "named")


@pytest.mark.parametrize(
    ("bound", "unit", "law"), [("max", "s", True), (False, "s", False), ("max", "1", False)]
)
def test_a_shape_at_its_bound_is_none_that_was_seen(bound, unit, law):
    """Evaporation was "a storage behind the bath" with a time as long as the record; a share of 1 is all of it."""
    made = found(("hidden_storage", "bath", 0.04, None))
    (one,) = made.effects
    numbers = {
        **one.parameters,
        "bath.hidden_storage.time": Estimate(7200.0, None, unit, at_bound=bound, quadratic=9.0),
    }
    made = replace(made, effects=(replace(one, parameters=numbers),))
    told = told_as_one_law(made)
    assert told.verdict == ("class" if law else "named")
    assert (told.unknown is not None) == law
    words = (
        "time of hidden_storage at bath is at its bound, so that the data do not determine its shape: a law"
    )
    assert any(text.startswith(words) for text in told.messages) == law
