"""--jobs: the starts of a fit in several processes end where they end in one."""

import json
import sys

import pytest

EFFECT = """
from casadi_engine.effects import Amplitude, Effect


class Fan(Effect):
    name, attaches, sentence = "fan", ("inertia",), "a fan on {port}"
    amplitude = Amplitude("coefficient", unit="N m s2/rad2", min=0)

    def law(self, port, p, math):
        return -p.coefficient * port.speed**2


def problem():
    m = one_inertia().with_effect(Fan(), at="engine")
"""


def with_starts(here):
    """The problem with three starts, and with an effect that the file itself defines."""
    path = here / "problem.py"
    text = path.read_text().replace("noise=Noise", "starts=3, noise=Noise")
    text = text.replace("def problem():\n    m = one_inertia()\n", EFFECT.lstrip())
    path.write_text(text)


@pytest.mark.slow  # tests/estimation/test_batch.py has such starts in the quick run
def test_starts_run_in_several_processes(here, call, quick_report):
    pytest.importorskip("joblib", reason="several processes need joblib")
    with_starts(here)
    results = []
    for jobs in (1, 2):
        done = call("fit", "problem.py", "--jobs", jobs, "--seed", 3, "--out", f"jobs{jobs}")
        assert done.code == 0, done.err
        results.append(json.loads((here / f"jobs{jobs}" / "result.json").read_text()))
    one, two = results
    assert sum(optimum["starts"] for optimum in two["optima"]) == 3
    assert len(one["optima"]) == len(two["optima"])
    for name, entry in one["parameters"].items():
        assert two["parameters"][name]["value"] == pytest.approx(entry["value"], rel=1e-8)
    assert two["arguments"]["jobs"] == 2


def test_without_joblib_one_process_works_and_several_are_refused(here, call, quick_report, monkeypatch):
    monkeypatch.setitem(sys.modules, "joblib", None)
    with_starts(here)
    done = call("fit", "problem.py", "--jobs", 2)
    assert (done.code, done.out) == (2, "")
    assert 'do: pip install "casadi-engine[cluster]", or leave jobs out' in done.err
    assert not (here / "results").exists()
    assert call("fit", "problem.py").code == 0
