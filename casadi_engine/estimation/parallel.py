"""Many independent calls of one function, in this process or in several by joblib."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator, Sequence
from pickle import PicklingError
from typing import Any

from casadi_engine.errors import EstimationError, MissingDependencyError
from casadi_engine.estimation.options import whole
from casadi_engine.problem.load import MODULE_PREFIX


def checked_jobs(jobs: Any) -> int | None:
    """The number of processes >= 1, or None for what ``joblib.parallel_config`` says."""
    return None if jobs is None else whole("jobs", jobs, 1)


def spread(
    work: Callable[[Any], Any], items: Sequence[Any], *, jobs: int | None = 1
) -> Iterator[tuple[int, Any]]:
    """(position, work(item)) of every item, in the order in which they are done.

    jobs : 1 works in this process, without joblib; more are processes of joblib's; None asks joblib how many and where,
        so that ``with joblib.parallel_config(backend="dask"):`` around the call runs it on a cluster
    Raises MissingDependencyError without joblib, EstimationError if ``work`` or an item cannot be sent to a process,
    and whatever ``work`` raises.
    """
    jobs = checked_jobs(jobs)
    if jobs == 1 or not items:
        yield from ((k, work(item)) for k, item in enumerate(items))
        return
    joblib = _joblib()
    _send_problem_files()
    done = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered", pre_dispatch="2*n_jobs")(
        joblib.delayed(_numbered)(work, k, item) for k, item in enumerate(items)
    )
    try:
        yield from done
    except (PicklingError, TypeError, AttributeError, RuntimeError) as error:
        if not _is_about_sending(error):
            raise
        raise EstimationError(
            "the work cannot be sent to another process",
            seen=_reason(error),
            allowed="functions and classes of modules that can be imported, and plain data",
            cure="move the function or class into a module, or leave jobs out",
        ) from error
    finally:
        done.close()


def in_order(work: Callable[[Any], Any], items: Sequence[Any], *, jobs: int | None = 1) -> list[Any]:
    """work(item) of every item, in the items' order; see `spread`."""
    found = dict(spread(work, items, jobs=jobs))
    return [found[k] for k in range(len(items))]


def _numbered(work: Callable[[Any], Any], position: int, item: Any) -> tuple[int, Any]:
    return position, work(item)


def _is_about_sending(error: BaseException) -> bool:
    return isinstance(error, PicklingError) or "pickle" in str(error) or "un-serialize" in str(error)


def _reason(error: BaseException) -> str:
    """What could not be sent: the last line of what joblib was told, or its own words."""
    told = error.__cause__ if isinstance(error, PicklingError) and error.__cause__ is not None else error
    lines = str(told).strip().strip('"').splitlines()
    return next((line.strip() for line in reversed(lines) if line.strip()), str(error))


def _send_problem_files() -> None:
    """Send what problem files define (an effect) as code, for their modules cannot be imported elsewhere."""
    files = [module for name, module in sys.modules.items() if name.startswith(MODULE_PREFIX)]
    for name in ("joblib.externals.cloudpickle", "cloudpickle"):  # that of processes, that of clusters
        try:
            sender = importlib.import_module(name) if files else None
        except ImportError:
            continue
        for module in files:
            sender.register_pickle_by_value(module)  # type: ignore[union-attr]


def _joblib() -> Any:
    try:
        import joblib
    except ImportError:
        raise MissingDependencyError(
            "several processes need joblib, which is not installed",
            seen="no module joblib",
            allowed='the extra "cluster" (joblib, dask), or one process',
            cure='pip install "casadi-engine[cluster]", or leave jobs out',
        ) from None
    return joblib
