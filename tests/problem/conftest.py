"""A small problem and a way to write problem files."""

from __future__ import annotations

import textwrap

import pytest

from casadi_engine.model import one_inertia
from casadi_engine.problem import Problem

FILE = """
from casadi_engine.model import one_inertia
from casadi_engine.problem import Problem


def problem():
    m = one_inertia()
    return Problem(name="demo", goal="find J", model=m, parameters=m.parameters(), records=["run.csv"])
"""


@pytest.fixture
def make():
    """make(**changes) -> a Problem of one inertia."""

    def build(**changes):
        model = one_inertia()
        fields = {"name": "demo", "goal": "find J", "model": model, "parameters": model.parameters()}
        return Problem(**{**fields, **changes})

    return build


@pytest.fixture
def write(tmp_path):
    """write(text, name) -> path of a file with that text."""

    def build(text=FILE, name="demo.py"):
        path = tmp_path / name
        path.write_text(textwrap.dedent(text), encoding="utf-8")
        return path

    return build


@pytest.fixture
def record(tmp_path):
    """record(name) -> path of a data file with torque and speed of a run-up."""

    def build(name="run.csv", rows=5):
        lines = ["time [s],T [N m],omega [rad/s]", *(f"{k / 10},1,{10 + k / 10}" for k in range(rows))]
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    return build
