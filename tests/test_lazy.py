"""What an import loads, and the public names that load their module at first use."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import casadi_engine as ce

PACKAGES = [
    "casadi_engine",
    *(
        f"casadi_engine.{name}"
        for name in (
            "discrepancy",
            "effects",
            "estimation",
            "experiment",
            "identifiability",
            "model",
            "report",
            "validation",
        )
    ),
]
HEAVY = ("scipy", "pandas", "matplotlib", "typer", "click", "rich", "jinja2", "joblib")
RECORD = Path(__file__).resolve().parent.parent / "data" / "normal_1200rpm.csv.gz"
FIT = f"""
model = ce.two_mass(
    cylinders=4,
    firing_order=(1, 3, 4, 2),
    geometry={{"r": 0.043, "L": 0.145, "A_p": 0.0058, "m_eq": 0.7, "p_crank": 1.0e5}},
)
run = ce.read_experiment({str(RECORD)!r}, optional=("omega_load",))
str(ce.estimate(model, run, noise=ce.Noise(omega="estimate")))
"""


def loaded(code: str) -> set[str]:
    """The modules that a new process has after `code`."""
    code = f"import sys\n{code}\nprint('\\n', *sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return {*done.stdout.splitlines()[-1].split()}


def heavy(modules: set[str]) -> set[str]:
    return {name for name in HEAVY if name in modules}


def test_the_import_loads_nothing_but_itself():
    assert {name for name in loaded("import casadi_engine") if name.startswith("casadi")} == {
        "casadi_engine",
        "casadi_engine.effects",
        "casadi_engine.lazy",
    }


def test_models_problems_and_records_are_made_without_heavy_packages():
    made = f"ce.two_mass()\nce.crankshaft\nce.Problem\nce.read_experiment({str(RECORD)!r})"
    assert heavy(loaded(f"import casadi_engine as ce\n{made}")) == set()


def test_a_linear_model_is_fitted_without_the_large_modules_of_scipy():
    modules = loaded(f"import casadi_engine as ce\n{FIT}")
    assert "casadi_engine.estimation.estimate" in modules
    assert heavy(modules) <= {"scipy"}
    large = {f"scipy.{name}" for name in ("stats", "signal", "optimize", "integrate", "ndimage", "sparse")}
    assert modules & large == set()


def test_the_help_of_the_command_computes_nothing():
    asked = "for arguments in (['--help'], ['fit', '--help'], ['--version']):\n    assert cli.main(arguments) == 0"
    modules = loaded(f"from casadi_engine import cli\n{asked}")
    assert "typer" in modules
    assert modules & {"numpy", "casadi", "scipy", "pandas", "matplotlib", "jinja2"} == set()


@pytest.mark.parametrize(
    "package",
    [PACKAGES[0], *(pytest.param(one, marks=pytest.mark.slow) for one in PACKAGES[1:])],
)
def test_every_public_name_is_there_at_once(package):
    """In a new process, where nothing is loaded yet."""
    code = f"""
import importlib, types
room = importlib.import_module({package!r})
assert {{*room.__all__}} <= {{*dir(room)}}
own = ("casadi_engine", "effects")
for name in room.__all__:
    assert (room.__name__, name) == own or not isinstance(getattr(room, name), types.ModuleType), name
names = {{}}
exec("from {package} import *", names)
assert {{*room.__all__}} <= {{*names}}
"""
    loaded(code)


@pytest.mark.parametrize("package", PACKAGES)
def test_type_checkers_see_the_same_names(package):
    room = importlib.import_module(package)
    tree = ast.parse(Path(room.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    shown = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        home = node.module if not node.level else f"{package}.{node.module}"
        shown |= {alias.name: home for alias in node.names}
    assert shown == room._homes
    assert {*room.__all__} == {*shown} | ({"effects"} if package == "casadi_engine" else set())


def test_a_module_does_not_take_the_place_of_the_function_of_its_name():
    importlib.import_module("casadi_engine.estimation.estimate")
    importlib.import_module("casadi_engine.identifiability")
    assert callable(ce.identifiability)
    assert not isinstance(importlib.import_module("casadi_engine.estimation").estimate, ModuleType)


def test_modules_are_still_reached_by_their_path():
    import casadi_engine.estimation.fit

    assert isinstance(casadi_engine.estimation.fit, ModuleType)


def test_an_unknown_name_is_an_attribute_error_with_the_one_that_was_meant():
    with pytest.raises(AttributeError, match=r"^module 'casadi_engine' has no attribute 'estimat'$"):
        _ = ce.estimat
    code = "import casadi_engine as ce; ce.estimat"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stderr.splitlines()[-1].endswith("Did you mean: 'estimate'?")
    with pytest.raises(ImportError, match="cannot import name 'estimat'"):
        from casadi_engine import estimat  # noqa: F401


def test_a_name_can_be_replaced(monkeypatch):
    monkeypatch.setattr(ce, "estimate", len)
    assert ce.estimate is len
    monkeypatch.undo()
    assert ce.estimate.__module__ == "casadi_engine.estimation.estimate"
