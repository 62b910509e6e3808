"""problems/hidden_effect.py: the main job names what the simulator hid, and says how large it is."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine import cli

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "problems" / "hidden_effect.py"
DATA = ROOT / "data" / "hidden_effect"
# The two masses of Table 4.1, which the simulator turned.
TRUTH = {"J_eng": 1 / 2.557, "J_load": 1 / 5.646, "K_el": 1992.0, "C_el": 2.5, "C_eng": 0.1541}


# The quick run has the parts of an answer in tests/discrepancy/test_repair_requests.py, and a smaller repair by the
# command in tests/cli/test_repair_command.py.
pytestmark = pytest.mark.slow


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


@pytest.fixture(scope="module")
def repaired(tmp_path_factory):
    """The command on two cycles, confirmed on three of the fresh record: exit code, what it complained of, its
    result.json, the answer."""
    folder, kept, complained = tmp_path_factory.mktemp("two_cycles"), [], io.StringIO()
    for name, last in (("misfire_1200rpm", 2), ("normal_1400rpm", 3)):
        ce.read_experiment(DATA / f"{name}.csv.gz").cycles(1, last).to_csv(folder / f"{name}.csv")
    files = ["--data", folder / "misfire_1200rpm.csv", "--validate", folder / "normal_1400rpm.csv"]

    def page(result, path, **options):
        # Figures take seconds; the tests of the report room draw them.
        kept.append(result)
        path.touch()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importlib.import_module("casadi_engine.report"), "report", page)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(complained):
            code = cli.main(["repair", str(PAGE), *map(str, files), "--out", str(folder / "out")])
    result = json.loads((folder / "out" / "result.json").read_text())
    return SimpleNamespace(code=code, complained=complained.getvalue(), result=result, answer=kept[0])


@pytest.fixture
def found(repaired):
    return repaired.answer


def test_the_hidden_effect_is_named_in_two_cycles(repaired, secret):
    assert (repaired.code, repaired.complained) == (0, "")
    check(repaired.result, secret)


def test_the_effect_stands_alone_at_its_place(found):
    (one,) = found.effects
    assert one.key == "coupling.coulomb_friction"
    assert one.sentence == "dry friction at coupling"
    assert one.p_value < 1e-10
    assert one.share_explained > 0.9
    assert [m.name for m in one.members] == ["coulomb_friction"]
    assert found.where.location == "coupling"
    assert found.latent[0].port == "coupling"


def test_the_repaired_model_is_as_good_as_noise_on_fresh_data(found):
    gaps = found.gaps
    assert gaps.source == "records"
    assert gaps.gain_per_cycle.mean > 2 * gaps.gain_per_cycle.se
    assert gaps.gain_per_cycle.cycles == 3
    assert set(gaps.validation_after.traces) == {"normal_1400rpm"}


def test_the_shift_of_the_damping_was_predicted(found):
    """The damper had stood for the friction."""
    (one,) = found.effects
    assert one.found_shift["C_el"] < -2
    assert one.predicted_shift["C_el"] == pytest.approx(one.found_shift["C_el"], rel=0.5)


def test_the_equations_of_the_repaired_model_show_the_term(found):
    assert any("coupling.coulomb_friction.torque" in line for line in found.equation.terms)
    assert found.equation.text == found.model.equations()
    assert "coupling.coulomb_friction.torque" in found.parameters


def test_what_was_not_found_comes_with_the_size_that_would_have_been(found):
    missed = {(m.name, m.at): m for m in found.not_found}
    assert ("coulomb_friction", "coupling") not in missed
    cubic = missed["cubic_stiffness", "coupling"]
    assert cubic.testable
    assert 1e3 < cubic.smallest_detectable < 1e6
    assert cubic.unit == "N m/rad3"
    lost = missed["viscous_friction", "engine"]  # it is one of the parameters
    assert not lost.testable
    assert lost.smallest_detectable == np.inf


def test_the_law_is_there_over_time(found):
    time, law = found.effects[0].course["misfire_1200rpm"]
    assert time[0] == found.latent[0].courses["misfire_1200rpm"].time[0]
    assert np.abs(law).max() == pytest.approx(found.effects[0].amplitude.value, rel=0.01)
    assert law.min() < 0 < law.max()


def test_the_summary_fits_one_screen_and_says_what_was_found(found):
    text = str(found)
    lines = text.splitlines()
    assert len(lines) <= 45
    assert max(map(len, lines)) <= 100
    assert lines[-1].startswith(("Next: ", "      "))
    assert text.startswith(
        "Repair of two_mass: coulomb_friction at coupling is missing, confirmed on fresh data"
    )
    assert "coupling.coulomb_friction.torque = " in text
    assert "fresh data: 2 ln(likelihood) changes by " in text


def test_the_main_job_as_it_is(secret, tmp_path, capsys):
    assert cli.main(["repair", str(PAGE), "--out", str(tmp_path)]) == 0
    result = ce.load_result(tmp_path).to_dict()
    check(result, secret)
    assert len(capsys.readouterr().out.splitlines()) <= 48
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert len(page) < 3_000_000
    assert page.count("<figure>") >= 8
