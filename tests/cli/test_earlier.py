"""Values of an earlier result, put into the problem that it was made with."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import casadi_engine as ce
from casadi_engine.cli import earlier
from casadi_engine.cli.options import Options
from casadi_engine.errors import ResultError

ASKED = Options("validate", Path("problem.py"))


@pytest.fixture
def put(monkeypatch):
    """Puts stored values into the set of a problem."""
    b = ce.Blueprint("lag")
    k, x = b.parameter("k", 1.0, unit="1", min=0.1, max=10), b.state("x")
    b.ode("x", -k * x)
    b.output("y", x)
    own = b.model().parameters()

    def values(**stored):
        monkeypatch.setattr(
            earlier, "_stored", lambda _: {name: (value, "1") for name, value in stored.items()}
        )
        return earlier.values_of(Path("result.json"), own, given=ASKED)

    return values


def test_widths_of_jumps_that_a_repair_rounded_are_none_of_the_problems(put):
    """`validate --from` of a repair whose model has a sign was refused: "give the problem file that the result was made
    with", and that it was."""
    assert put(k=2.5, **{"corner_1.jump.width": 0.01})["k"].value == 2.5


def test_a_value_of_no_parameter_is_named(put):
    with pytest.raises(
        ResultError, match="the result has a parameter that the problem does not have; seen: width"
    ):
        put(k=2.5, width=0.01)


@pytest.mark.parametrize(
    ("other", "tie", "fine"), [(2.5, None, True), (3.0, None, False), (3.0, "2*c", True)]
)
def test_a_file_with_two_values_of_one_parameter_is_refused(monkeypatch, other, tie, fine):
    """An edited result.json gave one of its values without a word."""
    stored = {
        "parameters": {"k": {"value": 2.5, "unit": "1"}},
        "parameter_set": {"parameters": [{"name": "k", "value": other, "tie": tie}]},
    }
    monkeypatch.setattr(earlier, "_document", lambda _: stored)
    if fine:
        assert earlier._stored(Path("result.json")) == {"k": (2.5, "1")}
        return
    with pytest.raises(ResultError, match="the result holds two values of the parameter k") as caught:
        earlier._stored(Path("result.json"))
    assert "seen: 2.5 in parameters, 3 in parameter_set" in str(caught.value)


@pytest.mark.parametrize(
    ("command", "status", "told"),
    [
        ("fit", "interrupted", True),
        ("fit", "converged", False),
        ("repair", "answered", False),
        ("validate", "x", False),
    ],
)
def test_values_of_a_fit_that_did_not_end_are_said_to_be_none(monkeypatch, capsys, command, status, told):
    b = ce.Blueprint("lag")
    k, x = b.parameter("k", 1.0, unit="1", min=0.1, max=10), b.state("x")
    b.ode("x", -k * x)
    b.output("y", x)
    problem = ce.Problem(name="lag", goal="test", model=b.model(), parameters=b.model().parameters())
    stored = {"command": command, "status": status, "equations": earlier.equations_of(problem.model)}
    monkeypatch.setattr(earlier, "_document", lambda _: stored)
    earlier.as_repaired(Path("result.json"), problem)
    words = " ".join(capsys.readouterr().out.split())
    assert ("The fit of result.json did not end (interrupted): its values are no optimum" in words) is told


def test_a_result_that_knows_its_errors_is_held_with_them(here, call):
    """A right repair failed on a third record: its values had counted as exact, while `ce.validate` counts with their
    errors."""
    assert call("fit", "problem.py", "--out", "out").code == 0
    done = call("validate", "problem.py", "--from", "out", "--data", "fresh.csv", "--out", "held")
    assert done.code == 0, done.err
    assert "parameters agree with those of the fit within their errors" in done.out
    assert "exact" not in done.out + done.err
    assert "it tells nothing of fresh data" not in done.out + done.err
    moved = call(
        "validate",
        "problem.py",
        "--from",
        "out",
        "--data",
        "fresh.csv",
        "--out",
        "moved",
        "--set",
        "J_eng=0.9",
    )
    assert (
        "The values count as exact here, as the result does not tell all their errors"
        in moved.out + moved.err
    )


def test_the_file_of_the_fit_itself_is_no_fresh_data(here, call):
    call("fit", "problem.py", "--out", "out")
    done = call("validate", "problem.py", "--from", "out", "--data", "run.csv", "--out", "same")
    assert "was found from the measurement of run: it tells nothing of fresh data" in done.out + done.err


@pytest.mark.parametrize("change", ["stderr", "covariance", "negative", "undetermined", "unit"])
def test_what_the_file_does_not_tell_counts_as_exact(here, call, change):
    call("fit", "problem.py", "--out", "out")
    path = here / "out" / "result.json"
    stored = json.loads(path.read_text())
    name = stored["free"][0]
    if change == "stderr":
        stored["parameters"][name] |= {"stderr": None, "why": {"stderr": "not known"}}
    elif change == "covariance":
        stored["covariance"][0][0] = None
    elif change == "negative":
        stored["covariance"][0][0] *= -1
    elif change == "undetermined":
        stored["undetermined"] = [{"text": name, "weights": {name: 1.0}}]
    else:
        stored["parameters"][name]["unit"] = "g m2"
        stored["parameters"][name]["value"] *= 1000
        stored["parameter_set"] = None
    path.write_text(json.dumps(stored))
    done = call("validate", "problem.py", "--from", "out", "--data", "fresh.csv", "--out", "held")
    assert "count as exact" in done.out + done.err


@pytest.mark.parametrize("change", [{"covariance": "none"}, {"free": 3}])
def test_a_result_that_was_edited_to_something_else_is_refused(here, call, change):
    call("fit", "problem.py", "--out", "out")
    path = here / "out" / "result.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    done = call("validate", "problem.py", "--from", "out", "--data", "fresh.csv", "--out", "held")
    assert done.code == 2
    assert f"result.{next(iter(change))} does not fit the schema" in done.err


def test_an_error_that_is_none_is_refused(here, call):
    """One that had been edited to -1 "agreed within the errors"."""
    call("fit", "problem.py", "--out", "out")
    path = here / "out" / "result.json"
    stored = json.loads(path.read_text())
    name = stored["free"][0]
    stored["parameters"][name]["stderr"] = -1.0
    path.write_text(json.dumps(stored))
    done = call("validate", "problem.py", "--from", "out", "--data", "fresh.csv", "--out", "held")
    assert done.code == 2
    assert f"the standard error of {name} is not a positive number" in done.err
    assert "seen: -1.0" in done.err
    assert "do: take the file as the fit wrote it" in done.err
