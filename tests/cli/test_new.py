"""casadi-engine new: the template."""

from __future__ import annotations

import os

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.cli.new import write_template
from casadi_engine.errors import OutputError, ProblemError
from casadi_engine.problem import load_problem


def test_it_writes_a_file_and_says_what_next(tmp_path, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    done = call("new", "my_engine")
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith("Written: my_engine.py\nNext: casadi-engine fit my_engine.py --data")
    text = (tmp_path / "my_engine.py").read_text()
    assert "{{" not in text
    assert text.startswith('"""my_engine: ')
    compile(text, "my_engine.py", "exec")
    assert os.listdir(tmp_path) == ["my_engine.py"]


def test_the_template_of_ones_own_equations_fits_a_record_and_is_repaired(tmp_path, monkeypatch, call):
    """A wheel with dry friction, written in the units that the file shows."""
    monkeypatch.chdir(tmp_path)
    done = call("new", "wheel-rig", "--equations")
    assert (done.code, done.err) == (0, "")
    text = (tmp_path / "wheel-rig.py").read_text()
    assert "{{" not in text
    assert 'missing = b.port("wheel", "inertia", {"speed": speed, "angle": angle})' in text
    t = np.arange(0, 20, 0.02)
    for seed in (1, 2):
        torque = 3 * np.sin(2.1 * t + seed) + 2 * np.sin(5.3 * t)

        def rate(time, y, torque=torque):
            dry = 0.5 * np.tanh(y[1] / 1e-3)
            return [y[1], (np.interp(time, t, torque) - 4 * y[0] - 0.2 * y[1] - dry) / 0.15]

        run = solve_ivp(rate, (0, 20), [0, 0], t_eval=t, rtol=1e-7, atol=1e-9, max_step=0.02, method="LSODA")
        shown = np.degrees(run.y[0]) + 0.3 * np.random.default_rng(seed).standard_normal(len(t))
        table = pd.DataFrame({"time [s]": t, "T [N mm]": 1e3 * torque, "angle [deg]": shown})
        table.to_csv(tmp_path / f"record_{seed}.csv", index=False)
    done = call("fit", "wheel-rig.py", "--data", "record_1.csv", "--validate", "record_2.csv")
    assert done.code == 0
    assert "Fit of wheel: converged" in done.out
    effects = ("--effects", "coulomb_friction", "--effects", "quadratic_drag")
    done = call("repair", "wheel-rig.py", "--data", "record_1.csv", "--validate", "record_2.csv", *effects)
    assert done.code == 0
    assert "coulomb_friction at wheel is missing, confirmed on fresh data" in done.out


def test_it_says_how_a_model_of_ones_own_gets_a_port(tmp_path):
    """The line as it is printed; the model of the template has ports already."""
    path = write_template(str(tmp_path / "rig"))
    assert 'missing = b.port("pivot", "inertia", {"speed": speed}), added to' in path.read_text()
    b = ce.Blueprint("pendulum")
    speed = b.state("speed", unit="rad/s")
    missing = b.port("pivot", "inertia", {"speed": speed})
    b.ode("speed", missing / b.parameter("J", 0.1, unit="kg m2"))
    b.output("w", speed, unit="rad/s")
    assert [port.name for port in ce.effects.ports_for(b.model(), ce.effects.CoulombFriction())] == ["pivot"]
    assert load_problem(path).model.ports.with_slot


def test_the_ending_may_be_given_and_folders_before_it(tmp_path):
    assert write_template(str(tmp_path / "rig.py")) == tmp_path / "rig.py"
    assert 'name="rig"' in (tmp_path / "rig.py").read_text()


def test_nothing_is_overwritten(tmp_path, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.py").write_text("mine")
    done = call("new", "rig")
    assert done.code == 2
    assert done.err.startswith("casadi-engine new: rig.py: there is a file of that name already")
    assert "give another name" in done.err
    assert (tmp_path / "rig.py").read_text() == "mine"


@pytest.mark.parametrize("name", ["", "a b", "ä", ".py", "x" * 101, "a.b"])
def test_names_that_are_not_acceptable(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ProblemError, match="the name of the new problem is not acceptable") as caught:
        write_template(name)
    assert "my_engine" in str(caught.value)
    assert os.listdir(tmp_path) == []


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(OutputError, match="cannot be written; seen: No such file or directory") as caught:
        write_template(str(tmp_path / "nowhere" / "rig"))
    assert "give a name in a folder that is there" in str(caught.value)


@pytest.mark.parametrize("name", ["casadi", "json", "numpy.py"])
def test_a_name_of_a_module_is_refused(name, tmp_path, monkeypatch):
    """``casadi.py`` in the folder was imported in the place of CasADi: "a bug of this program"."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ProblemError, match=r"that of a Python module.*give a name such as my_engine"):
        write_template(name)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_that_name_is_no_module(tmp_path, monkeypatch):
    (tmp_path / "elsewhere" / "hoist").mkdir(parents=True)
    monkeypatch.syspath_prepend(tmp_path / "elsewhere")
    monkeypatch.chdir(tmp_path)
    assert write_template("hoist").name == "hoist.py"
