"""What the commands do with a job: estimate, write the answer, say where it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casadi_engine.cli.earlier import equations_of
from casadi_engine.cli.folder import make_folder
from casadi_engine.cli.job import Job, say, uninterrupted
from casadi_engine.cli.shell_words import in_shell
from casadi_engine.errors import NotConvergedError

if TYPE_CHECKING:
    from casadi_engine.estimation.fit import Fit
    from casadi_engine.experiment import Experiment
    from casadi_engine.parameters import Parameters

# What the contract asks of a result where there is no answer to take it from.
EMPTY: dict[str, dict[str, Any]] = {
    "fit": {"iterations": 0, "nodes": 0, "optima": [], "fit_percent": {}},
    "validate": {"records": {}, "passed": False},
    "repair": dict.fromkeys(
        ("verdict", "confirmed", "threshold", "where", "gap", "unknown", "next_experiment", "equation")
    )
    | {"candidates": 0, "effects": [], "not_found": []},
}


def estimate_job(job: Job, records: Sequence[Experiment], parameters: Parameters) -> Fit:
    """Estimate `parameters` from `records` with the settings of the job's problem.

    A search that ends with nothing at all is written as a result with its status before the error goes on.
    """
    from casadi_engine import estimation

    problem = job.problem
    try:
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
        )
    except NotConvergedError as error:
        nothing_found(job, records, parameters, error)
        raise


def fitting(job: Job, records: Sequence[Experiment]) -> Sequence[Experiment]:
    """The records, if they have what the model needs; else ExperimentError, before the long work begins."""
    model = job.problem.model
    for record in records:
        record.require(
            inputs={variable.name: variable.unit for variable in model.inputs},
            outputs={variable.name: variable.unit for variable in model.outputs},
        )
    return records


def held(parameters: Parameters, free: Sequence[str] = ()) -> Parameters:
    """A copy with every parameter fixed at its value, but for those in `free`.

    Ties and constraints are left behind when nothing is free: they restrict a search, and there is none.
    """
    from casadi_engine.parameters import Parameters

    result = parameters.copy() if free else Parameters(parameters[name] for name in parameters)
    for name in result:
        if name not in free and result[name].tie is None:
            result.fix(name)
    return result


def write_answer(
    job: Job, answer: Any, *, check: Any = None, data_files: Mapping[str, Experiment] | None = None
) -> None:
    """Write data files, result.json and report.html into the folder of the job, each all or nothing.

    check : the Validation that goes with a Fit
    """
    with uninterrupted():
        from casadi_engine.report import report, to_result, write_result

        document = EMPTY.get(job.options.command, {}) | to_result(answer, **_common(job))
        if check is not None:
            # Beside what the contract asks of a fit: the residual tests that were made of it.
            tested = to_result(check, **_common(job))
            document["validation"] = {key: tested[key] for key in ("inputs", "records", "passed", "alpha")}
        if job.options.command in ("fit", "repair"):
            document["equations"] = equations_of(job.problem.model)
        make_folder(job.folder)
        for name, experiment in (data_files or {}).items():
            experiment.to_csv(job.folder / name)
        write_result(job.folder / "result.json", document)
        report(answer, job.folder / "report.html", validation=check, arguments=job.options.arguments())


def _common(job: Job) -> dict[str, Any]:
    options = job.options
    return {
        "command": options.command,
        "arguments": options.arguments(),
        "seconds": job.seconds,
        "seed": options.seed,
    }


def nothing_found(
    job: Job, records: Sequence[Experiment], parameters: Parameters, error: NotConvergedError
) -> None:
    """Write the result of a search that failed: where it started, and its status."""
    from casadi_engine.report import Simulated, to_result, write_result

    started_from = Simulated(job.problem.model, parameters, tuple(records), ())
    document = EMPTY.get(job.options.command, {}) | to_result(started_from, **_common(job))
    document["status"] = f"not converged: {error.problem}"
    if job.options.command == "repair":
        why = "the fit without effects found no point"
        null_fit = {"cost": None, "n": 0, "status": document["status"], "optima": [], "why": {"cost": why}}
        document |= {"alpha": job.options.extra["alpha"], "null_fit": null_fit}
        document["why"]["threshold"] = why
    with uninterrupted():
        make_folder(job.folder)
        # A page of an earlier run would stand beside a result that it does not belong to.
        (job.folder / "report.html").unlink(missing_ok=True)
        write_result(job.folder / "result.json", document)


def say_answer(job: Job, answer: Any, *, tested: bool | None = None, source: Path | None = None) -> None:
    """Print a result in the words of the command line.

    tested : whether the tests on fresh records passed, None where there were none; source : the result that holds the
    values, for those of a test
    """
    from casadi_engine.validation import Validation

    folder = source if isinstance(answer, Validation) else job.folder
    options = job.options
    repaired = options.command == "repair"
    say(in_shell(str(answer), problem=options.problem, folder=folder, tested=tested, repaired=repaired))


def say_where(job: Job, *others: str) -> None:
    """Say where the files are."""
    names = ("result.json", "report.html", *others)
    say("\n" + "\n".join(f"{'Written:' if k == 0 else '':<9}{job.folder / n}" for k, n in enumerate(names)))
