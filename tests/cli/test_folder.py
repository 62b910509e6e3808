"""The folder of the results: tried before the work, and left as it was."""

from __future__ import annotations

import os

import pytest

from casadi_engine.cli.folder import check_folder, make_folder, remove_files, simulated_files
from casadi_engine.errors import OutputError


def test_a_trial_leaves_nothing(tmp_path):
    check_folder(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "result.json").write_text("{}")
    check_folder(tmp_path / "a")
    check_folder(tmp_path / "a" / "b" / "c")
    assert os.listdir(tmp_path / "a") == ["result.json"]


def test_a_relative_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    from pathlib import Path

    check_folder(Path("results/x"))
    assert os.listdir(tmp_path) == []
    make_folder(Path("results/x"))
    assert (tmp_path / "results" / "x").is_dir()


def test_a_file_in_its_place(tmp_path):
    (tmp_path / "taken").write_text("x")
    for folder in (tmp_path / "taken", tmp_path / "taken" / "below"):
        for function in (check_folder, make_folder):
            with pytest.raises(OutputError) as caught:
                function(folder)
            assert f"the folder of the results cannot be written: {folder}" in str(caught.value)
            assert "--out DIR" in str(caught.value)
    assert (tmp_path / "taken").read_text() == "x"


def test_a_read_only_place():
    from pathlib import Path

    with pytest.raises(OutputError, match="cannot be written: /proc/results"):
        check_folder(Path("/proc/results"))


def test_a_folder_in_the_place_of_a_result(tmp_path):
    (tmp_path / "result.json").mkdir()
    with pytest.raises(OutputError, match="is a folder there"):
        check_folder(tmp_path)
    assert os.listdir(tmp_path) == ["result.json"]


def test_a_name_that_no_system_takes(tmp_path):
    with pytest.raises(OutputError, match="cannot be written"):
        check_folder(tmp_path / ("x" * 300))
    with pytest.raises(OutputError, match="cannot be written"):
        check_folder(tmp_path / "a\0b")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "text",
    [
        "",
        "not json",
        "[]",
        '{"command": "fit", "files": ["run.csv"]}',
        '{"command": "simulate", "files": 3}',
        '{"command": "simulate", "files": ["../run.csv", "/run.csv", "a/run.csv", "notes.txt", 3]}',
    ],
)
def test_files_in_doubt_are_not_ours(tmp_path, text):
    assert simulated_files(tmp_path) == ()
    (tmp_path / "result.json").write_text(text)
    assert simulated_files(tmp_path) == ()


def test_only_what_is_named_is_removed(tmp_path):
    (tmp_path / "result.json").write_text('{"command": "simulate", "files": ["run.csv", "gone.csv"]}')
    for name in ("run.csv", "mine.csv"):
        (tmp_path / name).write_text("x")
    remove_files(tmp_path, simulated_files(tmp_path))
    assert sorted(os.listdir(tmp_path)) == ["mine.csv", "result.json"]


def test_no_command_takes_the_result_of_another_one(here, call, quick_report):
    """A simulation had replaced the fit in whose folder it was to be written."""
    assert call("fit", "problem.py", "--out", "own").code == 0
    fitted = (here / "own" / "result.json").read_bytes()
    told = call("simulate", "problem.py", "--out", "own")
    assert told.code == 2
    assert "the result of another command would be lost: own/result.json" in told.err
    assert "seen: a result of fit there, and the command simulate" in told.err
    assert (here / "own" / "result.json").read_bytes() == fitted
    assert call("fit", "problem.py", "--out", "own").code == 0


def test_no_command_takes_a_file_that_is_not_its_own(here, call, quick_report):
    """A measured record had been replaced by its simulation, and result files of other programs by ours."""
    measured = (here / "run.csv").read_bytes()
    told = call("simulate", "problem.py", "--out", ".")
    assert told.code == 2
    assert "a file of this name would be lost: fresh.csv" in told.err or "would be lost: run.csv" in told.err
    assert "do: give another folder by --out DIR" in told.err
    assert (here / "run.csv").read_bytes() == measured
    assert call("simulate", "problem.py", "--out", "own").code == 0
    assert call("simulate", "problem.py", "--out", "own").code == 0  # what it wrote itself it writes again
    (here / "theirs").mkdir()
    (here / "theirs" / "result.json").write_text('{"score": 3}')
    told = call("fit", "problem.py", "--out", "theirs")
    assert told.code == 2
    assert "would be lost: theirs/result.json" in told.err
    assert (here / "theirs" / "result.json").read_text() == '{"score": 3}'
