"""Names and near matches."""

import pytest

from casadi_engine.errors import ParameterError
from casadi_engine.parameters.names import check_name, near_matches


@pytest.mark.parametrize("name", ["J_eng", "K21", "coupling.coulomb_friction.torque", "_a", "ζ", "ω_0"])
def test_identifiers_and_dotted_ones_are_names(name):
    assert check_name(name) == name


@pytest.mark.parametrize(
    "name", ["", "2K", "a b", "a-b", "a..b", ".a", "a.", "C_eng@r1", "lambda", "a.if", "a\n"]
)
def test_other_texts_are_no_names(name, refused):
    with refused(
        ParameterError,
        "a parameter's name is not acceptable",
        seen=repr(name),
        allowed="identifiers joined by dots",
        cure="use letters, digits and _",
    ):
        check_name(name)


@pytest.mark.parametrize("name", [None, 3, ("a",)])
def test_a_name_is_text(name, refused):
    with refused(
        ParameterError, "name must be text", seen=str(name), allowed="identifiers", cure="in quotes"
    ):
        check_name(name)


@pytest.mark.parametrize("name", ["pi", "min", "tanh"])
def test_the_words_of_expressions_are_taken(name, refused):
    with refused(
        ParameterError,
        "taken by a function or constant of the expressions",
        seen=repr(name),
        allowed="any other name than abs, cos, exp",
        cure=f"call it {name}_",
    ):
        check_name(name)


def test_a_letter_that_expressions_read_as_another_is_refused(refused):
    micro, mu = "\u00b5", "\u03bc"
    with refused(
        ParameterError,
        "letters that expressions read as other letters",
        seen="U+00B5",
        allowed="normal form (NFKC)",
        cure=f"write it {mu!r}",
    ):
        check_name(micro)
    assert check_name(mu) == mu


def test_near_matches_ignore_case_and_typing_slips():
    names = ["J_eng", "J_load", "K_el", "C_el", "C_eng"]
    assert near_matches("j_ENG", names) == "J_eng, J_load, K_el, C_el, C_eng (nearest: J_eng, C_eng)"
    assert near_matches("K_e1", names).endswith("(nearest: K_el, C_el)")
    assert near_matches("zzz", names) == "J_eng, J_load, K_el, C_el, C_eng"
    assert near_matches(None, names) == "J_eng, J_load, K_el, C_el, C_eng"


def test_near_matches_of_names_that_differ_in_case_alone():
    assert near_matches("k", ["k1", "K", "k"]).endswith("(nearest: K, k, k1)")


def test_near_matches_cut_long_lists_and_name_empty_ones():
    names = [f"K{i}" for i in range(40)]
    text = near_matches("K39", names)
    assert "K11, … (28 more)" in text
    assert "nearest: K39" in text
    assert near_matches("a", []) == "(there are none)"
