"""A progress bar on a terminal: iteration, cost and fit percentage of the search."""

from __future__ import annotations

import sys
from typing import Any


class _Bar:
    """Shows a search by rich; called with (iteration, cost, fit percent)."""

    def __init__(self, starts: int, most: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[words]}"),
            TimeElapsedColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        self._starts, self._most, self._run, self._best = starts, most, 0, float("inf")
        self._task = self._progress.add_task("fit", total=starts * most, words="")
        self._progress.start()

    def __call__(self, iteration: int, cost: float, fit_percent: float) -> None:
        if iteration == 0:
            self._run += 1
        self._best = min(self._best, cost)
        run = f"start {self._run}/{self._starts}, " if self._starts > 1 else ""
        words = (
            f"{run}iteration {iteration}, cost {cost:.6g} (best {self._best:.6g}), fit {fit_percent:.2f} %"
        )
        self._progress.update(self._task, completed=(self._run - 1) * self._most + iteration, words=words)

    def close(self) -> None:
        """Take the bar off the screen."""
        self._progress.stop()


def terminal_bar(starts: int, most: int) -> Any:
    """A bar if standard error is a terminal and rich is installed, else None."""
    if not sys.stderr.isatty():
        return None
    try:
        return _Bar(starts, most)
    except ImportError:
        return None
