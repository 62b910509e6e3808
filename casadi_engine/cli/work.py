"""What the commands do with a job: estimate, write the answer, say where it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from casadi_engine.cli.job import Job, say, uninterrupted
from casadi_engine.cli.progress import Progress
from casadi_engine.experiment import Experiment
from casadi_engine.parameters import Parameters

if TYPE_CHECKING:
    from casadi_engine.estimation.fit import Fit


def estimate_job(job: Job, records: Sequence[Experiment], parameters: Parameters, *, title: str) -> Fit:
    """Estimate `parameters` from `records` with the settings of the job's problem."""
    from casadi_engine import estimation

    problem = job.problem
    with Progress(title) as progress:
        return estimation.estimate(
            problem.model,
            records,
            parameters=parameters,
            noise=problem.noise,
            interval=problem.interval,
            initial=problem.initial_of(records),
            loss=problem.loss,
            ties=problem.ties,
            method=problem.method,
            starts=problem.starts,
            seed=job.options.seed,
            jobs=job.options.jobs,
            progress=progress,
        )


def held(parameters: Parameters, free: Sequence[str] = ()) -> Parameters:
    """A copy with every parameter fixed at its value, but for those in `free`.

    Constraints are left behind when nothing is free: they restrict a search, and there is none.
    """
    result = parameters.copy() if free else Parameters(parameters[name] for name in parameters)
    for name in result:
        if name not in free and result[name].tie is None:
            result.fix(name)
    return result


def write_answer(job: Job, answer: Any, check: Any = None, **fields: Any) -> None:
    """Write result.json, then report.html, each atomically, into the folder of the job."""
    raise NotImplementedError


def say_where(job: Job) -> None:
    """Say where the files are."""
    say(f"\nWritten: {job.folder / 'result.json'}\n         {job.folder / 'report.html'}")
