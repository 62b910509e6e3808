"""Checkpoints: what is finished is kept whole, what is not is done again, and a wrong file is refused."""

import json
import os

import pytest

from casadi_engine.errors import StudyError
from casadi_engine.estimation.checkpoint import Checkpoint, key_of


def test_rows_are_there_when_the_file_is_opened_again(tmp_path):
    path = tmp_path / "folder" / "study.jsonl"
    with Checkpoint(path, "squares", {"version": 1}) as kept:
        assert kept.rows == {}
        assert kept.add({"x": 2}, {"square": 4, "nothing": None, "bad": float("nan")})["square"] == 4
        kept.add({"x": 3}, {"square": 9})
    with Checkpoint(path, "squares", {"version": 1}) as kept:
        assert kept.rows[key_of({"x": 3})] == {"square": 9}
        assert kept.rows[key_of({"x": 2})]["nothing"] is None
        assert kept.rows[key_of({"x": 2})]["bad"] != kept.rows[key_of({"x": 2})]["bad"]
    assert len(path.read_text().splitlines()) == 3


def test_a_key_does_not_hang_on_the_order_of_entries():
    assert key_of({"a": 1, "b": [2.5, "c"]}) == key_of({"b": [2.5, "c"], "a": 1})
    assert key_of({"a": 1}) != key_of({"a": 2})


@pytest.mark.parametrize("left", [1, 20])
def test_a_line_that_was_not_finished_is_cut_off(tmp_path, left):
    path = tmp_path / "study.jsonl"
    with Checkpoint(path, "squares") as kept:
        kept.add({"x": 2}, 4)
        kept.add({"x": 3}, 9)
    whole = path.read_bytes()
    path.write_bytes(whole[:-left])
    with Checkpoint(path, "squares") as kept:
        assert list(kept.rows) == [key_of({"x": 2})]
        kept.add({"x": 3}, 9)
    assert path.read_bytes() == whole


def test_a_file_whose_first_line_was_not_finished_begins_again(tmp_path):
    path = tmp_path / "study.jsonl"
    path.write_text('{"checkpoint": 1, "st')
    with Checkpoint(path, "squares") as kept:
        kept.add({"x": 2}, 4)
    assert [set(json.loads(line)) for line in path.read_text().splitlines()] == [
        {"checkpoint", "study", "setting"},
        {"key", "piece", "row"},
    ]


@pytest.mark.parametrize(("study", "setting"), [("cubes", None), ("squares", {"version": 2})])
def test_the_file_of_another_study_is_refused(tmp_path, refused, study, setting):
    path = tmp_path / "study.jsonl"
    Checkpoint(path, "squares").close()
    with refused(StudyError, "belongs to another study", seen="squares", allowed=study, cure="another file"):
        Checkpoint(path, study, setting)


@pytest.mark.parametrize(
    ("line", "cure"),
    [("not JSON", "delete line 2"), ('{"key": 1}', "delete line 2"), ("[]", "delete line 2")],
)
def test_a_damaged_file_is_refused(tmp_path, refused, line, cure):
    path = tmp_path / "study.jsonl"
    Checkpoint(path, "squares").close()
    path.write_text(path.read_text() + line + "\n")
    with refused(StudyError, "is damaged", seen=f"line 2: {line}", allowed="a study has written", cure=cure):
        Checkpoint(path, "squares")


def test_another_file_is_not_taken_for_a_checkpoint(tmp_path, refused):
    path = tmp_path / "table.csv"
    path.write_text("a,b\n1,2\n")
    with refused(StudyError, "is damaged", seen="line 1: a,b", cure="delete the file"):
        Checkpoint(path, "squares")
    assert path.read_text() == "a,b\n1,2\n"


def test_a_file_that_is_no_checkpoint_is_left_as_it_is(tmp_path, refused):
    path = tmp_path / "notes.txt"
    for content in (b"a note without a line's end", b"a,b\n1,2\n3,4", b'{"checkpoint": 1, "study": "cubes"'):
        path.write_bytes(content)
        with refused(StudyError, "is damaged", seen="line 1: ", cure="name another file"):
            Checkpoint(path, "squares")
        assert path.read_bytes() == content
    Checkpoint(tmp_path / "cubes.jsonl", "cubes").close()
    content = (tmp_path / "cubes.jsonl").read_bytes() + b'{"key": '
    path.write_bytes(content)
    with refused(
        StudyError, "belongs to another study", seen="cubes", allowed="squares", cure="another file"
    ):
        Checkpoint(path, "squares")
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    "line",
    [
        '{"key": [1], "piece": 2, "row": 3}',
        '{"key": "abc", "piece": {"x": 2}, "row": 77}',
        json.dumps({"key": key_of({"x": 2}), "piece": {"x": 3}, "row": 4}),
        "[" * 100_000,
    ],
)
def test_a_row_that_is_not_its_pieces_is_refused(tmp_path, refused, line):
    path = tmp_path / "study.jsonl"
    Checkpoint(path, "squares").close()
    path.write_text(path.read_text() + line + "\n")
    with refused(StudyError, "is damaged", seen="line 2: " + line[:20], cure="delete line 2"):
        Checkpoint(path, "squares")


@pytest.mark.parametrize("path", [3, None, "", ["a"]])
def test_what_is_no_path_is_refused(refused, path):
    with refused(StudyError, "not the path of a file", seen=repr(path), allowed="text", cure="study.jsonl"):
        Checkpoint(path, "squares")


def test_names_of_files_and_studies_that_cannot_be_are_refused(tmp_path, refused):
    with refused(StudyError, "cannot be opened", seen="null", allowed="read and written", cure="another"):
        Checkpoint("a\0b", "squares")
    with refused(StudyError, "the name of the study", seen="set", allowed="texts", cure="float(...)"):
        Checkpoint(tmp_path / "study.jsonl", {1})  # type: ignore[arg-type]


def test_a_device_is_refused(refused):
    if not os.path.exists("/dev/null"):
        pytest.skip("this system has no such device")
    with refused(StudyError, "cannot be opened", seen="", allowed="read and written", cure="another file"):
        Checkpoint("/dev/null", "squares")


def test_a_file_in_use_is_refused(tmp_path, refused):
    pytest.importorskip("fcntl", reason="this system has no such locks")
    path = tmp_path / "study.jsonl"
    with (
        Checkpoint(path, "squares"),
        refused(StudyError, "is in use", seen="another process", allowed="one process", cure="wait"),
    ):
        Checkpoint(path, "squares")
    Checkpoint(path, "squares").close()


def test_a_place_that_cannot_be_written_is_refused(tmp_path, refused):
    with refused(
        StudyError, "cannot be opened", seen="directory", allowed="read and written", cure="another"
    ):
        Checkpoint(tmp_path, "squares")


def test_what_json_cannot_hold_is_refused(tmp_path, refused):
    with refused(StudyError, "a piece of the study", seen="set", allowed="texts, numbers", cure=".tolist()"):
        key_of({"x": {1, 2}})
    with (
        Checkpoint(tmp_path / "study.jsonl", "squares") as kept,
        refused(StudyError, "the result of a piece", seen="complex", allowed="texts", cure="float(...)"),
    ):
        kept.add({"x": 1}, 1j)
