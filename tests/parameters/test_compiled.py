"""The map from a set to the estimated vector."""

import dataclasses
import math
import time

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.errors import ConstraintError, ParameterError, TieError
from casadi_engine.parameters import ParameterMap, Parameters, compile

MODEL = ("J_eng", "J_load", "K_el", "C_el", "C2")


def ready(engine):
    """The two-mass set as users set it: C2 tied to the auxiliary C_eng."""
    engine.tie("C2", "C_eng/4")
    return engine


def at(map_: ParameterMap, expression, z):
    return ca.Function("g", [map_.z], [expression])(z).full().ravel()


def test_a_plain_set(engine):
    engine.fix("C_eng")
    map_ = compile(engine, ("K_el", "J_eng", "J_load", "C_el", "C2"))
    assert map_.free == ("J_eng", "J_load", "K_el")
    assert map_.start.tolist() == map_.scale.tolist() == [0.39, 0.5, 1e4]
    assert map_.lower.tolist() == [0.05, 0.05, 0.0]
    assert map_.upper.tolist() == [4.0, 4.0, math.inf]
    assert map_.z.shape == (3, 1)
    assert [s.name() for s in ca.symvar(map_.z)] == list(map_.free)
    assert tuple(map_.physical) == ("",)
    assert map_.physical[""].shape == (5, 1)
    assert map_.unpack([1, 2, 3]).tolist() == [3.0, 1.0, 2.0, 3.0, 0.04]
    assert map_.reported == engine.names
    assert map_.reported_expressions.shape == (6, 1)
    assert map_.values(map_.start) == engine.as_dict()
    assert map_.constraints == map_.frequency_constraints == map_.priors == ()
    assert map_.records == ("",)
    assert map_.names[0] == "K_el"


def test_the_map_cannot_be_changed(engine):
    engine.fix("C_eng")
    map_ = compile(engine, MODEL)
    for array in (map_.start, map_.lower, map_.upper, map_.scale):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    with pytest.raises(TypeError):
        map_.physical[""] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        map_.free = ()
    engine["J_eng"].set(3.0)
    assert map_.start[0] == 0.39


@pytest.mark.parametrize(
    ("value", "low", "high", "scale"),
    [(-3, -math.inf, math.inf, 3), (0, -1, 4, 1), (0, 0, math.inf, 1), (0, -math.inf, math.inf, 1)],
)
def test_scale_is_the_magnitude_of_the_start(value, low, high, scale):
    pars = Parameters()
    pars.add("a", value, min=low, max=high)
    assert compile(pars, ["a"]).scale.tolist() == [scale]


def test_nothing_free_gives_an_empty_vector(engine):
    for name in engine:
        engine.fix(name)
    map_ = compile(engine, MODEL)
    assert map_.free == ()
    assert map_.z.shape == (0, 1)
    assert map_.start.shape == (0,)
    assert map_.unpack([]).tolist() == [0.39, 0.5, 1e4, 3.0, 0.04]
    assert map_.values(()) == engine.as_dict()


def test_a_model_without_parameters():
    map_ = compile(Parameters(), ())
    assert map_.physical[""].shape == (0, 1)
    assert map_.values([]) == {}
    assert map_.unpack([]).shape == (0,)


def test_a_tie_to_an_auxiliary_parameter(engine):
    map_ = compile(ready(engine), MODEL)
    assert map_.free == ("J_eng", "J_load", "K_el", "C_eng")
    assert map_.unpack([1, 1, 1, 8])[4] == 2.0
    assert map_.values([1, 1, 1, 8])["C2"] == 2.0


def test_a_tie_to_a_fixed_parameter_is_a_number(engine):
    engine.fix("C_eng", 0.8)
    for ties in ("substitute", "constraint"):
        map_ = compile(ready(engine), MODEL, ties=ties)
        assert map_.free == ("J_eng", "J_load", "K_el")
        assert map_.physical[""][4].is_constant()
        assert map_.unpack(map_.start)[4] == pytest.approx(0.2)
        assert map_.constraints == ()


def test_ties_as_constraints(engine):
    map_ = compile(ready(engine), MODEL, ties="constraint")
    assert map_.free == ("J_eng", "J_load", "K_el", "C_eng", "C2")
    assert map_.start[-1] == pytest.approx(0.04)
    assert (map_.lower[-1], map_.upper[-1]) == (0.0, math.inf)
    (tie,) = map_.constraints
    assert (tie.label, tie.min, tie.max) == ("C2 == C_eng/4", 0.0, 0.0)
    assert at(map_, tie.expression, map_.start) == pytest.approx([0.0], abs=1e-15)
    assert at(map_, tie.expression, [1, 1, 1, 0.16, 0.08]) == pytest.approx([1.0])  # in units of 0.04
    assert map_.unpack([1, 1, 1, 8, 9])[4] == 9.0


def test_the_start_of_a_tied_entry_is_within_its_bounds(engine):
    ready(engine)["C2"].set(min=0.1)
    map_ = compile(engine, MODEL, ties="constraint")
    assert map_.start[-1] == 0.1


def chain():
    pars = Parameters()
    for name, value in {"a": 2.0, "b": 1.0, "c": 1.0, "d": 1.0, "f": 5.0}.items():
        pars.add(name, value)
    pars.fix("f")
    pars.tie("d", "2*c + a")
    pars.tie("c", "b*f")
    pars.tie("b", "a**2")
    return pars


def test_chains_of_ties():
    pars = chain()
    map_ = compile(pars, "abcd")
    assert map_.free == ("a",)
    assert map_.unpack([3.0]).tolist() == [3.0, 9.0, 45.0, 93.0]
    other = compile(pars, "abcd", ties="constraint")
    assert other.free == ("a", "b", "c", "d")
    assert [c.label for c in other.constraints] == ["b == a**2", "c == b*f", "d == 2*c + a"]
    slope = ca.Function(
        "J", [other.z], [ca.jacobian(ca.vertcat(*(c.expression for c in other.constraints)), other.z)]
    )
    assert (slope(other.start).full() != 0).tolist() == [  # each tie sees its own neighbours alone
        [True, True, False, False],
        [False, True, True, False],
        [True, False, True, True],
    ]


@given(
    a=st.floats(-5, 5),
    low=st.floats(-30, -20),
    seed=st.integers(0, 2**31),
    varying=st.booleans(),
)
@settings(max_examples=40, deadline=None)
def test_both_treatments_of_ties_agree(a, low, seed, varying):
    """Where the tie equalities hold, the two maps give the same model, report, constraints and priors."""
    pars = chain()
    pars["a"].set(a)
    pars["b"].set(min=low, max=1e4, prior=(1.0, 2.0))
    pars.constrain("a*d + c", -1e6, 1e6)
    if varying:
        pars.vary_by_experiment("a")
    records = ("r1", "r2")
    one = compile(pars, "abcdf", records)
    two = compile(pars, "abcdf", records, ties="constraint")
    z = np.random.default_rng(seed).uniform(-4, 4, len(one.free))
    values = one.values(z)
    full = [values[name] for name in two.free]
    assert two.values(full) == pytest.approx(values)
    for record in records:
        np.testing.assert_allclose(two.unpack(full, record), one.unpack(z, record), rtol=1e-12)
    labels = {c.label: c for c in two.constraints}
    for constraint in one.constraints:
        expected = at(one, constraint.expression, z)
        if "(tied)" in constraint.label:  # there it is a bound of an entry
            index = two.free.index(constraint.label.removesuffix(" (tied)"))
            assert (two.lower[index], two.upper[index]) == (constraint.min, constraint.max)
            assert full[index] == pytest.approx(expected[0])
        else:
            np.testing.assert_allclose(
                at(two, labels.pop(constraint.label).expression, full), expected, rtol=1e-9
            )
    for name, constraint in labels.items():
        assert " == " in name
        np.testing.assert_allclose(at(two, constraint.expression, full), 0.0, atol=1e-6)
    for p, q in zip(one.priors, two.priors, strict=True):
        assert p.label == q.label
        np.testing.assert_allclose(at(two, q.expression, full), at(one, p.expression, z), rtol=1e-12)


# ---- per experiment --------------------


def test_parameters_that_vary_by_experiment(engine):
    engine.vary_by_experiment("C_eng", "J_eng")
    map_ = compile(ready(engine), MODEL, ("r1", "r2"))
    assert map_.free == ("J_load", "K_el", "J_eng@r1", "J_eng@r2", "C_eng@r1", "C_eng@r2")
    z = [1, 2, 3, 4, 5, 6]
    assert map_.unpack(z, "r1").tolist() == [3.0, 1.0, 2.0, 3.0, 1.25]
    assert map_.unpack(z, "r2").tolist() == [4.0, 1.0, 2.0, 3.0, 1.5]
    assert map_.unpack(z).tolist() == map_.unpack(z, "r1").tolist()
    assert map_.reported == (
        "J_eng@r1", "J_eng@r2", "J_load", "K_el", "C_el", "C2@r1", "C2@r2", "C_eng@r1", "C_eng@r2",
    )  # fmt: skip
    assert map_.values(z)["C2@r2"] == 1.5


def test_a_tie_of_a_tie_with_one_value_per_record():
    pars = chain()
    pars.vary_by_experiment("a")
    map_ = compile(pars, "abcd", ("r1", "r2"), ties="constraint")
    assert map_.free == ("a@r1", "a@r2", "b@r1", "b@r2", "c@r1", "c@r2", "d@r1", "d@r2")
    assert [c.label for c in map_.constraints][:2] == ["b@r1 == a**2", "b@r2 == a**2"]
    assert map_.values(map_.start)["f"] == 5.0
    assert compile(pars, "abcd", ("r1", "r2")).unpack([1, 3], "r2").tolist() == [3.0, 9.0, 45.0, 93.0]


def test_a_single_record_without_a_name_keeps_plain_names(engine):
    engine.vary_by_experiment("C_eng")
    map_ = compile(ready(engine), MODEL)
    assert map_.free == ("J_eng", "J_load", "K_el", "C_eng")
    assert map_.reported == engine.names


def test_records_share_expressions_when_nothing_varies(engine):
    map_ = compile(ready(engine), MODEL, ("r1", "r2", "r3"))
    assert map_.free == ("J_eng", "J_load", "K_el", "C_eng")
    assert tuple(map_.physical) == ("r1", "r2", "r3")
    assert map_.unpack([1, 2, 3, 4], "r3").tolist() == [1.0, 2.0, 3.0, 3.0, 1.0]


def test_constraints_hold_for_every_record(engine):
    engine.vary_by_experiment("C_eng")
    ready(engine).constrain("C2 + J_eng", 0, 3)
    engine.constrain("J_eng - J_load", max=0, name="order")
    engine["C2"].set(min=0.01, max=2)
    engine["C_eng"].set(prior=(0.2, 0.1))
    map_ = compile(engine, MODEL, ("r1", "r2"))
    assert [c.label for c in map_.constraints] == [
        "C2 + J_eng@r1", "C2 + J_eng@r2", "order", "C2@r1 (tied)", "C2@r2 (tied)",
    ]  # fmt: skip
    z = [1, 2, 3, 4, 8]
    assert [at(map_, c.expression, z)[0] for c in map_.constraints] == [2.0, 3.0, -1.0, 1.0, 2.0]
    assert [(p.label, p.mean, p.sigma) for p in map_.priors] == [
        ("C_eng@r1", 0.2, 0.1),
        ("C_eng@r2", 0.2, 0.1),
    ]


# ---- constraints and priors --------------------


def test_finite_bounds_of_a_tied_parameter_become_a_constraint(engine):
    ready(engine)["C2"].set(min=0.01)
    map_ = compile(engine, MODEL)
    (bound,) = map_.constraints
    assert (bound.label, bound.min, bound.max) == ("C2 (tied)", 0.01, math.inf)
    assert at(map_, bound.expression, [1, 1, 1, 8]) == [2.0]
    engine["C2"].set(min=0.0)  # that of C_eng implies it
    assert compile(engine, MODEL).constraints == ()


def test_priors_of_fixed_parameters_are_constant_and_left_out(engine):
    engine["J_eng"].set(prior=(0.4, 0.1))
    engine["C_el"].set(prior=(3, 1))
    ready(engine)["C2"].set(prior=(0.05, 0.01))
    map_ = compile(engine, MODEL)
    assert [(p.label, p.mean, p.sigma) for p in map_.priors] == [("J_eng", 0.4, 0.1), ("C2", 0.05, 0.01)]
    assert at(map_, map_.priors[1].expression, [1, 1, 1, 8]) == [2.0]


def test_frequency_constraints_pass_through(engine):
    ready(engine).constrain_frequency(1, 40, 60)
    assert compile(engine, MODEL).frequency_constraints == engine.frequency_constraints


def test_a_constraint_on_fixed_parameters_is_checked_at_once(engine, refused):
    ready(engine).constrain("2*C_el", 5.0, 6.0)
    assert compile(engine, MODEL).constraints == ()
    engine.constrain("C_el**2", 10, name="stiff")
    with refused(
        ConstraintError,
        "the constraint stiff cannot be met, for all its parameters are fixed",
        seen="9",
        allowed="10 to inf",
        cure="free one of its parameters",
    ):
        compile(engine, MODEL)
    engine.free("C_el")
    compile(engine, MODEL)


def test_fixed_equalities_allow_for_rounding():
    pars = Parameters()
    pars.add("a", 0.1, vary=False)
    pars.constrain("a + 0.2", 0.3, 0.3)
    assert compile(pars, ["a"]).constraints == ()
    pars.constrain("a - 0.1", 0, 0)
    assert compile(pars, ["a"]).constraints == ()


def test_bounds_of_a_tied_parameter_on_fixed_ones_are_checked_at_once(engine, refused):
    engine.fix("C_eng", 0.8)
    ready(engine)["C2"].set(max=0.1)
    with refused(
        ConstraintError,
        "the constraint C2 (tied) cannot be met",
        seen="0.2",
        allowed="0 to 0.1",
        cure="change what C2 is tied to, or its bounds",
    ):
        compile(engine, MODEL)


@pytest.mark.parametrize("ties", ["substitute", "constraint"])
def test_tied_bounds_that_cannot_be_met(ties, engine):
    engine["C_eng"].set(max=1.0)
    ready(engine)["C2"].set(min=0.5)
    with pytest.raises(ConstraintError, match="cannot be met"):
        compile(engine, MODEL, ties=ties)


# ---- errors --------------------


def test_a_model_name_that_the_set_lacks(engine, refused):
    with refused(ParameterError, "unknown parameter", seen="'K_21'", allowed="J_eng", cure="add(...)"):
        compile(engine, ("J_eng", "K_21"))


def test_a_free_parameter_without_effect(engine, refused):
    engine.add("lost", 1.0)
    with refused(
        ParameterError,
        "free parameters without effect: neither the model nor a tie uses them",
        seen="C_eng, lost",
        allowed="the model, a constraint or a prior",
        cure='fix("C_eng")',
    ):
        compile(engine, MODEL)
    ready(engine)
    engine["lost"].set(prior=(1, 1))
    assert "lost" in compile(engine, MODEL).free
    engine["lost"].set(prior=())
    engine.constrain("lost - J_eng - J_load", 0, 0)
    assert "lost" in compile(engine, MODEL).free


@pytest.mark.parametrize("records", [(), ("a", "a"), "abc"])
def test_records_are_different_names(records, engine, refused):
    with refused(
        ParameterError,
        "the records that parameters are compiled for",
        seen=repr(records),
        allowed="at least one name, each once",
        cure="a tuple of different",
    ):
        compile(ready(engine), MODEL, records)


def test_ties_are_substituted_or_constraints(engine, refused):
    with refused(
        ParameterError,
        "unknown treatment of ties",
        seen="'keep'",
        allowed="substitute or constraint",
        cure="give one of the two",
    ):
        compile(ready(engine), MODEL, ties="keep")


@pytest.mark.parametrize(("tie", "value"), [("log(C_eng - 1)", "nan"), ("1/(C_eng - 0.16)", "inf")])
def test_a_tie_without_a_finite_start(tie, value, engine, refused):
    engine.tie("C2", tie)
    with refused(
        TieError,
        "the tie of C2 gives no finite number at the start values",
        seen=f"C2 == {tie} = {value}",
        allowed="a finite number",
        cure="change the start values",
    ):
        compile(engine, MODEL)


def test_unknown_records_and_wrong_lengths(engine, refused):
    map_ = compile(ready(engine), MODEL, ("run_1", "run_2"))
    with refused(
        ParameterError,
        "unknown record",
        seen="'run1'",
        allowed="run_1, run_2 (nearest: run_1",
        cure="compiled for",
    ):
        map_.unpack(map_.start, "run1")
    for function in (map_.values, map_.unpack):
        with refused(
            ParameterError,
            "the vector of free parameters has the wrong length",
            seen="2 numbers",
            allowed="4: J_eng, J_load, K_el, C_eng",
            cure="in its order",
        ):
            function([1, 2])


def test_errors_propagate_through_ties(engine):
    """The Jacobian of the report carries the covariance to tied parameters."""
    map_ = compile(ready(engine), MODEL)
    jacobian = ca.Function("J", [map_.z], [ca.jacobian(map_.reported_expressions, map_.z)])(map_.start).full()
    rows = dict(zip(map_.reported, jacobian.tolist(), strict=True))
    assert rows["C2"] == [0.0, 0.0, 0.0, 0.25]
    assert rows["C_el"] == [0.0] * 4


def test_compile_is_quick():
    """A fit is to take 50 ms: the best of many compilations of five free parameters takes a few."""
    pars = Parameters()
    for index in range(5):
        pars.add(f"p{index}", 1.0 + index, min=0)
    best = math.inf
    for _ in range(20):
        fresh = pars.copy()
        fresh["p0"].set(2.0)
        begin = time.process_time()
        compile(fresh, fresh.names)
        best = min(best, time.process_time() - begin)
    assert best < 6e-3


@pytest.mark.parametrize("ties", ["substitute", "constraint"])
def test_a_tie_to_numbers_alone(ties, engine):
    engine.tie("C2", "2*pi")
    engine.fix("C_eng")
    map_ = compile(engine, MODEL, ("r1", "r2"), ties=ties)
    assert map_.free == ("J_eng", "J_load", "K_el")
    assert map_.unpack(map_.start, "r2")[4] == 2 * math.pi


def test_a_tied_parameter_has_no_bounds_beyond_those_that_imply_them():
    """A fit of two equal halves with the same bounds was one with a constraint, and searched as such: 5 of 30 ended in
    a wrong optimum."""
    pars = Parameters()
    pars.add("half", 1.0, min=0.1, max=4.0)
    pars.add("other", 1.0, min=0.0, max=10.0)
    pars.add("third", 1.0, min=0.0, max=np.inf)
    pars.add("free", 1.0)
    for name, tie, low, high, kept in (
        ("same", "half", 0.1, 4.0, False),
        ("wider", "2*half - other", -20.0, 10.0, False),
        ("tighter", "2*half - other", -5.0, 10.0, True),
        ("positive", "half + third", 0.0, np.inf, False),
        ("above", "half + third", 0.0, 50.0, True),
        ("without", "free + half", 0.0, np.inf, True),
        ("bent", "half*other", 0.0, 40.0, True),
    ):
        one = pars.copy()
        one.add(name, 1.0, min=low, max=high)
        one.tie(name, tie)
        found = [each.label for each in compile(one, (name, "half", "other", "third", "free")).constraints]
        assert found == ([f"{name} (tied)"] if kept else []), name
