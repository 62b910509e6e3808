"""``casadi-engine identify``: can the free parameters be told, in principle and from these records?"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import typer

from casadi_engine.cli.job import ANSWERED, NEGATIVE, Job, run, say
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
from casadi_engine.errors import CasadiEngineError, IdentifiabilityError

if TYPE_CHECKING:
    from casadi_engine.experiment import Experiment
    from casadi_engine.model import Model

Inputs = Annotated[
    str,
    typer.Option(
        "--inputs",
        metavar="CLASS",
        help="How the drives behave: generic, constant, zero, unknown (arbitrary), 'unknown constant', 'unknown "
        "polynomial 2'; or for each drive T_1=generic,T_load=unknown, with *=CLASS for the others.",
    ),
]
Start = Annotated[
    str,
    typer.Option(
        "--start",
        metavar="START",
        help="What is known of the initial states: free, known, rest; or for each state twist=rest,*=free.",
    ),
]
Outputs = Annotated[
    list[str] | None,
    typer.Option(
        "--outputs",
        metavar="NAME",
        help="What is measured: outputs, or states as further sensors; repeatable.",
    ),
]
Combination = Annotated[
    list[str] | None,
    typer.Option(
        "--combination", metavar="TEXT", help='Test this combination of parameters too, "K21*J1"; repeatable.'
    ),
]
Check = Annotated[bool, typer.Option("--check", help="End with exit code 1 if a free parameter is lost.")]
Profiles = Annotated[
    bool,
    typer.Option(
        "--profiles", help="Fit the records too, and profile the likelihood of each free parameter (minutes)."
    ),
]


def identify(
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
    inputs: Inputs = "generic",
    start: Start = "free",
    outputs: Outputs = None,
    combination: Combination = None,
    check: Check = False,
    profiles: Profiles = False,
) -> None:
    """Test whether the free parameters can be told: exactly from the equations, then from the records.

    The first answer needs no data, and says what would bring lost parameters back. Where the problem has records
    and nothing is lost, the expected errors at the present values follow; with --profiles a fit and its profiles.
    """
    extra = ("inputs", "start", "outputs", "combination", "check", "profiles")
    run(Options.collect("identify", locals(), extra=extra), _work)


def _work(job: Job) -> int:
    from casadi_engine.identifiability import identifiability
    from casadi_engine.model.arrival import arriving
    from casadi_engine.report.identified import Identified

    extra, problem = job.options.extra, job.problem
    loaded = fitting(job, problem.load_records()) if problem.records else ()
    records = tuple(arriving(problem.model, record) for record in loaded)
    found = identifiability(
        problem.model,
        parameters=problem.parameters,
        inputs=by_name("--inputs", extra["inputs"]),
        start=by_name("--start", extra["start"]),
        outputs=_names(extra["outputs"]),
        combinations=extra["combination"] or (),
        seed=job.options.seed,
    )
    say_answer(job, found)
    information = fit = profiled = None
    notes: list[str] = []
    if not records:
        notes.append("The problem has no records: what data would tell is not known.")
    elif not found.passed:
        notes.append("Data cannot tell what structure hides: the records are not looked at.")
    elif found.free:
        seen = _names(extra["outputs"])
        records = tuple(_of_outputs(record, problem.model, seen) for record in records)
        information, fit, profiled = _practical(job, records, notes)
    answer = Identified(found, tuple(records), information, fit, profiled, tuple(notes))
    write_answer(job, answer)
    for part in (information, profiled, *notes):
        if part is not None:
            say("")
            say_answer(job, part)
    say_where(job)
    return NEGATIVE if extra["check"] and not found.passed else ANSWERED


def _of_outputs(record: Experiment, model: Model, seen: tuple[str, ...] | None) -> Experiment:
    """The record without the outputs that --outputs leaves out."""
    hidden = set() if seen is None else {out.name for out in model.outputs} - {*seen}
    return replace(record, channels=tuple(one for one in record.channels if one.name not in hidden))


def _practical(job: Job, records: Any, notes: list[str]) -> tuple[Any, Any, Any]:
    """Expected errors at the present values; a fit and its profiles. What cannot be had is noted, not raised."""
    from casadi_engine.identifiability import fisher, profile

    problem = job.problem
    information = fit = profiled = None
    try:
        information = fisher(problem.model, records, parameters=problem.parameters, noise=problem.noise)
        if job.options.extra["profiles"]:
            fit = estimate_job(job, records, problem.parameters)
            profiled = profile(fit)
    except KeyboardInterrupt:
        notes.append("Interrupted: the part on the records is not complete.")
    except CasadiEngineError as error:
        notes.append(f"Of the records: {error}")
    return information, fit, profiled


def by_name(option: str, text: str) -> str | dict[str, Any]:
    """One word for all, or name -> word; numbers as numbers.

    >>> by_name("--inputs", "constant"), by_name("--start", "twist=0, *=free")
    ('constant', {'twist': 0.0, '*': 'free'})
    """
    if "=" not in text:
        return text.strip()
    found: dict[str, Any] = {}
    for part in text.split(","):
        name, equals, word = (one.strip() for one in part.partition("="))
        if not (name and equals and word) or name in found:
            raise IdentifiabilityError(
                f"{option} cannot be read",
                seen=repr(text),
                allowed="one word, or NAME=WORD,NAME=WORD with each name once",
                cure=f"write for instance {option} T_1=generic,T_load=unknown",
            )
        try:
            found[name] = float(word)
        except ValueError:
            found[name] = word
    return found


def _names(given: list[str] | None) -> tuple[str, ...] | None:
    """Names given by a repeated option, or separated by commas."""
    if not given:
        return None
    return tuple(name.strip() for one in given for name in one.split(",") if name.strip())
