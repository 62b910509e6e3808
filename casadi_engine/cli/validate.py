"""``casadi-engine validate``: test given parameter values on records, without refitting them."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

from casadi_engine.cli.earlier import From, as_repaired, noise_of, same_files, stands_for, values_of
from casadi_engine.cli.job import ANSWERED, INTERRUPTED, NEGATIVE, NO_ANSWER, Job, complain, run, say
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
from casadi_engine.cli.work import estimate_job, held, say_answer, say_where, write_answer

Check = Annotated[bool, typer.Option("--check", help="End with exit code 1 if a residual test fails.")]


def validate(
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
    from_: From = None,
    check: Check = False,
) -> None:
    """Test the values of a problem's parameters on its validation records (on its records if it has none).

    The values are those of the problem file, or of --from, or of --set. They are kept; only the initial
    states are estimated, and the parameters that --free names.
    """
    run(Options.collect("validate", locals(), extra=("from_", "check")), _work)


def _work(job: Job) -> int:
    from casadi_engine import validation

    options, earlier = job.options, job.options.extra["from_"]
    if earlier is not None:
        job = replace(job, problem=as_repaired(earlier, job.problem))
    parameters = job.problem.parameters
    if earlier is not None:
        parameters = values_of(earlier, parameters, given=options)
    records = job.problem.load_validation() or job.problem.load_records()
    found = estimate_job(job, records, held(parameters, options.free))
    levels = {} if earlier is None else noise_of(earlier)
    known = None if earlier is None else stands_for(earlier, found, parameters, given=options)
    checked = None
    if found.converged and known is not None:
        checked = validation.validate(known, records)
    elif found.converged:
        checked = validation.validate(found, known=None if found.free else levels)
    write_answer(job, checked if checked is not None else found)
    say_answer(job, checked if checked is not None else found, source=earlier)
    if earlier is not None and known is None and checked is not None:
        say(
            "The values count as exact here, as the result does not tell all their errors; `casadi-engine fit ... "
            "--validate FILE` counts with them"
        )
    for name in () if earlier is None else same_files(earlier, records):
        say(
            f"The result of {earlier} was found from the measurement of {name}: it tells nothing of fresh data"
        )
    say_where(job)
    if checked is None:
        complain("validate", f"no answer: {found.status}; the best point so far is in {job.folder}")
        return INTERRUPTED if found.status == "interrupted" else NO_ANSWER
    return NEGATIVE if options.extra["check"] and not checked.passed else ANSWERED
