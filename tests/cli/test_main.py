"""The program itself: help, version, missing packages, and real processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from casadi_engine import __version__, cli
from casadi_engine.cli.job import guarded


def run(*arguments, cwd, code=None, **options):
    start = ["-c", code] if code else ["-m", "casadi_engine"]
    return subprocess.run(
        [sys.executable, *start, *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=60,
        **options,
    )


def test_help_and_version(call):
    done = call("--version")
    assert (done.code, done.out) == (0, f"{__version__}\n")
    done = call("--help")
    assert done.code == 0
    for command in ("simulate", "fit", "validate", "new"):
        assert command in done.out
    done = call("fit", "--help")
    for option in (
        "--data",
        "--validate",
        "--set",
        "--free",
        "--fix",
        "--out",
        "--seed",
        "--jobs",
        "--debug",
    ):
        assert option in done.out
    assert "130 interrupted" in " ".join(done.out.split())
    assert call("validate", "-h").out.count("  --check ") == 1
    assert call().code == 2


@pytest.mark.parametrize("name", ["typer", "rich", "jinja2"])
def test_a_missing_package_is_named_with_its_cure(name, monkeypatch, call):
    monkeypatch.setitem(sys.modules, name, None)
    done = call("fit", "problem.py")
    assert (done.code, done.out) == (2, "")
    assert done.err == (
        "casadi-engine: the command line needs packages that are not installed; "
        f"seen: without {name}; do: pip install 'casadi-engine[app]'\n"
    )


def test_all_missing_packages_in_one_message(monkeypatch, call):
    for name in cli.NEEDED:
        monkeypatch.setitem(sys.modules, name, None)
    assert "without typer, rich, jinja2" in call("new", "x").err


def test_as_a_module(here):
    done = run("fit", "nowhere.py", cwd=here)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "casadi-engine fit: nowhere.py: no such problem file; "
        "do: give the path of a problem file; `casadi-engine new NAME` writes one\n"
    )


# The command line with a page that takes no time to draw.
QUICK = """
import importlib, sys
from pathlib import Path
from casadi_engine import cli
importlib.import_module("casadi_engine.report").report = lambda result, path, **options: Path(path).touch()
sys.exit(cli.main(sys.argv[1:]))
"""

# Slows each iteration of a search that has very many starts, and says when it runs.
SLOW = """
import sys, time
from casadi_engine import estimation, cli
real = estimation.estimate
def estimate(*arguments, **options):
    def progress(iteration, cost, fit_percent):
        print("iteration", iteration, flush=True)
        time.sleep(0.02)
    return real(*arguments, **{**options, "starts": 100_000, "progress": progress})
estimation.estimate = estimate
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_ctrl_c_in_a_fit(here):
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW, "fit", "problem.py", "--out", "out"],
        cwd=here, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        for _ in range(8):
            assert process.stdout.readline().startswith("iteration")
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 130, err
    assert (
        err.splitlines()[-1] == "casadi-engine fit: no answer: interrupted; the best point so far is in out"
    )
    assert "Traceback" not in err
    result = json.loads((here / "out" / "result.json").read_text())
    assert result["status"] == "interrupted"
    assert (here / "out" / "report.html").is_file()
    assert "Written: " in out


# Sends Ctrl-C at the moment at which a module is about to be imported.
INTERRUPTED_IMPORT = """
import importlib.abc, os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background would ignore it
module = sys.argv.pop(1)
class Interrupt(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == module:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
from casadi_engine_start import main
sys.exit(main())
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("module", "command"),
    [
        ("casadi_engine", ""),
        ("typer", ""),
        ("casadi", " fit"),
        ("casadi_engine.estimation.answer", " fit"),
    ],
)
def test_ctrl_c_while_the_program_is_loaded(module, command, here):
    done = run(module, "fit", "problem.py", cwd=here, code=INTERRUPTED_IMPORT)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == f"casadi-engine{command}: interrupted before there was anything to write\n"
    assert not (here / "results").exists()


def test_the_command_starts_beside_the_package(here):
    done = subprocess.run(
        [sys.executable, "-m", "casadi_engine_start", "--version"],
        cwd=here, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{__version__}\n", "")


def test_ctrl_c_that_is_ignored_stays_ignored(monkeypatch):
    import casadi_engine_start

    found = []

    def command():
        found.append(signal.getsignal(signal.SIGINT))
        return 0

    monkeypatch.setattr(cli, "main", lambda: guarded("fit", command, debug=False))
    for before in (signal.SIG_IGN, signal.default_int_handler):
        old = signal.signal(signal.SIGINT, before)
        try:
            assert casadi_engine_start.main() == 0
        finally:
            signal.signal(signal.SIGINT, old)
    assert found == [signal.SIG_IGN, signal.default_int_handler]


@pytest.mark.skipif(os.name == "nt", reason="pipes of POSIX")
def test_a_reader_that_goes_away_is_no_error(here):
    (here / "quick.py").write_text(QUICK)
    command = f'{sys.executable} quick.py fit problem.py --out out > >(true); echo "code $?"'
    done = subprocess.run(["bash", "-c", command], cwd=here, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip().endswith("code 0"), done.stderr
    assert "BrokenPipe" not in done.stderr


def test_a_terminal_without_unicode(here):
    ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = run("fit", "problem.py", "--out", "out", cwd=here, code=QUICK, env=ascii_only)
    assert (done.returncode, done.stderr) == (0, "")  # no progress line in a pipe either
    assert "J_eng" in done.stdout


@pytest.mark.parametrize("set_by_user", [None, "2"])
def test_the_command_takes_one_blas_thread_unless_told_otherwise(set_by_user, monkeypatch):
    """Run beside a command line that does nothing, for this process has loaded its libraries already."""
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    for name in names:
        monkeypatch.setenv(name, "unset")  # so that the end of the test takes back what the command sets
        monkeypatch.delenv(name)
    if set_by_user:
        monkeypatch.setenv(names[0], set_by_user)
    import casadi_engine_start

    monkeypatch.setattr("casadi_engine.cli.main", lambda: 0)
    assert casadi_engine_start.main() == 0
    assert [os.environ[name] for name in names] == [set_by_user or "1", "1", "1"]


def test_the_version_stands_in_one_place():
    """It was 0.10.0 in the results of eight releases: pyproject.toml had another one."""
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
    assert "version" in project["project"]["dynamic"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "casadi_engine.__version__"}
    changes = (Path(__file__).parents[2] / "CHANGELOG.md").read_text(encoding="utf-8")
    assert next(line for line in changes.splitlines() if line.startswith("## ")).startswith(
        f"## {__version__} ("
    )
