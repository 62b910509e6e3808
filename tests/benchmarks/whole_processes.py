"""What a person waits for: whole processes from start to end, in CPU seconds, pairs run in turn.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/whole_processes.py [--runs 7] [--before CHECKOUT] [--write] [ROW ...]

import      `import numpy, casadi, casadi_engine` beside `import numpy, casadi`
help        `casadi-engine --help`
fit         `casadi-engine fit` on one bundled record, page included, beside the same job with SciPy and matplotlib
crankshaft  `casadi-engine fit problems/crankshaft.py`
repair      the main job of README beside that of CHECKOUT, an earlier release
two         a repair of the two-mass engine, ten cycles, with nothing hidden, beside CHECKOUT
seven       a repair of the crankshaft with drag hidden, beside CHECKOUT

Medians and ranges; --write keeps them with the date in SPEED.md. The commands run with compiled files of the package
at hand, as they are after the first start.
"""

from __future__ import annotations

import argparse
import datetime
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
COMMAND = "import sys, casadi_engine_start as s; sys.argv[0] = 'casadi-engine'; s.main()"
REPAIR_TWO = """
import sys; sys.path.insert(0, 'problems')
import hidden_effect as h, casadi_engine as ce
m = h.model(); p = h.parameters(m)
plant = m.parameters()
for k, v in dict(J_eng=.39, J_load=.177, K_el=1992, C_el=2.5, C_eng=.154).items(): plant[k].set(v)
import numpy as np
rng, data = np.random.default_rng(1), []
for path in h.problem().records:
    e = h.read(path)
    first = dict(omega_eng=float(e['omega'].values[0]), omega_load=float(e['omega'].values[0]), twist=-0.03)
    run = ce.simulate(m, e, parameters=plant, initial=first)
    cols = {n: e[n].values for n in e.names if n != 'omega_load'}
    cols['omega'] = run['omega'].values + 0.1 * rng.standard_normal(len(cols['omega']))
    data.append(ce.Experiment.from_arrays(e.name, time=e['omega'].time, units={n: e[n].unit for n in cols}, **cols))
import time; t = time.process_time()
r = ce.repair(m, data, parameters=p, noise=ce.Noise(omega='estimate'), progress=False)
print('CPU', time.process_time() - t, r.verdict)
"""


def rows(checkout: str, folder: str) -> dict[str, tuple[list[str], list[str] | None]]:
    """Row -> our command and that of its peer (None without); in the second one's place stands CHECKOUT."""
    py = sys.executable
    ours = [py, "-c", COMMAND]
    record = str(ROOT / "data" / "misfire_1200rpm.csv.gz")
    main_job = [*ours, "repair", "problems/hidden_effect.py", "--out", folder]
    seven = [py, "tests/benchmarks/repair_seven.py", "drag"]
    two = [py, "-c", REPAIR_TWO]
    return {
        "import": ([py, "-c", "import numpy, casadi, casadi_engine"], [py, "-c", "import numpy, casadi"]),
        "help": ([*ours, "--help"], None),
        "fit": (
            [*ours, "fit", str(HERE / "one_record.py"), "--out", folder],
            [py, str(HERE / "peer_page.py"), record, folder],
        ),
        "crankshaft": ([*ours, "fit", "problems/crankshaft.py", "--out", folder], None),
        "repair": (main_job, main_job if checkout else None),
        "two": (two, two if checkout else None),
        "seven": (seven, seven if checkout else None),
    }


def spent(command: list[str], place: Path) -> float:
    """CPU seconds of a command, its children with it; by its own word where it says "CPU"."""
    env = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    env |= {
        "PYTHONPATH": str(place),
        "MPLBACKEND": "Agg",
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
    }
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, cwd=place, env=env, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(command[-3:])} ended with {done.returncode}:\n{done.stderr[-2000:]}")
    own = [line.split()[1] for line in done.stdout.splitlines() if line.startswith("CPU ")]
    return float(own[0]) if own else after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure(
    row: tuple[list[str], list[str] | None], peer_place: Path, runs: int
) -> Mapping[str, list[float]]:
    """The runs of both commands, one after the other; the first ones do not count."""
    ours, peer = row
    found: dict[str, list[float]] = {"ours": [], "peer": []}
    for k in range(runs + 1):
        one = spent(ours, ROOT)
        other = spent(peer, peer_place) if peer else None
        if k:
            found["ours"].append(one)
            if other is not None:
                found["peer"].append(other)
    return found


def words(numbers: list[float]) -> str:
    """Median and range."""
    if not numbers:
        return ""
    return f"{statistics.median(numbers):.3g} ({min(numbers):.3g} … {max(numbers):.3g})"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rows", nargs="*")
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--before", default="", help="checkout of an earlier release")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    today = datetime.date.today()
    with tempfile.TemporaryDirectory() as folder:
        known = rows(options.before, folder)
        lines = []
        for name in options.rows or known:
            earlier = options.before and name in ("repair", "two", "seven")
            place = Path(options.before) if earlier else ROOT
            runs = options.runs if name in ("import", "help", "fit", "crankshaft") else min(options.runs, 3)
            found = measure(known[name], place, runs)
            ratio = ""
            if found["peer"]:
                ratio = f"{statistics.median(found['ours']) / statistics.median(found['peer']):.3g}"
            lines.append(f"| {name} | {words(found['ours'])} | {words(found['peer'])} | {ratio} | {today} |")
            print(lines[-1], flush=True)
    if options.write:
        table = ["| row | CPU s | peer, CPU s | ratio | date |", "|---|---|---|---|---|", *lines]
        head = (__doc__ or "").split("\n\n")
        text = "# What a person waits for\n\n" + head[2] + "\n\n" + "\n".join(table) + "\n"
        (HERE / "SPEED.md").write_text(text)


if __name__ == "__main__":
    main()
