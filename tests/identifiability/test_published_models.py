"""Published models of other fields, and the traps of the field, against the verdicts in the literature."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import published_jakstat
import published_models
import pytest
from published_models import SHAPES_OF_AN_INPUT, written

import casadi_engine as ce
from casadi_engine.errors import IdentifiabilityError
from casadi_engine.identifiability import identifiability


@pytest.mark.parametrize("one", published_models.ALL, ids=lambda one: one.name)
def test_published_verdict(one):
    found = identifiability(one.model(), combinations=list(one.combinations), **one.asked)
    assert {name for name in found.free if found.identifiable[name]} == set(one.told.split())
    assert set(found.lost) == set(one.lost.split())
    if one.lost_states is not None:
        assert {name.removesuffix("(0)") for name in found.lost_states} == set(one.lost_states.split())
    if one.rank is not None:
        assert (found.rank, found.size) == (one.rank, one.size)
    assert dict(found.combinations) == one.combinations
    assert found.seeds == 2
    assert found.error_probability < 1e-9


def test_there_are_enough_of_them_and_each_has_a_source():
    assert len(published_models.ALL) >= 10
    assert all(any(letter.isdigit() for letter in one.source) for one in published_models.ALL)


def test_jakstat_with_25_states_and_27_parameters():
    model = published_jakstat.jakstat2()
    found = identifiability(model)
    assert (found.rank, found.size) == (49, 52)
    assert set(found.lost) == {"EpoRCISInh", "init_EpoRJAK2"}
    assert [one.kind for one in found.symmetries] == ["scaling", "scaling", "shift"]
    # The third direction by the model's own Jacobians: a shift from p12 to p1 decays by itself and is never seen.
    names = [variable.name for variable in model.states]
    shift = np.zeros(len(names))
    shift[names.index("p1")], shift[names.index("p12")] = 1, -1
    both = ca.vertcat(model.ode, model.output_expressions)
    inputs = [model.x, model.p, model.d, model.u]
    jacobian = ca.Function("jacobian", inputs, [ca.jacobian(both, model.x)])
    draw = np.random.default_rng(4)
    seen = np.array(jacobian(*(draw.uniform(0.5, 2, one.numel()) for one in inputs))) @ shift
    assert np.abs(seen - seen[names.index("p1")] * np.append(shift, np.zeros(14)))[: len(names)].max() < 1e-12
    assert np.abs(seen[len(names) :]).max() < 1e-12


def test_an_input_has_to_change():
    """Villaverde et al. 2019: the same two compartments are not identifiable from a constant input."""
    model = SHAPES_OF_AN_INPUT.model()
    assert identifiability(model, inputs="generic").passed
    constant = identifiability(model, inputs="constant")
    assert set(constant.lost) == {"k1e", "k12", "k21", "b"}
    assert constant.size - constant.rank == 1
    # nor does a second constant step help without its start, and from a known empty start one is enough
    assert identifiability(model, inputs="constant", start="rest").passed


def test_experiments_together_tell_what_each_alone_does_not():
    """Ovchinnikov, Pillay, Pogudin & Scanlon 2020, example 7.7: a constant condition x0, different in each run."""
    model = written(
        "conditions",
        {"x0": "0*x0", "x1": "x0*x1 + mu1*x0 + mu2"},
        {"y": "x1"},
        parameters="mu1 mu2",
    )
    assert identifiability(model).lost == ("mu1", "mu2")
    assert identifiability(model, combinations=["mu1", "mu2"], experiments=[{}, {}]).passed


def four_tanks(*, area=False):
    """Johansson, IEEE Trans. Control Syst. Technol. 8 (2000): a3, a4 feed from above; the lower levels measured."""
    odes = {
        "h1": "(-a1*sqrt(2*g*h1) + a3*sqrt(2*g*h3) + g1*k1*v1)/A1",
        "h2": "(-a2*sqrt(2*g*h2) + a4*sqrt(2*g*h4) + g2*k2*v2)/A2",
        "h3": "(-a3*sqrt(2*g*h3) + (1 - g2)*k2*v2)/A3",
        "h4": "(-a4*sqrt(2*g*h4) + (1 - g1)*k1*v1)/A4",
    }
    names = "A1 A2 A3 A4 a1 a2 a3 a4 g1 g2 k1 k2"
    model = written("tanks", odes, {"y1": "h1", "y2": "h2"}, parameters=f"{names} g", inputs="v1 v2")
    parameters = model.parameters()
    parameters.fix("g")
    for name in ("A1", "A2", *(("A3", "A4") if area else ())):
        parameters.fix(name)
    return model, parameters


def test_four_tanks_with_square_roots():
    """By hand: h3 → m²·h3, A3 → A3/m², a3 → a3/m keeps all flows, so the upper tanks' areas have to be known."""
    model, parameters = four_tanks()
    found = identifiability(model, parameters=parameters, combinations=["a3/sqrt(A3)", "a4**2/A4", "a3/a4"])
    assert set(found.lost) == {"A3", "A4", "a3", "a4"}
    assert set(found.lost_states) == {"h3(0)", "h4(0)"}
    assert list(found.combinations.values()) == [True, True, False]
    exponents = [dict(one.exponents) for one in found.symmetries]
    assert {one["h3(0)"] / one["a3"] for one in exponents if "a3" in one} == {Fraction(-2)}
    assert {"fix A3 at a value from elsewhere", "fix A4 at a value from elsewhere"} <= {
        change.sentence for remedy in found.remedies(most=20) for change in remedy.changes
    }
    model, parameters = four_tanks(area=True)
    assert identifiability(model, parameters=parameters).passed


def test_the_square_roots_as_states_of_their_own_say_the_same():
    """s = sqrt(h) makes the tanks rational, 2·A·s·s' = inflow - a·sqrt(2g)·s: another way through the code."""
    root = "1.5*"
    odes = {
        "s1": f"(-a1*{root}s1 + a3*{root}s3 + g1*k1*v1)/(2*s1)",
        "s2": f"(-a2*{root}s2 + a4*{root}s4 + g2*k2*v2)/(2*s2)",
        "s3": f"(-a3*{root}s3 + (1 - g2)*k2*v2)/(2*A3*s3)",
        "s4": f"(-a4*{root}s4 + (1 - g1)*k1*v1)/(2*A4*s4)",
    }
    parameters = "A3 A4 a1 a2 a3 a4 g1 g2 k1 k2"
    rational = identifiability(
        written("tanks", odes, {"y1": "s1**2", "y2": "s2**2"}, parameters=parameters, inputs="v1 v2")
    )
    model, given = four_tanks()
    as_written = identifiability(model, parameters=given)
    assert set(rational.lost) == set(as_written.lost)
    assert (rational.rank, rational.size) == (as_written.rank, as_written.size)


# ---- the traps


def test_trap_a_special_start_stalls_the_rank_and_it_grows_again():
    """S' = 1 + a S² from S(0) = 0: y' = 1 and y'' = 0 hold no a; y''' = 2a does."""
    model = written("riccati", {"S": "1 + a*S**2"}, {"y": "S"}, parameters="a")
    found = identifiability(model, start="rest")
    assert found.passed
    assert found.order == 3
    assert identifiability(model, start="free").order < 3


@pytest.mark.parametrize("power", [2, 5, 9])
def test_trap_the_rank_may_stall_for_long(power):
    """S' = 1 + a S^p from rest: the first derivative with a in it is that of order p + 1."""
    model = written("slow", {"S": f"1 + a*S**{power}"}, {"y": "S"}, parameters="a")
    found = identifiability(model, start="rest")
    assert found.passed
    assert found.order == power + 1


def test_a_negative_from_a_known_start_says_how_far_was_looked():
    model = written("silent", {"S": "1 + 0*S", "q": "-a*q"}, {"y": "S + q"}, parameters="a")
    found = identifiability(model, start="rest")
    assert not found.passed
    assert not found.final
    assert f"not seen in derivatives up to order {found.orders}" in str(found)
    assert identifiability(model, start="free").passed


def test_trap_related_exponentials_are_not_independent():
    """exp(2a) is exp(a)²: of y = p·exp(2a) + q·exp(a)² only p + q can be told beside exp."""
    model = written(
        "exponentials",
        {"x": "-p*exp(2*a)*x - q*exp(a)**2*x"},
        {"y": "x"},
        parameters="p q a",
    )
    found = identifiability(model, combinations=["(p + q)*exp(2*a)", "p/q", "p + q"])
    assert found.directions == 1
    assert list(found.combinations.values()) == [True, False, False]
    same = written(
        "same", {"x": "u", "c": "0*c"}, {"y": "p*exp(2*x) + q*exp(x)**2"}, parameters="p q", inputs="u"
    )
    assert identifiability(same, outputs=["y", "x"]).lost == ("p", "q")


def test_trap_a_logarithm_undoes_an_exponential():
    """q·(log(exp(p·x)) - p·x) is zero whatever q is."""
    model = written("zero", {"x": "-p*x + q*(log(exp(p*x)) - p*x)"}, {"y": "x"}, parameters="p q")
    assert identifiability(model).lost == ("q",)


@pytest.mark.parametrize("cylinders", [3, 4, 5, 6, 7])
def test_trap_phases_of_evenly_firing_cylinders_add_up_to_nothing(cylinders):
    """Σ sin(θ + 2πk/n) = 0: a torque common to all cylinders leaves no trace, one cylinder's own does."""
    b = ce.Blueprint("crank")
    p, q, J = (b.parameter(name, 1.0) for name in ("p", "q", "J"))
    speed, torque = b.state("speed"), b.input("T")
    theta = b.input("theta")
    phases = [ca.sin(theta + 2 * np.pi * k / cylinders) for k in range(cylinders)]
    b.ode("speed", (torque + p * sum(phases) + q * phases[1]) / J)
    b.output("speed", speed)
    found = identifiability(b.model())
    assert found.lost == ("p",)
    assert found.identifiable["q"]


def test_trap_the_same_crank_phases_in_products():
    """sin²θ + sin²(θ + 120°) + sin²(θ + 240°) = 3/2 is a constant torque: p and c enter as 3p/2 + c."""
    b = ce.Blueprint("crank")
    p, c = b.parameter("p", 1.0), b.parameter("c", 1.0)
    speed, theta = b.state("speed"), b.input("theta")
    squares = sum(ca.sin(theta + 2 * np.pi * k / 3) ** 2 for k in range(3))
    b.ode("speed", p * squares + c)
    b.output("speed", speed)
    found = identifiability(b.model(), combinations=["3*p/2 + c", "p + c"])
    assert found.lost == ("p", "c")
    assert list(found.combinations.values()) == [True, False]


def test_trap_the_test_is_local():
    """Two rates that may change places are told up to that: a local yes, as published for linear chains."""
    chain = written("chain", {"a": "-k1*a", "b": "k1*a - k2*b"}, {"y": "b"}, parameters="k1 k2")
    found = identifiability(chain, start={"a": 1.0, "b": 0.0}, combinations=["k1*k2", "k1 + k2"])
    assert found.passed
    assert all(found.combinations.values())


# ---- bad input


def test_an_unknown_name_in_a_tie_or_a_start_is_named():
    model = SHAPES_OF_AN_INPUT.model()
    with pytest.raises(ce.CasadiEngineError, match="k13") as caught:
        model.parameters().fix("k13")
    assert "k12" in str(caught.value)
    with pytest.raises(ce.CasadiEngineError, match="unknown name k9"):
        identifiability(model, combinations=["k9*b"])


def test_an_output_that_depends_on_nothing_is_refused():
    model = written("blind", {"x": "-a*x"}, {"y": "x", "label": "3 + 0*x"}, parameters="a")
    with pytest.raises(IdentifiabilityError) as caught:
        identifiability(model)
    text = str(caught.value)
    assert "the output label depends on no state and no free parameter" in text
    assert "label = 3" in text
    assert "leave it out of outputs" in text
    assert identifiability(model, outputs=["y"]).passed


@pytest.mark.parametrize(
    ("law", "name", "advice"),
    [
        (ca.fabs, "fabs", "sqrt(v**2 + e**2)"),
        (ca.sign, "sign", "tanh(v/e)"),
        (lambda v: ca.if_else(v > 0, v, 0), "if_else", "test each"),
        (lambda v: ca.fmin(v, 1), "fmin", "smooth minimum"),
        (lambda v: ca.fmax(v, 0), "fmax", "smooth maximum"),
        (ca.floor, "floor", "write it with exp"),
        (ca.atan, "atan", "write it with exp"),
    ],
)
def test_an_operation_without_an_exact_rule_is_refused_by_name_and_place(law, name, advice):
    b = ce.Blueprint("sharp")
    c = b.parameter("c", 1.0)
    v = b.state("v")
    b.ode("v", -c * law(v) * v)
    b.output("v", v)
    with pytest.raises(IdentifiabilityError, match="has no rule for the operation") as caught:
        identifiability(b.model())
    text = str(caught.value)
    assert "the ode of v" in text
    assert advice in text
    if name not in ("if_else",):  # CasADi writes it as a comparison and a product
        assert name in text


def test_a_power_with_a_state_in_the_exponent_is_refused_with_advice():
    model = written("power", {"x": "-a*2**x"}, {"y": "x"}, parameters="a")
    with pytest.raises(IdentifiabilityError, match="exponent that changes in time") as caught:
        identifiability(model)
    assert "exp(b*log(a))" in str(caught.value)
