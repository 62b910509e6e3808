"""Progress of long work: one line on a terminal, nothing anywhere else."""

from __future__ import annotations

import math
import sys
from types import TracebackType
from typing import Any


class Progress:
    """A context manager that is called with (iteration, cost, fit_percent) during the work.

    It draws on standard error, and only if that is a terminal: logs and pipes stay clean. The last line goes
    when the work is done.
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> Progress:
        if sys.stderr.isatty():
            from rich import progress
            from rich.console import Console

            self._bar = progress.Progress(
                progress.SpinnerColumn(),
                progress.TextColumn("{task.description}"),
                progress.TimeElapsedColumn(),
                console=Console(stderr=True),
                transient=True,
            )
            self._bar.start()
            self._task = self._bar.add_task(self.title, total=None)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def __call__(self, iteration: int, cost: float, fit_percent: float | None = None) -> None:
        """Show where the work is."""
        if self._bar is not None:
            self._bar.update(self._task, description=line(self.title, iteration, cost, fit_percent))


def line(title: str, iteration: int, cost: float, fit_percent: float | None) -> str:
    """The text of the progress line.

    >>> line("fit", 12, 14402.31, 98.765)
    'fit   iteration 12   cost 14402.3   fit 98.77 %'
    """
    text = f"{title}   iteration {iteration}   cost {cost:.6g}"
    if fit_percent is not None and math.isfinite(fit_percent):
        text += f"   fit {fit_percent:.2f} %"
    return text
