"""problems/hidden_effect.py: the main job names what the simulator hid, and says how large it is."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import pytest

import casadi_engine as ce
from casadi_engine import cli

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "problems" / "hidden_effect.py"
DATA = ROOT / "data" / "hidden_effect"
# The two masses of Table 4.1, which the simulator turned.
TRUTH = {"J_eng": 1 / 2.557, "J_load": 1 / 5.646, "K_el": 1992.0, "C_el": 2.5, "C_eng": 0.1541}


@pytest.fixture(scope="module")
def secret():
    """What is hidden: name, port and size; only the simulator and this test read it."""
    (effect,) = json.loads((DATA / "truth.json").read_text(encoding="utf-8"))["effects"]
    return effect


def check(result, secret, *, errors=4.5):
    assert (result["verdict"], result["confirmed"]) == ("named", True)
    (found,) = result["effects"]
    assert (found["name"], found["at"]) == (secret["name"], secret["at"])
    amplitude = next(iter(found["parameters"].values()))
    assert abs(amplitude["value"] - secret["size"]) < errors * amplitude["stderr"]
    assert amplitude["unit"] == secret["unit"]
    for name, truth in TRUTH.items():
        one = result["parameters"][name]
        assert abs(one["value"] - truth) < errors * one["stderr"], name
    gap = result["gap"]["validation"]
    assert gap["before"]["chi2_per_sample"] > 1.2
    assert gap["after"]["chi2_per_sample"] == pytest.approx(1.0, abs=0.05)
    assert all(p > 0.001 for outputs in gap["after"]["whiteness_p"].values() for p in outputs.values())


def test_the_hidden_effect_is_named_in_three_cycles(secret, tmp_path, monkeypatch, capsys):
    # Figures take seconds; the tests of the report room draw them.
    room = importlib.import_module("casadi_engine.report")
    monkeypatch.setattr(room, "report", lambda result, path, **options: path.touch())
    for name in ("misfire_1200rpm", "normal_1400rpm"):
        ce.read_experiment(DATA / f"{name}.csv.gz").cycles(1, 3).to_csv(tmp_path / f"{name}.csv")
    files = ["--data", tmp_path / "misfire_1200rpm.csv", "--validate", tmp_path / "normal_1400rpm.csv"]
    code = cli.main(["repair", str(PAGE), *map(str, files), "--out", str(tmp_path / "out")])
    told = capsys.readouterr()
    assert (code, told.err) == (0, "")
    check(json.loads((tmp_path / "out" / "result.json").read_text()), secret)


@pytest.mark.slow
def test_the_main_job_as_it_is(secret, tmp_path, capsys):
    assert cli.main(["repair", str(PAGE), "--out", str(tmp_path)]) == 0
    result = ce.load_result(tmp_path).to_dict()
    check(result, secret)
    assert len(capsys.readouterr().out.splitlines()) <= 48
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert len(page) < 3_000_000
    assert page.count("<figure>") >= 8
