"""The problem files of the project: pages that load, run on short records, and find the truth."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import pytest

import casadi_engine as ce
from casadi_engine import cli

ROOT = Path(__file__).resolve().parents[2]
# Table 4.1 of the thesis, which the bundled records were made with.
TRUTH = {"J_eng": 1 / 2.557, "J_load": 1 / 5.646, "K_el": 1992.0, "C_el": 2.5, "C_eng": 0.1541}


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """short(name) -> a file with the first engine cycles of a bundled record."""
    folder = tmp_path_factory.mktemp("short")

    def cut(name, cycles=1):
        path = folder / f"{name}.csv"
        if not path.exists():
            record = ce.read_experiment(ROOT / "data" / f"{name}.csv.gz")
            record.cycles(1, cycles).to_csv(path)
        return path

    return cut


def run(folder, *arguments):
    """The exit code of the command line, and the result that it wrote."""
    code = cli.main([*map(str, arguments), "--out", str(folder)])
    return code, json.loads((folder / "result.json").read_text())


def quick_report(monkeypatch):
    """Figures take seconds; one test here draws them."""
    room = importlib.import_module("casadi_engine.report")
    monkeypatch.setattr(room, "report", lambda result, path, **options: path.touch())


@pytest.mark.parametrize("name", ["two_mass", "one_inertia", "hidden_effect"])
def test_a_page_that_loads(name):
    path = ROOT / "problems" / f"{name}.py"
    problem = ce.load_problem(path)
    assert problem.name == name
    assert problem.source == path
    assert len(path.read_text().splitlines()) <= 60
    assert problem.goal.strip().count("\n") >= 3
    for record in (*problem.records, *problem.validation):
        assert Path(record).is_file()
    assert not set(problem.records) & set(problem.validation)
    # Every declared bound leaves room on both sides of its start.
    for name, parameter in problem.parameters.items():
        assert not parameter.vary or parameter.min < parameter.value < parameter.max, name


def test_two_mass_finds_the_truth_in_a_short_record(short, tmp_path, capsys):
    page = ROOT / "problems" / "two_mass.py"
    code, result = run(tmp_path, "fit", page, "--data", short("misfire_1200rpm"), "--set", "K_el=1500")
    assert code == 0, capsys.readouterr().err
    for name, truth in TRUTH.items():
        found = result["parameters"][name]
        assert abs(found["value"] - truth) < 4.5 * found["stderr"], name
    assert result["noise"]["omega"]["sigma"] == pytest.approx(0.1, rel=0.1)
    assert result["validation"]["passed"] is True
    assert (tmp_path / "report.html").stat().st_size < 3_000_000
    ce.load_result(tmp_path)


def test_one_inertia_is_rejected_by_the_residual_tests(short, tmp_path, monkeypatch, capsys):
    quick_report(monkeypatch)
    page = ROOT / "problems" / "one_inertia.py"
    code, result = run(tmp_path, "fit", page, "--data", short("normal_1200rpm"))
    assert code == 0, capsys.readouterr().err
    assert result["validation"]["passed"] is False


def test_the_template_runs_on_a_record_as_it_is(short, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    quick_report(monkeypatch)
    assert cli.main(["new", "my_engine"]) == 0
    assert cli.main(["fit", "my_engine.py"]) == 2
    assert "the problem my_engine has no records" in capsys.readouterr().err
    record = short("misfire_1200rpm")
    code, result = run(tmp_path / "out", "fit", "my_engine.py", "--data", record, "--fix", "C_el=2.5")
    assert code == 0, capsys.readouterr().err
    assert result["parameters"]["J_eng"]["value"] == pytest.approx(TRUTH["J_eng"], rel=0.05)
    code, result = run(tmp_path / "test", "validate", "my_engine.py", "--from", "out", "--data", record)
    assert code == 0, capsys.readouterr().err
    assert list(result["records"]) == ["misfire_1200rpm"]


def test_the_advice_in_the_template_is_code_that_works(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["new", "rig"]) == 0
    path = tmp_path / "rig.py"
    text = path.read_text()

    def advice(start):
        bare = [
            line.strip().removeprefix("# ") for line in text.splitlines() if line.strip().startswith("# ")
        ]
        return "".join(f"    {line.split('   ')[0]}\n" for line in bare if line.startswith(start))

    for start, end in ((("p.", "p["), "    return p\n"), ("record = ", "    return record\n")):
        assert advice(start)
        text = text.replace(end, advice(start) + end)
    path.write_text(text)
    problem = ce.load_problem(path).with_data([ROOT / "data" / "normal_1200rpm.csv.gz"])
    pars = problem.parameters
    assert pars["C_el"].tie == "K_el/800"
    assert not pars["J_load"].vary
    assert pars["K_el"].prior == (2000, 100)
    assert pars["C_eng"].varies_by_experiment
    assert len(pars.constraints) == 1
    (record,) = problem.load_records()
    assert len(record["omega"]) == -(-len(record["theta"]) // 15)
