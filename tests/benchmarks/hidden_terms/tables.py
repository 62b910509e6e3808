"""The dated tables of a results file: by kind, by signal-to-noise ratio, probabilities, amplitudes."""

from __future__ import annotations

import datetime
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from statistics import median
from typing import Any

Row = Mapping[str, Any]
OUTCOMES = (
    "right", "in class", "right (unnamed)", "alike", "partly", "unnamed", "missed", "wrong class", "wrong single",
    "no answer", "over budget", "crashed",
)  # fmt: skip
_BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0)


def tables(rows: Sequence[Row], version: str) -> str:
    """All tables of the rows of one version."""
    head = (
        f"# Hidden terms in systems of many kinds\n\n{datetime.date.today().isoformat()}, version {version}: "
        f"{sum(not row['null'] for row in rows)} tasks, {sum(row['null'] for row in rows)} nulls, made by "
        "`python tests/benchmarks/hidden_terms/run.py`; `tests/benchmarks/hidden_terms/README.md` says what the "
        "columns mean.\n"
    )
    tasks, nulls = ([row for row in rows if row["null"] == null] for null in (False, True))
    parts = [
        head,
        _section("By kind", "kind", _by(rows, lambda row: row["kind"])),
        _section("By signal-to-noise ratio", "dB", _by(rows, lambda row: row["snr"])),
        _section("By noise", "noise", _by(rows, lambda row: row["noise"])),
        _section("By what is hidden", "task", _by(tasks, lambda row: f"{row['kind']}: {row['label']}")),
        _section("Nulls, by what is known beside the model", "null", _by(nulls, lambda row: row["label"])),
        "## Gap on fresh data, in standard deviations of the noise\n\n" + _gaps(tasks),
        "## Stated probabilities of class members\n\n" + _reliability(tasks),
        "## Amplitudes\n\n" + _coverage(tasks),
    ]
    return "\n".join(parts)


def word_of(row: Row) -> str:
    """The outcome without the words of an exception."""
    return row["outcome"].partition(":")[0]


def _by(rows: Iterable[Row], key: Callable[[Row], Any]) -> dict[Any, list[Row]]:
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    every = [row for group in groups.values() for row in group]
    return dict(sorted(groups.items())) | ({"all": every} if len(groups) > 1 else {})


def _section(title: str, what: str, groups: Mapping[Any, Sequence[Row]]) -> str:
    """Counts of outcomes of tasks, false alarms among nulls, and CPU seconds, a line for each group."""
    seen = {word_of(row) for group in groups.values() for row in group if not row["null"]}
    words = [word for word in OUTCOMES if word in seen]
    nulls = any(row["null"] for group in groups.values() for row in group)
    if not groups:
        return f"## {title}\n\nnone\n"
    heads = [what, "tasks", *words, *(["false alarms"] if nulls else []), "CPU s, median", "longest"]
    lines = [f"## {title}\n", line(heads), line(["---"] * len(heads))]
    for name, group in groups.items():
        tasks = [row for row in group if not row["null"]]
        counted = Counter(word_of(row) for row in tasks)
        cells = [name, len(tasks), *(counted[word] or "" for word in words)]
        if nulls:
            cells.append(_false_alarms([row for row in group if row["null"]]))
        seconds = [row["seconds"] for row in group]
        lines.append(line([*cells, f"{median(seconds):.1f}", f"{max(seconds):.0f}"]))
    return "\n".join(lines) + "\n"


def _false_alarms(nulls: Sequence[Row]) -> str:
    if not nulls:
        return ""
    counted = Counter(word_of(row) for row in nulls)
    others = sum(count for word, count in counted.items() if word not in ("right", "false alarm"))
    return f"{counted['false alarm']} of {len(nulls)}" + (f" ({others} without an answer)" if others else "")


def _gaps(tasks: Sequence[Row]) -> str:
    """Simulation less noise-free truth, before and after, medians of the tasks that were answered."""
    lines = [line(["kind", "answered", "before", "after"]), line(["---"] * 4)]
    for name, group in _by(tasks, lambda row: row["kind"]).items():
        gaps = [row["answer"]["gap"] for row in group if row.get("answer", {}).get("gap")]
        if gaps:
            before, after = (median(one[word] for one in gaps) for word in ("before", "after"))
            lines.append(line([name, len(gaps), f"{before:.2f}", f"{after:.2f}"]))
    return "\n".join(lines) + "\n"


def _reliability(tasks: Sequence[Row]) -> str:
    """How often a member of a class is a true term, by the probability that it was given."""
    pairs = [(p, hit) for row in tasks for p, hit in row.get("members", ())]
    lines = [line(["stated", "members", "mean stated", "true"]), line(["---"] * 4)]
    for low, high in pairwise(_BINS):
        own = [(p, hit) for p, hit in pairs if low < p <= high or (low == 0 and p == 0)]
        if own:
            stated, true = (sum(one[k] for one in own) / len(own) for k in (0, 1))
            lines.append(line([f"{low:g} to {high:g}", len(own), f"{stated:.2f}", f"{true:.2f}"]))
    return "\n".join(lines) + "\n"


def _coverage(tasks: Sequence[Row]) -> str:
    """How often the true size is within two standard errors, for terms found under their own names."""
    found: dict[str, list[float]] = {}
    without = 0
    for row in tasks:
        for one in row.get("amplitudes", ()):
            if not one["stderr"]:
                without += 1
                continue
            off = (one["amplitude"] - one["true"]) / one["stderr"]
            found.setdefault(one["term"].rpartition(".")[2], []).append(off)
    lines = [line(["effect", "found", "within 1.96 standard errors", "median of their size"])]
    lines.append(line(["---"] * 4))
    everything = [one for own in found.values() for one in own]
    for name, offs in [*sorted(found.items()), ("all", everything)]:
        if offs:
            inside = sum(abs(one) < 1.96 for one in offs)
            lines.append(line([name, len(offs), inside, f"{median(abs(one) for one in offs):.2f}"]))
    return "\n".join(lines) + f"\n\n{without} were found without a standard error.\n"


def line(cells: Iterable[Any]) -> str:
    return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"
