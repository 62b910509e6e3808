"""The set as JSON-able data and back."""

import copy
import itertools
import json
import math

import casadi as ca
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.errors import ExpressionError, ParameterError, TieError
from casadi_engine.parameters import Parameters


def full(engine):
    engine.tie("C2", " C_eng/4 ")
    engine.tie("J_load", engine.symbol("J_eng") * 1.25 + 0)
    engine.fix("C_el", 2.5)
    engine["K_el"].set(prior=(1e4, 1e3))
    engine.vary_by_experiment("C_eng")
    engine.constrain("J_eng + J_load", 0.3, 3)
    engine.constrain(ca.sqrt(engine.symbol("K_el")), min=1, name="root")
    engine.constrain_frequency(2, max=80)
    return engine


def test_what_is_written(engine):
    data = full(engine).to_dict()
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert data["parameters"][0] == {
        "name": "J_eng", "value": 0.39, "unit": "kg m2", "min": 0.05, "max": 4.0, "vary": True,
        "fixed_by_user": False, "varies_by_experiment": False, "tie": None, "prior": None, "description": "",
    }  # fmt: skip
    assert data["parameters"][2]["max"] is None
    assert data["parameters"][2]["prior"] == [1e4, 1e3]
    assert [p["tie"] for p in data["parameters"]] == [None, "1.25*J_eng", None, None, "C_eng/4", None]
    assert data["constraints"] == [
        {"name": None, "expression": "J_eng + J_load", "min": 0.3, "max": 3.0},
        {"name": "root", "expression": "sqrt(K_el)", "min": 1.0, "max": None},
    ]
    assert data["frequency_constraints"] == [{"mode": 2, "min": 0.0, "max": 80.0}]


def test_round_trip(engine):
    data = full(engine).to_dict()
    given_ = copy.deepcopy(data)
    again = Parameters.from_dict(given_)
    assert given_ == data
    assert again.to_dict() == data
    assert again.as_dict() == engine.as_dict()
    assert str(again) == str(engine)
    assert again["C_eng"].varies_by_experiment
    with pytest.raises(TieError, match="both tied and fixed"):
        again.tie("C_el", "C_eng")


def test_a_tie_may_stand_before_what_it_refers_to():
    pars = Parameters()
    pars.add("a", 1.0)
    pars.add("b", 2.0)
    pars.tie("a", "b")
    assert Parameters.from_dict(pars.to_dict())["a"].value == 2.0


def test_an_sx_tie_outside_the_grammar_cannot_be_stored(engine, refused):
    engine.tie("C2", ca.atan2(engine.symbol("C_eng"), 4))
    with refused(
        ExpressionError,
        "cannot be written as text, and so not be stored",
        seen="atan2(C_eng,4)",
        allowed="names, numbers",
        cure="keep the set in memory alone",
    ):
        engine.to_dict()
    assert issubclass(ExpressionError, ParameterError)
    engine.untie("C2")
    engine.constrain(ca.erf(engine.symbol("C_eng")), 0, 1)
    with pytest.raises(ParameterError, match="the operation in erf"):
        engine.to_dict()


def drop(data, *path):
    *way, last = path
    for step in way:
        data = data[step]
    del data[last]


def put(data, value, *path):
    *way, last = path
    for step in way:
        data = data[step]
    data[last] = value


@pytest.mark.parametrize(
    ("spoil", "place", "seen", "allowed"),
    [
        (lambda d: drop(d, "constraints"), "the data", "lacks constraints", "exactly the keys parameters"),
        (lambda d: put(d, 1, "extra"), "the data", "has extra", "exactly the keys parameters"),
        (lambda d: put(d, 3, "parameters"), "parameters", "3", "a list"),
        (lambda d: put(d, 3, "parameters", 1), "parameters[1]", "3", "an object with the keys name"),
        (lambda d: drop(d, "parameters", 2, "min"), "parameters[2]", "lacks min", "exactly the keys name"),
        (lambda d: put(d, "x", "parameters", 0, "value"), "parameters[0].value", "'x'", "a number"),
        (lambda d: put(d, None, "parameters", 0, "value"), "parameters[0].value", "None", "a number"),
        (lambda d: put(d, "inf", "parameters", 0, "max"), "parameters[0].max", "'inf'", "or null for none"),
        (lambda d: put(d, 1, "parameters", 0, "vary"), "parameters[0].vary", "1", "a flag"),
        (lambda d: put(d, 1, "parameters", 0, "unit"), "parameters[0].unit", "1", "a text"),
        (lambda d: put(d, 1, "parameters", 0, "tie"), "parameters[0].tie", "1", "text or null"),
        (lambda d: put(d, [1], "parameters", 0, "prior"), "parameters[0].prior", "[1]", "pair or null"),
        (lambda d: put(d, 1, "constraints", 0, "expression"), "constraints[0].expression", "1", "a text"),
        (
            lambda d: put(d, True, "frequency_constraints", 0, "mode"),
            "frequency_constraints[0].mode",
            "True",
            "number",
        ),
    ],
)
def test_data_that_do_not_fit_are_located(spoil, place, seen, allowed, engine, refused):
    data = full(engine).to_dict()
    spoil(data)
    with refused(
        ParameterError,
        f"stored parameters do not fit at {place}",
        seen=seen,
        allowed=allowed,
        cure="write them with to_dict()",
    ) as caught:
        Parameters.from_dict(data)
    assert caught.value.problem.endswith(f"at {place}")


def test_data_of_another_kind(refused):
    with refused(ParameterError, "do not fit at the data", seen="[]", allowed="an object", cure="to_dict()"):
        Parameters.from_dict([])


def test_values_are_checked_as_ever(engine):
    data = full(engine).to_dict()
    put(data, math.nan, "parameters", 0, "value")
    with pytest.raises(ParameterError, match="the value of the parameter J_eng is not acceptable"):
        Parameters.from_dict(data)
    data = engine.to_dict()
    put(data, True, "parameters", 4, "fixed_by_user")
    with pytest.raises(TieError, match="C2 cannot be both tied and fixed"):
        Parameters.from_dict(data)


@st.composite
def sets(draw):
    """Any set: bounds of all kinds, priors, ties down the line, constraints."""
    pars = Parameters()
    names = draw(
        st.lists(st.sampled_from(["a", "b.c", "K_1", "ζ", "x2", "port.effect.p"]), unique=True, min_size=1)
    )
    number = st.floats(-1e9, 1e9, allow_nan=False)
    for name in names:
        low, value, high = sorted(draw(st.tuples(number, number, number)))
        if low == high:
            high = low + 1
        pars.add(
            name,
            value,
            unit=draw(st.text(max_size=5)),
            min=draw(st.sampled_from([low, -math.inf])),
            max=draw(st.sampled_from([high, math.inf])),
            vary=draw(st.booleans()),
            prior=draw(st.none() | st.tuples(number, st.floats(1e-9, 1e9))),
            description=draw(st.text(max_size=8)),
        )
    for earlier, name in itertools.pairwise(names):
        match draw(st.integers(0, 5)):
            case 0:
                pars.tie(name, f"{draw(number)!r}*{earlier} + sqrt(abs({earlier}))")
            case 1:
                pars.tie(name, draw(number) * pars.symbol(earlier) - draw(number))
            case 2:
                pars.fix(name)
            case 3 if pars[name].vary:
                pars.vary_by_experiment(name)
    for _ in range(draw(st.integers(0, 3))):
        name = draw(st.sampled_from(names))
        text = draw(st.booleans())
        expression = f"{name}**2" if text else ca.exp(pars.symbol(name)) - draw(number)
        pars.constrain(expression, draw(number))
    for mode in draw(st.sets(st.integers(1, 5))):
        pars.constrain_frequency(mode, draw(st.floats(0, 100)), draw(st.floats(100, 1e4)))
    return pars


@given(sets())
@settings(max_examples=80, deadline=None)
def test_any_set_survives_json(pars):
    data = pars.to_dict()
    again = Parameters.from_dict(json.loads(json.dumps(data, allow_nan=False)))
    assert again.to_dict() == data
    assert again.as_dict() == pytest.approx(pars.as_dict(), rel=1e-12, nan_ok=True)
    assert str(again) == str(pars)
    assert pars.copy().to_dict() == data
    assert pars.frozen().to_dict() == data
