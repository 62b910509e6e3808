"""What the constants of the repair workflow do: the open tasks with each of them halved and doubled.

    python tests/benchmarks/hidden_terms/constants.py [NAME ...] [--tasks N] [--nulls N] [--kinds KIND ...] [--budget S]
        [--out FILE.jsonl] [--table FILE.md] [--list]

One JSON line per constant, factor and task is added to FILE.jsonl; what stands there for the same task, setting and
version is not run again. `--table` writes the dated table of all that FILE.jsonl holds of this version.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import importlib
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hidden_terms.kind import load_kinds, nulls_of, tasks_of
from hidden_terms.run import read, run_task, version_of

ROOM = "casadi_engine.discrepancy."
GOOD = ("right", "in class", "alike")


@dataclass(frozen=True)
class Constant:
    """A constant: its name, the modules that hold it, and what it means."""

    name: str
    modules: tuple[str, ...]
    meaning: str

    @property
    def value(self) -> float:
        """What it is."""
        return getattr(importlib.import_module(ROOM + self.modules[0]), self.name)

    @contextlib.contextmanager
    def times(self, factor: float) -> Iterator[None]:
        """The constant multiplied by a factor; counts stay whole."""
        before = self.value
        value = type(before)(max(before * factor, 1) if isinstance(before, int) else before * factor)
        for module in self.modules:
            setattr(importlib.import_module(ROOM + module), self.name, value)
        try:
            yield
        finally:
            for module in self.modules:
                setattr(importlib.import_module(ROOM + module), self.name, before)


CONSTANTS = (
    Constant(
        "FACTOR", ("refits", "choice"), "a structure is excluded where another is so many times more probable"
    ),
    Constant("BEYOND", ("choice",), "standard errors of the least certain amplitude of a finding"),
    Constant("PHYSICAL", ("priors",), "share of an output's variation that an effect may well make"),
    Constant("SENSOR", ("priors",), "the same of an error of a sensor"),
    Constant("STATED", ("priors",), "share of itself by which a stated number may well be wrong"),
    Constant("_BENT", ("priors",), "prior of a law that bends: so many times its amplitude at most"),
    Constant("_OPEN", ("priors",), "prior of a parameter without bounds, in its own size"),
    Constant("_STATE", ("evidence",), "prior of a first state, in the state's scale"),
    Constant("SEEN", ("fresh_choice", "answer"), "share of the gap whose closing a person would see"),
    Constant(
        "_SWINGS", ("answer",), "independent samples that a coloured residual is worth to be called noise"
    ),
    Constant("STEPS", ("path",), "steps of a refit over one horizon"),
    Constant("FELT", ("path", "refits"), "chi-squared by which a corner's width is felt"),
    Constant("_WIDER", ("path",), "times that corners are four times as wide where a refit begins"),
    Constant("_SHARPER", ("path",), "times that corners are made four times as sharp at most"),
    Constant(
        "_INTEGRATED", ("path",), "steps of the integration beyond which they are short in places alone"
    ),
    Constant("_TOLD", ("too_few",), "standard errors of an effect from which fresh data would tell it"),
    Constant("_BEHIND", ("too_few",), "standard errors by which a gain may stay behind what was foretold"),
    Constant("_PATIENCE", ("path",), "what a refit with sharper corners may cost more than others"),
    Constant("_RIVALS", ("pairs",), "rivals of an effect that are tried with one more effect each"),
    Constant("_SECONDS", ("pairs",), "effects that such a rival is tried with"),
    Constant("_FIRST", ("choice",), "effects of a linear model that are refitted whatever one step says"),
    Constant("PART", ("refits", "choice"), "share of the best one's gain that one step may miss"),
    Constant("_EXCHANGED", ("choice",), "candidates that are refitted in the place of a member"),
    Constant("_AGAIN", ("choice",), "times that a better one is looked from"),
    Constant("_NESTED", ("choice",), "chi-squared above its special case at which a refit has not arrived"),
    Constant("_SMALL", ("choice",), "share of the one-step amplitude from which a refit is tried again"),
    Constant("_NOTHING", ("choice",), "log likelihood that a further effect promises to be refitted"),
    Constant("_RELEVELLED", ("refits",), "fall of the noise's level at which refits go on"),
    Constant(
        "_POOR", ("fresh_fits",), "chi-squared per fresh sample from which other first states are tried"
    ),
)


def arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--tasks", type=int, default=2)
    parser.add_argument("--nulls", type=int, default=1)
    parser.add_argument("--kinds", nargs="*", default=None)
    parser.add_argument("--budget", type=float, default=60.0)
    parser.add_argument("--out", type=Path, default=Path("constants.jsonl"))
    parser.add_argument("--table", type=Path)
    parser.add_argument("--list", action="store_true", help="list the constants and end")
    return parser.parse_args(argv)


def table(rows: list[dict[str, Any]], version: str) -> str:
    """Outcomes by constant and factor, and which tasks changed."""
    plain = {row["key"]: row for row in rows if row["constant"] == "none"}
    good = sum(row["outcome"].startswith(GOOD) for row in plain.values())
    seconds = sum(row["seconds"] for row in plain.values())
    kinds = ", ".join(sorted({row["kind"] for row in plain.values()}))
    lines = [
        "# The constants of the repair workflow, halved and doubled",
        "",
        f"{datetime.date.today().isoformat()}, {version}. {len(plain)} open tasks and nulls ({kinds}); as they are "
        f"{good} are right or in class, in {seconds:.0f} s of CPU. Tasks that are not listed end as they do.",
        "",
        "| constant | value | means | halved | doubled |",
        "|---|---|---|---|---|",
    ]
    for one in CONSTANTS:
        cells = []
        for factor in (0.5, 2.0):
            own = [
                r for r in rows if r["constant"] == one.name and r["factor"] == factor and r["key"] in plain
            ]
            moved = [
                f"{r['key']}: {r['outcome'][:40]}" for r in own if r["outcome"] != plain[r["key"]]["outcome"]
            ]
            cpu = sum(r["seconds"] for r in own) / max(sum(plain[r["key"]]["seconds"] for r in own), 1e-9)
            right = sum(r["outcome"].startswith(GOOD) for r in own)
            cells.append(
                f"{right} of {len(own)}, CPU x{cpu:.2f}" + "".join(f"; {m}" for m in moved) if own else "-"
            )
        lines.append(f"| `{one.name}` | {one.value:g} | {one.meaning} | {cells[0]} | {cells[1]} |")
    return "\n".join(lines) + "\n"


def main(argv: list[str] | None = None) -> None:
    given = arguments(argv)
    if given.list:
        for one in CONSTANTS:
            print(f"{one.name:14s} {one.value:<8g} {one.meaning}")
        return
    kinds = load_kinds()
    picked = [kinds[name] for name in given.kinds or kinds]
    tasks = [t for kind in picked for t in (*tasks_of(kind)[: given.tasks], *nulls_of(kind)[: given.nulls])]
    version = version_of()
    rows = [row for row in read(given.out) if row["version"] == version]
    done = {(row["constant"], row["factor"], row["key"]) for row in rows}
    wanted = [one for one in CONSTANTS if not given.names or one.name in given.names]
    settings = [(None, 1.0), *((one, factor) for one in wanted for factor in (0.5, 2.0))]
    for one, factor in settings:
        name = "none" if one is None else one.name
        for task in tasks:
            if (name, factor, task.key) in done:
                continue
            with contextlib.nullcontext() if one is None else one.times(factor):
                row = run_task(task, given.budget, sealed=False)
            row |= {"constant": name, "factor": factor, "key": task.key, "version": version}
            with given.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            rows.append(row)
            print(
                f"{name:14s} x{factor:<4g} {task.key:60s} {row['seconds']:6.1f} s  {row['outcome'][:60]}",
                flush=True,
            )
    if given.table:
        given.table.write_text(table(rows, version), encoding="utf-8")


if __name__ == "__main__":
    main()
