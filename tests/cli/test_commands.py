"""The commands in this process: answers, exit codes, and one message on standard error for every fault."""

from __future__ import annotations

import dataclasses
import json
import os

import pytest

from casadi_engine import estimation
from casadi_engine.errors import NotConvergedError
from casadi_engine.experiment import read_experiment
from casadi_engine.report import load_result

pytestmark = pytest.mark.usefixtures("here", "quick_report")


def stored(folder):
    return json.loads((folder / "result.json").read_text())


def files(folder="."):
    return sorted(os.listdir(folder))


UNTOUCHED = ["fresh.csv", "problem.py", "run.csv"]


# ---- answered


def test_fit_answers(here, call):
    done = call("fit", "problem.py", "--seed", 3)
    assert (done.code, done.err) == (0, "")
    folder = here / "results" / "run_up-fit"
    assert files(folder) == ["report.html", "result.json"]
    for words in ("converged", "J_eng", "Written: ", os.path.join("results", "run_up-fit", "result.json")):
        assert words in done.out
    result = stored(folder)
    assert (result["command"], result["status"], result["seed"]) == ("fit", "converged", 3)
    assert result["arguments"]["problem"] == "problem.py"
    assert 0 < result["seconds"] < 60
    assert abs(result["parameters"]["J_eng"]["value"] - 0.4) < 5 * result["parameters"]["J_eng"]["stderr"]
    assert list(result["fit_percent"]) == ["run"]
    assert result["validation"]["passed"] in (True, False)
    assert list(result["validation"]["records"]) == ["fresh"]
    load_result(folder)  # the published schema holds


def test_options_reach_the_fit(here, call):
    done = call(
        "fit",
        "problem.py",
        "--data",
        "fresh.csv",
        "--data",
        "run.csv",
        "--fix",
        "C_eng=0.5",
        "--set",
        "J_eng=0.7",
        "--out",
        "there/it/is",
    )
    assert done.code == 0
    result = stored(here / "there" / "it" / "is")
    assert result["parameters"]["C_eng"]["value"] == 0.5
    assert result["parameters"]["C_eng"]["vary"] is False
    assert result["start"] == {"J_eng": 0.7}
    assert list(result["fit_percent"]) == ["fresh", "run"]
    # --data took the problem's validation records away: the tests are those of the fitted records.
    assert list(result["validation"]["records"]) == ["fresh", "run"]
    assert result["arguments"]["data"] == ["fresh.csv", "run.csv"]
    assert result["arguments"]["fix"] == ["C_eng=0.5"]


def test_a_second_run_replaces_the_first(here, call):
    call("fit", "problem.py", "--out", "out")
    call("fit", "problem.py", "--out", "out", "--fix", "C_eng=0.5")
    assert stored(here / "out")["parameters"]["C_eng"]["value"] == 0.5
    assert files("out") == ["report.html", "result.json"]


def test_simulate_writes_data_files(here, call):
    done = call(
        "simulate", "problem.py", "--set", "J_eng=0.4", "--set", "C_eng=0.5", "--validate", "fresh.csv"
    )
    assert (done.code, done.err) == (0, "")
    folder = here / "results" / "run_up-simulate"
    assert files(folder) == ["fresh.csv", "report.html", "result.json", "run.csv"]
    assert stored(folder)["files"] == ["run.csv", "fresh.csv"]
    assert os.path.join("run_up-simulate", "fresh.csv") in done.out
    simulated, measured = read_experiment(folder / "run.csv"), read_experiment("run.csv")
    assert abs(simulated["omega"].values - measured["omega"].values).max() < 0.3
    load_result(folder)
    # A simulated file is a record like any other.
    assert call("fit", "problem.py", "--data", folder / "run.csv", "--out", "again").code == 0


def test_simulate_takes_its_own_old_files_away(here, call, quick_report):
    """A reused folder holds what the last run says it holds, and files of others."""
    call("simulate", "problem.py", "--validate", "fresh.csv", "--out", "again")
    (here / "again" / "mine.csv").write_text("time [s]\n")
    assert files("again") == ["fresh.csv", "mine.csv", "report.html", "result.json", "run.csv"]
    assert call("simulate", "problem.py", "--data", "fresh.csv", "--out", "again").code == 0
    assert files("again") == ["fresh.csv", "mine.csv", "report.html", "result.json"]
    assert stored(here / "again")["files"] == ["fresh.csv"]


def test_validate_keeps_the_values(here, call):
    done = call("validate", "problem.py", "--set", "J_eng=0.4", "--set", "C_eng=0.5")
    assert (done.code, done.err) == (0, "")
    result = stored(here / "results" / "run_up-validate")
    assert list(result["records"]) == ["fresh"]
    assert result["parameters"]["J_eng"]["value"] == 0.4
    assert result["parameters"]["J_eng"]["stderr"] is None
    assert result["passed"] is True
    load_result(here / "results" / "run_up-validate")


def test_validate_from_an_earlier_fit(here, call):
    call("fit", "problem.py")
    value = stored(here / "results" / "run_up-fit")["parameters"]["J_eng"]["value"]
    done = call("validate", "problem.py", "--from", "results/run_up-fit", "--set", "C_eng=0.5")
    assert done.code == 0
    result = stored(here / "results" / "run_up-validate")
    assert result["parameters"]["J_eng"]["value"] == value
    assert result["parameters"]["C_eng"]["value"] == 0.5
    assert result["arguments"]["from"] == "results/run_up-fit"


def test_values_that_were_found_with_other_equations_come_with_a_word(here, call):
    call("fit", "problem.py")
    file = here / "results" / "run_up-fit" / "result.json"
    assert "equations" not in call("simulate", "problem.py", "--from", str(file)).out
    found = json.loads(file.read_text())
    file.write_text(json.dumps(found | {"equations": "0" * 64}))
    for command in ("simulate", "validate"):
        said = " ".join(call(command, "problem.py", "--from", str(file)).out.split())
        assert "The equations of one_inertia are not those that" in said
        assert "its values may mean something else here" in said


def test_simulate_from_an_earlier_fit(here, call):
    call("fit", "problem.py")
    value = stored(here / "results" / "run_up-fit")["parameters"]["J_eng"]["value"]
    done = call("simulate", "problem.py", "--from", "results/run_up-fit", "--set", "C_eng=0.5")
    assert (done.code, done.err) == (0, "")
    result = stored(here / "results" / "run_up-simulate")
    assert result["parameters"]["J_eng"]["value"] == value
    assert result["parameters"]["C_eng"]["value"] == 0.5
    assert result["arguments"]["from"] == "results/run_up-fit"
    plain = call("simulate", "problem.py", "--out", "plain")
    assert plain.code == 0
    runs = [
        read_experiment(f / "run.csv")["omega"].values
        for f in (here / "results" / "run_up-simulate", here / "plain")
    ]
    assert abs(runs[0] - runs[1]).max() > 1e-3
    missing = call("simulate", "problem.py", "--from", "nowhere.json", "--out", "none")
    assert missing.code == 2
    assert "nowhere.json: no such file" in missing.err
    assert not (here / "none").exists()


def test_validate_may_estimate_what_is_freed(here, call):
    done = call("validate", "problem.py", "--free", "J_eng", "--set", "C_eng=0.5", "--data", "run.csv")
    assert done.code == 0
    entry = stored(here / "results" / "run_up-validate")["parameters"]["J_eng"]
    assert abs(entry["value"] - 0.4) < 5 * entry["stderr"]


# ---- 1: negative, only with --check


def test_check_says_no_by_its_exit_code(here, call):
    wrong = ("validate", "problem.py", "--set", "J_eng=0.8", "--set", "C_eng=0.5")
    assert call(*wrong).code == 0
    done = call(*wrong, "--check")
    assert (done.code, done.err) == (1, "")
    assert stored(here / "results" / "run_up-validate")["passed"] is False
    right = ("validate", "problem.py", "--set", "J_eng=0.4", "--set", "C_eng=0.5", "--check")
    assert call(*right).code == 0


# ---- 2: the input is at fault


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere.py"], "nowhere.py: no such problem file"),
        (["run.csv"], "a problem file is a Python file"),
        (["problem.py", "--data", "nowhere.csv"], "nowhere.csv: no such file"),
        (["problem.py", "--validate", "nowhere.csv"], "nowhere.csv: no such file"),
        (["problem.py", "--data", "problem.py"], "problem.py"),
        (["problem.py", "--set", "J_eng"], "--set is not of the form NAME=VALUE"),
        (["problem.py", "--set", "J_eng=-1"], "outside its bounds; seen: -1; allowed: 0.01 to 4"),
        (["problem.py", "--set", "J_en=1"], "nearest: J_eng"),
        (["problem.py", "--free", "mass"], "mass"),
        (["problem.py", "--fix", "J_eng", "--free", "J_eng"], "--free and --fix name the same parameter"),
        (["problem.py", "--out", "run.csv"], "the folder of the results cannot be written: run.csv"),
        (
            ["problem.py", "--out", "run.csv/below"],
            "the folder of the results cannot be written: run.csv/below",
        ),
        (
            ["problem.py", "--out", "/proc/results"],
            "the folder of the results cannot be written: /proc/results",
        ),
    ],
)
@pytest.mark.parametrize("command", ["fit", "simulate", "validate"])
def test_faults_of_the_input(command, arguments, words, call):
    done = call(command, *arguments)
    assert done.code == 2
    assert done.out == ""
    assert words in done.err
    assert done.err.startswith(f"casadi-engine {command}: ")
    assert done.err.count("\n") == 1  # one message
    assert "Traceback" not in done.err
    assert files() == UNTOUCHED


def test_the_folder_is_tried_before_the_work(call, monkeypatch):
    def never(*arguments, **options):
        raise AssertionError("the work began")

    monkeypatch.setattr(estimation, "estimate", never)
    assert call("fit", "problem.py", "--out", "run.csv").code == 2


def test_the_folder_is_not_made_when_the_data_are_at_fault(here, call):
    (here / "bad.csv").write_text("time [s],T [N m],omega [rad/s]\n0,1,1\n0,1,1\n")
    done = call("fit", "problem.py", "--data", "bad.csv")
    assert done.code == 2
    assert "bad.csv" in done.err
    assert "row 3" in done.err
    assert files() == ["bad.csv", *UNTOUCHED]


def test_a_problem_file_that_raises(here, call):
    (here / "bad.py").write_text("def problem():\n    return 1 / 0\n")
    done = call("fit", "bad.py")
    assert done.code == 2
    assert "bad.py, line 2: the problem file raised an error; seen: ZeroDivisionError" in done.err


def test_debug_shows_the_traceback_of_a_fault(call):
    done = call("fit", "problem.py", "--set", "J_eng=9", "--debug")
    assert done.code == 2
    assert "Traceback" in done.err
    assert done.err.splitlines()[-1].startswith("casadi-engine fit: the value of the parameter J_eng")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fit"], "Missing argument"),
        (["fit", "problem.py", "--sed", "1"], "No such option"),
        (["fit", "problem.py", "--seed", "x"], "--seed"),
        (["fit", "problem.py", "--jobs", "0"], "--jobs"),
        (["fit", "problem.py", "--check"], "No such option"),
        (["repairs", "problem.py"], "No such command"),
    ],
)
def test_a_command_that_cannot_be_read(arguments, words, call):
    done = call(*arguments)
    assert (done.code, done.out) == (2, "")
    assert words in done.err
    assert files() == UNTOUCHED


def test_from_a_file_that_is_no_result(here, call):
    for name, words in (("nowhere", "no such file"), ("run.csv", "broken JSON")):
        done = call("validate", "problem.py", "--from", name)
        assert done.code == 2
        assert words in done.err
    assert files() == UNTOUCHED


def test_from_a_result_of_another_problem(here, call):
    call("fit", "problem.py", "--out", "out")
    text = (here / "out" / "result.json").read_text()
    (here / "other.json").write_text(text.replace('"J_eng"', '"J_other"'))
    done = call("validate", "problem.py", "--from", "other.json")
    assert done.code == 2
    assert "a parameter that the problem does not have; seen: J_other" in done.err
    assert "give the problem file" in done.err
    (here / "by_record.json").write_text(text.replace('"C_eng"', '"C_eng@run"'))
    done = call("validate", "problem.py", "--from", "by_record.json")
    assert done.code == 2
    assert "no single value of the parameter C_eng; seen: C_eng@run" in done.err
    assert "--set C_eng=VALUE" in done.err
    assert call("validate", "problem.py", "--from", "by_record.json", "--set", "C_eng=0.5").code == 0
    assert call("validate", "problem.py", "--from", "by_record.json", "--free", "C_eng").code == 0


@pytest.mark.parametrize("command", ["simulate", "validate"])
@pytest.mark.parametrize("source", ["out", "out/result.json"])
def test_the_result_that_values_are_taken_from_is_not_written_over(here, call, command, source):
    """A fit, with its covariance, was replaced by the simulation of its values, without a word."""
    call("fit", "problem.py", "--out", "out")
    kept = (here / "out" / "result.json").read_bytes()
    done = call(command, "problem.py", "--from", source, "--out", "out")
    assert done.code == 2
    assert "the result that the values are taken from would be lost" in done.err
    assert (here / "out" / "result.json").read_bytes() == kept


def test_from_a_result_in_other_units(here, call):
    call("fit", "problem.py", "--out", "out")
    stored = json.loads((here / "out" / "result.json").read_text())
    value = stored["parameters"]["J_eng"]["value"]
    stored["parameters"]["J_eng"] |= {"value": 1e4 * value, "unit": "kg cm2"}
    (here / "cm.json").write_text(json.dumps(stored))
    done = call("validate", "problem.py", "--from", "cm.json", "--out", "same")
    assert done.code == 0
    assert "kg cm2 of cm.json is" in " ".join(done.out.split())
    again = json.loads((here / "same" / "result.json").read_text())
    assert again["parameters"]["J_eng"]["value"] == pytest.approx(value, rel=1e-9)
    stored["parameters"]["J_eng"]["unit"] = "kg"
    (here / "wrong.json").write_text(json.dumps(stored))
    done = call("validate", "problem.py", "--from", "wrong.json")
    assert done.code == 2
    assert "the unit of the parameter J_eng is another one in the problem" in done.err
    assert "kg in the result, kg m2 in the problem" in done.err


def test_a_sensor_that_reads_too_high_fails_behind_a_result(here, call):
    """Values from a result count as exact; what is left is held against the noise of that fit."""
    call("fit", "problem.py", "--out", "out")
    head, *lines = (here / "run.csv").read_text().splitlines()
    column = [name.split(" [")[0] for name in head.split(",")].index("omega")
    rows = [line.split(",") for line in lines]
    for row in rows:
        row[column] = f"{float(row[column]) + 5.0:.9f}" if row[column] else ""
    wild = [list(row) for row in rows]
    wild[len(rows) // 2][column] = "9999"
    for name, table in {"off": rows, "wild": wild}.items():
        (here / f"{name}.csv").write_text("\n".join([head, *(",".join(row) for row in table)]) + "\n")
        done = call(
            "validate", "problem.py", "--from", "out", "--data", f"{name}.csv", "--check", "--out", name
        )
        assert done.code == 1, done.err
        assert f"{name}/omega/" in done.out
    assert (
        call("validate", "problem.py", "--from", "out", "--data", "run.csv", "--check", "--out", "as").code
        == 0
    )


# ---- 3: no answer


def other_ending(monkeypatch, status):
    """Have estimate end with another status, at the point that it found."""
    real = estimation.estimate

    def estimate(*arguments, **options):
        return dataclasses.replace(real(*arguments, **options), status=status)

    monkeypatch.setattr(estimation, "estimate", estimate)


@pytest.mark.parametrize("command", ["fit", "validate"])
def test_not_converged(here, call, monkeypatch, command):
    other_ending(monkeypatch, "not converged: Maximum_Iterations_Exceeded")
    done = call(command, "problem.py")
    assert done.code == 3
    folder = os.path.join("results", f"run_up-{command}")
    assert done.err == (
        f"casadi-engine {command}: no answer: not converged: Maximum_Iterations_Exceeded; "
        f"the best point so far is in {folder}\n"
    )
    result = load_result(folder)
    assert result["status"] == "not converged: Maximum_Iterations_Exceeded"
    assert "J_eng" in result["parameters"]
    assert files(folder) == ["report.html", "result.json"]


@pytest.mark.parametrize("command", ["fit", "validate"])
def test_nothing_found_at_all(here, call, monkeypatch, command):
    def estimate(*arguments, **options):
        raise NotConvergedError("no start could be evaluated", cure="change the start")

    call(command, "problem.py")
    monkeypatch.setattr(estimation, "estimate", estimate)
    done = call(command, "problem.py")
    assert done.code == 3
    assert done.err == f"casadi-engine {command}: no start could be evaluated; do: change the start\n"
    folder = os.path.join("results", f"run_up-{command}")
    assert load_result(folder)["status"] == "not converged: no start could be evaluated"
    # The page of the run before does not stand beside a result that it does not belong to.
    assert files(folder) == ["result.json"]


# ---- 4: our bug


def test_our_bug(call, monkeypatch):
    def estimate(*arguments, **options):
        raise RuntimeError("two\nlines")

    monkeypatch.setattr(estimation, "estimate", estimate)
    done = call("fit", "problem.py")
    assert (done.code, done.out) == (4, "")
    assert done.err == (
        "casadi-engine fit: a bug of this program: RuntimeError: two lines; "
        "do: repeat it with --debug and report the traceback\n"
    )
    done = call("fit", "problem.py", "--debug")
    assert done.code == 4
    assert "Traceback (most recent call last)" in done.err
    assert done.err.endswith("casadi-engine fit: a bug of this program: RuntimeError: two lines\n")


# ---- 130: interrupted


@pytest.mark.parametrize("command", ["fit", "validate"])
def test_interrupted_writes_the_best_so_far(here, call, monkeypatch, command):
    other_ending(monkeypatch, "interrupted")
    done = call(command, "problem.py")
    assert done.code == 130
    folder = os.path.join("results", f"run_up-{command}")
    assert load_result(folder)["status"] == "interrupted"
    assert done.err.startswith(
        f"casadi-engine {command}: no answer: interrupted; the best point so far is in "
    )


def test_interrupted_before_there_is_anything(here, call):
    (here / "slow.py").write_text("raise KeyboardInterrupt\n")
    done = call("fit", "slow.py")
    assert done.code == 130
    assert done.err == "casadi-engine fit: interrupted before there was anything to write\n"
    assert files() == sorted([*UNTOUCHED, "slow.py"])


def test_interrupted_in_the_tests_keeps_the_fit(here, call, monkeypatch):
    def validate(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("casadi_engine.validation.validate", validate)
    done = call("fit", "problem.py")
    assert done.code == 130
    assert done.err == (
        "casadi-engine fit: interrupted in the residual tests; "
        f"the fit itself is in {os.path.join('results', 'run_up-fit')}\n"
    )
    assert stored(here / "results" / "run_up-fit")["status"] == "converged"


def test_a_bug_in_the_tests_keeps_the_fit(here, call, monkeypatch):
    def validate(*arguments, **options):
        raise RuntimeError("broken")

    monkeypatch.setattr("casadi_engine.validation.validate", validate)
    assert call("fit", "problem.py").code == 4
    assert stored(here / "results" / "run_up-fit")["status"] == "converged"


def test_validation_records_are_looked_at_before_the_work(here, call, monkeypatch):
    def never(*arguments, **options):
        raise AssertionError("the work began")

    monkeypatch.setattr(estimation, "estimate", never)
    (here / "no_speed.csv").write_text("time [s],T [N m]\n0,1\n1,1\n")
    done = call("fit", "problem.py", "--validate", "no_speed.csv")
    assert done.code == 2
    assert "output channel 'omega' is missing" in done.err


def test_a_test_on_the_fitted_records_says_so(here, call):
    words = "Tested on the records it was fitted to"
    alone = call("fit", "problem.py", "--data", "run.csv", "--out", "alone")
    assert alone.code == 0
    assert words in alone.out
    fresh = call("fit", "problem.py", "--data", "run.csv", "--validate", "fresh.csv", "--out", "both")
    assert words not in fresh.out


def test_a_fit_of_data_that_are_stated_wrong_says_so(here, call, quick_report):
    """A torque in kN m under a header of N m had led away: "look for a better optimum"."""
    lines = (here / "run.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    wrong = [f"{t},{-float(x):.6f},{w}" for t, x, w in rows]
    (here / "run.csv").write_text("\n".join([lines[0], *wrong]) + "\n")
    told = call("fit", "problem.py", "--out", "made")
    said = " ".join(told.out.split())
    assert "Note: with the input T reversed the fit explains" in said
    assert "Next: look at the data first, as noted above, and fit again" in said
