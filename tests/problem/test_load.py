"""load_problem: a good file, and every fault of one as a message with its line."""

from __future__ import annotations

import os
import sys

import pytest

from casadi_engine.errors import ProblemError
from casadi_engine.problem import Problem, load_problem

HEAD = """
from casadi_engine.model import one_inertia
from casadi_engine.problem import Problem
"""


def message(path):
    with pytest.raises(ProblemError) as caught:
        load_problem(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_good_file(write, record, tmp_path):
    record("run.csv")
    before = set(sys.modules)
    problem = load_problem(write())
    assert isinstance(problem, Problem)
    assert problem.source == tmp_path / "demo.py"
    # Records are found from the file's folder, wherever the command runs.
    assert [e.name for e in problem.load_records()] == ["run"]
    added = set(sys.modules) - before
    assert all(name.startswith("_casadi_engine_problem_") for name in added), added
    assert not (tmp_path / "__pycache__").exists()


def test_a_name_that_clashes_with_a_module(write):
    import json

    assert load_problem(write(name="json.py")).name == "demo"
    import json as after

    assert after is json
    assert "demo" not in sys.modules


def test_files_of_one_name_do_not_meet(write, tmp_path):
    first = write()
    (tmp_path / "other").mkdir()
    second = write(first.read_text().replace('"demo"', '"second"'), "other/demo.py")
    assert (load_problem(first).name, load_problem(second).name) == ("demo", "second")
    # The source is read every time, with no stale bytecode between.
    first.write_text(first.read_text().replace('"demo"', '"third"'))
    assert load_problem(first).name == "third"


def test_dataclasses_with_written_annotations_work(write):
    text = "from __future__ import annotations\nfrom dataclasses import dataclass\nimport typing\n" + HEAD
    text += """
@dataclass
class Rig:
    bore: typing.ClassVar[float] = 0.1

def problem():
    m = one_inertia()
    return Problem(name="rig", goal="", model=m, parameters=m.parameters())
"""
    assert load_problem(write(text)).name == "rig"


def test_paths_that_are_no_problem_file(tmp_path, write):
    assert "nowhere.py: no such problem file" in message(tmp_path / "nowhere.py")
    assert "casadi-engine new NAME" in message(tmp_path / "nowhere.py")
    assert "a folder, not a problem file" in message(tmp_path)
    text = message(write("x = 1", "problem.txt"))
    assert "seen: problem.txt; allowed: NAME.py" in text
    assert "not the path of a problem file; seen: 3" in message(3)


@pytest.mark.parametrize("text", ["x = 1", "problem = 3", ""])
def test_no_function_problem(write, text):
    found = message(write(text))
    assert "the file has no function problem()" in found
    assert "def problem(): return ce.Problem(...)" in found


def test_problem_returns_something_else(write):
    found = message(write("\n\ndef problem():\n    return {'name': 'x'}\n"))
    assert "demo.py, line 3: problem() does not return a Problem; seen: dict" in found
    assert "seen: None" in message(write("def problem():\n    pass\n"))
    assert "line ?" in message(write("class problem:\n    pass\n"))


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("x = 1\ny = 1 / 0\n", 2, "ZeroDivisionError: division by zero"),
        ("def f():\n    raise KeyError('a')\n\ndef problem():\n    f()\n", 2, "KeyError: 'a'"),
        ("def problem():\n    raise ValueError\n", 2, "seen: ValueError;"),
        ("def problem(m):\n    pass\n", None, "missing 1 required positional argument: 'm'"),
        ("import sys\nsys.exit(3)\n", 2, "SystemExit: 3"),
        ("x = 1\nraise RecursionError('deep')\n", 2, "RecursionError: deep"),
    ],
)
def test_whatever_the_file_raises(write, text, line, words):
    found = message(write(text))
    assert ("demo.py: " if line is None else f"demo.py, line {line}: ") in found
    assert "the problem file raised an error" in found
    assert words in found
    assert "do: correct this line" in found


def test_our_own_errors_keep_their_parts(write):
    text = HEAD + 'def problem():\n    m = one_inertia()\n    m.parameters()["J_eng"].set(-1.0)\n'
    found = message(write(text))
    assert "demo.py, line 6: the value of the parameter J_eng is outside its bounds; seen: -1" in found
    assert "allowed: 1e-06 to 1000" in found


def test_not_python(write, tmp_path):
    found = message(write("x = 1\ndef problem(:\n"))
    assert "demo.py, line 2: this is not Python" in found
    assert "def problem(:" in found
    assert "this is not Python" in message(write("def problem():\n  return 1\n   x = 2\n"))
    path = tmp_path / "bytes.py"
    path.write_bytes(b"x = '\xff'\n")
    assert "bytes.py" in message(path)
    path.write_bytes(b"x = 1\0\n")
    assert "bytes.py" in message(path)


def test_a_module_that_is_not_there(write):
    found = message(write("import casadi_engine\nimport helper_beside\n"))
    assert "demo.py, line 2: the file imports a module that is not there; seen: helper_beside" in found
    assert "stands alone" in found


def test_a_failed_file_leaves_no_module(write):
    before = set(sys.modules)
    message(write("raise ValueError('x')"))
    assert set(sys.modules) == before


def test_an_interrupt_is_not_the_files_fault(write):
    with pytest.raises(KeyboardInterrupt):
        load_problem(write("raise KeyboardInterrupt"))


def test_a_reader_that_fails_names_its_line(write, record):
    record("run.csv")
    text = HEAD + (
        "def read(path):\n    return path.nothing\n\n"
        "def problem():\n    m = one_inertia()\n"
        '    return Problem("demo", "", m, m.parameters(), read=read, records=["run.csv"])\n'
    )
    problem = load_problem(write(text))
    with pytest.raises(ProblemError) as caught:
        problem.load_records()
    assert "demo.py, line 5: read(" in str(caught.value)
    assert "has no attribute 'nothing'" in str(caught.value)


def test_the_file_is_named_from_the_working_folder(write, tmp_path, monkeypatch):
    write("1 / 0")
    monkeypatch.chdir(tmp_path)
    assert message("demo.py").startswith("demo.py, line 1: ")
    os.chdir("/")
    assert message(tmp_path / "demo.py").startswith(f"{str(tmp_path / 'demo.py')[1:]}, line 1: ")
