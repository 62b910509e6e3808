"""REAL_RIGS.md from the rows of a run."""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

from by_hand import kept
from outcome import beside_by_hand, judged
from rigs_common import HERE, rig

PAGE = HERE.parent / "REAL_RIGS.md"
_TOP = """# Repair of real systems

One model of each system without one of its effects, its records, the whole library, default settings:
`python tests/benchmarks/real_rigs/run.py --out FILE.jsonl`, then `--table FILE.jsonl`. By hand: Runge-Kutta and SciPy's
`least_squares` in the right structure, on the same samples (`by_hand.py`, `by_hand.json`). Each system is written in up
to three ways, which are the same physics; an answer that depends on the way is a fault of ours. The measurements are
not ours and not in this repository; systems whose name begins with `made` are made with SciPy.
"""


def write(rows: Path) -> str:
    """Write the page; returns a line that says so. The last row of a rig and writing counts."""
    last: dict[tuple[str, int], dict[str, Any]] = {}
    for text in rows.read_text(encoding="utf-8").splitlines():
        row = json.loads(text)
        row["outcome"] = judged(row, rig(row["rig"]).truth)  # truths may have been mended since
        last[row["rig"], row["writing"]] = row
    ordered = [last[key] for key in sorted(last)]
    versions = ", ".join(sorted({row["version"] for row in ordered}))
    dates = sorted({row["date"][:10] for row in ordered})
    text = (
        f"{_TOP}\nVersion {versions}, {dates[0]}" + (f" to {dates[-1]}" if len(dates) > 1 else "") + ".\n\n"
    )
    text += _summary(ordered) + _rows(ordered) + _hands({row["rig"] for row in ordered})
    PAGE.write_text(text, encoding="utf-8")
    return f"wrote {PAGE.name}: {len(ordered)} rows"


def _summary(rows: list[dict[str, Any]]) -> str:
    counted = Counter(row["outcome"] for row in rows)
    words = ", ".join(f"{outcome} {number}" for outcome, number in counted.most_common())
    return f"{len(rows)} repairs: {words}. CPU {sum(row['cpu_s'] for row in rows):.0f} s in all.\n\n"


def _rows(rows: list[dict[str, Any]]) -> str:
    head = (
        "| system | way | outcome | verdict and effects (probability in its class) | fresh data | rmse without | with |"
        " by hand × | fresh without | with | by hand × | CPU s |\n|---|---|---|---|---|---|---|---|---|---|---|---|\n"
    )
    return head + "".join(_row(row) for row in rows) + "\n"


def _row(row: dict[str, Any]) -> str:
    ratio = beside_by_hand(row)
    said = row["error"].splitlines()[0][:80] if "error" in row else f"{row['verdict']}: " + "; ".join(
        f"{one['key']} {one['amplitude']} {one['unit']} ({_class(one)})" for one in row["effects"]
    )  # fmt: skip
    sure = {True: "confirmed", False: "refused", None: "–"}[row.get("confirmed")]
    cells = [
        row["rig"], row["writing"], row["outcome"], said, sure,
        _number(row.get("null")), _number(row.get("estimation")), _times(ratio.get("estimation")),
        _number(row.get("null_fresh")), _number(row.get("fresh")), _times(ratio.get("fresh")), f"{row['cpu_s']:.0f}",
    ]  # fmt: skip
    return "| " + " | ".join(str(cell) for cell in cells) + " |\n"


def _class(one: dict[str, Any]) -> str:
    return ", ".join(f"{key.partition('.')[2]} {share:.2f}" for key, share in one["class"].items()) or "alone"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _times(value: float | None) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value:.2f}"


def _hands(names: set[str]) -> str:
    text = "By hand, in SI (the right structure in bold):\n\n"
    text += "| system | structure | rmse | fresh | parameters | date |\n|---|---|---|---|---|---|\n"
    for name, entry in kept().items():
        if name not in names:
            continue
        for structure, one in entry["structures"].items():
            shown = f"**{structure}**" if structure == rig(name).same else structure
            values = ", ".join(f"{key} {value:.4g}" for key, value in one["parameters"].items())
            text += f"| {name} | {shown} | {one['estimation']:.4g} | {one['fresh']:.4g} | {values} |"
            text += f" {entry['date']} |\n"
    return text
