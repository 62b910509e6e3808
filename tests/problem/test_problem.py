"""Problem: its checks, its records, and its changed copies."""

from __future__ import annotations

import dataclasses
import re

import pytest

from casadi_engine.errors import DataFileError, ParameterError, ProblemError
from casadi_engine.experiment import Experiment
from casadi_engine.model import Blueprint
from casadi_engine.parameters import Parameters
from casadi_engine.problem import Noise
from casadi_engine.problem.problem import record_keys


def experiment(name="demo"):
    return Experiment.from_arrays(name, time=[0.0, 1.0], units={"omega": "rad/s"}, omega=[1.0, 2.0])


def refused(make, *words, **changes):
    with pytest.raises(ProblemError) as caught:
        make(**changes)
    for word in words:
        assert word in str(caught.value)


def test_it_holds_a_frozen_copy_of_the_parameters(make):
    problem = make()
    with pytest.raises(ParameterError, match="frozen"):
        problem.parameters["J_eng"].set(0.2)
    with pytest.raises(dataclasses.FrozenInstanceError):
        problem.name = "other"


def test_defaults(make):
    problem = make()
    assert problem.records == problem.validation == ()
    assert problem.noise.outputs == ()
    assert (problem.interval, problem.loss, problem.ties, problem.method, problem.starts) == (
        "auto",
        "square",
        "substitute",
        "exact",
        1,
    )


def test_printed_on_one_screen(make):
    text = str(make(goal="\nFind J.\nMore.", records=["a/run.csv", experiment()]))
    assert text.startswith("demo: Find J.\n")
    assert "records     run.csv, demo\nvalidation  (none)" in text
    assert "J_eng" in text


@pytest.mark.parametrize("name", ["", "a b", "../x", "-a", "a" * 101, 3, None, "ä", "a\n", "a.b"])
def test_name_must_suit_a_folder(make, name):
    refused(make, "the problem's name is not acceptable", repr(name), "letters A-Z a-z", "folder", name=name)


@pytest.mark.parametrize(
    ("field", "value", "seen", "cure"),
    [
        ("goal", None, "NoneType", "goal=__doc__"),
        ("model", "two_mass", "str", "ce.two_mass()"),
        ("parameters", {"J_eng": 1.0}, "dict", "model.parameters()"),
        ("noise", 0.1, "float", 'ce.Noise(omega="estimate")'),
        ("initial", [1.0], "list", "initial={"),
    ],
)
def test_wrong_kinds(make, field, value, seen, cure):
    refused(make, f"the problem's {field} is of the wrong kind", seen, cure, **{field: value})


def test_read_must_be_a_function(make):
    refused(make, "read is not a function", "'path'", "path -> Experiment", "read_experiment", read="path")


def test_parameters_of_another_model(make):
    refused(make, "lack ones of the model", "without J_eng", "extended(model)", parameters=Parameters())


def test_names_of_noise_and_initial_states_must_exist(make):
    refused(make, "noise names an output", "'omga'", "nearest: omega", noise=Noise(omga=0.1))
    refused(make, "initial names a state", "'omega'", "omega_eng", "model.table()", initial={"omega": 1.0})
    refused(make, "initial names a state", "'speed'", initial={"run": {"speed": 1.0}})
    assert make(initial={"run": {"omega_eng": 1.0}}).initial == {"run": {"omega_eng": 1.0}}


@pytest.mark.parametrize("field", ["records", "validation"])
@pytest.mark.parametrize("value", [3, [None], ["a.csv", ""], [b"a.csv"]])
def test_records_must_be_paths_or_experiments(make, field, value):
    refused(make, f"an entry of the problem's {field} is not a record", "path", **{field: value})


def test_one_record_may_stand_without_a_list(make):
    assert make(records="run.csv").records == ("run.csv",)


# ---- reading


def test_records_are_read_only_when_needed(make, record):
    seen = []

    def read(path):
        seen.append(path)
        return experiment()

    problem = make(read=read, records=["a.csv"], validation=["b.csv"])
    assert seen == []
    assert [e.name for e in problem.load_records()] == ["demo"]
    assert seen == ["a.csv"]
    problem.load_validation()
    assert seen == ["a.csv", "b.csv"]


def test_record_keys_are_unique(make, record):
    problem = make(records=[record("run.csv"), record("x/run.csv"), experiment("run")])
    assert [e.name for e in problem.load_records()] == ["run", "run_2", "run_3"]
    assert make().load_validation() == ()


def test_keys_known_before_reading_are_those_after(make, record):
    for names in (["run.csv", "x/run.csv"], ["run.csv", "x/run.csv", "run_2.csv"], ["run_2.csv", "run.csv"]):
        files = [record(name) for name in names]
        assert record_keys(files) == tuple(e.name for e in make(records=files).load_records())


def test_no_records_is_an_error_with_its_cure(make):
    with pytest.raises(ProblemError, match=re.escape("demo has no records")) as caught:
        make().load_records()
    assert "--data FILE" in str(caught.value)


def test_errors_of_data_files_come_through(make):
    with pytest.raises(DataFileError, match="no such file"):
        make(records=["/nowhere/run.csv"]).load_records()


def test_read_that_fails_or_returns_something_else(make):
    def broken(path):
        return 1 / 0

    with pytest.raises(ProblemError) as caught:
        make(read=broken, records=["run.csv"]).load_records()
    text = str(caught.value)
    assert "read('run.csv') failed; seen: ZeroDivisionError: division by zero" in text
    assert "correct read" in text
    with pytest.raises(ProblemError) as caught:
        make(read=lambda path: None, records=["run.csv"]).load_records()
    assert "returned something else than an Experiment; seen: NoneType" in str(caught.value)


# ---- changed copies


def test_with_data_replaces_records_and_validation(make):
    problem = make(records=["a.csv"], validation=["b.csv"])
    assert problem.with_data() is problem
    one = problem.with_data(["c.csv"])
    assert (one.records, one.validation) == (("c.csv",), ())
    two = problem.with_data(["c.csv"], ["d.csv"])
    assert (two.records, two.validation) == (("c.csv",), ("d.csv",))
    three = problem.with_data(validate=["d.csv"])
    assert (three.records, three.validation) == (("a.csv",), ("d.csv",))
    assert (problem.records, problem.validation) == (("a.csv",), ("b.csv",))


def test_initial_states_of_other_records_are_left_out(make):
    initial = {"a": {"omega_eng": 1.0}, "b": {"omega_eng": 2.0}, "typo": {"omega_eng": 3.0}}
    problem = make(records=["a.csv"], validation=["b.csv"], initial=initial)
    # A name that no record of the problem has is kept, so that the estimation refuses it.
    assert set(problem.initial_of([experiment("a")])) == {"a", "typo"}
    assert set(problem.initial_of([experiment("b")])) == {"b", "typo"}
    assert set(problem.with_data(["c.csv"]).initial) == {"typo"}
    assert make().initial_of([experiment("a")]) is None
    plain = make(records=["a.csv"], initial={"omega_eng": "free"})
    assert plain.with_data(["c.csv"]).initial_of([experiment("c")]) == {"omega_eng": "free"}


def test_with_parameters(make):
    problem = make()
    pars = problem.parameters.copy()
    pars["J_eng"].set(0.2)
    assert problem.with_parameters(pars).parameters["J_eng"].value == 0.2
    with pytest.raises(ProblemError, match="wrong kind"):
        problem.with_parameters({})


def test_a_general_model_serves_too(make):
    b = Blueprint("decay")
    rate = b.parameter("rate", 1.0, unit="1/s")
    x = b.state("x", unit="1")
    b.ode("x", -rate * x)
    b.output("y", x, unit="1")
    model = b.model()
    assert make(model=model, parameters=model.parameters(), noise=Noise(y=0.1)).model is model
