"""The set of parameters: reading, changing, copies."""

import copy
import json
import math

import casadi as ca
import numpy as np
import pytest

from casadi_engine.errors import ConstraintError, ExpressionError, ParameterError, TieError
from casadi_engine.parameters import Parameter, Parameters, compile

NAMES = ("J_eng", "J_load", "K_el", "C_el", "C2", "C_eng")


def test_it_reads_like_a_mapping(engine):
    assert engine.names == engine.keys() == tuple(engine) == NAMES
    assert len(engine) == 6
    assert "J_eng" in engine
    assert "j_eng" not in engine
    assert 3 not in engine
    assert [name for name, _ in engine.items()] == list(NAMES)
    assert dict(engine)["J_eng"] is engine["J_eng"]
    assert engine.as_dict()["K_el"] == 1e4
    assert repr(engine) == "<Parameters: 6, 4 free, 0 tied>"


def test_as_dict_is_the_callers_own(engine):
    engine.as_dict()["K_el"] = 0
    assert engine.as_dict()["K_el"] == 1e4


@pytest.mark.parametrize("name", ["j_eng", "J_en"])
def test_an_unknown_name_shows_near_matches(name, engine, refused):
    with refused(
        ParameterError,
        "unknown parameter",
        seen=repr(name),
        allowed="J_eng, J_load, K_el, C_el, C2, C_eng (nearest: J_eng",
        cure="use one of these names, or add(...) it",
    ):
        engine[name]


@pytest.mark.parametrize("name", [3, None, ["J_eng"]])
def test_a_name_of_another_type_is_unknown(name, engine, refused):
    with refused(ParameterError, "unknown parameter", seen=repr(name), allowed="J_eng", cure="add"):
        engine[name]


@pytest.mark.parametrize(
    "verb",
    [
        lambda p: p.fix("J"),
        lambda p: p.free("J_eng", "J"),
        lambda p: p.untie("J"),
        lambda p: p.symbol("J"),
        lambda p: p.vary_by_experiment("J_eng", "J"),
    ],
)
def test_every_verb_checks_the_name_first(verb, engine):
    before = engine.to_dict()
    with pytest.raises(ParameterError, match="unknown parameter; seen: 'J'"):
        verb(engine)
    assert engine.to_dict() == before


def test_add_gives_the_parameter(engine):
    added = engine.add(
        "r", 0.05, unit="m", min=0, max=1, vary=False, prior=(0.05, 0.01), description="radius"
    )
    assert added is engine["r"]
    assert (added.unit, added.vary, added.prior, added.description) == ("m", False, (0.05, 0.01), "radius")


def test_a_name_is_added_once(engine, refused):
    with refused(
        ParameterError,
        "the parameter J_eng is there already",
        seen="J_eng",
        allowed="a name of its own",
        cure='parameters["J_eng"].set(...)',
    ):
        engine.add("J_eng", 1.0)
    with pytest.raises(ParameterError, match="there already"):
        Parameters([Parameter("a", 1), Parameter("a", 2)])


def test_a_set_is_made_of_parameters(refused):
    with refused(
        ParameterError,
        "a set of parameters is made of Parameter objects",
        seen="'J_eng'",
        allowed="Parameter(name, value",
        cure="wrap it",
    ):
        Parameters(["J_eng"])


def test_parameters_of_another_set_come_without_their_ties(engine):
    engine.tie("C2", "C_eng/2")
    pars = Parameters(parameter for _, parameter in engine.items())
    assert pars["C2"].tie is None
    assert pars["C2"].value == pytest.approx(0.08)


def test_fix_and_free(engine):
    engine.fix("J_eng", 0.5)
    assert (engine["J_eng"].value, engine["J_eng"].vary) == (0.5, False)
    engine.fix("K_el")
    assert engine["K_el"].value == 1e4
    engine.free("J_eng", "K_el", "C_el")
    assert all(engine[name].vary for name in ("J_eng", "K_el", "C_el"))


def test_fix_keeps_to_the_bounds(engine):
    with pytest.raises(ParameterError, match=r"outside its bounds; seen: 5; allowed: 0\.05 to 4"):
        engine.fix("J_eng", 5)
    assert engine["J_eng"].vary is True


# ---- constraints --------------------


def test_constraints_are_kept_in_order(engine):
    engine.constrain(" J_eng + J_load ", 0.5, 1)
    engine.constrain(engine.symbol("J_eng") - engine.symbol("J_load"), max=0, name="order")
    first, second = engine.constraints
    assert (first.label, first.min, first.max, first.names) == (
        "J_eng + J_load",
        0.5,
        1.0,
        ("J_eng", "J_load"),
    )
    assert str(first) == "0.5 <= J_eng + J_load <= 1"
    assert (second.label, second.min, second.max, second.text) == ("order", -math.inf, 0.0, "J_eng - J_load")
    assert str(second) == "order: J_eng - J_load <= 0"


def test_equal_bounds_make_an_equality(engine):
    engine.constrain("J_eng + J_load", 1, 1)
    assert str(engine.constraints[0]) == "J_eng + J_load == 1"


@pytest.mark.parametrize(
    ("low", "high", "problem", "seen", "allowed", "cure"),
    [
        (2, 1, "are in the wrong order", "min = 2, max = 1", "min <= max", "exchange"),
        (
            -math.inf,
            math.inf,
            "has no bound",
            "min = -inf, max = inf",
            "at least one",
            "give min, max or both",
        ),
        (math.nan, 1, "the min of", "nan", "a finite number or -inf", "give one number"),
        (0, "a", "the max of", "'a'", "a finite number or inf", "give one number"),
        (math.inf, math.inf, "the min of", "inf", "a finite number or -inf", "give one number"),
    ],
)
def test_bounds_of_a_constraint(low, high, problem, seen, allowed, cure, engine, refused):
    with refused(ConstraintError, problem, seen=seen, allowed=allowed, cure=cure) as caught:
        engine.constrain("J_eng + J_load", low, high)
    assert "the constraint J_eng + J_load" in caught.value.problem
    assert engine.constraints == ()


def test_names_of_constraints(engine, refused):
    engine.constrain("J_eng", 0.1, name="first")
    with refused(
        ConstraintError, "two constraints have one name", seen="first", allowed="of its own", cure="another"
    ):
        engine.constrain("J_load", 0.1, name="first")
    for bad in (3, ""):
        with refused(
            ConstraintError,
            "the name of a constraint is not acceptable",
            seen=repr(bad),
            allowed="text, or None",
            cure="short text",
        ):
            engine.constrain("J_load", 0.1, name=bad)


def test_expressions_of_constraints(engine, refused):
    with refused(ExpressionError, "unknown name J", seen="^", allowed="J_eng", cure="at the caret"):
        engine.constrain("J + 1", 0)
    with refused(
        ConstraintError, "symbols that are not of this set", seen="x", allowed="J_eng", cure="this very set"
    ):
        engine.constrain(ca.SX.sym("x"), 0)
    with refused(
        ConstraintError, "a constraint must be text or", seen="7", allowed="C_eng/4", cure="one scalar"
    ):
        engine.constrain(7, 0)


def test_frequency_constraints_are_data(engine):
    engine.constrain_frequency(1, 40, 60)
    engine.constrain_frequency(2, max=200)
    engine.constrain_frequency(3, 300)
    assert [(c.mode, c.min, c.max) for c in engine.frequency_constraints] == [
        (1, 40.0, 60.0),
        (2, 0.0, 200.0),
        (3, 300.0, math.inf),
    ]
    assert engine.frequency_constraints[0].label == "natural frequency 1"
    assert str(engine.frequency_constraints[0]) == "40 <= natural frequency 1 [Hz] <= 60"


@pytest.mark.parametrize("mode", [0, -1, 1.0, True, "1", None])
def test_modes_count_from_one(mode, engine, refused):
    with refused(
        ConstraintError,
        "the number of a natural frequency is not acceptable",
        seen=repr(mode),
        allowed="a whole number from 1 on",
        cure="print(model.modes(parameters))",
    ):
        engine.constrain_frequency(mode, 1, 2)


@pytest.mark.parametrize(("low", "high"), [(-1, 5), (-math.inf, 0), (0, 0)])
def test_bounds_of_frequencies(low, high, engine, refused):
    with refused(
        ConstraintError,
        "natural frequency 1 are not frequencies",
        seen="Hz",
        allowed="0 <= min, 0 < max",
        cure="positive frequencies",
    ):
        engine.constrain_frequency(1, low, high)


def test_bounds_of_frequencies_in_order(engine):
    with pytest.raises(ConstraintError, match="natural frequency 1 are in the wrong order"):
        engine.constrain_frequency(1, 5, 3)


def test_a_mode_is_constrained_once(engine, refused):
    engine.constrain_frequency(1, 40)
    with refused(
        ConstraintError,
        "natural frequency 1 is constrained twice",
        seen="natural frequency 1 [Hz] <= 60",
        allowed="one pair",
        cure="both bounds in one call",
    ):
        engine.constrain_frequency(1, max=60)


# ---- by experiment --------------------


def test_only_free_parameters_vary_by_experiment(engine, refused):
    engine.vary_by_experiment("C_eng", "J_eng")
    assert engine["C_eng"].varies_by_experiment is True
    engine.tie("C2", "C_eng/4")
    with refused(
        ParameterError,
        "C_el cannot vary by experiment",
        seen="C_el is fixed",
        allowed="free parameters",
        cure='free("C_el")',
    ):
        engine.vary_by_experiment("C_el")
    with refused(
        ParameterError,
        "C2 cannot vary by experiment",
        seen="C2 == C_eng/4",
        allowed="free parameters",
        cure='untie("C2")',
    ):
        engine.vary_by_experiment("K_el", "C2")
    assert engine["K_el"].varies_by_experiment is False


def test_a_fixed_parameter_has_one_value_until_freed(engine):
    engine.vary_by_experiment("C_eng")
    engine.fix("C_eng")
    assert engine["C_eng"].varies_by_experiment is False
    engine.free("C_eng")
    assert engine["C_eng"].varies_by_experiment is True


def test_values_by_experiment_are_starts_bounds_and_constants(engine, refused):
    engine.vary_by_experiment("C_eng", values={"first": 0.3, "second": (0.5, 0.4, 0.6)})
    engine.vary_by_experiment("C_el", values={"second": 7.0})
    engine.tie("C2", "C_eng*C_el")
    assert engine["C_el"].varies_by_experiment is True
    records = ("first", "second", "third")
    for one in (engine, engine.copy(), Parameters.from_dict(json.loads(json.dumps(engine.to_dict())))):
        pmap = compile(one, NAMES, records)
        own = [pmap.free.index(f"C_eng@{record}") for record in records]
        assert pmap.start[own].tolist() == [0.3, 0.5, one["C_eng"].value]
        assert pmap.lower[own].tolist() == [one["C_eng"].min, 0.4, one["C_eng"].min]
        assert pmap.upper[own].tolist() == [one["C_eng"].max, 0.6, one["C_eng"].max]
        assert not any(name.startswith("C_el") for name in pmap.free)
        assert pmap.unpack(pmap.start, "second").tolist()[3:] == [7.0, 3.5, 0.5]
        assert pmap.unpack(pmap.start, "first")[3] == one["C_el"].value
        assert pmap.values(pmap.start)["C_el@second"] == 7.0
    engine.fix("C_eng", 0.2)  # one word for all records
    pmap = compile(engine, NAMES, records)
    assert pmap.values(pmap.start)["C_eng"] == 0.2
    for wrong, problem, seen, allowed, cure in (
        ([1.0], "J_eng by experiment are no mapping", "[1.0]", "record -> value", "{"),
        (
            {"first": "a"},
            "the value in first of the parameter J_eng is not acceptable",
            "'a'",
            "a finite",
            "give",
        ),
        (
            {"first": (2.0, 3.0, 4.0)},
            "the value of the parameter J_eng is outside its bounds",
            "2",
            "3 to 4",
            "change",
        ),
    ):
        with refused(ParameterError, problem, seen=seen, allowed=allowed, cure=cure):
            engine.vary_by_experiment("J_eng", values=wrong)
    assert engine["J_eng"].varies_by_experiment is False


# ---- copies --------------------


@pytest.mark.parametrize("duplicate", [Parameters.copy, copy.copy, copy.deepcopy])
def test_a_copy_is_independent_and_shares_symbols(duplicate, engine):
    engine.tie("C2", "C_eng/4")
    before = engine.to_dict()
    other = duplicate(engine)
    assert other.to_dict() == before
    assert ca.is_equal(other.symbol("C_eng"), engine.symbol("C_eng"))
    other["J_eng"].set(1.0)
    other["C_eng"].set(0.8)
    other.untie("C2")
    other.add("new", 1)
    other.constrain("new", 0)
    other.constrain_frequency(1, 3)
    other.vary_by_experiment("K_el")
    assert engine.to_dict() == before
    assert other["C2"].value == pytest.approx(0.2)


def test_symbols_of_the_original_serve_its_copies(engine):
    other = engine.copy()
    other.tie("C2", engine.symbol("C_eng") / 4)
    assert other["C2"].value == pytest.approx(0.04)
    assert engine["C2"].tie is None


def test_symbols_are_listed_and_read_only(engine):
    assert tuple(engine.symbols) == NAMES
    assert ca.is_equal(engine.symbols["J_eng"], engine.symbol("J_eng"))
    with pytest.raises(TypeError):
        engine.symbols["x"] = 3


CHANGES = {
    "set": lambda p: p["J_eng"].set(1.0),
    "value": lambda p: setattr(p["J_eng"], "value", 1.0),
    "min": lambda p: setattr(p["J_eng"], "min", 0.01),
    "prior": lambda p: setattr(p["J_eng"], "prior", (1.0, 1.0)),
    "tie of one": lambda p: setattr(p["J_eng"], "tie", "J_load"),
    "untie of one": lambda p: setattr(p["C2"], "tie", None),
    "item": lambda p: p.__setitem__("J_eng", 1.0),
    "add": lambda p: p.add("x", 1.0),
    "fix": lambda p: p.fix("J_eng"),
    "free": lambda p: p.free("C_el"),
    "tie": lambda p: p.tie("J_eng", "J_load"),
    "untie": lambda p: p.untie("C2"),
    "constrain": lambda p: p.constrain("J_eng", 0),
    "frequency": lambda p: p.constrain_frequency(1, 3),
    "vary": lambda p: p.vary_by_experiment("C_eng"),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_frozen_set_refuses_every_change(change, engine, refused):
    engine.tie("C2", "C_eng/4")
    frozen = engine.frozen()
    before = frozen.to_dict()
    with refused(
        ParameterError,
        "this set of parameters is frozen",
        seen="an attempt to change it",
        allowed="changes of a copy",
        cure="pars = fit.parameters.copy()",
    ):
        change(frozen)
    assert frozen.to_dict() == before
    change(engine)  # the original and copies stay open
    change(frozen.copy())


def test_extended_keeps_settings_and_frees_what_is_new(engine):
    engine["J_eng"].set(0.7)
    engine.tie("C2", "C_eng/4")
    engine.constrain("J_eng + J_load", 0, 3)
    engine.constrain_frequency(1, 3)
    bigger = Parameters()
    for name in ("J_eng", "K_el"):
        bigger.add(name, 1e3, vary=False)
    bigger.add("coupling.friction.torque", 0.5, unit="N m", min=0, vary=False)
    bigger.add("half", 1.0)
    bigger.tie("half", bigger.symbol("K_el") / 2)
    bigger.constrain("half - J_eng", 0, name="new one")
    bigger.constrain("K_el", 0, name="not about the new")
    both = engine.extended(bigger.frozen())
    assert both.names == (*NAMES, "coupling.friction.torque", "half")
    assert (both["J_eng"].value, both["J_eng"].vary) == (0.7, True)
    added = both["coupling.friction.torque"]
    assert (added.vary, added.min, added.value, added.unit) == (True, 0.0, 0.5, "N m")
    assert both["half"].tie == "K_el/2"
    assert both["half"].value == 5e3
    assert [c.label for c in both.constraints] == ["J_eng + J_load", "new one"]
    assert both.frequency_constraints == engine.frequency_constraints
    assert ca.is_equal(both.symbol("J_eng"), engine.symbol("J_eng"))
    assert {s.element_hash() for s in ca.symvar(both.constraints[1].expression)} == {
        both.symbol(name).element_hash() for name in ("half", "J_eng")
    }
    added.set(0.9)
    assert bigger["coupling.friction.torque"].value == 0.5
    assert len(engine) == 6


def test_what_is_new_may_be_tied_even_if_it_was_fixed_there(engine):
    other = Parameters()
    other.add("x", 1.0)
    other.fix("x", 2.0)
    both = engine.extended(other)
    assert both["x"].value == 2.0
    both.tie("x", "J_eng")


def test_extended_by_nothing_new(engine):
    assert engine.extended(engine).to_dict() == engine.to_dict()
    assert engine.extended(Parameters()).to_dict() == engine.to_dict()


def test_extended_by_a_model_takes_its_fresh_set(engine):
    class Model:
        def parameters(self):
            return Parameters([Parameter("x", 2.0)])

    assert engine.extended(Model()).names == (*NAMES, "x")


def test_extended_takes_a_set(engine, refused):
    with refused(
        ParameterError,
        "can only be extended by another",
        seen="dict",
        allowed="Parameters",
        cure="model.parameters()",
    ):
        engine.extended({})


@pytest.mark.parametrize("mode", [np.array([1, 2]), 1.0, "1", True, None])
def test_a_mode_of_another_kind(mode):
    with pytest.raises(ConstraintError, match="the number of a natural frequency is not acceptable"):
        Parameters([Parameter("a", 1.0)]).constrain_frequency(mode, 1, 2)


@pytest.mark.parametrize("prior", [np.zeros(2), np.zeros(0), [], "ab"])
def test_a_prior_of_another_kind(prior):
    pars = Parameters([Parameter("a", 1.0, prior=(1.0, 0.5))])
    with pytest.raises(ParameterError, match="prior of the parameter a"):
        pars["a"].set(prior=prior)
    assert pars["a"].prior == (1.0, 0.5)


def test_get_is_that_of_a_mapping(engine):
    assert engine.get("J_eng") is engine["J_eng"]
    assert engine.get("J_enh") is None
    assert engine.get("J_enh", 3) == 3
    assert engine.get(3, "no") == "no"


def test_a_number_assigned_to_a_name_is_its_value(engine, refused):
    engine["J_eng"] = 0.7
    assert engine["J_eng"].value == 0.7
    with refused(
        ParameterError, "unknown parameter", seen="'J_enh'", allowed="nearest: J_eng", cure="add(...)"
    ):
        engine["J_enh"] = 0.7


def test_a_misspelt_attribute_of_the_set_is_no_new_one(engine):
    with pytest.raises(AttributeError):
        engine.J_eng = 3


def test_a_tie_is_assigned_and_taken_away(engine):
    engine["C2"].tie = "C_eng/4"
    assert engine["C2"].tie == "C_eng/4"
    assert engine["C2"].value == pytest.approx(engine["C_eng"].value / 4)
    engine["C2"].tie = None
    engine["C2"].tie = None
    assert engine["C2"].tie is None
    with pytest.raises(TieError, match="close a cycle"):
        engine["C2"].tie = "C2"
