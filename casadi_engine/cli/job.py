"""A job: the problem as the options have it, the folder of its results, and its way to an exit code."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from casadi_engine.cli.folder import check_folder, is_ours, keep_others, keep_source, refuse_others
from casadi_engine.cli.options import Options
from casadi_engine.errors import CasadiEngineError

if TYPE_CHECKING:
    from casadi_engine.problem import Problem

ANSWERED, NEGATIVE, NO_ANSWER, OUR_BUG, INTERRUPTED = 0, 1, 3, 4, 130


@dataclass(frozen=True)
class Job:
    """What a command works on; the problem holds the data and parameters that the options ask for."""

    options: Options
    problem: Problem
    folder: Path

    @property
    def seconds(self) -> float:
        """Wall time [s] since the command began; the import of the package is not in it."""
        return time.perf_counter() - self.options.started


def prepare(options: Options) -> Job:
    """Load the problem, apply the options, and see that the folder of the results can be written.

    All that can be wrong with the command is found out here, before the long work.
    """
    from casadi_engine.cli.settings import apply_settings
    from casadi_engine.problem import load_problem

    problem = load_problem(options.problem)
    problem = problem.with_data(options.data, options.validate)
    parameters = apply_settings(problem.parameters, set=options.set, free=options.free, fix=options.fix)
    folder = options.out or Path("results") / f"{problem.name}-{options.command}"
    check_folder(folder)
    if not is_ours(folder):
        refuse_others(folder, ("result.json", "report.html"))
    else:
        if (source := options.extra.get("from_")) is not None:
            keep_source(folder, Path(source))
        keep_others(folder, options.command)
    return Job(options, problem.with_parameters(parameters), folder)


def run(options: Options, work: Callable[[Job], int]) -> None:
    """Prepare the job, do `work`, which returns the exit code, and end the process with it."""
    raise typer.Exit(guarded(options.command, lambda: work(prepare(options)), debug=options.debug))


def guarded(command: str, work: Callable[[], int], *, debug: bool) -> int:
    """Exit code of `work`; every error becomes one message on standard error."""
    found: BaseException
    _take_interrupts()
    try:
        return work()
    except CasadiEngineError as error:
        found, code, message = error, error.exit_code, str(error)
    except KeyboardInterrupt as error:
        found, code, message = error, INTERRUPTED, "interrupted before there was anything to write"
    except Exception as error:  # noqa: BLE001  the last line of defence: whatever arrives here is our bug
        found, code = error, OUR_BUG
        words = " ".join(str(error).split())
        message = f"a bug of this program: {type(error).__name__}: {words}"
        message += "" if debug else "; do: repeat it with --debug and report the traceback"
    if debug:
        traceback.print_exception(found)
    complain(command, message)
    return code


def _take_interrupts() -> None:
    """Take Ctrl-C over from the start of the program, whose handler says that it waits for this."""
    if getattr(signal.getsignal(signal.SIGINT), "until_a_command_begins", False):
        signal.signal(signal.SIGINT, signal.default_int_handler)


def complain(command: str, message: str) -> None:
    """Write one message on standard error."""
    print(f"casadi-engine {command}: {message}", file=sys.stderr)


def say(text: Any) -> None:
    """Print for the user; a reader that went away (``| head``) or an old terminal is no error."""
    try:
        print(text, flush=True)
    except UnicodeEncodeError:
        encoding = sys.stdout.encoding or "ascii"
        print(str(text).encode(encoding, "replace").decode(encoding), flush=True)
    except BrokenPipeError:
        # What is left in the buffer would raise once more when the process ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Let a second Ctrl-C not take away what the first one is having written."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before if before is not None else signal.SIG_DFL)
