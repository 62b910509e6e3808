"""The code of the README runs as it stands."""

import inspect
import os
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.confirmation import Gap
from casadi_engine.discrepancy.repaired import (
    FoundEffect,
    Gaps,
    Member,
    Nearest,
    NotFound,
    Repair,
    Side,
    Unknown,
)
from casadi_engine.estimation import Estimate

ROOT = Path(__file__).resolve().parents[1]
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)


# In the quick run a repair is of a small record, among the same effects but for a play: those of the main job's records
# are in tests/problems.
WHOLE = pytest.param(True, marks=pytest.mark.slow, id="as it stands")
RUNS = [
    pytest.param(number, *whole.values, marks=whole.marks, id=f"{number}{'-whole' if whole.marks else ''}")
    for number, block in enumerate(BLOCKS)
    for whole in ([pytest.param(False), WHOLE] if "ce.repair" in block else [pytest.param(False)])
]


def swing():
    """A shaft with dry friction that goes to and fro."""
    time = 0.02 * np.arange(200)
    torque = 80 * np.sin(1.5 * time)
    plant = ce.one_inertia().with_effect(ce.effects.CoulombFriction(), at="engine", values={"torque": 3.0})
    drive = ce.Experiment.from_arrays("swing", time=time, units={"T": "N m"}, T=torque)
    speed = ce.simulate(plant, drive, initial={"omega_eng": 0.0})["omega"].values
    speed = speed + 0.1 * np.random.default_rng(0).standard_normal(len(time))
    return ce.Experiment.from_arrays(
        "swing", time=time, units={"T": "N m", "omega": "rad/s"}, T=torque, omega=speed
    )


@pytest.mark.parametrize(("number", "whole"), RUNS)
def test_block(number, whole, tmp_path, monkeypatch, capsys):
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    real = ce.repair

    def of_a_small_record(model, record, *, fresh, effects, **options):
        inspect.signature(real).bind(model, record, fresh=fresh, effects=effects, **options)
        assert model.inputs == ce.two_mass().inputs
        assert {*record.names} == {*fresh.names}
        few = [one for one in effects if one != "backlash"]
        return real(ce.one_inertia(), swing(), effects=few, starts=1, **options)

    if not whole:
        monkeypatch.setattr(ce, "repair", of_a_small_record)
    exec(compile("import casadi_engine as ce\n" + BLOCKS[number], f"README.md block {number}", "exec"), {})  # noqa: S102
    if "ce.report" in BLOCKS[number]:
        assert os.path.getsize("report.html") > 10_000
        assert "Fit of two_mass: converged" in capsys.readouterr().out


def test_there_are_blocks():
    assert len(BLOCKS) >= 2


def test_the_table_of_a_repair_names_what_there_is():
    """Every name in code of the table's first column is one of the answer's, of its parts, or of an estimate."""
    known = {"found", "name", "output"}
    for part in (Repair, FoundEffect, Member, Nearest, Unknown, NotFound, Gaps, Side, Gap, Estimate):
        known |= {one.name for one in fields(part)} | {name for name in dir(part) if name[0] != "_"}
    table = (
        (ROOT / "README.md").read_text(encoding="utf-8").partition("| in Python |")[2].partition("\n\n")[0]
    )
    rows = [row.split("|")[1] for row in table.splitlines() if row.startswith("| `")]
    assert len(rows) == 11
    names = [
        name for row in rows for text in re.findall(r"`(.*?)`", row) for name in re.findall(r"[a-z]\w+", text)
    ]
    assert len(names) > 25
    assert set(names) <= known, set(names) - known
