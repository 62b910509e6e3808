"""The options that the commands share, declared once, and as one object."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

ProblemFile = Annotated[Path, typer.Argument(metavar="PROBLEM.py", help="The problem file.")]
Data = Annotated[
    list[Path] | None,
    typer.Option(
        "--data",
        metavar="FILE",
        help="Data file that replaces the problem's records (and its validation records, unless --validate "
        "is given); repeat for several.",
    ),
]
Validate = Annotated[
    list[Path] | None,
    typer.Option(
        "--validate",
        metavar="FILE",
        help="Data file that replaces the validation records; repeat for several.",
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Value of a parameter, where a fit starts; repeatable."),
]
Free = Annotated[
    list[str] | None, typer.Option("--free", metavar="NAME", help="Estimate this parameter; repeatable.")
]
Fix = Annotated[
    list[str] | None,
    typer.Option("--fix", metavar="NAME[=VALUE]", help="Keep this parameter at its value; repeatable."),
]
Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Folder of the results; default results/<problem>-<command>."),
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of everything that is random.")]
Jobs = Annotated[int, typer.Option("--jobs", min=1, help="Processes for several starts.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


@dataclass(frozen=True)
class Options:
    """What a command was asked for; `extra` holds the options that it does not share with the others."""

    command: str
    problem: Path
    data: tuple[Path, ...] = ()
    validate: tuple[Path, ...] = ()
    set: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    fix: tuple[str, ...] = ()
    out: Path | None = None
    seed: int = 0
    jobs: int = 1
    debug: bool = False
    extra: dict[str, Any] = field(default_factory=dict)
    started: float = field(default_factory=time.perf_counter)

    @staticmethod
    def collect(command: str, given: dict[str, Any], *, extra: tuple[str, ...] = ()) -> Options:
        """Options from the arguments of a command function (its ``locals()``)."""
        fields: dict[str, Any] = {name: given[name] for name in ("problem", "out", "seed", "jobs", "debug")}
        for name in ("data", "validate", "set", "free", "fix"):
            fields[name] = tuple(given[name] or ())
        return Options(command, **fields, extra={name: given[name] for name in extra})

    def arguments(self) -> dict[str, Any]:
        """The arguments as JSON-able data for result.json."""
        return {
            "problem": str(self.problem),
            "data": [str(path) for path in self.data],
            "validate": [str(path) for path in self.validate],
            "set": list(self.set),
            "free": list(self.free),
            "fix": list(self.fix),
            "out": None if self.out is None else str(self.out),
            "seed": self.seed,
            "jobs": self.jobs,
            **{
                name.rstrip("_"): str(value) if isinstance(value, Path) else value
                for name, value in self.extra.items()
            },
        }
