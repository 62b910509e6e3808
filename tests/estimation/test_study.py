"""Studies: rows in the pieces' order, nothing done twice, and a killed process's work taken up again."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from casadi_engine.errors import MissingDependencyError, StudyError
from casadi_engine.estimation.study import study

# A piece is a fit, or nothing but numbers, for which the large packages are not loaded.
SCRIPT = """
import json, sys, time
from casadi_engine.estimation.study import study


def begun(piece):
    with open(sys.argv[2], "a") as file:
        file.write(f"{piece['seed']}\\n")


def plain(piece):
    begun(piece)
    time.sleep(float(sys.argv[3]))
    return {"values": {"square": piece["seed"] ** 2}, "stderr": {"square": 0.1 * piece["seed"]}}


def fit(piece):
    import numpy as np
    import casadi_engine as ce

    rng, time_ = np.random.default_rng(piece["seed"]), 0.02 * np.arange(150)
    torque = 10 + 5 * np.sign(np.sin(4 * time_))
    speed = [20.0]
    for push in torque[:-1]:
        speed.append(np.exp(-0.025) * speed[-1] + 2 * (1 - np.exp(-0.025)) * push)
    data = ce.Experiment.from_arrays(
        "run_up", time=time_, units={"T": "N m", "omega": "rad/s"}, hold="zero",
        T=torque, omega=np.array(speed) + 0.05 * rng.standard_normal(150),
    )
    begun(piece)
    found = ce.estimate(ce.one_inertia(), data, noise=ce.Noise(omega=0.05), progress=False)
    time.sleep(float(sys.argv[3]))
    return {"values": found.values, "stderr": found.stderr}


if __name__ == "__main__":
    pieces = [{"seed": seed} for seed in range(9)]
    work = {"fit": fit, "plain": plain}[sys.argv[5]]
    print(json.dumps(study(work, pieces, name="kill", jobs=int(sys.argv[4]), checkpoint=sys.argv[1])))
"""


def begin(folder, name, kind, *, pause=0.0, jobs=1):
    """Start the study in a process of its own, in a folder with its checkpoint and its log."""
    script = folder / "killed_study.py"
    script.write_text(SCRIPT)
    command = [sys.executable, str(script), str(folder / f"{name}.jsonl"), str(folder / f"{name}.log")]
    return subprocess.Popen(
        [*command, str(pause), str(jobs), kind], stdout=subprocess.PIPE, text=True, start_new_session=True
    )


def log(folder, name):
    """The pieces that were begun, in their order."""
    path = folder / f"{name}.log"
    return [int(line) for line in path.read_text().split()] if path.exists() else []


def finished(path):
    """The pieces in a checkpoint."""
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    return [json.loads(line)["piece"]["seed"] for line in lines[1:] if line.endswith("\n")]


@pytest.mark.parametrize("kind", ["plain", pytest.param("fit", marks=pytest.mark.slow)])
def test_a_killed_study_goes_on_and_ends_with_the_same_table(tmp_path, kind):
    jobs, pause = 1, 0.1
    if kind == "fit":
        pause, jobs = 0.8, 2 if importlib.util.find_spec("joblib") else 1
    whole = begin(tmp_path, "whole", kind)
    first = begin(tmp_path, "killed", kind, pause=pause, jobs=jobs)
    path, limit = tmp_path / "killed.jsonl", time.monotonic() + 180
    while len(finished(path)) < 3 and time.monotonic() < limit:
        time.sleep(0.01)
    os.killpg(first.pid, signal.SIGKILL)  # with the workers that it started
    first.communicate()
    assert first.returncode == -signal.SIGKILL
    done, begun = finished(path), log(tmp_path, "killed")
    assert 3 <= len(done) < 9
    second = begin(tmp_path, "killed", kind)  # in one process what several began
    again = second.communicate(timeout=240)[0]
    assert second.returncode == 0
    expected = whole.communicate(timeout=240)[0]
    assert len(json.loads(expected)) == 9
    for row, twin in zip(json.loads(again), json.loads(expected), strict=True):
        assert row["values"] == pytest.approx(twin["values"], rel=1e-9)
        assert row["stderr"] == pytest.approx(twin["stderr"], rel=1e-7)
    # nothing that was finished is done again, nothing is lost
    repeated = log(tmp_path, "killed")[len(begun) :]
    assert sorted(done + repeated) == list(range(9))
    assert sorted(finished(path)) == list(range(9))
    assert sorted(log(tmp_path, "whole")) == list(range(9))


def test_rows_come_in_the_pieces_order_and_equal_pieces_are_done_once(tmp_path):
    calls, seen = [], []

    def work(piece):
        calls.append(piece)
        return {"square": piece**2}

    path = tmp_path / "study.jsonl"
    rows = study(work, [3, 1, 3], checkpoint=path, watch=lambda *counts: seen.append(counts))
    assert rows == [{"square": 9}, {"square": 1}, {"square": 9}]
    assert calls == [3, 1]
    assert seen == [(0, 2), (1, 2), (2, 2)]
    seen.clear()
    assert study(work, [1, 2], checkpoint=path, watch=lambda *counts: seen.append(counts)) == [
        {"square": 1},
        {"square": 4},
    ]
    assert calls == [3, 1, 2]
    assert seen == [(1, 2), (2, 2)]


def test_what_was_finished_before_an_error_is_kept(tmp_path):
    def work(piece):
        if piece == 2:
            raise ZeroDivisionError("piece two")
        return piece

    path = tmp_path / "study.jsonl"
    with pytest.raises(ZeroDivisionError, match="piece two"):
        study(work, [0, 1, 2, 3], checkpoint=path)
    assert study(lambda piece: -piece, [0, 1, 2, 3], checkpoint=path) == [0, 1, -2, -3]


def test_several_processes_need_joblib(monkeypatch, refused):
    monkeypatch.setitem(sys.modules, "joblib", None)
    with refused(
        MissingDependencyError,
        "joblib, which is not installed",
        seen="joblib",
        allowed="one process",
        cure='pip install "casadi-engine[cluster]"',
    ):
        study(abs, [-1, 2], jobs=2)
    assert study(abs, [-1, 2]) == [1, 2]
    assert study(abs, [], jobs=2) == []


@pytest.mark.parametrize(
    ("words", "problem", "seen"),
    [
        ({"work": None}, "the work of a study is not a function", "None"),
        ({"watch": 3}, "the watch of a study is not a function", "3"),
        ({"pieces": 3}, "the pieces of a study are not a sequence", "3"),
        ({"pieces": {"seed": 1}}, "the pieces of a study are not a sequence", "{'seed': 1}"),
        ({"pieces": "ab"}, "the pieces of a study are not a sequence", "'ab'"),
    ],
)
def test_what_is_no_study_is_refused(refused, words, problem, seen):
    with refused(StudyError, problem, seen=seen, allowed="", cure="give a"):
        study(**({"work": str, "pieces": [1, 2]} | words))


def test_pieces_may_come_one_by_one():
    assert study(lambda piece: piece + 1, (k for k in range(3))) == [1, 2, 3]
