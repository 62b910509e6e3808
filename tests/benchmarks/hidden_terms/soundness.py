"""Are the tasks sound? The true structure, fitted by ``ce.estimate`` alone, must leave the noise and nothing else.

    python tests/benchmarks/hidden_terms/soundness.py [KIND ...] [--tasks N] [--sealed] [--out FILE.jsonl]

For each task: chi-squared per sample at the known noise, of the model as the user has it (from the user's start values)
and of the true structure: with sharp corners from the true values, and rounded, as refits of effects are, from the
user's. A task whose truth the library lacks has no true structure here. `repair` is never called.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import warnings
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import casadi_engine as ce  # noqa: E402
from hidden_terms.kind import TASKS, Kind, Task, load_kinds, tasks_of  # noqa: E402
from hidden_terms.records import case_of, with_terms  # noqa: E402


def sound(kind: Kind, task: Task) -> dict[str, Any]:
    """What fits leave of one task."""
    case = case_of(kind, task)
    noise = ce.Noise(**case.sigma)
    hidden = {name: kind.terms[name] for name in task.deleted if kind.terms[name].in_library}
    names = tuple(name for name, one in hidden.items() if one.effect is not None)
    full = with_terms(kind, case.model, names, case.values)
    sharp = with_terms(kind, kind.model(task.outputs), (*task.declared, *names), case.values, sharp=True)
    near = sharp.parameters()
    known = {name: value for name, value in case.values.items() if name in near}
    for name in (*hidden, *task.declared):
        if kind.terms[name].effect is not None:
            known[f"{name}.{kind.terms[name].effect.amplitude.name}"] = case.values[name]
    for name, value in known.items():
        near[name].set(value)
    far = case.parameters.extended(full)
    for name, one in hidden.items():
        if one.wrong:
            near[one.wrong].set(near[one.wrong].value * (1 + case.values[name]))
            for pars in (near, far):
                pars[one.wrong].vary = True
    row: dict[str, Any] = {"key": task.key, "noise": task.noise}
    for word, model, start in (
        ("null", case.model, case.parameters),
        ("true", sharp, near),
        ("far", full, far),
    ):
        begun = time.process_time()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                fit = ce.estimate(model, case.data, parameters=start, noise=noise, progress=False)
            left = [
                trace.residual[trace.mask] / case.sigma[name]
                for one in fit.traces.values()
                for name, trace in one.items()
            ]
            count = sum(map(len, left))
            row[word] = [sum(float(one @ one) for one in left) / count, fit.converged]
            row["samples"] = count
        except Exception as fault:  # noqa: BLE001 (what fails is to be seen)
            row[word] = [None, f"{type(fault).__name__}: {fault}"[:300]]
        row[f"{word} s"] = round(time.process_time() - begun, 1)
        if word == "null" and not hidden:
            break
    return row


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kinds", nargs="*", metavar="KIND")
    parser.add_argument("--tasks", type=int, default=TASKS)
    parser.add_argument("--sealed", action="store_true")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args(argv)
    kinds = load_kinds(sealed=given.sealed)
    for name in given.kinds or kinds:
        for task in tasks_of(kinds[name])[: given.tasks]:
            row = sound(kinds[name], task)
            words = [
                f"{w} {row[w][0] or 0:8.3f} {row[w][1]!s:5.30}" for w in ("null", "true", "far") if w in row
            ]
            print(f"{row['key']:64s} {row['noise']:9s} " + "   ".join(words), flush=True)
            if given.out:
                with given.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
