"""Run one solver on one problem in a process of its own; one JSON line for every start.

    python worker.py SOLVER CASE [START ...] [--limit SECONDS] [--warm]

CPU time (all threads, of which there is one) of set-up and solution apart; imports, reading and the making of the
records are not counted. A start that passes the limit is stopped and has no values. CASE is a name of `cases.CASES`,
or CYLINDERSxSAMPLES for the scaling study.
"""

from __future__ import annotations

import _thread
import argparse
import importlib
import json
import os
import resource
import signal
import threading
import time
from types import FrameType
from typing import Any

import numpy as np
from cases import CASES, Case, scaling_case
from solvers import SOLVERS
from yardstick import chi_squared

HARD = 1.5  # where a library does not come back to Python, the process ends at this multiple of the limit
OUT_OF_TIME = 98  # exit status then


class OutOfTimeError(Exception):
    """The limit has passed."""


class Watch(threading.Thread):
    """Raises OutOfTimeError in the main thread when the CPU time from now on passes a limit.

    Not by the system's own timers: where one is set, some systems count CPU time in ticks of 10 ms only.
    """

    def __init__(self, limit: float) -> None:
        super().__init__(daemon=True)
        self._begun, self._limit, self._over = time.process_time(), limit, threading.Event()

    def run(self) -> None:
        told = False
        while not self._over.wait(0.25):
            spent = time.process_time() - self._begun
            if spent > HARD * self._limit:
                os._exit(OUT_OF_TIME)
            if spent > self._limit and not told:
                told = True
                _thread.interrupt_main(signal.SIGINT)

    def stop(self) -> None:
        self._over.set()
        self.join()


def _stop(_signal: int, _frame: FrameType | None) -> None:
    raise OutOfTimeError


def case_of(name: str) -> Case:
    """A problem by its name."""
    if name in CASES:
        return CASES[name]()
    cylinders, samples = name.split("x")
    return scaling_case(int(cylinders), int(samples))


def run(solver: Any, case: Case, number: int, limit: float) -> dict[str, Any]:
    """One start: times, what was found, and the chi-squared of the yardstick."""
    before = signal.signal(signal.SIGINT, _stop)
    watch = Watch(limit)
    watch.start()
    begun = time.process_time()
    marks = [begun]
    row: dict[str, Any] = {"start": number}
    try:
        found = solver(case, case.start(number), lambda: marks.append(time.process_time()))
    except OutOfTimeError:
        found = {"values": None, "iterations": None, "words": f"stopped at {limit:g} s"}
    finally:
        ended = time.process_time()
        watch.stop()
        signal.signal(signal.SIGINT, before)
    row |= {"setup": marks[:2][-1] - begun, "solve": ended - marks[:2][-1], "iterations": found["iterations"]}
    row["words"] = str(found.get("words", ""))
    row["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    values = found["values"]
    if values is not None and np.all(np.isfinite(values)) and np.all(np.asarray(values) > 0):
        row["values"] = np.asarray(values).tolist()
        row["chi2"] = chi_squared(case, np.asarray(values)) / case.samples
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("solver", choices=SOLVERS)
    parser.add_argument("case")
    parser.add_argument("starts", nargs="*", type=int, default=[0])
    parser.add_argument("--limit", type=float, default=120.0)
    parser.add_argument("--warm", action="store_true", help="run a start that is not counted first")
    options = parser.parse_args()
    chosen = SOLVERS[options.solver]
    case = case_of(options.case)
    solver = getattr(importlib.import_module(chosen.module), chosen.function)
    if options.warm:
        run(solver, case, 1000, options.limit)
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    for number in options.starts:
        row = run(solver, case, number, options.limit) | {"base_mb": base}
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
