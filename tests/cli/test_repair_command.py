"""`casadi-engine repair` in this process: verdicts, exit codes, files, options, and one message for every fault."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import io
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine import cli, discrepancy
from casadi_engine.cli.earlier import _with_effects
from casadi_engine.discrepancy.input_hold import TAKEN
from casadi_engine.discrepancy.repaired import UNTOLD, Unknown
from casadi_engine.effects import InputPath
from casadi_engine.effects.protocol import settings_of, with_settings
from casadi_engine.errors import NotConvergedError
from casadi_engine.estimation import Estimate
from casadi_engine.report import load_result
from casadi_engine.report.repaired import _effect as stored_effect

PROBLEM = '''"""Inertia and damping from a torque that goes back and forth."""
import casadi_engine as ce


def problem():
    m = ce.one_inertia()
    p = m.parameters()
    p["J_eng"].set(0.3, min=0.01, max=4)
    p["C_eng"].set(0.4, min=0.01, max=4)
    return ce.Problem(name="swing", goal=__doc__, model=m, parameters=p, noise=ce.Noise(omega=0.05),
                      records=["run.csv"], validation=["fresh.csv"])
'''


def swing(path, *, seed, friction=0.0, rows=400):
    """A record of one inertia under random torque, with sharp dry friction; in 200 steps between samples."""
    rng = np.random.default_rng(seed)
    step, parts, inertia, damping = 0.02, 200, 0.4, 0.5
    time = step * np.arange(rows)
    torque = sum(rng.uniform(20, 40) * np.sin(w * time + rng.uniform(0, 6)) for w in (2.0, 5.1, 11.3, 17.7))
    fine = np.interp(np.arange(rows * parts) * step / parts, time, torque).tolist()
    speed, h, omega = 0.0, step / parts, []
    for k, drive in enumerate(fine):
        if k % parts == 0:
            omega.append(speed)
        free = speed + h / inertia * (drive - damping * speed)
        grip = h / inertia * friction
        speed = free - max(-grip, min(grip, free))  # implicit: it sticks as long as it can hold
    noisy = np.array(omega) + 0.05 * rng.standard_normal(rows)
    lines = [f"{t:.6f},{x:.9f},{w:.9f}" for t, x, w in zip(time, torque, noisy, strict=True)]
    path.write_text("\n".join(["time [s],T [N m],omega [rad/s]", *lines]) + "\n")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """problem.py, run.csv and fresh.csv with dry friction of 3 N m, clean.csv and clean_fresh.csv without."""
    made = tmp_path_factory.mktemp("swing")
    (made / "problem.py").write_text(PROBLEM)
    for name, seed, friction in (
        ("run", 1, 3.0),
        ("fresh", 2, 3.0),
        ("clean", 3, 0.0),
        ("clean_fresh", 4, 0.0),
    ):
        swing(made / f"{name}.csv", seed=seed, friction=friction)
    return made


def run(folder, *arguments, out="out"):
    """Exit code and result.json of the command in a folder."""
    code = cli.main(["repair", str(folder / "problem.py"), *map(str, arguments), "--out", str(folder / out)])
    path = folder / out / "result.json"
    return code, json.loads(path.read_text()) if path.exists() else None


@pytest.fixture(scope="module")
def found(folder):
    """One run with everything that it writes, what it said, and what `repair` was given and gave."""
    said, complained, kept = io.StringIO(), io.StringIO(), []
    real = discrepancy.repair

    def repair(*arguments, **options):
        kept.append((options, real(*arguments, **options)))
        return kept[-1][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(discrepancy, "repair", repair)
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(complained):
            code, result = run(folder, "--seed", 3, out="found")
    options, answer = kept[0]
    return SimpleNamespace(
        code=code,
        result=result,
        out=said.getvalue(),
        err=complained.getvalue(),
        options=options,
        answer=answer,
    )


@pytest.fixture
def canned(found, monkeypatch, quick_report):
    """canned(verdict=...) lets the next command find the answer of `found`, changed so."""

    def give(**changes):
        given = []
        changed = dataclasses.replace(found.answer, **changes)
        monkeypatch.setattr(discrepancy, "repair", lambda *a, **options: given.append(options) or changed)
        return given

    return give


# ---- one real run


def test_a_hidden_effect_is_named_and_confirmed(found):
    assert (found.code, found.err) == (0, "")
    result = found.result
    assert (result["command"], result["status"], result["verdict"], result["confirmed"]) == (
        "repair", "answered", "named", True,
    )  # fmt: skip
    (effect,) = result["effects"]
    assert (effect["name"], effect["at"]) == ("coulomb_friction", "engine")
    torque = effect["parameters"]["engine.coulomb_friction.torque"]
    assert abs(torque["value"] - 3.0) < 4 * torque["stderr"]
    for name, truth in (("J_eng", 0.4), ("C_eng", 0.5)):
        one = result["parameters"][name]
        assert abs(one["value"] - truth) < 5 * one["stderr"], name
    gap = result["gap"]["validation"]
    assert gap["after"]["rmse"]["omega"] < 0.1 * gap["before"]["rmse"]["omega"]
    assert (result["seed"], result["arguments"]["alpha"], result["arguments"]["holdout"]) == (3, 0.01, 0.3)


def test_the_verdict_is_one_screen_and_says_where_the_files_are(found, folder):
    lines = found.out.splitlines()
    assert lines[0] == "Repair of one_inertia: coulomb_friction at engine is missing, confirmed on fresh data"
    assert len(lines) <= 48
    assert lines[-2].endswith("result.json")
    assert lines[-1].endswith("report.html")


def test_the_page_opens_alone_and_the_result_is_read_back(found, folder):
    page = (folder / "found" / "report.html").read_text(encoding="utf-8")
    assert "Something is missing: dry friction at engine" in page
    assert page.count("<figure>") >= 6
    assert "://" not in page
    assert len(page) < 3_000_000
    again = load_result(folder / "found")
    assert again.values["engine.coulomb_friction.torque"] == pytest.approx(3.0, abs=0.1)


def test_how_the_answer_took_the_inputs_goes_along_with_it(folder, canned, found, capsys):
    """A right model with a held input, which `repair` had found by itself, failed on the records that were read as
    lines again."""
    canned(options={**found.answer.options, TAKEN: {"T": "zero"}})
    code, result = run(folder, out="taken")
    assert (code, result["with_hold"]) == (0, {"T": "zero"})
    assert found.result["with_hold"] == {}
    capsys.readouterr()
    problem = str(folder / "problem.py")
    for command in ("validate", "simulate"):
        options = ["--from", str(folder / "taken"), "--out", str(folder / f"taken_{command}")]
        assert cli.main([command, problem, *options]) == 0
        assert 'as the repair took them, with_hold(T="zero")' in capsys.readouterr().out
    stored = json.loads((folder / "taken_validate" / "result.json").read_text())
    holds = {one["name"]: one["hold"] for one in stored["inputs"][0]["channels"]}
    assert holds == {"T": "zero", "omega": "first"}


def test_what_reaches_repair(found):
    assert found.options["fresh"][0].name == "fresh"
    assert (found.options["alpha"], found.options["holdout"], found.options["seed"]) == (0.01, 0.3, 3)
    assert found.options["starts"] == 4
    assert found.options["noise"].level("omega") == 0.05


def test_nothing_missing_is_no_negative_answer(folder, quick_report, capsys):
    files = ["--data", folder / "clean.csv", "--validate", folder / "clean_fresh.csv", "--check"]
    code, result = run(folder, *files, out="clean")
    assert (code, result["verdict"], result["effects"]) == (0, "nothing missing", [])
    assert "nothing is missing" in capsys.readouterr().out


# ---- exit codes and options


@pytest.mark.parametrize("verdict", ["named", "class", "unnamed"])
def test_check_makes_something_missing_negative(folder, canned, verdict, capsys):
    canned(verdict=verdict)
    assert run(folder, "--check")[0] == 1
    assert run(folder)[0] == 0
    assert capsys.readouterr().err == ""


def test_options_reach_repair(folder, canned):
    given = canned()
    files = [
        "--data",
        folder / "clean.csv",
        "--alpha",
        "0.05",
        "--holdout",
        "0.5",
        "--seed",
        "9",
        "--fix",
        "C_eng=0.5",
    ]
    code, result = run(folder, *files)
    (options,) = given
    assert (code, options["fresh"]) == (0, None)  # --data replaces the validation records too
    assert (options["alpha"], options["holdout"], options["seed"]) == (0.05, 0.5, 9)
    assert not options["parameters"]["C_eng"].vary
    assert result["arguments"]["alpha"] == 0.05


def test_no_name_is_no_wish_for_the_whole_library(folder, capsys):
    assert run(folder, "--effects", "", out="none")[0] == 2
    assert "the library has no such effect; seen: ''" in capsys.readouterr().err


def test_names_are_given_by_commas_or_by_repeating_the_option(folder, canned):
    given = canned()
    run(
        folder,
        "--effects",
        "coulomb_friction, viscous_friction",
        "--effects",
        "backlash",
        "--without",
        "impulse",
    )
    assert given[0]["effects"] == ["coulomb_friction", "viscous_friction", "backlash"]
    assert given[0]["without"] == ["impulse"]
    run(folder)
    assert (given[1]["effects"], given[1]["without"]) == (None, [])


@pytest.mark.parametrize(
    ("status", "code"), [("the fit without effects has not converged", 3), ("interrupted", 130)]
)
def test_a_first_fit_without_answer(folder, canned, found, capsys, status, code):
    canned(status=status, verdict=None, confirmed=None, effects=(), gaps=None, threshold=None, equation=None,
           where=None, fit=found.answer.null_fit)  # fmt: skip
    got, result = run(folder, out="failed")
    assert (got, result["status"], result["verdict"]) == (code, status, None)
    assert capsys.readouterr().err == (
        f"casadi-engine repair: no answer: {status}; what there is lies in {folder / 'failed'}\n"
    )


def test_a_time_that_was_too_short_for_a_finding(folder, canned, capsys):
    canned(
        status=UNTOLD, verdict=None, confirmed=None, effects=(), unknown=Unknown(UNTOLD, {}),
        stopped="the time budget",
    )  # fmt: skip
    code, _ = run(folder, out="short")
    assert code == 3
    said = "no answer: the time was up before it could be told whether anything is missing; what there is lies in"
    assert said in " ".join(capsys.readouterr().err.split())


def test_a_search_that_finds_no_point_is_written(folder, monkeypatch, capsys):
    def repair(*arguments, **options):
        raise NotConvergedError("no start gave a finite cost", cure="give other start values")

    monkeypatch.setattr(discrepancy, "repair", repair)
    code, result = run(folder, out="nothing")
    assert code == 3
    assert "no start gave a finite cost" in capsys.readouterr().err
    assert result["status"] == "not converged: no start gave a finite cost"
    assert (result["verdict"], result["alpha"], result["effects"]) == (None, 0.01, [])
    assert result["why"]["threshold"] == "the fit without effects found no point"
    load_result(folder / "nothing")
    assert not (folder / "nothing" / "report.html").exists()


def test_ctrl_c_in_the_search_keeps_the_fit(folder, quick_report, monkeypatch, capsys):
    def screen(*arguments, **options):
        raise KeyboardInterrupt

    # By the import system: the attribute `repair` of the package is the function of that name.
    monkeypatch.setattr(importlib.import_module("casadi_engine.discrepancy.repair"), "screen_in_turn", screen)
    code, result = run(folder, out="stopped")
    assert (code, result["status"], result["verdict"]) == (130, "interrupted", None)
    assert result["null_fit"]["status"] == "converged"
    assert result["parameters"]["J_eng"]["value"] == pytest.approx(0.4, rel=0.01)
    assert "interrupted before the search was at its end" in result["messages"][0]
    told = capsys.readouterr().err
    assert (
        told == f"casadi-engine repair: no answer: interrupted; what there is lies in {folder / 'stopped'}\n"
    )
    load_result(folder / "stopped")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--alpha", "0"], "invalid `alpha`"),
        (["--alpha", "2"], "invalid `alpha`"),
        (["--holdout", "1"], "invalid `holdout`"),
        (["--set", "K_el=3"], "K_el"),
        (["--data", "none.csv"], "none.csv"),
    ],
)
def test_wrong_input_is_one_message_and_nothing_is_written(folder, capsys, options, words):
    code, result = run(folder, *options, out="untouched")
    assert (code, result) == (2, None)
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("casadi-engine repair: ")
    assert words in told.err
    assert not (folder / "untouched").exists()


def test_an_alpha_that_is_no_number(folder, capsys):
    code, result = run(folder, "--alpha", "small", out="untouched")
    assert (code, result) == (2, None)
    assert "Invalid value for '--alpha'" in capsys.readouterr().err


def test_the_help_names_every_option(capsys):
    assert cli.main(["repair", "--help"]) == 0
    told = capsys.readouterr().out
    for option in ("--alpha", "--holdout", "--check", "--data", "--validate", "--set", "--free", "--fix", "--out",
                   "--seed", "--jobs", "--debug"):  # fmt: skip
        assert option in told


MADE = (
    ce.effects.SensorDrift(span=899.0, first=100.0),
    ce.effects.SensorLag(span=(0.5, 20.0), first=2.0),
    ce.effects.InputLag(first=3.0),
    ce.effects.GroundSpring(first=0.25),
    ce.effects.WrongValue(absolute=True, low=-1.0, high=2.0),
    ce.effects.Backlash(width=0.01, torques=(-3.0, 4.0), most=0.2),
    ce.effects.StribeckFriction(span=(0.1, 2.0)),
    ce.effects.CoulombFriction(),
)


@pytest.mark.parametrize("effect", MADE, ids=lambda one: one.name)
def test_a_stored_effect_is_the_one_that_was_found(effect):
    """A drift of 0.4 mm within a record came back as one of 0.4 mm a second: rmse 55.8 mm after "confirmed"."""
    (plain,) = ce.effects.library(effect.name)
    assert with_settings(plain, json.loads(json.dumps(settings_of(effect)))) == effect
    assert settings_of(plain) == {}


def test_an_effect_of_ones_own_needs_no_settings():
    class Own(ce.Effect):
        name, attaches = "own", ("sensor",)

    own = Own()
    assert settings_of(own) == {}
    assert with_settings(own, {"span": 3.0}) is own


@dataclasses.dataclass(frozen=True)
class _Problem:
    model: object
    parameters: object


def test_a_stored_repair_has_what_is_taken_off_an_input():
    """Else `validate --from` lets the whole of an air pressure act, where its variation does."""
    b = ce.Blueprint("room")
    b.input("p", unit="Pa")
    x = b.state("x", unit="K")
    slot = b.port("air", "inertia", {"speed": x}, unit="W")
    b.ode("x", (slot - 5.0 * x) / 100.0)
    b.output("y", x, unit="K")
    model = b.model()
    wider = model.with_effect(InputPath(about=101300.0), at="p_to_air", values={"gain": 2.0})
    one = SimpleNamespace(
        key="p_to_air.input_path", name="input_path", at="p_to_air", sentence="", constants={}, z=9.0, p_value=0.0,
        drop=9.0, share_explained=1.0, predicted_shift={}, found_shift={}, selection_frequency=1.0, members=(),
        parameters={"p_to_air.input_path.gain": Estimate(2.0, 0.1, "W/Pa")},
    )  # fmt: skip
    stored = stored_effect(one, SimpleNamespace(model=wider))
    assert stored["about"] == 101300.0
    again = _with_effects(Path("r"), _Problem(model, model.parameters()), [stored])
    (effect,) = [own.effect for own in again.model.effects]
    assert effect.about == 101300.0
