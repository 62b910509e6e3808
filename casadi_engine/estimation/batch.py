"""A batch: many fits at once, in several processes if asked."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from casadi_engine.errors import CasadiEngineError, EstimationError
from casadi_engine.estimation.estimate import estimate
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.parallel import in_order
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import near_matches


@dataclass(frozen=True, eq=False)
class Task:
    """One fit of a batch: what `estimate` is given.

    options : its keyword arguments, ``parameters`` and ``noise`` among them
    """

    model: Model
    data: Experiment | Sequence[Experiment]
    options: Mapping[str, Any] = field(default_factory=dict)


def fits(tasks: Sequence[Task], *, jobs: int | None = 1) -> list[Fit | CasadiEngineError]:
    """The Fit of every task, in the tasks' order; a task that cannot be fitted has its error there instead.

    jobs : 1 for this process, more for so many of joblib's (extra "cluster"), None for what ``joblib.parallel_config``
        says, such as a dask cluster: the same numbers wherever they are made
    Raises MissingDependencyError without joblib, EstimationError if something is no Task or a task cannot be sent to
    another process.

    >>> import numpy as np, casadi_engine as ce
    >>> t = np.arange(200) * 0.01
    >>> exp = ce.Experiment.from_arrays("run_up", time=t, units={"T": "N m", "omega": "rad/s"}, hold="zero",
    ...     T=np.full(200, 2.0), omega=4 * (1 - np.exp(-t / 0.8)) + 0.01 * np.cos(90 * t))
    >>> tasks = [Task(ce.one_inertia(), exp, {"noise": ce.Noise(omega=level)}) for level in (0.01, 0.02)]
    >>> [round(fit.cost / fits(tasks)[0].cost, 2) for fit in fits(tasks)]
    [1.0, 0.25]
    """
    given = list(tasks) if isinstance(tasks, Iterable) else [tasks]
    for task in given:
        if not isinstance(task, Task):
            raise EstimationError(
                "a task of a batch is not acceptable",
                seen=repr(task),
                allowed="a sequence of Tasks",
                cure="give [Task(model, data, {...}), ...]",
            )
    return in_order(_fit, given, jobs=jobs)


def check_options(options: Any, without: Sequence[str] = ()) -> None:
    """EstimationError unless the options are keyword arguments of `estimate`, other than those in ``without``."""
    known = [
        name
        for name, one in inspect.signature(estimate).parameters.items()
        if one.kind is one.KEYWORD_ONLY and name not in without
    ]
    if not isinstance(options, Mapping):
        raise EstimationError(
            "the options of a fit are not a mapping",
            seen=repr(options),
            allowed="name -> value of the options of estimate",
            cure='give {"noise": Noise(...)}, for instance',
        )
    for name in options:
        if name not in known:
            raise EstimationError(
                "estimate has no such option",
                seen=repr(name),
                allowed=near_matches(str(name), known),
                cure="help(ce.estimate) lists them",
            )


def _fit(task: Task) -> Fit | CasadiEngineError:
    try:
        check_options(task.options)
        return estimate(task.model, task.data, **{"progress": False, **task.options})
    except CasadiEngineError as error:
        return error
