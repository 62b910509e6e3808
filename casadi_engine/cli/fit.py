"""``casadi-engine fit``: estimate the free parameters, and test the residuals."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from casadi_engine.cli.drawn import FILES, check_files, draw, remove_earlier
from casadi_engine.cli.job import ANSWERED, INTERRUPTED, NO_ANSWER, Job, complain, run, say
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
from casadi_engine.cli.work import estimate_job, fitting, say_answer, say_where, write_answer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from casadi_engine.estimation.fit import Fit
    from casadi_engine.experiment import Experiment

Posterior = Annotated[
    bool,
    typer.Option(
        "--posterior",
        help="Draw the distribution of the parameters too, for errors that no ± describes (seconds to minutes).",
    ),
]


def fit(
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
    posterior: Posterior = False,
) -> None:
    """Estimate the free parameters of a problem from its records.

    The residual tests are made on the validation records, or on the fitted ones if there are none.
    """
    run(Options.collect("fit", locals(), extra=("posterior",)), _work)


def _with_doubts(job: Job, found: Fit, records: Sequence[Experiment]) -> Fit:
    """The fit with what is likely wrong with its data said first, where it follows next to nothing of an output: an
    input reversed, a unit, two columns exchanged. It is looked for twice as long as the fit took, and three seconds."""
    from casadi_engine.estimation.followed import not_followed

    if found.status == "interrupted" or not not_followed(found):
        return found
    from casadi_engine.deadline import Deadline, TimeUp
    from casadi_engine.discrepancy.misread import misread
    from casadi_engine.estimation.faulty_samples import IN_DOUBT
    from casadi_engine.estimation.interrupts import Interrupts

    problem = job.problem
    options = {
        "interval": problem.interval,
        "initial": problem.initial_of(found.data),
        "method": problem.method,
    }
    doubt, own = None, Deadline(3.0 + 2.0 * found.timing["solve"])
    with Interrupts(own.stop) as asked, suppress(TimeUp, KeyboardInterrupt), own:
        doubt = misread(found, problem.parameters, problem.noise, options, math.inf, every=True, data=records)
    if asked.stopped:
        return replace(found, status="interrupted")
    if doubt is None:
        return found
    messages = (doubt.words, *found.messages)
    return replace(found, messages=messages, options={**found.options, IN_DOUBT: doubt.words})


def _work(job: Job) -> int:
    from casadi_engine import validation

    check_files(job)
    records = job.problem.load_records()
    fresh = fitting(job, job.problem.load_validation())  # a fault in these files shows before the long work
    found = _with_doubts(job, estimate_job(job, records, job.problem.parameters), records)
    check, stopped = None, False
    if found.converged:
        try:
            check = validation.validate(found, fresh or None)
        except KeyboardInterrupt:
            stopped = True
        except Exception:
            write_answer(job, found)  # the fit is not lost with its tests
            raise
    remove_earlier(job)
    write_answer(job, found, check=check)
    say_answer(job, found, tested=check.passed if fresh and check is not None else None)
    if check is not None:
        say("")
        say_answer(job, check, source=job.folder)
        if not fresh:
            say(
                "Tested on the records it was fitted to: that proves little; give fresh ones by --validate FILE"
            )
    if stopped:
        say_where(job)
        complain("fit", f"interrupted in the residual tests; the fit itself is in {job.folder}")
        return INTERRUPTED
    if found.converged:
        code = draw(job, found) if job.options.extra["posterior"] else ANSWERED
        say_where(job, *(FILES if job.options.extra["posterior"] and code == ANSWERED else ()))
        return code
    say_where(job)
    complain("fit", f"no answer: {found.status}; the best point so far is in {job.folder}")
    return INTERRUPTED if found.status == "interrupted" else NO_ANSWER
