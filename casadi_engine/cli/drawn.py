"""``casadi-engine fit --posterior``: the distribution of the fit's parameters, and its files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from casadi_engine.cli.folder import is_ours, refuse_others, remove_files
from casadi_engine.cli.job import ANSWERED, INTERRUPTED, NO_ANSWER, Job, complain, say, uninterrupted
from casadi_engine.cli.work import say_answer
from casadi_engine.errors import CasadiEngineError, UntrustedPosteriorError

if TYPE_CHECKING:
    from casadi_engine.estimation.fit import Fit

FILES = ("posterior.json", "posterior.html")


def check_files(job: Job) -> None:
    """OutputError if a file of somebody else stands where one of the posterior's is to be."""
    if job.options.extra["posterior"] and not _own(job.folder):
        refuse_others(job.folder, FILES)


def remove_earlier(job: Job) -> None:
    """Take away the posterior of an earlier fit, which would stand beside a fit that it does not belong to."""
    if _own(job.folder):
        remove_files(job.folder, FILES)


def draw(job: Job, fit: Fit) -> int:
    """Draw, write and print the posterior of a fit; the exit code. The fit's own files are there already."""
    from casadi_engine.posterior import posterior
    from casadi_engine.report import report

    try:
        found = posterior(fit, seed=job.options.seed, progress=_line if sys.stderr.isatty() else None)
    except KeyboardInterrupt:
        complain("fit", f"interrupted before the posterior; the fit itself is in {job.folder}")
        return INTERRUPTED
    except CasadiEngineError as error:
        stopped = isinstance(error, UntrustedPosteriorError) and str(error.seen).startswith("Ctrl-C")
        complain("fit", f"no posterior: {error}; the fit itself is in {job.folder}")
        return INTERRUPTED if stopped else NO_ANSWER
    finally:
        if sys.stderr.isatty():
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
    with uninterrupted():
        found.save(job.folder / FILES[0])
        report(found, job.folder / FILES[1])
    say("")
    say_answer(job, found)
    return ANSWERED


def _own(folder: Path) -> bool:
    return is_ours(folder, FILES[0])


def _line(what: str, evaluations: int) -> None:
    print(f"\r\x1b[Kposterior: {what}, {evaluations} evaluations", end="", file=sys.stderr, flush=True)
