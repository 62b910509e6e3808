"""``casadi-engine simulate``: the model's outputs for the inputs of the records."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from casadi_engine.cli.earlier import From, as_repaired, values_of
from casadi_engine.cli.folder import refuse_others, remove_files, simulated_files
from casadi_engine.cli.job import ANSWERED, Job, run, say
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
from casadi_engine.cli.work import say_where, write_answer


def simulate(
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
) -> None:
    """Simulate the records of a problem with its parameter values, and write a data file for each.

    The values are those of the problem file, or of --from, or of --set.
    The files given by --validate are simulated too. Initial states that the problem does not give as numbers
    are those that fit the measured outputs best.
    """
    run(Options.collect("simulate", locals(), extra=("from_",)), _work)


def _work(job: Job) -> int:
    from casadi_engine import estimation
    from casadi_engine.cli.one_time import on_one_time
    from casadi_engine.model.arrival import arriving
    from casadi_engine.report import Simulated, text

    earlier = job.options.extra["from_"]
    problem = job.problem if earlier is None else as_repaired(earlier, job.problem)
    parameters = problem.parameters
    if earlier is not None:
        parameters = values_of(earlier, parameters, given=job.options)
    records = problem.load_records()
    if job.options.validate:
        records += problem.load_validation()
    records = tuple(arriving(problem.model, record) for record in records)
    files, earlier = file_names(record.name for record in records), simulated_files(job.folder)
    refuse_others(job.folder, {*files} - {*earlier})
    states = [state.name for state in problem.model.states]
    outputs = [output.name for output in problem.model.outputs]
    made = tuple(
        on_one_time(
            estimation.simulate(
                problem.model,
                record,
                parameters=parameters,
                initial=initial_state(problem.initial, record.name, states),
                method=problem.method,
            ),
            outputs,
        )
        for record in records
    )
    answer = Simulated(problem.model, parameters, records, made, files)
    write_answer(job, answer, data_files=dict(zip(files, made, strict=True)))
    # Records of an earlier run would stand beside a result that does not speak of them.
    remove_files(job.folder, {*earlier} - {*files})
    say(text(answer))
    say_where(job, *files)
    return ANSWERED


def initial_state(
    initial: Mapping[str, Any] | None, record: str, states: Iterable[str]
) -> dict[str, float] | None:
    """The initial states of a record that are given as numbers, or None if there are none.

    >>> initial_state({"omega_eng": 125.0, "twist": "free"}, "run", ["omega_eng", "twist"])
    {'omega_eng': 125.0}
    """
    given = initial or {}
    own = given.get(record)
    values = {**given, **own} if isinstance(own, Mapping) else given
    chosen = {state: values[state] for state in states if state in values}
    return {
        state: float(value)
        for state, value in chosen.items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    } or None


def file_names(records: Iterable[str]) -> tuple[str, ...]:
    """A file name for each record key, safe on every operating system, each its own.

    >>> file_names(["normal_1200rpm", "a/b", "a:b"])
    ('normal_1200rpm.csv', 'a_b.csv', 'a_b_2.csv')
    """
    names: list[str] = []
    taken: set[str] = set()
    for record in records:
        stem = re.sub(r"[^A-Za-z0-9._@+-]", "_", record).lstrip(".")[:100] or "record"
        name, number = f"{stem}.csv", 2
        while name.lower() in taken:
            name, number = f"{stem}_{number}.csv", number + 1
        taken.add(name.lower())
        names.append(name)
    return tuple(names)
