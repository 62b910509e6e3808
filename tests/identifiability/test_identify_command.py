"""``casadi-engine identify``: answers, exit codes, files, and messages."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest

from casadi_engine import cli
from casadi_engine.cli.identify import by_name
from casadi_engine.errors import IdentifiabilityError
from casadi_engine.report import load_result

PROBLEM = '''"""Two masses without records."""
from casadi_engine.model import two_mass
from casadi_engine.problem import Problem


def problem():
    m = two_mass(reciprocating_speed="measured")
    return Problem(name="pair", goal=__doc__, model=m, parameters=m.parameters())
'''


@pytest.fixture
def call(tmp_path, monkeypatch, capsys):
    (tmp_path / "problem.py").write_text(PROBLEM)
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        code = cli.main(["identify", "problem.py", *arguments])
        captured = capsys.readouterr()
        folder = tmp_path / "results" / "pair-identify"
        return SimpleNamespace(code=code, out=captured.out, err=captured.err, folder=folder)

    return run


def test_a_yes_is_written_and_ends_with_0(call):
    done = call("--check")
    assert (done.code, done.err) == (0, "")
    assert "YES, all 5 free parameters can be told" in done.out
    assert "has no records" in done.out
    stored = load_result(done.folder)  # the published schema holds
    assert (stored["rank"], stored["size"], stored["directions"], stored["order"]) == (8, 8, 5, 7)
    assert stored["identifiable"]["K_el"] is True
    assert stored["remedies"] == ()
    page = (done.folder / "report.html").read_text()
    assert "can be told" in page
    assert "://" not in page


def test_a_lost_parameter_ends_with_1_only_when_it_is_checked(call):
    done = call("--inputs", "zero", "--combination", "K_el/J_eng")
    assert done.code == 0
    assert "NO, none of the 5 free parameters can be told" in done.out
    stored = json.loads((done.folder / "result.json").read_text())
    assert (stored["rank"], stored["size"], stored["passed"]) == (6, 8, False)
    assert stored["symmetries"][0]["exponents"]["C_el"] == 1
    assert stored["combinations"] == {"K_el/J_eng": False}
    assert any(change["kind"] == "drive" for remedy in stored["remedies"] for change in remedy["changes"])
    assert "excite T_1" in (done.folder / "report.html").read_text()
    assert call("--inputs", "zero", "--check").code == 1


def test_drives_starts_and_outputs_by_name(call):
    done = call(
        "--inputs", "T_load=unknown,*=constant", "--start", "twist=0,*=free", "--outputs", "omega,omega_load"
    )
    assert done.code == 0
    settings = json.loads((done.folder / "result.json").read_text())["settings"][0]
    assert settings["inputs"]["T_load"] == "unknown arbitrary"
    assert settings["inputs"]["T_1"] == "constant"
    assert settings["start"] == {"omega_eng": "free", "omega_load": "free", "twist": "0"}
    assert settings["outputs"] == ["omega", "omega_load"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--free", "K_e"), ("unknown parameter", "'K_e'", "nearest: K_el")),
        (("--inputs", "T_9=zero"), ("the model has no such drive", "'T_9'", "T_1")),
        (("--inputs", "rich"), ("the class of a drive is not known", "'rich'", "generic, constant, zero")),
        (("--inputs", "T_1=zero,T_1=zero"), ("--inputs cannot be read", "each name once")),
        (("--start", "asleep"), ("the start is not acceptable", "'asleep'")),
        (("--start", "angle=rest"), ("the model has no such state", "'angle'")),
        (("--outputs", "torque"), ("the model has no such output or state", "'torque'")),
        (("--combination", "K_el*J9"), ("unknown name J9",)),
    ],
)
def test_bad_input_is_one_message_and_nothing_is_written(call, arguments, words):
    done = call(*arguments)
    assert done.code == 2
    assert not done.folder.exists()
    assert len(done.err.strip().splitlines()) == 1 or "^" in done.err
    for word in words:
        assert word in done.err


def test_words_by_name():
    assert by_name("--inputs", " zero ") == "zero"
    assert by_name("--start", "a=1.5,b=free") == {"a": 1.5, "b": "free"}
    with pytest.raises(IdentifiabilityError, match="cannot be read"):
        by_name("--start", "a=")
