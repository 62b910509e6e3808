"""Linear constraints that cannot be met are proved so; all others are left to the solver."""

import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from casadi_engine.errors import ConstraintError, ParameterError
from casadi_engine.parameters import Parameters, compile


def boxed(low=0.0, high=1.0, names="ab", start=0.5):
    pars = Parameters()
    for name in names:
        pars.add(name, start, min=low, max=high)
    return pars


def test_one_constraint_out_of_reach_is_named(refused):
    pars = boxed()
    pars.constrain("a + b", 0, 1)
    pars.constrain("2*a - b", 2.5, 5, name="far")
    with refused(
        ConstraintError,
        "the constraint far cannot be met within the bounds of its parameters",
        seen="it can be -1 to 2 at most",
        allowed="2.5 to 5",
        cure="widen the bounds",
    ):
        compile(pars, "ab")


def test_one_sided_and_unbounded_parameters():
    pars = Parameters()
    pars.add("a", 1.0, min=0)
    pars.add("b", 1.0)
    pars.constrain("a", max=-1)
    with pytest.raises(ConstraintError, match="it can be 0 to inf at most; allowed: -inf to -1"):
        compile(pars, "ab")
    pars = Parameters()
    pars.add("a", 1.0, min=0)
    pars.add("b", 1.0)
    pars.constrain("a + b", max=-1)
    compile(pars, "ab")


def test_constraints_that_contradict_each_other(refused):
    pars = boxed(high=10)
    pars.constrain("a + b", 4)
    pars.constrain("a - b", 0, 0, name="equal")
    pars.constrain("a + 2*b", max=5)
    with refused(
        ConstraintError,
        "the constraints cannot be met together within the bounds",
        seen="a + b >= 4; equal = 0; a + 2*b <= 5",
        allowed="some values",
        cure="take out or widen one",
    ):
        compile(pars, "ab")


def test_a_start_outside_a_constraint_is_fine():
    pars = boxed(high=10)
    pars.constrain("a + b", 4)
    pars.constrain("a - b", 1, 1)
    assert len(compile(pars, "ab").constraints) == 2


@pytest.mark.parametrize("expression", ["a**2 + b**2", "sqrt(a - 1)", "log(a - b)", "min(a, b)"])
def test_nonlinear_constraints_are_left_to_the_solver(expression):
    pars = boxed()
    pars.constrain(expression, 50)
    assert len(compile(pars, "ab").constraints) == 1


def test_linear_ones_among_nonlinear_ones_are_judged():
    pars = boxed()
    pars.constrain("a**2", 50)
    pars.constrain("a + b", 1.5)
    pars.constrain("a - b", 0.6)
    with pytest.raises(ConstraintError, match=r"together .* seen: a \+ b >= 1.5; a - b >= 0.6;"):
        compile(pars, "ab")


def test_a_tie_counts():
    pars = boxed()
    pars.tie("b", "a/2")
    pars.constrain("a + b", 1.6)
    for ties in ("substitute", "constraint"):
        with pytest.raises(ConstraintError, match="cannot be met"):
            compile(pars, "ab", ties=ties)


def test_touching_the_bounds_is_possible():
    pars = boxed()
    pars.constrain("a + b", 2)
    pars.constrain("a - b", 0, 0)
    assert len(compile(pars, "ab").constraints) == 2


def test_magnitudes_far_apart():
    pars = Parameters()
    pars.add("K", 1e5, min=1e4, max=1e6)
    pars.add("J", 1e-3, min=1e-4, max=1e-2)
    pars.constrain("J", 2e-3)
    pars.constrain("K - 1e8*J", 0, 0)
    compile(pars, "KJ")
    pars.constrain("J - 1e-8*K", 1e-5)
    with pytest.raises(ConstraintError, match="together"):
        compile(pars, "KJ")


def test_the_linear_program_is_asked_only_when_needed(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.optimize", None)  # any import of it fails
    pars = boxed()
    pars.constrain("a + b", 0.5)
    pars.constrain("a - b", 0, 0)
    compile(pars, "ab")


number = st.integers(-4, 4)


@given(st.lists(st.tuples(number, number, number, st.integers(0, 3)), min_size=1, max_size=4))
@settings(max_examples=60, deadline=None)
def test_the_verdict_is_that_of_a_linear_program(rows):
    pars = boxed(low=-1.0, high=2.0, start=0.0)
    matrix, limit = [], []
    for a, b, low, width in rows:
        if a == b == 0:
            continue
        pars.constrain(f"{a}*a + {b}*b", low, low + width)
        matrix += [[a, b], [-a, -b]]
        limit += [low + width, -low]
    if not matrix:
        return
    answer = linprog([0, 0], A_ub=matrix, b_ub=limit, bounds=[(-1, 2)] * 2, method="highs")
    if answer.status == 2:
        with pytest.raises(ConstraintError, match="cannot be met"):
            compile(pars, "ab")
    else:
        compile(pars, "ab")


@pytest.mark.parametrize(("mean", "out"), [(5.4, False), (5.6, True), (-0.4, False), (-0.6, True)])
def test_a_prior_that_lies_outside_the_bounds_is_refused(refused, mean, out):
    pars = boxed(0.0, 5.0, "a")
    pars["a"].set(prior=(mean, 0.1))
    if not out:
        compile(pars, ("a",), ("r",))
        return
    with refused(
        ParameterError,
        "the prior of a lies outside its bounds",
        seen=f"{mean:g} ± 0.1, where bounds leave 0 to 5",
        allowed="within 5 of its standard deviations",
        cure="widen the bounds, or correct the prior",
    ):
        compile(pars, ("a",), ("r",))


def test_a_prior_of_what_hangs_on_a_fixed_parameter_is_a_number_that_is_added():
    """A profile holds a parameter where its prior does not have it, and what is tied to it goes along."""
    pars = boxed(0.0, 5.0, "abc")
    pars.tie("b", "2*a")
    pars["b"].set(prior=(0.1, 0.01))
    pars.fix("a", 1.0)
    assert compile(pars, ("a", "b", "c"), ("r",)).free == ("c",)


def test_bounds_of_one_ratio_that_have_nothing_in_common_are_refused(refused):
    """Two ranges of a ratio had been searched for, and other starts advised."""
    pars = boxed(0.1, 50.0, "ab", start=3.0)
    pars.constrain("a/b", 1, 100)
    pars.constrain("a / b", min=50)
    compile(pars, "ab")
    pars.constrain("a/b", 1000, 2000)
    with refused(
        ConstraintError,
        "two constraints on a/b cannot be met together",
        seen="1 to 100, and 1000 to 2000",
        allowed="values in common",
        cure="both sides in one call",
    ):
        compile(pars, "ab")
