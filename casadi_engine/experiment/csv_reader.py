"""Reading a CSV data file by the data-file contract, fast when nothing is wrong."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np

from casadi_engine.errors import DataFileError

from .channel import Channel, IntArray, Step, frozen
from .csv_careful import read_rows, shown
from .header import Column, Header, Request, parse_header
from .source import Loaded, Source, unpacked
from .units import FloatArray, as_recorded, to_si

_PLAIN = b"0123456789+-.eE, \t\n"
# NumPy reads a body of fewer bytes than this before pandas, which reads five times faster, is imported.
_SHORT = 15_000_000


def read_csv(source: Source, request: Request) -> Loaded:
    """Channels of a CSV file (plain or gzip).

    Every column becomes a channel on the file's time; an empty cell is a missing sample.
    Raises :class:`DataFileError` or :class:`UnitError` with file, column and row.
    """
    path = source.path
    data = _text_bytes(path, unpacked(source))
    first, _, body = data.partition(b"\n")
    header = parse_header(path, first.decode(), request)
    body = body.rstrip(b" \t\n")
    values, rows = _table(path, body, header)
    if rows.size < 2:
        raise DataFileError(
            f"{path}, row {rows.size + 1}: fewer than two samples",
            seen=f"{rows.size} below the header line",
            allowed="two or more rows",
            cure="export the record again",
        )
    time = _time(path, header.time, values[:, 0], rows)
    channels = tuple(
        _channel(path, column, values[:, index], time, rows, request)
        for index, column in enumerate(header.channels, start=1)
    )
    arguments: dict[str, Any] = {"file": path}
    if request.assumed:
        arguments["assumed"] = list(request.assumed)
    step = Step("read_experiment", arguments, rows.size, rows.size)
    return Loaded(channels, (step,), header.ignored, path, source.sha256, request.inputs)


def _text_bytes(path: str, data: bytes) -> bytes:
    """UTF-8 text with line feeds only and without a byte order mark."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise DataFileError(
            f"{path}, row 1: the file is not UTF-8 text",
            seen="a UTF-16 byte order mark",
            allowed="UTF-8",
            cure="save the file as CSV UTF-8",
        )
    if data.startswith(b"PK\x03\x04"):
        raise DataFileError(
            f"{path}, row 1: the file is not text",
            seen="a zip archive",
            allowed="UTF-8 text, gzip of it, or .npz by name",
            cure="export the record as CSV",
        )
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n") if b"\n" in data else data.replace(b"\r", b"\n")
    for byte, called in ((b"\x00", "a zero byte"), (b"\r", "a carriage return inside the line")):
        where = data.find(byte)
        if where >= 0:
            raise DataFileError(
                f"{_position(path, data, where)}: the row is not text of one line",
                seen=called,
                allowed="UTF-8 text, lines ended by LF or CR LF",
                cure="export the record again as CSV UTF-8",
            )
    if not data.isascii():
        try:
            data.decode()
        except UnicodeDecodeError as error:
            raise DataFileError(
                f"{_position(path, data, error.start)}: the file is not UTF-8 text",
                seen=f"byte 0x{data[error.start]:02x}",
                allowed="UTF-8",
                cure="save the file as CSV UTF-8",
            ) from None
    return data


def _position(path: str, data: bytes, where: int) -> str:
    """File, column and row of a byte; the column's name is the header cell as far as it can be read."""
    start = data.rfind(b"\n", 0, where) + 1
    number = data.count(b",", start, where)
    labels = data.partition(b"\n")[0].split(b",")
    row = data.count(b"\n", 0, where) + 1
    label = labels[number].decode("utf-8", "replace").strip(' "') if number < len(labels) else ""
    label = "".join(sign for sign in label if sign.isprintable())
    called = f"column {shown(label)!r}" if label and row > 1 else f"column number {number + 1}"
    return f"{path}, {called}, row {row}"


def _table(path: str, body: bytes, header: Header) -> tuple[FloatArray, IntArray]:
    """(N, 1 + channels) values with NaN for an empty cell, and the (N,) row numbers."""
    table = _fast_table(body, header.width) if body else np.zeros((0, header.width))
    if table is not None:
        wanted = table[:, [0, *(column.position for column in header.channels)]]
        nameless = table[:, [column.position for column in header.empty]]
        if np.isnan(nameless).all() and not np.isinf(wanted).any():
            return wanted, frozen(np.arange(2, len(table) + 2), np.int64)
    return read_rows(path, body.decode(), header)


def _fast_table(body: bytes, width: int) -> FloatArray | None:
    """Table of a body of plain numbers, or None when it may hold anything else."""
    if body.translate(None, _PLAIN):
        return None
    signs = np.frombuffer(body, dtype=np.uint8)
    ends = np.flatnonzero(signs == ord("\n"))
    commas = np.flatnonzero(signs == ord(","))
    # As many commas in every row: pandas would fill up a short row without a word.
    if commas.size != (width - 1) * (ends.size + 1):
        return None
    if not np.array_equal(np.searchsorted(commas, ends), (width - 1) * np.arange(1, ends.size + 1)):
        return None
    try:
        table = _by_numpy(body, width) if len(body) < _SHORT else _by_pandas(body, width)
    except (ValueError, OverflowError):
        return None
    return table if table.shape == (ends.size + 1, width) else None


def _by_numpy(body: bytes, width: int) -> FloatArray:
    cells = body.replace(b"\n", b",").split(b",")
    return np.array([cell or b"nan" for cell in cells], dtype=np.float64).reshape(-1, width)


def _by_pandas(body: bytes, width: int) -> FloatArray:
    import pandas as pd

    version = tuple(int(part) for part in pd.__version__.split(".")[:2])
    # Before pandas 3.1 its default parser was not correctly rounded in the last digit.
    precision: dict[str, Any] = {} if version >= (3, 1) else {"float_precision": "round_trip"}
    frame = pd.read_csv(
        io.BytesIO(body),
        header=None,
        names=list(range(width)),
        index_col=False,
        dtype=np.float64,
        na_values=[""],
        keep_default_na=False,
        skip_blank_lines=False,
        skipinitialspace=True,
        quoting=csv.QUOTE_NONE,
        engine="c",
        low_memory=False,
        **precision,
    )
    return frame.to_numpy(dtype=np.float64)


def _time(path: str, column: Column, values: FloatArray, rows: IntArray) -> FloatArray:
    time, _ = to_si(values, column.unit or "s")
    empty = np.isnan(time)
    if empty.any():
        row = int(rows[np.flatnonzero(empty)[0]])
        raise DataFileError(
            f"{column.at(path, row)}: an empty time cell",
            allowed="a number in every row",
            cure="complete the time, or delete the row",
        )
    later = time[1:] > time[:-1]
    if not later.all():
        index = int(np.flatnonzero(~later)[0]) + 1
        raise DataFileError(
            f"{column.at(path, int(rows[index]))}: the time does not increase",
            seen=f"{float(values[index])!r} after {float(values[index - 1])!r}",
            allowed="strictly increasing times",
            cure="sort the rows and delete repeated ones; write the time with more digits if it was rounded",
        )
    time.setflags(write=False)
    return time


def _channel(
    path: str, column: Column, values: FloatArray, time: FloatArray, rows: IntArray, request: Request
) -> Channel:
    data, unit = to_si(values, column.unit or "1")
    if column.name in request.inputs and np.isnan(data).any():
        row = int(rows[np.flatnonzero(np.isnan(data))[0]])
        raise DataFileError(
            f"{column.at(path, row)}: an empty cell in an input column",
            allowed="a number in every row of an input; only outputs may have missing samples",
            cure="fill the gap, or cut the record there",
        )
    if np.isinf(data).any():
        index = int(np.flatnonzero(np.isinf(data))[0])
        raise DataFileError(
            f"{column.at(path, int(rows[index]))}: the number is too large in {unit}",
            seen=f"{float(values[index])!r} {column.unit}",
            allowed="numbers below 1.8e308",
            cure="correct the cell",
        )
    data.setflags(write=False)
    return Channel(
        name=column.name,
        unit=unit,
        recorded=as_recorded(column.unit or "1"),
        time=time,
        values=data,
        hold=request.hold,
        origin="assumed" if column.name in request.assumed else "measured",
        rows=rows,
    )
