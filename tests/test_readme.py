"""The code of the README runs as it stands."""

import os
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_block(number, tmp_path, monkeypatch, capsys):
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    exec(compile("import casadi_engine as ce\n" + BLOCKS[number], f"README.md block {number}", "exec"), {})  # noqa: S102
    if "ce.report" in BLOCKS[number]:
        assert os.path.getsize("report.html") > 10_000
        assert "Fit of two_mass: converged" in capsys.readouterr().out


def test_there_are_blocks():
    assert len(BLOCKS) >= 2
