"""problems/crankshaft.py: a page that loads, and that finds the truth of its records in seconds."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import casadi_engine as ce
from casadi_engine import cli

PAGE = Path(__file__).resolve().parents[2] / "problems" / "crankshaft.py"
# Table 4.12 of the thesis, which the bundled records were made with.
TRUTH = {"J1": 1 / 33.39, "J2": 1 / 22.3, "J6": 1 / 5.968, "K21": 241.8e3, "K32": 1270e3, "K65": 1427e3}
NOISE = ce.Noise(omega=0.1)  # known: an estimated level counts the free parameters
CHANCE = chi2.ppf(0.999, len(TRUTH))


def test_the_page_loads():
    problem = ce.load_problem(PAGE)
    assert problem.name == "crankshaft"
    assert len(PAGE.read_text(encoding="utf-8").splitlines()) <= 62
    assert problem.model.linear is not None
    assert not problem.model.has_slot_laws
    assert [Path(record).name for record in problem.records] == [
        "normal_1200rpm.csv.gz",
        "misfire_1200rpm.csv.gz",
    ]
    for path in (*problem.records, *problem.validation):
        assert Path(path).is_file()
    assert not set(problem.records) & set(problem.validation)
    pars = problem.parameters
    free = [name for name in pars if pars[name].vary and not pars[name].tie]
    assert free == list(TRUTH)
    for name in free:
        assert pars[name].min < pars[name].value < pars[name].max
        assert abs(pars[name].value / TRUTH[name] - 1) > 0.05  # the fit has something to find


def test_the_fit_finds_the_truth(tmp_path, monkeypatch, capsys):
    room = importlib.import_module("casadi_engine.report")
    monkeypatch.setattr(room, "report", lambda result, path, **options: path.touch())  # figures take seconds
    code = cli.main(["fit", str(PAGE), "--out", str(tmp_path)])
    assert code == 0, capsys.readouterr().err
    result = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert result["status"] == "converged"
    size = np.sqrt(np.diag(result["covariance"]))
    # noise puts an optimum beside the truth's a little lower: both are named
    optima = [found["values"] for found in result["optima"] if found["cost"] < result["cost"] + CHANCE]
    off = [
        max(abs(values[name] - TRUTH[name]) / one for name, one in zip(TRUTH, size, strict=True))
        for values in optima
    ]
    assert min(off) < 4
    for name, truth, quadratic in zip(TRUTH, TRUTH.values(), size, strict=True):
        found = result["parameters"][name]
        assert quadratic < 0.08 * truth, name
        # noise decides which optimum is the lowest: no error is known
        assert found["stderr"] is None, name
        assert found["why"]["stderr"] == "not known (see note)", name
    assert "the errors are not known" in result["messages"][0]
    assert result["messages"][0].endswith("call ce.posterior(fit)")
    for name in ("J3", "J4", "J5"):
        assert result["parameters"][name]["value"] == result["parameters"]["J2"]["value"]
    assert result["noise"]["omega"]["sigma"] == pytest.approx(0.1, rel=0.02)
    assert result["validation"]["passed"] is True


def test_the_likelihood_of_the_truth_is_that_of_the_fit_within_chance():
    """The values of the lowest optimum may be far from the truth; its likelihood may not."""
    problem = ce.load_problem(PAGE)
    records = [ce.read_experiment(path) for path in problem.records]
    pars = problem.parameters.copy()
    fit = ce.estimate(problem.model, records, parameters=pars, noise=NOISE, progress=False)
    for name, value in TRUTH.items():
        pars.fix(name, value)
    known = ce.estimate(problem.model, records, parameters=pars, noise=NOISE, progress=False)
    assert 0 < known.cost - fit.cost < CHANCE
