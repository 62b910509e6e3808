"""A repair that is saved and read back."""

import json
import os

import pytest

import casadi_engine as ce
from casadi_engine.errors import OutputError
from casadi_engine.report.schema import faults


@pytest.mark.parametrize("kind", ["repaired", "unnamed", "nothing_missing", "no_answer"])
@pytest.mark.parametrize("name", ["kept", "deep/kept", "kept.json"])
def test_what_is_read_back_prints_the_same(request, tmp_path, kind, name):
    found = request.getfixturevalue(kind)
    written = found.save(tmp_path / name)
    assert written == tmp_path / (name if name.endswith(".json") else f"{name}/result.json")
    loaded = ce.load_result(tmp_path / name)
    assert str(loaded) == str(found)
    assert loaded["verdict"] == found.verdict
    assert [one["name"] for one in loaded["effects"]] == [one.name for one in found.effects]
    assert list(faults(loaded.to_dict())) == []
    assert os.listdir(written.parent) == [written.name]


def test_a_page_is_made_of_it(repaired, tmp_path):
    repaired.save(tmp_path / "kept")
    page = ce.report(ce.load_result(tmp_path / "kept"), tmp_path / "page.html")
    assert "dry friction at coupling" in (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page is None or os.fspath(page) == os.fspath(tmp_path / "page.html")


def test_a_result_of_another_command_prints_what_it_is(tmp_path, repaired):
    file = repaired.save(tmp_path)
    document = json.loads(file.read_text(encoding="utf-8"))
    del document["summary"]
    file.write_text(json.dumps(document), encoding="utf-8")
    assert str(ce.load_result(tmp_path)) == f"Result({str(file)!r}: repair, answered)"


def test_a_file_that_cannot_be_written_leaves_the_old_one(repaired, tmp_path, monkeypatch):
    file = repaired.save(tmp_path)
    before = file.read_bytes()

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OutputError, match=r"result\.json"):
        repaired.save(tmp_path)
    assert file.read_bytes() == before


def test_a_place_that_is_none_is_refused(repaired):
    with pytest.raises(OutputError, match="not the path of a file to write; seen: int"):
        repaired.save(7)
