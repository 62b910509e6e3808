"""The graph of ties, alone and through the set."""

import casadi as ca
import pytest

from casadi_engine.errors import ExpressionError, ParameterError, TieError
from casadi_engine.parameters import Parameters
from casadi_engine.parameters.ties import closure, cycle, in_order

GRAPH = {"d": ("c", "a"), "c": ("b",), "b": ("a", "x")}


def test_order_puts_references_first():
    assert in_order(GRAPH) == ("b", "c", "d")
    assert in_order({}) == ()


def test_closure_follows_ties():
    assert closure(GRAPH, ["c"]) == {"c", "b", "a", "x"}
    assert closure(GRAPH, []) == set()
    assert closure(GRAPH, ["z"]) == {"z"}


def test_cycle_is_the_way_back():
    assert cycle(GRAPH, "a", ("d",)) in (["a", "d", "a"], ["a", "d", "c", "b", "a"])
    assert cycle(GRAPH, "x", ("c",)) == ["x", "c", "b", "x"]
    assert cycle(GRAPH, "a", ("a",)) == ["a", "a"]
    assert cycle(GRAPH, "d", ("c",)) == []


def test_a_ladder_of_ties_is_searched_once_per_rung():
    ladder = {}
    for i in range(60):  # 2**60 ways lead through it
        ladder[f"l{i}"] = ladder[f"r{i}"] = (f"l{i + 1}", f"r{i + 1}")
    assert cycle(ladder, "top", ("l0", "r0")) == []
    assert len(in_order(ladder)) == 120


def chain() -> Parameters:
    pars = Parameters()
    for name in "abcd":
        pars.add(name, 1.0)
    return pars


def test_a_chain_of_ties_is_worked_out_in_any_order():
    pars = chain()
    pars.tie("d", "2*c")
    pars.tie("c", "b + 1")
    pars.tie("b", "3*a")
    assert pars.as_dict() == {"a": 1.0, "b": 3.0, "c": 4.0, "d": 8.0}
    assert pars.tied_in_order() == ("b", "c", "d")
    pars["a"].set(2.0)
    assert pars["d"].value == 14.0


@pytest.mark.parametrize(
    ("ties", "last", "seen", "leave"),
    [
        ([], ("a", "2*a"), "a -> a", "a"),
        ([("b", "a")], ("a", "b"), "a -> b -> a", "b"),
        ([("b", "c"), ("c", "2*d")], ("d", "b/2"), "d -> b -> c -> d", "c"),
    ],
)
def test_a_cycle_is_written_out(ties, last, seen, leave, refused):
    pars = chain()
    for name, expression in ties:
        pars.tie(name, expression)
    before = pars.to_dict()
    with refused(
        TieError,
        "ties close a cycle",
        seen=seen,
        allowed="end at free or fixed parameters",
        cure=f"the tie of {leave}",
    ) as caught:
        pars.tie(*last)
    assert caught.value.seen == seen
    assert pars.to_dict() == before


def test_a_name_that_cancels_is_no_reference():
    pars = chain()
    pars.tie("a", pars.symbol("b") + 0 * pars.symbol("a"))
    assert pars.references(["a"]) == {"a", "b"}


def test_an_unknown_name_in_a_tie(engine, refused):
    with refused(
        TieError,
        "unknown name C_Eng",
        seen="  C_Eng/4\n  ^",
        allowed="(nearest: C_eng",
        cure="at the caret",
    ):
        engine.tie("C2", "C_Eng/4")
    assert engine["C2"].tie is None


def test_an_unknown_parameter_to_tie(engine, refused):
    with refused(ParameterError, "unknown parameter", seen="'C3'", allowed="nearest: C2", cure="add(...)"):
        engine.tie("C3", "C_eng/4")


def test_a_tie_outside_the_grammar_is_an_expression_error(engine, refused):
    with refused(ExpressionError, "cannot be read", seen="C_eng/", allowed="names", cure="at the caret"):
        engine.tie("C2", "C_eng/")


def test_tied_and_fixed_is_an_error_in_either_order(engine, refused):
    engine.fix("J_load", 0.6)
    with refused(
        TieError,
        "J_load cannot be both tied and fixed",
        seen="J_load is fixed at 0.6",
        allowed="one of the two",
        cure='free("J_load")',
    ):
        engine.tie("J_load", "J_eng")
    engine.free("J_load")
    engine.tie("J_load", "J_eng")
    with refused(
        TieError,
        "J_load cannot be both tied and fixed",
        seen="J_load == J_eng",
        allowed="one of the two",
        cure='untie("J_load")',
    ):
        engine.fix("J_load")


def test_fixed_through_set_is_fixed_by_word_too(engine):
    engine["J_load"].set(vary=False)
    with pytest.raises(TieError, match="both tied and fixed"):
        engine.tie("J_load", "J_eng")


def test_a_parameter_that_the_model_fixes_by_default_may_be_tied(engine):
    assert engine["C2"].vary is False
    engine.tie("C2", "C_eng/4")
    engine.untie("C2")
    assert engine["C2"].vary is False


def test_a_tied_parameter_cannot_be_freed(engine, refused):
    engine.tie("C2", "C_eng/4")
    with refused(
        TieError,
        "the parameter C2 is tied and cannot be freed",
        seen="C2 == C_eng/4",
        allowed="not tied",
        cure='untie("C2")',
    ):
        engine.free("C_el", "C2")
    assert engine["C_el"].vary is False  # nothing was done


def test_untie_keeps_the_value_and_needs_a_tie(engine, refused):
    engine.tie("C2", "C_eng/2")
    engine.untie("C2")
    assert engine["C2"].value == pytest.approx(0.08)
    with refused(
        TieError,
        "the parameter C2 is not tied",
        seen="C2",
        allowed="(no parameter is tied)",
        cure="leave the call out",
    ):
        engine.untie("C2")
    engine.tie("C_el", "C_eng")
    with refused(TieError, "C2 is not tied", seen="C2", allowed="C_el", cure="leave"):
        engine.untie("C2")


def test_a_second_tie_replaces_the_first(engine):
    engine.tie("C2", "C_eng/4")
    engine.tie("C2", engine.symbol("J_eng") * 2)
    assert engine["C2"].value == pytest.approx(0.78)
    assert engine["C2"].tie == "2*J_eng"


def test_sx_ties_equal_text_ties(engine):
    other = engine.copy()
    engine.tie("C2", "sqrt(C_eng)/4")
    other.tie("C2", ca.sqrt(other.symbol("C_eng")) / 4)
    assert engine.as_dict() == other.as_dict()
    assert other["C2"].tie == "sqrt(C_eng)/4"


def test_an_sx_tie_is_kept_apart_from_the_users_object(engine):
    mine = engine.symbol("C_eng") * 1
    engine.tie("C2", mine)
    mine[0] = 7
    symbol = engine.symbol("C_eng")
    symbol[0] = 7
    engine.symbols["C_eng"][0] = 7
    assert engine["C2"].value == pytest.approx(0.16)
    assert engine.symbol("C_eng").is_symbolic()


def test_symbols_of_another_set_are_refused(engine, refused):
    with refused(
        TieError,
        "the tie of C2 uses symbols that are not of this set",
        seen="C_eng",
        allowed="parameters.symbol(name) with J_eng",
        cure="from this very set",
    ):
        engine.tie("C2", ca.SX.sym("C_eng") / 4)


@pytest.mark.parametrize("thing", [3.0, None, ca.SX(2, 2), ca.MX.sym("a")])
def test_a_tie_is_text_or_a_scalar(thing, engine, refused):
    with refused(
        TieError,
        "the tie of C2 must be text or a CasADi SX scalar",
        seen="SX (2, 2)" if isinstance(thing, ca.SX) else repr(thing),
        allowed="C_eng/4",
        cure="one scalar expression",
    ):
        engine.tie("C2", thing)


def test_a_long_sx_tie_outside_the_grammar_is_shown_shortened(engine):
    symbol = engine.symbol("C_eng")
    engine.tie("C2", ca.atan2(symbol, 2))
    assert engine["C2"].tie == "atan2(C_eng,2)"
    expression = symbol
    for _ in range(30):
        expression = ca.atan2(expression + 1, 2)
    engine.tie("C2", expression)
    assert len(engine["C2"].tie) == 60
    assert engine["C2"].tie.endswith("...")
