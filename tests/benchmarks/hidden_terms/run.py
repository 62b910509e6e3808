"""Hidden terms in systems of many kinds: does `ce.repair`, by its public verb alone, name them?

    python tests/benchmarks/hidden_terms/run.py [KIND ...] [--tasks N] [--nulls N] [--skip N] [--budget S] [--jobs J]
        [--sealed] [--out FILE.jsonl] [--label TEXT] [--table FILE.md] [--list]

One JSON line per task is added to FILE.jsonl; what stands there for the same task and the same version is not run
again, so that a run may be stopped and go on. `--tasks N` and `--nulls N` take the first N of every kind (20 and 140);
any first part holds all signal-to-noise ratios in turn. `--budget S` ends a repair after S seconds of CPU time: its
clock is the processor's here, so that a machine which is shared gives the same answers.
`--table` writes the dated tables of all that FILE.jsonl holds of this version.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import hashlib
import inspect
import json
import os
import signal
import sys
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import casadi_engine as ce  # noqa: E402
from casadi_engine.deadline import Deadline  # noqa: E402
from hidden_terms.judge import amplitudes, answer_of, judged, members  # noqa: E402
from hidden_terms.kind import NULLS, TASKS, Task, load_kinds, nulls_of, tasks_of  # noqa: E402
from hidden_terms.records import case_of  # noqa: E402
from hidden_terms.tables import tables  # noqa: E402

Deadline.__init__.__kwdefaults__["clock"] = time.process_time
# A verb that keeps a budget itself gets this much longer before it is stopped from outside.
_GRACE = 1.5


class OutOfBudgetError(BaseException):
    """The CPU time of a task is used up. No Exception, so that nobody on the way takes it for a failed fit."""


@contextlib.contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise OutOfBudgetError in here after so many seconds of CPU time."""

    def stop(_number: int, _frame: Any) -> None:
        raise OutOfBudgetError

    before = signal.signal(signal.SIGPROF, stop)
    # again and again: what is raised in a solver's callback may get lost there
    signal.setitimer(signal.ITIMER_PROF, seconds, 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def run_task(task: Task, budget: float, sealed: bool) -> dict[str, Any]:
    """One line of the results."""
    kind = load_kinds(sealed=sealed)[task.kind]
    case = case_of(kind, task)
    options: dict[str, Any] = {"parameters": case.parameters, "fresh": case.fresh, "progress": False}
    if case.effects is not None:
        options["effects"] = case.effects
    known = inspect.signature(ce.repair).parameters
    if "budget" in known:
        options["budget"] = budget
    row: dict[str, Any] = {"kind": task.kind, "label": task.label, "snr": task.snr, "noise": task.noise}
    row |= {"null": task.null, "in library": all(kind.terms[one].in_library for one in task.deleted)}
    row |= {"outputs": list(task.outputs), "pair": list(task.pair), "truth": list(task.deleted)}
    begun = time.process_time()
    try:
        with limited(budget * (_GRACE if "budget" in known else 1.0)), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = ce.repair(case.model, case.data, **options)
        row["seconds"] = time.process_time() - begun
        answer = answer_of(found, case)
        row |= {"outcome": judged(kind, task, answer), "answer": answer}
        row["members"] = members(kind, task, answer)
        row["amplitudes"] = amplitudes(task, case, answer)
    except OutOfBudgetError:
        row |= {"outcome": "over budget", "seconds": time.process_time() - begun}
    except Exception as fault:  # noqa: BLE001 (a crash is an outcome)
        words = f"crashed: {type(fault).__name__}: {fault}"
        row |= {"outcome": words[:400], "seconds": time.process_time() - begun}
    return row


def version_of() -> str:
    """The package's version, and a digest of its source: the version alone stays while it is worked on."""
    folder = Path(ce.__file__).parent
    digest = hashlib.sha256()
    for file in sorted(folder.rglob("*.py")):
        digest.update(file.read_bytes())
    return f"{ce.__version__}+{digest.hexdigest()[:8]}"


def read(out: Path) -> list[dict[str, Any]]:
    """The lines of a results file; a line that was cut by a stop is left out."""
    rows = []
    for line in out.read_text(encoding="utf-8").splitlines() if out.exists() else []:
        with contextlib.suppress(json.JSONDecodeError):
            rows.append(json.loads(line))
    return rows


def wanted(given: argparse.Namespace) -> list[Task]:
    """The tasks and nulls asked for, one of every kind in turn."""
    kinds = load_kinds(sealed=given.sealed)
    unknown = [name for name in given.kinds if name not in kinds]
    if unknown:
        raise SystemExit(f"no kind {', '.join(unknown)}; there are {', '.join(kinds)}")
    picked = [kinds[name] for name in given.kinds or kinds]
    lists = [tasks_of(kind)[given.skip : given.tasks] for kind in picked] + [
        nulls_of(kind)[given.skip : given.nulls] for kind in picked
    ]
    return [one[k] for k in range(max(map(len, lists), default=0)) for one in lists if k < len(one)]


def arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kinds", nargs="*", metavar="KIND")
    parser.add_argument("--tasks", type=int, default=TASKS)
    parser.add_argument(
        "--skip", type=int, default=0, help="leave out the first tasks and nulls of every kind"
    )
    parser.add_argument("--nulls", type=int, default=0, help=f"nulls of every kind, up to {NULLS} (0)")
    parser.add_argument("--budget", type=float, default=120.0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--sealed", action="store_true", help="the sealed kinds too: once, at the end")
    parser.add_argument("--out", type=Path, default=Path("hidden_terms.jsonl"))
    parser.add_argument("--label", default="", help="of the version, instead of a digest of the source")
    parser.add_argument("--table", type=Path, help="write tables of FILE.jsonl")
    parser.add_argument("--list", action="store_true", help="list the tasks and end")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    given = arguments(argv)
    tasks = wanted(given)
    if given.list:
        for task in tasks:
            print(f"{task.key:70s} {task.noise:10s} {','.join(task.outputs):12s} {' then '.join(task.pair)}")
        return
    version = given.label or version_of()
    rows = read(given.out)
    done = {row["key"] for row in rows if row["version"] == version}
    left = [task for task in tasks if task.key not in done]
    work = partial(run_task, budget=given.budget, sealed=given.sealed)
    with contextlib.ExitStack() as stack:
        if given.jobs > 1:
            pool = stack.enter_context(ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")))
            results: Any = pool.map(work, left)
        else:
            results = map(work, left)
        for task, row in zip(left, results, strict=True):
            row |= {"key": task.key, "version": version, "date": datetime.date.today().isoformat()}
            with given.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            rows.append(row)
            names = "; ".join(
                "/".join(m for m, _ in e["members"]) for e in row.get("answer", {}).get("effects", ())
            )
            print(f"{task.key:66s} {row['seconds']:6.1f} s  {row['outcome'][:90]}  {names}", flush=True)
    if given.table:
        own = [row for row in rows if row["version"] == version]
        given.table.write_text(tables(own, version), encoding="utf-8")


if __name__ == "__main__":
    main()
