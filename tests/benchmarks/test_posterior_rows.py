"""The rows of the posterior's study that the repository keeps."""

import json

import posterior_study
import pytest
from posterior_rows import FEW, FOLDER, Kept

SETTING = {"version": 0, "draws": 999}


def row(rank, **more):
    return {"rank": {"J1": rank, "K": 0.5}, "z": {"J1": 1.234, "K": None}, "height": 0.25, "seconds": 2.04, "why": FEW,
            "modes": 1, "evaluations": 4000, "status": "converged", **more}  # fmt: skip


def test_rows_come_back_as_they_were_but_for_rounding(tmp_path):
    kept = Kept(tmp_path, "A", SETTING)
    kept.add(
        {3: row(3 / 999), 1: row(0.5, why="R-hat", height=None), 2: {"refused": "no\nmore", "seconds": 9.0}}
    )
    found = Kept(tmp_path, "A", SETTING).rows
    assert sorted(found) == [1, 2, 3]
    assert found == kept.rows
    assert found[3]["rank"]["J1"] == pytest.approx(3 / 999)
    assert found[3]["z"] == {"J1": 1.23, "K": None}
    assert found[3]["why"] == FEW != found[1]["why"]
    assert found[1]["height"] is None
    assert found[2] == {"seconds": 9.0, "refused": "no", "z": {}}


def test_a_row_is_taken_in_once_and_remembers_its_version(tmp_path, monkeypatch):
    Kept(tmp_path, "A", SETTING).add({1: row(0.1)})
    monkeypatch.setattr("posterior_rows.ce.__version__", "99.0")
    later = Kept(tmp_path, "A", SETTING)
    later.add({1: row(0.9), 2: row(0.2)})
    assert later.rows[1]["rank"]["J1"] == pytest.approx(0.1, abs=1e-3)
    groups = json.loads((tmp_path / FOLDER / "A.json").read_text("utf-8"))["rows"]
    assert [len(groups[key]) for key in sorted(groups)] == [1, 1]
    assert groups["99.0"][0][0] == 2


def test_rows_of_another_study_are_left_out(tmp_path):
    Kept(tmp_path, "A", SETTING).add({1: row(0.1)})
    assert not Kept(tmp_path, "A", SETTING | {"version": 1}).rows


def test_a_study_goes_on_from_what_is_kept(tmp_path, monkeypatch):
    asked = []

    def made(piece):
        asked.append(piece["seed"])
        return row(0.5)

    monkeypatch.setattr(posterior_study, "row", made)
    posterior_study.run("A", 2, tmp_path)
    posterior_study.checkpoint("A", tmp_path).unlink()  # another machine
    posterior_study.run("A", 3, tmp_path)
    assert asked == [0, 1, 2]
    assert sorted(posterior_study.taken_in("A", tmp_path).rows) == [0, 1, 2]


def test_what_a_stopped_study_has_finished_is_taken_in(tmp_path, monkeypatch):
    def made(piece):
        if piece["seed"] == 2:
            raise KeyboardInterrupt
        return row(0.5)

    monkeypatch.setattr(posterior_study, "row", made)
    with pytest.raises(KeyboardInterrupt):
        posterior_study.run("A", 3, tmp_path)
    assert sorted(posterior_study.taken_in("A", tmp_path).rows) == [0, 1]
