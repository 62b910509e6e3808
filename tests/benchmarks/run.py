"""Every table of the benchmarks by one command.

    python tests/benchmarks/run.py [NAME ...] [--quick] [--peers PYTHON] [--solvers NAME ...]

NAME: A, B, B6, B21 (the problems), precision, scaling, or tables (write RESULTS.md from what was measured); none: all.
--quick takes two starts and a quarter of the time limit, prints its tables and writes nothing. See README.md.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import tables
from solvers import SOLVERS, Solver
from tables import total
from worker import OUT_OF_TIME

HERE = Path(__file__).resolve().parent
PROBLEMS = {"A": 20, "B": 20, "B6": 20, "B21": 10}  # name -> starts
STUDIES = ("precision", "scaling")
LIMIT = 60.0  # CPU seconds for a start
SCALING_CYLINDERS = tuple((cylinders, 14_400) for cylinders in (1, 2, 3, 4, 6, 8, 12))
SCALING_SAMPLES = tuple((4, samples) for samples in (14_400, 43_200, 144_000, 432_000, 1_440_000))
SCALING_SOLVERS = ("ours", "scipy")
SCALING_LIMIT = 600.0

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
# XLA would use every core for its thread pool: one device thread, no parallel loops.
ONE_THREAD["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
VERSIONS = (
    "import importlib.metadata as m, json, sys; print(json.dumps({n: m.version(n) for n in sys.argv[1:]}))"
)


def launch(python: str, arguments: list[str]) -> tuple[list[dict[str, Any]], str]:
    """Lines of JSON that a script of this folder prints, and what it says when it fails."""
    done = subprocess.run(
        [python, *arguments],
        cwd=HERE,
        env=os.environ | ONE_THREAD,
        capture_output=True,
        text=True,
        check=False,
    )
    rows = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    last = (done.stderr.strip().splitlines() or [""])[-1]
    if done.returncode == OUT_OF_TIME:
        return rows, "stopped at the time limit"
    return rows, f"ended with {done.returncode}: {last}" if done.returncode else ""


def measure(name: str, case: str, starts: list[int], python: str, limit: float, warm: bool) -> list[Any]:
    """Rows of one solver on one problem; slow solvers get a process a start, and end with one that runs out of time."""
    options = ["--limit", str(limit), *(["--warm"] if warm else [])]
    if SOLVERS[name].starts >= 20:
        rows, trouble = launch(python, ["worker.py", name, case, *map(str, starts), *options])
        missing = starts[len(rows) :]
        return rows + [{"start": number, "words": trouble} for number in missing[:1]]
    rows = []
    for number in starts:
        found, trouble = launch(python, ["worker.py", name, case, str(number), *options])
        rows += found or [{"start": number, "words": trouble}]
        if total(rows[-1]) > 0.9 * limit or "chi2" not in rows[-1]:  # the next would be no faster
            break
    return rows


def problem(case: str, names: list[str], options: argparse.Namespace, store: dict[str, Any]) -> None:
    """One problem with every solver that takes part in it."""
    limit = LIMIT / 4 if options.quick else LIMIT
    for name in names:
        solver = SOLVERS[name]
        python = interpreter(solver, options)
        if (solver.cases and case not in solver.cases) or python is None:
            continue
        count = min(PROBLEMS[case], solver.starts, 2 if options.quick else 20)
        rows = measure(name, case, list(range(count)), python, limit, warm=solver.starts >= 20)
        store = store if options.quick else tables.read_store()  # another run may have written meanwhile
        store["problems"].setdefault(case, {})[name] = {
            "rows": rows,
            "limit": limit,
            "date": str(datetime.date.today()),
            "versions": versions(solver, python),
        }
        if not options.quick:
            tables.write_store(store)
        print(f"{case} {name}: {tables.one_line(case, rows, store)}", flush=True)


def scaling(options: argparse.Namespace, store: dict[str, Any]) -> None:
    """Cost against cylinders and samples; one process, one start a point."""
    points = [*SCALING_CYLINDERS, *SCALING_SAMPLES[1:]]
    if options.quick:
        points = [(1, 14_400), (4, 14_400), (4, 43_200)]
    for name in [name for name in SCALING_SOLVERS if name in options.solvers]:
        found = []
        for cylinders, samples in points:
            # the small points are warmed up, for what a first call costs would bend the curve
            warm = ["--warm"] if samples <= 50_000 else []
            starts = ["0", "1", "2"] if samples <= 50_000 else ["0"]
            case = f"{cylinders}x{samples}"
            arguments = ["worker.py", name, case, *starts, "--limit", str(SCALING_LIMIT), *warm]
            rows, trouble = launch(sys.executable, arguments)
            found.append({"cylinders": cylinders, "samples": samples, "rows": rows, "words": trouble})
            print(f"scaling {name} {case}: {tables.point_line(rows)} {trouble}", flush=True)
        store = store if options.quick else tables.read_store()
        store["scaling"][name] = {"points": found, "date": str(datetime.date.today())}
        if not options.quick:
            tables.write_store(store)


def precision(options: argparse.Namespace, store: dict[str, Any]) -> None:
    """Errors of B6 over noise seeds against the Cramér-Rao bound."""
    for name in [name for name in ("ours", "scipy") if name in options.solvers]:
        rows, trouble = launch(sys.executable, ["precision.py", name, "2" if options.quick else "20"])
        store = store if options.quick else tables.read_store()
        if rows:
            store["precision"][name] = rows[0] | {"date": str(datetime.date.today())}
        if not options.quick:
            tables.write_store(store)
        print(f"precision {name}: {tables.precision_line(rows[0]) if rows else trouble}", flush=True)


def interpreter(solver: Solver, options: argparse.Namespace) -> str | None:
    """Python of a solver; None if the peers' environment is not there."""
    if not solver.peers:
        return sys.executable
    return options.peers if options.peers and Path(options.peers).exists() else None


def versions(solver: Solver, python: str) -> dict[str, str]:
    """Version of every package that a solver stands on."""
    done = subprocess.run(
        [python, "-c", VERSIONS, *solver.packages], capture_output=True, text=True, check=False
    )
    return dict(json.loads(done.stdout)) if done.returncode == 0 else {}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--quick", action="store_true", help="two starts, short limits, write nothing")
    parser.add_argument(
        "--peers", default=os.environ.get("BENCHMARK_PEERS"), help="Python that has jax-sysid and lmfit"
    )
    parser.add_argument("--solvers", nargs="*", choices=list(SOLVERS), default=list(SOLVERS))
    options = parser.parse_args()
    unknown = set(options.names) - {*PROBLEMS, *STUDIES, "tables"}
    if unknown:
        parser.error(f"unknown: {', '.join(unknown)}")
    names = options.names or [*PROBLEMS, *STUDIES, "tables"]
    store = {"problems": {}, "scaling": {}, "precision": {}} if options.quick else tables.read_store()
    for name in names:
        if name in PROBLEMS:
            problem(name, options.solvers, options, store)
        elif name == "scaling":
            scaling(options, store)
        elif name == "precision":
            precision(options, store)
    if options.quick:
        print(tables.generated(store))
    else:
        tables.write_results(tables.read_store())
    return 0


if __name__ == "__main__":
    sys.exit(main())
