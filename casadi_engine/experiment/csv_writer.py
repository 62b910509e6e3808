"""Writing an experiment as a data file that the reader accepts."""

from __future__ import annotations

import contextlib
import csv
import gzip
import io
import os
import secrets
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.errors import ExperimentError, OutputError

from .source import path_text

if TYPE_CHECKING:
    from .experiment import Experiment


def to_csv(experiment: Experiment, path: Any) -> None:
    """Write a data file by the contract; see ``Experiment.to_csv``."""
    text = path_text(path)
    content = csv_text(experiment).encode()
    if text.lower().endswith(".gz"):
        packed = io.BytesIO()
        # No name and no time in the gzip header: the same experiment gives the same bytes.
        with gzip.GzipFile(filename="", fileobj=packed, mode="wb", compresslevel=6, mtime=0) as stream:
            stream.write(content)
        content = packed.getvalue()
    write_atomically(text, content)


def csv_text(experiment: Experiment) -> str:
    """The text of the data file."""
    longest = max(experiment.channels, key=len)
    time = longest.time
    columns: dict[str, Any] = {"time [s]": time}
    for channel in experiment.channels:
        label = f"{channel.name} [{channel.unit}]"
        if channel.time is time or np.array_equal(channel.time, time):
            columns[label] = channel.values
            continue
        place = np.minimum(np.searchsorted(time, channel.time), time.size - 1)
        if not np.array_equal(time[place], channel.time):
            raise ExperimentError(
                f"{experiment.place}: the channels do not share a time, so one file cannot hold them",
                seen=f"times of {channel.name!r} that are not among those of {longest.name!r}",
                allowed="channels on one time, or on a part of it after resample",
                cure="write them apart: only(...) and to_csv for each",
            )
        values = np.full(time.size, np.nan)
        values[place] = channel.values
        columns[label] = values
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    cells = [["" if value != value else value for value in column.tolist()] for column in columns.values()]
    writer.writerows(zip(*cells, strict=True))
    return stream.getvalue()


def write_atomically(path: str, content: bytes) -> None:
    """Write a file so that a reader sees the old one or the new one, never a part.

    Raises :class:`OutputError` with the path; nothing is left behind then.
    """
    folder, name = os.path.split(path)
    temporary = os.path.join(folder, f".{name[:100]}.{secrets.token_hex(6)}.tmp")
    try:
        try:
            with open(temporary, "xb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError, ValueError):
                os.unlink(temporary)
            raise
    except (OSError, ValueError) as error:
        raise OutputError(
            f"{path}: cannot be written",
            seen=str(error),
            cure="check the directory, its permissions and the disk",
        ) from None
