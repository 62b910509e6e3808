"""Run every page of problems/thesis and write the dated table THESIS.md: published, ours, conclusion.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/thesis.py

Also copies their figures into .pictures. About a minute of processor time, more the first time, when records are made.
"""

from __future__ import annotations

import datetime
import json
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "problems" / "thesis"
RESULTS = ROOT / "results" / "thesis"
# In the order of the thesis.
ORDER = (
    "two_mass_tables",
    "residual_tests",
    "crankshaft_tables",
    "reduction",
    "engine_orders",
    "friction_map",
    "friction_law",
    "misfire_detector",
    "pressure_model",
    "speed_alone",
    "dampers",
    "driveline",
)


def spent() -> float:
    """Processor time of the processes run so far [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def rows_of(name: str) -> tuple[str, list[dict[str, str | bool]], float]:
    """First line of a page, its lines, and its processor time [s]."""
    begun = spent()
    (RESULTS / f"{name}.json").unlink(missing_ok=True)  # a page that fails must not show an earlier answer
    subprocess.run(
        [sys.executable, str(PAGES / f"{name}.py")], cwd=ROOT, stdout=subprocess.DEVNULL, check=False
    )
    about = (PAGES / f"{name}.py").read_text("utf-8").split('"""')[1].splitlines()[0]
    for figure in RESULTS.glob(f"{name}*.png"):
        shutil.copy(figure, ROOT / ".pictures" / f"thesis_{figure.name}")
    return about, json.loads((RESULTS / f"{name}.json").read_text("utf-8")), spent() - begun


def main() -> int:
    pages = [*ORDER, *sorted({path.stem for path in PAGES.glob("*.py")} - {*ORDER, "shared"})]
    text = [
        f"# The thesis beside ours, {datetime.datetime.now(tz=datetime.UTC).date()}",
        "",
        "By `python tests/benchmarks/thesis.py`. The thesis's records are not public: all are simulated by "
        "`data/simulator`, so conclusions are compared, and numbers where the thesis gives parameters.",
    ]
    failed = 0
    for name in pages:
        about, lines, seconds = rows_of(name)
        text += ["", f"## [{name}.py](../../problems/thesis/{name}.py)", "", about, ""]
        text += [
            f"{seconds:.0f} s of processor time.",
            "",
            "| where | thesis | ours | conclusion |",
            "|---|---|---|---|",
        ]
        for line in lines:
            words = [str(line[key]) for key in ("place", "published", "ours", "conclusion")]
            words[3] = words[3] if line["holds"] else f"**not borne out:** {words[3]}"
            failed += not line["holds"]
            text.append("| " + " | ".join(re.sub(r"\|", "/", word) for word in words) + " |")
        drawn = sorted(path.name for path in RESULTS.glob(f"{name}*.png"))
        text += [line for one in drawn for line in ("", f"![{about}](../../.pictures/thesis_{one})")]
    Path(__file__).with_name("THESIS.md").write_text("\n".join(text) + "\n", "utf-8")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
