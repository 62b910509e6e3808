"""Repair real systems with the whole library, each in its own process.

    python tests/benchmarks/real_rigs/run.py [NAME ...] [--writing I] [--budget S] [--out FILE.jsonl] [--again]
    python tests/benchmarks/real_rigs/run.py --table FILE.jsonl      writes tests/benchmarks/REAL_RIGS.md

A row that FILE.jsonl holds already (rig, writing and package version) is not run again. A repair that takes more CPU
seconds than the budget is ended, and its outcome is "out of time".
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

from rigs_common import NAMES, PROJECT, NoDataError, rig  # noqa: E402

_MARK = "ROW "
# beyond its budget a repair may still write down its best answer
_GRACE = 20


def main() -> None:
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
    ask.add_argument("--writing", type=int, action="append", help="0, 1 or 2; all if left out")
    ask.add_argument("--budget", type=float, default=300.0, help="CPU seconds of one repair (300)")
    ask.add_argument("--out", type=Path, help="JSON lines; rows in it are not run again")
    ask.add_argument("--again", action="store_true", help="run again what the file holds")
    ask.add_argument("--print", action="store_true", dest="whole", help="print what repair printed")
    ask.add_argument("--table", type=Path, metavar="FILE.jsonl", help="write REAL_RIGS.md from rows")
    ask.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    asked = ask.parse_args()
    if asked.table is not None:
        from rigs_table import write

        print(write(asked.table))
        return
    for name in asked.names or NAMES:
        every = range(len(rig(name).writings))
        for writing in every if asked.writing is None else [w for w in asked.writing if w in every]:
            if asked.one:
                from outcome import repaired

                print(_MARK + json.dumps(repaired(name, writing, asked.budget)))
            else:
                _run(name, writing, asked)


def _run(name: str, writing: int, asked: Any) -> None:
    from outcome import line

    if not asked.again and _done(asked.out, name, writing):
        return
    try:
        rig(name).records()
    except NoDataError as why:
        print(f"{name:18} {writing}  skipped: {why}")
        return
    row = _in_a_process(name, writing, asked.budget)
    if asked.out is not None:
        with asked.out.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
    print(line(row), flush=True)
    if asked.whole and "printed" in row:
        print(row["printed"])


def _done(path: Path | None, name: str, writing: int) -> bool:
    import casadi_engine as ce

    if path is None or not path.exists():
        return False
    rows = [json.loads(text) for text in path.read_text(encoding="utf-8").splitlines()]
    return any(
        (one["rig"], one["writing"], one["version"]) == (name, writing, ce.__version__) for one in rows
    )


def _in_a_process(name: str, writing: int, budget: float) -> dict[str, Any]:
    import casadi_engine as ce

    command = [sys.executable, __file__, name, "--writing", str(writing), "--budget", str(budget), "--one"]
    path = os.pathsep.join([str(PROJECT), *filter(None, [os.environ.get("PYTHONPATH")])])
    most = int(budget) + _GRACE
    done = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path}, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (most, most)),
    )  # fmt: skip
    row = next((text for text in done.stdout.splitlines() if text.startswith(_MARK)), None)
    if row is not None:
        return dict(json.loads(row.removeprefix(_MARK)))
    late = done.returncode in (-9, -24)  # killed for its CPU time
    return {
        "rig": name, "writing": writing, "version": ce.__version__, "budget_s": budget,
        "date": time.strftime("%Y-%m-%dT%H:%MZ", time.gmtime()), "cpu_s": float(most) if late else 0.0,
        "outcome": "out of time" if late else "crashed",
        "error": f"no answer in {most} s of CPU" if late else done.stderr[-2000:].strip() or "no message",
    }  # fmt: skip


if __name__ == "__main__":
    main()
