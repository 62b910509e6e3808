"""``casadi-engine fit --posterior``: files, words, and a fit that is kept where no posterior can be had."""

from __future__ import annotations

import importlib
import json
import os

import pytest

from casadi_engine.errors import UntrustedPosteriorError
from casadi_engine.report import load_result

pytestmark = pytest.mark.usefixtures("here", "quick_report")

FIT = ["report.html", "result.json"]
DRAWN = ["posterior.html", "posterior.json"]


def files(folder):
    return sorted(os.listdir(folder))


def test_a_posterior_beside_its_fit(here, call):
    done = call("fit", "problem.py", "--posterior", "--out", "out")
    assert (done.code, done.err) == (0, "")
    assert files(here / "out") == [*DRAWN, *FIT]
    assert "Posterior" in done.out
    assert done.out.rstrip().endswith("posterior.html")
    fit, drawn = load_result(here / "out"), load_result(here / "out" / "posterior.json")
    assert fit["arguments"]["posterior"] is True
    assert abs(drawn.draws["J_eng"].mean() - fit["parameters"]["J_eng"]["value"]) < 0.01
    assert drawn.draws["J_eng"].std() == pytest.approx(fit["parameters"]["J_eng"]["stderr"], rel=0.15)


def test_the_next_fit_takes_the_earlier_posterior_away(here, call):
    call("fit", "problem.py", "--posterior", "--out", "out")
    assert call("fit", "problem.py", "--out", "out").code == 0
    assert files(here / "out") == FIT


def test_files_of_somebody_else_stay(here, call):
    call("fit", "problem.py", "--out", "out")
    (here / "out" / "posterior.html").write_text("mine")
    done = call("fit", "problem.py", "--posterior", "--out", "out")
    assert done.code == 2
    assert "a file of this name would be lost" in done.err
    assert call("fit", "problem.py", "--out", "out").code == 0
    assert (here / "out" / "posterior.html").read_text() == "mine"


@pytest.mark.parametrize(
    ("seen", "code"), [("draws worth 7", 3), ("Ctrl-C while drawing, after 100 evaluations", 130)]
)
def test_without_a_posterior_the_fit_is_there(here, call, monkeypatch, seen, code):
    def refused(fit, **options):
        raise UntrustedPosteriorError("the draws are too few", seen=seen, allowed="more", cure="wait")

    monkeypatch.setattr(importlib.import_module("casadi_engine.posterior"), "posterior", refused)
    done = call("fit", "problem.py", "--posterior", "--out", "out")
    assert done.code == code
    assert "no posterior: the draws are too few" in done.err
    assert "the fit itself is in out" in done.err
    assert files(here / "out") == FIT
    assert json.loads((here / "out" / "result.json").read_text())["status"] == "converged"


def test_what_the_data_leave_open_is_one_message(here, call):
    text = (here / "problem.py").read_text()
    bounds = 'p["C_eng"].set(0.4, min=0.01, max=4)'
    (here / "problem.py").write_text(text.replace(bounds, 'p["C_eng"].set(0.4, min=-float("inf"))'))
    done = call("fit", "problem.py", "--posterior", "--out", "out")
    assert done.code == 3
    assert "no posterior: " in done.err
    assert "C_eng" in done.err
    assert files(here / "out") == FIT


def test_an_interrupt_before_the_draws_keeps_the_fit(here, call, monkeypatch):
    def stopped(fit, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib.import_module("casadi_engine.posterior"), "posterior", stopped)
    done = call("fit", "problem.py", "--posterior", "--out", "out")
    assert done.code == 130
    assert "interrupted before the posterior; the fit itself is in out" in done.err
    assert files(here / "out") == FIT
    (here / "out" / "posterior.html").write_text("mine")  # the earlier command left none
    assert call("fit", "problem.py", "--out", "out").code == 0
    assert (here / "out" / "posterior.html").read_text() == "mine"
