"""read_experiment: one record from a data file."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from casadi_engine.errors import DataFileError

from .csv_reader import read_csv
from .experiment import Experiment
from .header import make_request
from .npz_reader import read_npz
from .source import path_text, read_source, record_key

if TYPE_CHECKING:
    import os

_OTHER_KINDS = (
    ".mat",
    ".mf4",
    ".mdf",
    ".parquet",
    ".feather",
    ".h5",
    ".hdf5",
    ".xls",
    ".xlsx",
    ".npy",
)


def read_experiment(
    path: str | os.PathLike[str],
    *,
    name: str | None = None,
    assumed: Iterable[str] = (),
    optional: Iterable[str] = (),
    required: Iterable[str] | None = None,
    inputs: Iterable[str] | None = None,
    hold: str = "first",
) -> Experiment:
    """Read one record from a data file: CSV (plain or gzip) or .npz.

    A CSV file is UTF-8 text with one header line ``time [s],name [unit],...``; units such as rpm, bar, N mm,
    L/min, mg/L or degC are converted to SI. An empty cell is a missing sample.

    path : the file; its name without endings is the record key unless ``name`` is given.
    assumed : columns that were not measured but made up (origin "assumed").
    optional : columns that may be absent.  required : columns to read; all others, whatever they hold, are
    ignored and listed. Left out, every column is read.
    inputs : columns in which an empty cell is an error; left out, ``Experiment.require`` finds it later.
    hold : how the channels go on between samples, "first" or "zero".

    Raises :class:`DataFileError` or :class:`UnitError` naming file, column and row: unknown or missing
    unit, missing or repeated column, text or an infinite number in a cell, an empty time or input cell,
    time that does not increase, fewer than two samples, rows of the wrong length, text that is not UTF-8,
    damaged or missing files.
    """
    request = make_request(assumed=assumed, optional=optional, required=required, inputs=inputs, hold=hold)
    text = path_text(path)
    lower = text.lower()
    source = read_source(text)
    if lower.endswith(_OTHER_KINDS):
        raise DataFileError(
            f"{text}: a kind of data file that is not read here",
            seen=lower[lower.rfind(".") :],
            allowed=".csv, .csv.gz, .npz",
            cure="convert it, or load it yourself and use Experiment.from_dataframe or from_arrays",
        )
    loaded = read_npz(source, request) if lower.endswith(".npz") else read_csv(source, request)
    return Experiment(record_key(text) if name is None else name, **loaded.fields())
