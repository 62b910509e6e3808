"""Writing a file of results: all of it or nothing."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from casadi_engine.errors import OutputError
from casadi_engine.experiment.csv_writer import write_atomically


def write_file(path: Any, content: bytes) -> Path:
    """Write a file through a temporary one beside it, making its folder if need be; return its path.

    Raises OutputError with the path; the file that was there before is untouched then.
    """
    try:
        text = os.fsdecode(os.fspath(path))
    except TypeError:
        raise OutputError(
            "not the path of a file to write",
            seen=type(path).__name__,
            allowed="text or a pathlib.Path",
            cure='give a path such as "results/report.html"',
        ) from None
    if os.path.isdir(text):
        raise OutputError(
            f"{text}: cannot be written",
            seen="a folder of that name",
            allowed="a file, new or old",
            cure=f"give a file in it, such as {os.path.join(text, 'report.html')}",
        )
    if not os.path.basename(text):
        raise OutputError(
            "the path of a file to write has no name",
            seen=repr(text),
            allowed="a folder, if any, and a name",
            cure='give a path such as "results/report.html"',
        )
    folder = os.path.dirname(text)
    if folder:
        try:
            os.makedirs(folder, exist_ok=True)
        except (OSError, ValueError) as error:
            raise OutputError(
                f"{text}: cannot be written, because its folder cannot be made",
                seen=str(error),
                cure="choose another folder, or change the permissions of the one above it",
            ) from None
    write_atomically(text, content)
    return Path(text)
