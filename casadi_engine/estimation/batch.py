"""A batch: many fits at once, in several processes if asked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation.estimate import estimate
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.parallel import in_order
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model


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
    Raises MissingDependencyError without joblib, EstimationError if a task cannot be sent to another process.

    >>> import numpy as np, casadi_engine as ce
    >>> t = np.arange(200) * 0.01
    >>> exp = ce.Experiment.from_arrays("run_up", time=t, units={"T": "N m", "omega": "rad/s"}, hold="zero",
    ...     T=np.full(200, 2.0), omega=4 * (1 - np.exp(-t / 0.8)))
    >>> tasks = [Task(ce.one_inertia(), exp, {"noise": ce.Noise(omega=level)}) for level in (0.01, 0.02)]
    >>> [round(fit.cost / fits(tasks)[0].cost, 2) for fit in fits(tasks)]
    [1.0, 0.25]
    """
    return in_order(_fit, tasks, jobs=jobs)


def _fit(task: Task) -> Fit | CasadiEngineError:
    try:
        return estimate(task.model, task.data, **{"progress": False, **task.options})
    except CasadiEngineError as error:
        return error
