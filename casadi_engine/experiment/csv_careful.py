"""The slow reading of a data file: row by row, so that the faulty cell can be named.

It decides what a cell means. The fast reading in ``csv_reader`` is used first and gives up on everything
that it is not sure of, so this module sees faulty files and unusual ones (quoted cells, text in columns
that are ignored).
"""

from __future__ import annotations

import csv
import io
import math
import re
from typing import NoReturn

import numpy as np

from casadi_engine.errors import DataFileError

from .channel import IntArray
from .header import Column, Header
from .units import FloatArray

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_MISSING_WORDS = {"nan", "na", "n/a", "#n/a", "null", "none", "nil", "-", "?", "missing"}
_INFINITE_WORDS = {"inf", "infinity", "-inf", "+inf", "-infinity", "+infinity"}
NUMBER_RULE = "a number with a decimal point, such as -1.5e3; in an output column also an empty cell"


def read_rows(path: str, text: str, header: Header) -> tuple[FloatArray, IntArray]:
    """Read the rows below the header.

    text : lines below the header, separated by line feeds.
    Returns (N, 1 + channels) values, NaN for an empty cell, time first, and the (N,) row numbers.
    Raises :class:`DataFileError` for the first fault in reading order.
    """
    wanted = (header.time, *header.channels)
    values: list[list[float]] = []
    rows: list[int] = []
    reader = csv.reader(io.StringIO(text, newline="\n"), strict=True, skipinitialspace=True)
    row = 2
    try:
        for cells in reader:
            if len(cells) != header.width:
                _wrong_width(path, header, row, cells)
            values.append([_number(path, column, row, cells[column.position]) for column in wanted])
            for column in header.empty:
                if cells[column.position].strip(" \t"):
                    _nameless(path, column, row, cells[column.position])
            rows.append(row)
            row = reader.line_num + 2
    except csv.Error as error:
        raise DataFileError(
            f"{path}, row {row}: the row cannot be split into cells",
            seen=str(error),
            allowed="cells separated by commas",
            cure="take the quotes out of that row",
        ) from None
    return np.array(values, dtype=float).reshape(-1, len(wanted)), np.array(rows, dtype=np.int64)


def _number(path: str, column: Column, row: int, cell: str) -> float:
    text = cell.strip(" \t")
    if not text:
        return math.nan
    if _NUMBER.fullmatch(text):
        value = float(text)
        if math.isfinite(value):
            return value
        raise DataFileError(
            f"{column.at(path, row)}: the number is too large",
            seen=shown(text),
            allowed="numbers below 1.8e308",
            cure="correct the cell",
        )
    return _not_a_number(path, column, row, text)


def _not_a_number(path: str, column: Column, row: int, text: str) -> NoReturn:
    word = text.lower()
    if word in _MISSING_WORDS:
        cure = "leave the cell of a missing output sample empty"
    elif word in _INFINITE_WORDS:
        cure = "leave the cell empty if that output sample is of no use"
    elif "," in text or "'" in text or " " in text or "_" in text:
        cure = "write numbers without thousands separators and with a decimal point"
    else:
        cure = "correct the cell"
    raise DataFileError(
        f"{column.at(path, row)}: not a number", seen=repr(shown(text)), allowed=NUMBER_RULE, cure=cure
    )


def _nameless(path: str, column: Column, row: int, cell: str) -> NoReturn:
    raise DataFileError(
        f"{column.at(path, row)}: the column holds data but its header is empty",
        seen=repr(shown(cell)),
        allowed="a header name [unit] above every column that holds data",
        cure="write its header, or name the columns to be read by required=",
    )


def _wrong_width(path: str, header: Header, row: int, cells: list[str]) -> NoReturn:
    if not cells or cells == [""]:
        raise DataFileError(
            f"{path}, column {header.time.label!r}, row {row}: an empty line inside the data",
            allowed="one row of cells on every line",
            cure="delete the empty line",
        )
    found, width = len(cells), header.width
    if found > width:
        problem = f"{path}, column number {width + 1}, row {row}: the row is too long"
        cure = "write decimal points and no thousands separators"
        if not any(cell.strip() for cell in cells[width:]):
            cure = "take the extra commas away: those at the end of the row, or thousands separators"
    else:
        label = header.column(found).label or f"number {found + 1}"
        problem = f"{path}, column {label!r}, row {row}: the row is too short"
        cure = "complete the row; the file may have been cut off while it was written"
    raise DataFileError(
        problem, seen=f"{found} cells", allowed=f"{width} cells, as in the header line", cure=cure
    )


def shown(text: str, longest: int = 60) -> str:
    """Text short enough for a message."""
    return text if len(text) <= longest else text[:longest] + "..."
