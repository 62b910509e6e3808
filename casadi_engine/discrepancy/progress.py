"""What a repair is doing, one line at a time, and how long the refits of a round may still take."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from typing import Any

from casadi_engine.errors import EstimationError

_REFIT = re.compile(r"refit (\d+) of (\d+): ")
# Refits that have to be over before the mean of their times says anything.
_FEWEST = 3
_WIDTH = 100


class Progress:
    """Tells each step as it begins; a refit with the time that those to come may take, by the mean of those done.

    show : takes the text; clock : seconds
    """

    def __init__(self, show: Callable[[str], Any], *, clock: Callable[[], float] = time.perf_counter) -> None:
        self.show, self.clock = show, clock
        self.stopping = False
        self._begun = 0.0

    def __call__(self, text: str) -> None:
        """Say what begins."""
        now, found = self.clock(), _REFIT.match(text)
        if found is not None:
            number, of = int(found[1]), int(found[2])
            if number == 1:
                self._begun = now
            done = number - 1
            if done >= _FEWEST:
                text += f" ({duration((now - self._begun) / done * (of - done))} more for these refits)"
        self.show(f"stopping, Ctrl-C again ends at once: {text}" if self.stopping else text)


def duration(seconds: float) -> str:
    """A time that is known roughly.

    >>> duration(0.4), duration(37.2), duration(96.0), duration(1500.0), duration(9000.0)
    ('about 1 s', 'about 40 s', 'about 100 s', 'about 25 min', 'about 2.5 h')
    """
    if seconds < 100:
        return f"about {max(float(f'{seconds:.1g}'), 1.0):.0f} s"
    return f"about {seconds / 60:.0f} min" if seconds < 7200 else f"about {seconds / 3600:.1f} h"


class Line:
    """One line of a terminal that is written anew by each step.

    write : takes the text
    """

    def __init__(self, write: Callable[[str], Any] | None = None) -> None:
        self.write = _to_terminal if write is None else write
        self.used = False

    def __call__(self, text: str) -> None:
        """Show a text in place of the last one."""
        self.used = True
        self.write("\r" + f"repair: {text}"[:_WIDTH].ljust(_WIDTH))

    def clear(self) -> None:
        """Take the line away."""
        if self.used:
            self.write("\r" + " " * _WIDTH + "\r")


def shown(progress: Any) -> tuple[Progress, Callable[[], None]]:
    """The progress that ``repair(progress=...)`` asks for, and what to do at the end; EstimationError for none."""
    if progress is None:
        line = Line()
        return (Progress(line), line.clear) if sys.stderr.isatty() else (Progress(_silent), _nothing)
    if progress is False:
        return Progress(_silent), _nothing
    if not callable(progress):
        raise EstimationError(
            "invalid `progress`",
            seen=repr(progress),
            allowed="None, False, or a function of a text",
            cure="leave it out",
        )
    return Progress(progress), _nothing


def _to_terminal(text: str) -> None:
    sys.stderr.write(text)
    sys.stderr.flush()


def _silent(_: str) -> None:
    return


def _nothing() -> None:
    return
