"""Which line of the user's file an exception came from, and how that file is named in messages."""

from __future__ import annotations

import os
import traceback
from pathlib import Path


def line_in(path: Path, error: BaseException) -> int | None:
    """Number of the innermost line of `path` in the traceback of `error`, or None if it is not in it.

    For a file that Python cannot read as code it is the line where it stopped.
    """
    if isinstance(error, SyntaxError) and error.filename is not None and _same(error.filename, path):
        return error.lineno
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if _same(frame.filename, path)]
    return lines[-1] if lines else None


def _same(filename: str, path: Path) -> bool:
    return os.path.abspath(filename) == os.path.abspath(path)


def shown(path: Path) -> str:
    """A path for messages: from the working directory if it lies below it.

    >>> shown(Path.cwd() / "problems" / "two_mass.py")
    'problems/two_mass.py'
    """
    try:
        return str(path.relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)
