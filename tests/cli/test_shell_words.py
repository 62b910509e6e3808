"""A command says what to type next on the command line, and a repaired model goes on from its result."""

import json
from pathlib import Path

import pytest

from casadi_engine.cli.shell_words import in_shell


def shown(text, **how):
    return in_shell(text, problem=Path("rig.py"), folder=Path("results/rig-fit"), **how)


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        (
            "Next: test it on data it has not seen: print(ce.validate(fit, fresh))",
            "Next: test it on data it has not seen: casadi-engine validate rig.py --from results/rig-fit --data\n"
            "      FRESH.csv",
        ),
        (
            "Next: go on with repair.fit, the repaired model: print(repair.fit)",
            "Next: go on with the repaired model: casadi-engine validate rig.py --from results/rig-fit --data\n"
            "      FRESH.csv, or casadi-engine simulate rig.py --from results/rig-fit",
        ),
        ("Note: 2 more in repair.messages", "Note: 2 more in result.json, messages"),
        (
            "Next: only one search found the lowest cost: repeat with starts=32",
            "Next: only one search found the lowest cost: repeat with starts=32 in the problem file",
        ),
        (
            "Next: look at the curve of the unknown torque, ce.report(repair, 'repair.html'), and write an\n"
            "      effect of your own",
            "Next: look at the curve of the unknown torque in report.html, and write an effect of your own",
        ),
        (
            "Next: the errors that the data do tell: print(ce.posterior(fit))",
            "Next: the errors that the data do tell: casadi-engine fit rig.py --posterior",
        ),
        (
            "Note: the errors of J1 are not known, call ce.posterior(fit)",
            "Note: the errors of J1 are not known, call casadi-engine fit rig.py --posterior",
        ),
    ],
)
def test_the_next_step_is_one_of_the_shell(said, expected):
    assert shown(said) == expected


def test_a_fit_of_the_problem_file_is_not_that_of_a_repaired_model():
    said = shown("Next: its errors: print(ce.posterior(repair.fit))", repaired=True)
    assert said == "Next: its errors: ce.posterior(repair.fit), in Python"


def test_what_was_just_tested_is_not_asked_for_again():
    said = shown("Next: test it on data it has not seen: print(ce.validate(fit, fresh))", tested=True)
    assert said == "Next: use it: casadi-engine simulate rig.py --from results/rig-fit"
    said = shown("Next: test it on data it has not seen: print(ce.validate(fit, fresh))", tested=False)
    assert said == "Next: see below what the fresh records say of it"


def test_tables_stay_as_they_are():
    text = "Fit of rig: converged\n  records   run\nParameters\n  J  0.4 ± 0.1  kg m2\n\nNote: a\n  b"
    assert shown(text) == text


def test_a_repaired_model_goes_on_from_its_result(here, call, quick_report):
    """Its effect had been "a parameter that the problem does not have"."""
    problem = (here / "problem.py").read_text()
    fixed = problem.replace('p["C_eng"].set(0.4, min=0.01, max=4)', 'p.fix("C_eng", 0.3)')
    (here / "problem.py").write_text(fixed)
    assert call("repair", "problem.py", "--effects", "viscous_friction", "--out", "made").code == 0
    (found,) = json.loads((here / "made" / "result.json").read_text())["effects"]
    assert found["name"] == "viscous_friction"
    told = call("validate", "problem.py", "--from", "made", "--data", "fresh.csv", "--out", "tested")
    assert (told.code, told.err) == (0, "")
    assert "PASSED" in told.out
    assert call("simulate", "problem.py", "--from", "made", "--out", "run").code == 0
    values = json.loads((here / "run" / "result.json").read_text())["parameters"]
    assert values["engine.viscous_friction.coefficient"]["value"] == pytest.approx(0.2, abs=0.02)
    event = (here / "made" / "result.json").read_text().replace('"viscous_friction"', '"load_step"')
    (here / "event.json").write_text(event)
    told = call("simulate", "problem.py", "--from", "event.json", "--out", "at_that_time")
    assert "load_step at engine is an event of the records it was found in: here it happens at" in told.out
    foreign = (here / "made" / "result.json").read_text().replace('"viscous_friction"', '"fan_torque"')
    (here / "made" / "result.json").write_text(foreign)
    told = call("validate", "problem.py", "--from", "made")
    assert told.code == 2
    assert "the effect fan_torque at engine that was found cannot be added" in told.err
    assert 'model.with_effect(..., at="engine")' in told.err
