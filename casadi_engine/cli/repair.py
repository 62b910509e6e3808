"""``casadi-engine repair``: find what the model lacks, name it, add it, and show that the gap shrinks."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from casadi_engine.cli.job import ANSWERED, INTERRUPTED, NEGATIVE, NO_ANSWER, Job, complain, run
from casadi_engine.cli.options import (
    Data,
    Debug,
    Fix,
    Free,
    Jobs,
    Options,
    Out,
    ProblemFile,
    Seed,
    Set,
    Validate,
)
from casadi_engine.cli.work import fitting, nothing_found, say_answer, say_where, write_answer
from casadi_engine.errors import NotConvergedError

Alpha = Annotated[
    float,
    typer.Option("--alpha", metavar="SHARE", help="False-alarm rate of all that is looked for together."),
]
HoldOut = Annotated[
    float,
    typer.Option(
        "--holdout",
        metavar="SHARE",
        help="Share of the cycles kept for confirmation where no fresh file is given.",
    ),
]
Effects = Annotated[
    list[str] | None,
    typer.Option(
        "--effects", metavar="NAME", help="Look for this effect alone; NAME,NAME for several, or repeat."
    ),
]
Without = Annotated[
    list[str] | None,
    typer.Option(
        "--without", metavar="NAME", help="Do not look for this effect; NAME,NAME for several, or repeat."
    ),
]
Budget = Annotated[
    float | None,
    typer.Option("--budget", metavar="SECONDS", help="Time after which no further effect is tried."),
]
Check = Annotated[bool, typer.Option("--check", help="End with exit code 1 if something is missing.")]

# A wrong optimum of the model without effects looks like missing physics: so many starts at least.
STARTS = 4


def repair(
    problem: ProblemFile,
    data: Data = None,
    validate: Validate = None,
    set: Set = None,  # the option's name is --set
    free: Free = None,
    fix: Fix = None,
    out: Out = None,
    seed: Seed = 0,
    jobs: Jobs = 1,
    debug: Debug = False,
    alpha: Alpha = 0.01,
    holdout: HoldOut = 0.3,
    effects: Effects = None,
    without: Without = None,
    budget: Budget = None,
    check: Check = False,
) -> None:
    """Find where simulation and records disagree, name the missing effect, add it, and test it on fresh records.

    The fresh records are the problem's validation records, or those of --validate; without any the last cycles of each
    record are held out.
    """
    run(
        Options.collect(
            "repair", locals(), extra=("alpha", "holdout", "effects", "without", "budget", "check")
        ),
        _work,
    )


def _work(job: Job) -> int:
    found = _found(job)
    write_answer(job, found)
    say_answer(job, found)
    say_where(job)
    if found.verdict is None:
        complain("repair", f"no answer: {found.status}; what there is lies in {job.folder}")
        return INTERRUPTED if found.status == "interrupted" else NO_ANSWER
    if found.stopped == "the user":
        return INTERRUPTED
    missing = found.verdict != "nothing missing"
    return NEGATIVE if job.options.extra["check"] and missing else ANSWERED


def _found(job: Job) -> Any:
    from casadi_engine import discrepancy

    problem, wanted = job.problem, job.options.extra["effects"]
    records = fitting(job, problem.load_records())
    fresh = fitting(job, problem.load_validation())
    try:
        return discrepancy.repair(
            problem.model,
            records,
            parameters=problem.parameters,
            fresh=fresh or None,
            noise=problem.noise,
            alpha=job.options.extra["alpha"],
            holdout=job.options.extra["holdout"],
            effects=None if wanted is None else _names(wanted) or [""],  # no name is none of the library's
            without=_names(job.options.extra["without"]),
            budget=job.options.extra["budget"],
            starts=max(STARTS, problem.starts),
            seed=job.options.seed,
            jobs=job.options.jobs,
            interval=problem.interval,
            initial=problem.initial_of(records),
            method=problem.method,
        )
    except NotConvergedError as error:
        nothing_found(job, records, problem.parameters, error)
        raise


def _names(given: list[str] | None) -> list[str]:
    """Names from options that were repeated, joined by commas, or both."""
    return [name for text in given or () for part in text.split(",") if (name := part.strip())]
