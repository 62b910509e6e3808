"""The header line of a data file: which column is which, and which are read."""

from __future__ import annotations

import csv
import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from casadi_engine.errors import DataFileError, ExperimentError, UnitError

from .channel import HOLDS, check_channel_name
from .units import si_unit, split_header

HEADER_RULE = "one header line of the form: time [s],name [unit],..."


@dataclass(frozen=True)
class Request:
    """What a caller asks of a file: see :func:`casadi_engine.experiment.read_experiment`."""

    assumed: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()
    required: tuple[str, ...] | None = None
    inputs: tuple[str, ...] = ()
    hold: str = "first"

    @property
    def needed(self) -> tuple[str, ...]:
        """Names that have to be in the file, in the order in which they were asked for."""
        names = dict.fromkeys((*(self.required or ()), *self.inputs, *self.assumed))
        return tuple(name for name in names if name not in self.optional)

    def wants(self, name: str) -> bool:
        """True when a column of this name is to be read."""
        return self.required is None or name in (*self.required, *self.optional, *self.inputs, *self.assumed)


def make_request(
    *,
    assumed: Iterable[str] = (),
    optional: Iterable[str] = (),
    required: Iterable[str] | None = None,
    inputs: Iterable[str] | None = None,
    hold: str = "first",
) -> Request:
    """Check the options of a reader; raises :class:`ExperimentError` for what is not a list of names."""
    if not isinstance(hold, str) or hold not in HOLDS:
        raise ExperimentError(
            "unknown hold", seen=repr(hold), allowed=", ".join(HOLDS), cure="choose one of the allowed words"
        )
    return Request(
        assumed=name_list(assumed, "assumed"),
        optional=name_list(optional, "optional"),
        required=None if required is None else name_list(required, "required"),
        inputs=() if inputs is None else name_list(inputs, "inputs"),
        hold=hold,
    )


def name_list(names: Any, option: str) -> tuple[str, ...]:
    """Tuple of names from one name or several; a repeated one is kept once."""
    if isinstance(names, str):
        names = (names,)
    try:
        result = tuple(dict.fromkeys(names))
    except TypeError:
        result = (None,)
    if not all(isinstance(name, str) for name in result):
        raise ExperimentError(
            f"{option} is not a list of channel names",
            seen=repr(names),
            allowed="a name or several names, without units",
            cure=f'write for example {option}=("p3", "p4")',
        )
    return result


@dataclass(frozen=True)
class Column:
    """A column of a file: position (0 is time), header text, name, unit in the file (None if ignored)."""

    position: int
    label: str
    name: str
    unit: str | None

    def at(self, path: str, row: int) -> str:
        """Opening of a message about a cell of this column."""
        called = f"column {self.label!r}" if self.label else f"column number {self.position + 1} (no name)"
        return f"{path}, {called}, row {row}"


@dataclass(frozen=True)
class Header:
    """A file's columns: ``time``, the ``channels`` to be read, and those that must be ``empty``."""

    width: int
    time: Column
    channels: tuple[Column, ...]
    empty: tuple[Column, ...] = ()
    ignored: tuple[str, ...] = field(default=())

    def column(self, position: int) -> Column:
        """The column at a position; a stand-in without a name when it is an ignored one."""
        for column in (self.time, *self.channels, *self.empty):
            if column.position == position:
                return column
        return Column(position, "", "", None)


def split_cells(path: str, line: str) -> list[str]:
    """Cells of the header line."""
    try:
        rows = list(csv.reader([line], strict=True, skipinitialspace=True))
    except csv.Error as error:
        raise DataFileError(
            f"{path}, row 1: the header line cannot be split into columns",
            seen=str(error),
            allowed=HEADER_RULE,
            cure="take the quotes out of the header line",
        ) from None
    return [cell.strip() for cell in rows[0]] if rows else []


def parse_header(path: str, line: str, request: Request) -> Header:
    """Read the header line of a data file; every breach of the contract is a named error."""
    cells = split_cells(path, line)
    time = _time_column(path, cells)
    _refuse_repeated(path, cells)
    channels: list[Column] = []
    empty: list[Column] = []
    ignored: list[str] = []
    for position, label in enumerate(cells[1:], start=1):
        name, unit = split_header(label)
        if not label:
            ignored.append(f"column {position + 1} (no name)")
            if request.required is None:
                empty.append(Column(position, "", "", None))
        elif not request.wants(name):
            ignored.append(label)
        else:
            channels.append(_channel_column(path, Column(position, label, name, unit)))
    header = Header(len(cells), time, tuple(channels), tuple(empty), tuple(ignored))
    _refuse_missing(path, header, request)
    return header


def _time_column(path: str, cells: Sequence[str]) -> Column:
    label = cells[0] if cells else ""
    name, unit = split_header(label)
    column = Column(0, label, name, unit)
    if name != "time":
        others = [cell for cell in cells[1:] if split_header(cell)[0] == "time"]
        if others:
            cure = "move the time column to the front"
        elif len(cells) == 1 and (";" in label or "\t" in label):
            cure = "separate the columns by commas, and write decimal points"
        else:
            cure = "write a header line whose first column is time [s]"
        seen = repr(label[:60]) if label else "no name"
        raise DataFileError(
            f"{path}, column number 1, row 1: the first column is not the time",
            seen=seen,
            allowed=HEADER_RULE,
            cure=cure,
        )
    if unit is None:
        raise DataFileError(
            f"{column.at(path, 1)}: no unit in the header",
            seen=repr(label),
            allowed=HEADER_RULE,
            cure="write time [s]",
        )
    if si_unit(unit, where=column.at(path, 1)) != "s":
        raise UnitError(
            f"{column.at(path, 1)}: not a unit of time",
            seen=unit,
            allowed="s, ms, min, h or another unit of time",
            cure="write time [s]",
        )
    return column


def _refuse_repeated(path: str, cells: Sequence[str]) -> None:
    seen: dict[str, int] = {}
    for position, label in enumerate(cells):
        name = split_header(label)[0]
        if not name:
            continue  # columns without a name are no repetition of each other
        if name in seen:
            raise DataFileError(
                f"{path}, column {label!r}, row 1: a repeated column",
                seen=f"{name!r} in columns number {seen[name] + 1} and {position + 1}",
                allowed="each name once",
                cure="rename or delete one of them",
            )
        seen[name] = position


def _channel_column(path: str, column: Column) -> Column:
    where = column.at(path, 1)
    try:
        check_channel_name(column.name, where=where)
    except ExperimentError as error:
        raise DataFileError(
            error.problem, seen=error.seen, allowed=error.allowed, cure="rename the column"
        ) from None
    if column.unit is None:
        raise DataFileError(
            f"{where}: no unit in the header",
            seen=repr(column.label),
            allowed=HEADER_RULE,
            cure=f"write {column.name} [unit], with [1] for a dimensionless quantity, "
            "or name the columns to be read by required=",
        )
    si_unit(column.unit, where=where)
    return column


def _refuse_missing(path: str, header: Header, request: Request) -> None:
    names = [column.name for column in header.channels]
    present = names + [split_header(label)[0] for label in header.ignored]
    for name in request.needed:
        if name not in names:
            near = difflib.get_close_matches(name, present, n=1)
            raise DataFileError(
                f"{path}, row 1: column {name!r} is missing",
                seen=", ".join(["time", *present]),
                allowed=f"a column {name} [unit]",
                cure=f"rename column {near[0]!r}" if near else "add the column, or do not ask for it",
            )
    if not names:
        raise DataFileError(
            f"{path}, row 1: no column to read beside the time",
            seen=", ".join(["time", *present]),
            allowed=HEADER_RULE,
            cure="add a column, or ask for one that is there by required=",
        )
