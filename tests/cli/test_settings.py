"""--set, --free and --fix."""

from __future__ import annotations

import pytest

from casadi_engine.cli.settings import apply_settings
from casadi_engine.errors import ParameterError, TieError
from casadi_engine.parameters import Parameter, Parameters


@pytest.fixture
def pars():
    made = Parameters(
        [
            Parameter("J", 0.4, min=0.1, max=4),
            Parameter("C", 0.1, min=0, max=1),
            Parameter("m", 0.7, vary=False),
        ]
    )
    made.add("D", 0.2)
    made.tie("D", "C/2")
    return made


def test_all_three(pars):
    made = apply_settings(pars.frozen(), set=["J=0.5", "m = 7e-1"], free=["m"], fix=["C=0.25"])
    assert (made["J"].value, made["J"].vary) == (0.5, True)
    assert (made["m"].value, made["m"].vary) == (0.7, True)
    assert (made["C"].value, made["C"].vary) == (0.25, False)
    assert made["D"].value == 0.125
    assert pars["J"].value == 0.4  # the given set is as it was


def test_fix_at_its_value_also_after_set(pars):
    made = apply_settings(pars, set=["J=0.6"], fix=["J"])
    assert (made["J"].value, made["J"].vary) == (0.6, False)


@pytest.mark.parametrize("text", ["J", "J:0.5", "=0.5", ""])
def test_set_of_another_form(pars, text):
    with pytest.raises(ParameterError) as caught:
        apply_settings(pars, set=[text])
    assert f"--set is not of the form NAME=VALUE; seen: {text!r}" in str(caught.value)
    assert "write for instance --set J=0.4" in str(caught.value)


@pytest.mark.parametrize("text", ["J=", "J=half", "J=0,5", "J=0.5 kg", "J=__import__('os')", "J==1"])
def test_values_that_are_no_number(pars, text):
    for option in ("set", "fix"):
        with pytest.raises(ParameterError) as caught:
            apply_settings(pars, **{option: [text]})
        assert f"the value of --{option} is not a number; seen: {text!r}" in str(caught.value)
        assert "decimal point" in str(caught.value)


@pytest.mark.parametrize("options", [{"set": ["j=1"]}, {"free": ["j"]}, {"fix": ["j"]}, {"fix": ["j=1"]}])
def test_unknown_names_with_their_nearest(pars, options):
    with pytest.raises(ParameterError, match="nearest: J"):
        apply_settings(pars, **options)


@pytest.mark.parametrize("value", ["9", "nan", "inf", "-1e400"])
def test_values_outside_the_bounds(pars, value):
    with pytest.raises(ParameterError, match="parameter J"):
        apply_settings(pars, set=[f"J={value}"])


def test_tied_parameters(pars):
    for options in ({"set": ["D=1"]}, {"free": ["D"]}, {"fix": ["D"]}):
        with pytest.raises(TieError, match="D == C/2"):
            apply_settings(pars, **options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"set": ["J=1", "J=2"]}, "--set names a parameter twice; seen: J"),
        ({"free": ["J", "J"]}, "--free names a parameter twice; seen: J"),
        ({"fix": ["J", "J=2"]}, "--fix names a parameter twice; seen: J"),
        ({"free": ["J"], "fix": ["J"]}, "--free and --fix name the same parameter; seen: J"),
        ({"set": ["J=1"], "fix": ["J=2"]}, "--set and --fix name the same parameter; seen: J"),
    ],
)
def test_contradictions(pars, options, words):
    with pytest.raises(ParameterError) as caught:
        apply_settings(pars, **options)
    assert words in str(caught.value)
    assert "leave one" in str(caught.value)
