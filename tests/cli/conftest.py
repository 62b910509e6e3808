"""A small problem on disk, the command line in this process, and stubs where the real thing is slow."""

from __future__ import annotations

import importlib
from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine import cli

PROBLEM = '''"""Inertia and damping from a run-up."""
from casadi_engine.model import one_inertia
from casadi_engine.problem import Noise, Problem


def problem():
    m = one_inertia()
    p = m.parameters()
    p["J_eng"].set(0.3, min=0.01, max=4)
    p["C_eng"].set(0.4, min=0.01, max=4)
    return Problem(name="run_up", goal=__doc__, model=m, parameters=p, noise=Noise(omega=0.05),
                   records=["run.csv"], validation=["fresh.csv"])
'''


def run_up(path, *, seed, inertia=0.4, damping=0.5, rows=120, ripple=0.0):
    """Write a record of one inertia under an alternating torque, with white noise of 0.05 rad/s."""
    rng = np.random.default_rng(seed)
    step = 0.02
    torque = np.where(rng.random(rows) < 0.5, 1.0, 3.0)
    decay = np.exp(-damping / inertia * step)
    omega = np.empty(rows)
    omega[0] = 2.0
    for k in range(rows - 1):
        # The torque is joined by straight lines between its samples, as engine inputs are by default.
        rest, slope = torque[k], (torque[k + 1] - torque[k]) / step
        ends = (
            (rest - slope * inertia / damping) / damping,
            (rest + slope * step - slope * inertia / damping) / damping,
        )
        omega[k + 1] = decay * (omega[k] - ends[0]) + ends[1]
    time = step * np.arange(rows)
    omega += 0.05 * rng.standard_normal(rows) + ripple * np.sin(40 * time)
    lines = [f"{t:.6f},{x:.6f},{w:.9f}" for t, x, w in zip(time, torque, omega, strict=True)]
    path.write_text("\n".join(["time [s],T [N m],omega [rad/s]", *lines]) + "\n")
    return path


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with problem.py, run.csv and fresh.csv, which is the working folder."""
    (tmp_path / "problem.py").write_text(PROBLEM)
    run_up(tmp_path / "run.csv", seed=1)
    run_up(tmp_path / "fresh.csv", seed=2)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def call(capsys):
    """call("fit", "problem.py") -> code, out, err of the command line."""

    def run(*arguments):
        code = cli.main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return SimpleNamespace(code=code, out=captured.out, err=captured.err)

    return run


@pytest.fixture
def quick_report(monkeypatch):
    """Figures take a second; tests that do not look at them do without."""

    def page(result, path, **options):
        path.write_text("<!doctype html><title>stub</title>")
        return path

    # By the import system: the attribute `report` of the package may be the function of that name.
    monkeypatch.setattr(importlib.import_module("casadi_engine.report"), "report", page)


def tree(folder):
    """All files and folders below a folder, without what Python leaves."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))
