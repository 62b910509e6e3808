"""One parameter: its checks, its setter, its copies."""

import copy
import math
from fractions import Fraction

import numpy as np
import pytest

from casadi_engine.errors import ParameterError, TieError
from casadi_engine.parameters import Parameter, Parameters


def test_defaults():
    parameter = Parameter("K", 3)
    assert (parameter.name, parameter.value, parameter.unit) == ("K", 3.0, "1")
    assert (parameter.min, parameter.max, parameter.vary) == (-math.inf, math.inf, True)
    assert (parameter.tie, parameter.prior, parameter.description) == (None, None, "")
    assert parameter.varies_by_experiment is False
    assert isinstance(parameter.value, float)


def test_set_returns_itself_and_leaves_the_rest():
    parameter = Parameter("J", 0.3, unit="kg m2", min=0, max=1)
    assert parameter.set(0.4, max=2) is parameter
    assert (parameter.value, parameter.min, parameter.max) == (0.4, 0.0, 2.0)
    assert parameter.set(vary=False).vary is False
    assert parameter.set(vary=np.bool_(True)).vary is True
    assert parameter.set(prior=(0.4, 0.1)).prior == (0.4, 0.1)
    assert parameter.set(min=-1).prior == (0.4, 0.1)
    assert parameter.set(prior=()).prior is None
    assert parameter.set(min=-math.inf, max=math.inf).max == math.inf


def test_value_and_bounds_move_together_in_one_call():
    parameter = Parameter("J", 0.3, min=0, max=1)
    assert parameter.set(5, min=4, max=6).value == 5.0


@pytest.mark.parametrize("number", [np.float32(2), np.int64(2), np.array(2.0), Fraction(4, 2), 2])
def test_numbers_of_all_kinds(number):
    assert Parameter("J", number).value == 2.0


@pytest.mark.parametrize(
    "bad", [math.nan, math.inf, -math.inf, True, "3", None, [1], np.array([1.0]), 10**400, 1j]
)
def test_a_value_is_a_finite_number(bad, refused):
    with refused(
        ParameterError,
        "the value of the parameter J is not acceptable",
        seen=repr(bad),
        allowed="a finite number",
        cure="give one number",
    ):
        Parameter("J", bad)


@pytest.mark.parametrize(
    ("side", "bad", "allowed"),
    [
        ("min", math.nan, "a finite number or -inf"),
        ("min", math.inf, "a finite number or -inf"),
        ("max", -math.inf, "a finite number or inf"),
        ("max", "big", "a finite number or inf"),
    ],
)
def test_bounds_are_numbers_or_the_infinity_of_their_side(side, bad, allowed, refused):
    with refused(
        ParameterError,
        f"the {side} of the parameter J is not acceptable",
        seen=repr(bad),
        allowed=allowed,
        cure="give one number",
    ):
        Parameter("J", 1.0).set(**{side: bad})


def test_equal_bounds_tell_to_fix(refused):
    parameter = Parameter("J", 1.0, min=0, max=2)
    with refused(
        ParameterError,
        "the bounds of the parameter J are equal",
        seen="min = max = 1",
        allowed="min < max",
        cure='fix it instead: fix("J", 1)',
    ):
        parameter.set(min=1, max=1)
    assert (parameter.min, parameter.max) == (0.0, 2.0)


def test_bounds_in_the_wrong_order(refused):
    with refused(
        ParameterError,
        "the bounds of the parameter J are in the wrong order",
        seen="min = 3, max = 2",
        allowed="min < max",
        cure="exchange them",
    ):
        Parameter("J", 2.5, min=3, max=2)


@pytest.mark.parametrize("value", [-0.1, 2.1])
def test_a_value_outside_its_bounds_changes_nothing(value, refused):
    parameter = Parameter("J", 1.0, min=0, max=2)
    with refused(
        ParameterError,
        "the value of the parameter J is outside its bounds",
        seen=f"{value}",
        allowed="0 to 2",
        cure="the bounds in the same call",
    ):
        parameter.set(value, vary=False, prior=(1, 1))
    assert (parameter.value, parameter.vary, parameter.prior) == (1.0, True, None)


@pytest.mark.parametrize(
    "bad", [(1,), (1, 0), (1, -1), (math.nan, 1), (1, math.inf), 3, "ab", (1, 2, 3), ("1", "2")]
)
def test_a_prior_is_a_mean_and_a_positive_sigma(bad, refused):
    with refused(
        ParameterError,
        "the prior of the parameter J is not acceptable",
        seen=repr(bad),
        allowed="(mean, sigma), both finite, sigma > 0",
        cure="leave the prior out",
    ):
        Parameter("J", 1.0, prior=bad)


def test_vary_is_a_flag(refused):
    with refused(
        ParameterError,
        "vary of the parameter J is not acceptable",
        seen="'no'",
        allowed="True or False",
        cure="give one",
    ):
        Parameter("J", 1.0, vary="no")


@pytest.mark.parametrize("what", ["unit", "description"])
def test_unit_and_description_are_text(what, refused):
    with refused(
        ParameterError,
        f"the {what} of the parameter J is not text",
        seen="3",
        allowed="text",
        cure="put it in quotes",
    ):
        Parameter("J", 1.0, **{what: 3})


def test_plain_assignment_is_set():
    parameter = Parameter("J", 1.0, min=0, max=2)
    parameter.value, parameter.max, parameter.min = 3 / 2, 4, 1
    parameter.vary, parameter.prior = False, (1, 0.5)
    assert (parameter.value, parameter.min, parameter.max) == (1.5, 1.0, 4.0)
    assert (parameter.vary, parameter.prior) == (False, (1.0, 0.5))
    with pytest.raises(ParameterError, match="outside its bounds"):
        parameter.value = 5
    with pytest.raises(ParameterError, match="min of the parameter J is not acceptable"):
        parameter.min = "low"
    with pytest.raises(ParameterError, match="vary of the parameter J is not acceptable"):
        parameter.vary = None
    assert (parameter.value, parameter.min) == (1.5, 1.0)
    with pytest.raises(AttributeError):
        parameter.valeu = 3


@pytest.mark.parametrize("what", ["name", "unit", "description", "varies_by_experiment"])
def test_what_a_parameter_is_cannot_be_assigned(what, refused):
    with refused(
        ParameterError,
        f"the {what} of the parameter J cannot be changed",
        seen=f"{what} = 'x'",
        allowed="value, min, max, vary, prior and tie",
        cure="vary_by_experiment" if what == "varies_by_experiment" else "Blueprint.parameter(...)",
    ):
        setattr(Parameter("J", 1.0), what, "x")


def test_a_tie_outside_a_set_is_refused(refused):
    with refused(TieError, "is in no set", seen="'K'", allowed="in a set", cure="Parameters([...])"):
        Parameter("J", 1.0).tie = "K"


def test_none_takes_away_and_nothing_keeps():
    parameter = Parameter("J", 1.0, min=0, max=2, prior=(1.0, 0.5))
    assert parameter.set(1.5).prior == (1.0, 0.5)
    assert parameter.set(prior=None).prior is None
    assert (parameter.set(min=None).min, parameter.max) == (-math.inf, 2.0)
    assert parameter.set(max=None).max == math.inf
    parameter.prior = (1.0, 0.5)
    parameter.prior = None
    assert parameter.prior is None
    with pytest.raises(ParameterError, match="value of the parameter J is not acceptable"):
        parameter.set(None)
    with pytest.raises(ParameterError, match="vary of the parameter J is not acceptable"):
        parameter.set(vary=None)


def test_a_tied_parameter_shows_the_value_of_its_tie(engine):
    engine.tie("C2", "C_eng/4")
    assert engine["C2"].value == pytest.approx(0.04)
    engine["C_eng"].set(0.4)
    assert engine["C2"].value == pytest.approx(0.1)
    assert engine["C2"].vary is False


@pytest.mark.parametrize("change", [{"value": 1.0}, {"vary": False}, {"vary": True}])
def test_a_tied_parameter_has_no_value_of_its_own(change, engine, refused):
    engine.tie("C2", "C_eng/4")
    with refused(
        TieError,
        "the parameter C2 is tied",
        seen="C2 == C_eng/4",
        allowed="min, max and prior",
        cure='untie("C2")',
    ):
        engine["C2"].set(**change)


def test_bounds_of_a_tied_parameter_need_not_hold_its_old_value(engine):
    engine.tie("C2", "C_eng/4")
    engine["C2"].set(min=1.0, max=2.0, prior=(1.5, 0.1))
    assert (engine["C2"].min, engine["C2"].max) == (1.0, 2.0)
    engine.untie("C2")
    assert engine["C2"].value == 1.0


def test_a_copy_stands_alone(engine):
    engine.tie("C2", "C_eng/4")
    engine["C_eng"].set(0.8)
    for other in (copy.copy(engine["C2"]), copy.deepcopy(engine["C2"])):
        assert (other.value, other.tie) == (0.2, None)
        other.set(5)
    assert engine["C2"].value == pytest.approx(0.2)


def test_a_copy_of_a_tie_without_a_value_keeps_the_old_one(engine):
    engine.tie("C2", "1/(C_eng - 0.16)")
    assert not math.isfinite(engine["C2"].value)
    assert copy.copy(engine["C2"]).value == 0.04


def test_repr_tells_the_state(engine):
    assert repr(engine["J_eng"]) == "<Parameter J_eng = 0.39 kg m2 [0.05, 4]>"
    assert repr(engine["C_el"]) == "<Parameter C_el = 3 N m s/rad [-inf, inf] fixed>"
    engine.tie("C2", "C_eng/4")
    assert repr(engine["C2"]) == "<Parameter C2 = 0.04 N m s/rad [0, inf] == C_eng/4>"


def test_parameters_given_to_a_set_are_copied():
    mine = Parameter("J", 1.0)
    pars = Parameters([mine])
    pars["J"].set(2.0)
    assert mine.value == 1.0
