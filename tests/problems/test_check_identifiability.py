"""The check script: it runs as a script and as a problem file, answers on one screen and ends as the contract says."""

from __future__ import annotations

import importlib.util
import json
import runpy
import sys
from pathlib import Path

import pytest

import casadi_engine as ce
from casadi_engine.report import load_result

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "problems" / "check_identifiability.py"


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run the page as a script in an empty folder: exit code and what it printed."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", [str(PAGE), *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            runpy.run_path(str(PAGE), run_name="__main__")
        return end.value.code, capsys.readouterr()

    return call


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """One engine cycle of the record, so that the profiles take a second."""
    path = tmp_path_factory.mktemp("short") / "misfire_1200rpm.csv"
    record = ce.read_experiment(ROOT / "data" / "misfire_1200rpm.csv.gz", optional=("omega_load",))
    record.cycles(1, 1).to_csv(path)
    return path


def test_it_is_a_page_that_can_be_copied():
    assert len(PAGE.read_text().splitlines()) <= 60
    problem = ce.load_problem(PAGE)
    assert problem.name == "check_identifiability"
    assert all(Path(record).is_file() for record in problem.records)
    spec = importlib.util.spec_from_file_location("page", PAGE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)  # importing it runs nothing
    pars = module.problem().parameters
    assert {name for name in pars if pars[name].vary} == {"J_eng", "J_load", "K_el", "C_el", "C_eng"}


def test_verdict_errors_and_profiles_on_one_screen(run, short, tmp_path):
    code, text = run("--data", short, "--check", "--fix", "J_load", "--fix", "C_eng")
    assert (code, text.err) == (0, "")
    lines = text.out.splitlines()
    assert len(lines) <= 50
    assert max(map(len, lines)) <= 100
    assert "YES, all 3 free parameters can be told" in lines[0]
    assert "K_el/J_eng: yes" in text.out
    assert "Expected standard errors" in text.out
    assert "Profile likelihood of two_mass" in text.out
    folder = tmp_path / "results" / "check_identifiability-identify"
    stored = load_result(folder)
    assert (stored["rank"], stored["size"], stored["directions"]) == (6, 6, 3)
    raw = json.loads((folder / "result.json").read_text())
    assert set(raw["profiles"]) == set(raw["expected_errors"]) == {"J_eng", "K_el", "C_el"}
    for name, ends in raw["profiles"].items():
        assert ends["low"] < raw["parameters"][name]["value"] < ends["high"]
    page = (folder / "report.html").read_text()
    assert "Profiles" in page
    assert page.count("<figure>") == 2  # expected errors, profiles


def test_a_lost_parameter_names_its_reason_and_remedy(run):
    code, text = run("--inputs", "zero", "--check")
    assert code == 1
    assert "scaling: J_eng, J_load, K_el, C_el, C_eng times s" in text.out
    assert "excite T_1 (now zero)" in text.out
    assert len(text.out.splitlines()) <= 45
    assert run("--inputs", "zero")[0] == 0


def test_bad_words_are_one_message(run, tmp_path):
    code, text = run("--free", "K_e")
    assert code == 2
    assert "unknown parameter" in text.err
    assert "nearest: K_el" in text.err
    assert not (tmp_path / "results").exists()
