"""The bytes of a data file and what is known of it: path, hash, record key."""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from casadi_engine.errors import DataFileError

from .channel import Channel, Step

# Far above any record, far below what fills a computer's memory with one hostile file.
LARGEST = 4 * 1024**3


@dataclass(frozen=True)
class Source:
    """A file that was read: its path as given, its bytes and the SHA-256 of them."""

    path: str
    content: bytes
    sha256: str


@dataclass(frozen=True)
class Loaded:
    """What a reader hands to :class:`Experiment`: the fields of one, without its name."""

    channels: tuple[Channel, ...]
    history: tuple[Step, ...]
    ignored: tuple[str, ...] = ()
    source: str | None = None
    sha256: str | None = None
    inputs: tuple[str, ...] = ()

    def fields(self) -> Mapping[str, Any]:
        """The fields by name."""
        return {key: getattr(self, key) for key in self.__dataclass_fields__}


def path_text(path: Any) -> str:
    """Path as text; raises :class:`DataFileError` when it is not a path at all."""
    try:
        text = os.fspath(path)
    except TypeError:
        raise DataFileError(
            "not the path of a data file",
            seen=f"{type(path).__name__}",
            allowed="text or a pathlib.Path",
            cure="give the path of a .csv, .csv.gz or .npz file",
        ) from None
    return os.fsdecode(text)


def record_key(path: str) -> str:
    """Record key of a file: its name without directory and endings.

    >>> record_key("data/normal_1200rpm.csv.gz")
    'normal_1200rpm'
    """
    name = Path(path).name
    for ending in (".gz", ".csv", ".npz", ".txt"):
        if name.lower().endswith(ending) and len(name) > len(ending):
            name = name[: -len(ending)]
    return name


def read_source(path: Any) -> Source:
    """Read a file's bytes; every failure of the file system is a :class:`DataFileError` with the path."""
    text = path_text(path)
    try:
        with open(text, "rb") as stream:
            content = stream.read()
    except FileNotFoundError:
        raise DataFileError(f"{text}: no such file", cure=_missing_cure(text)) from None
    except IsADirectoryError:
        raise DataFileError(
            f"{text}: a directory, not a file", cure="give the path of one data file in it"
        ) from None
    except PermissionError:
        cure = "give the path of one data file in it" if os.path.isdir(text) else "change its permissions"
        raise DataFileError(f"{text}: no permission to read it", cure=cure) from None
    except (OSError, ValueError) as error:
        raise DataFileError(
            f"{text}: cannot be read", seen=str(error), cure="check the path and the disk"
        ) from None
    if not content:
        raise DataFileError(
            f"{text}, row 1: the file is empty",
            allowed="a header line and two or more rows",
            cure="export the record again",
        )
    return Source(text, content, hashlib.sha256(content).hexdigest())


def _missing_cure(text: str) -> str:
    folder = Path(text).parent
    if not folder.is_dir():
        return f"check the path: the directory {str(folder)!r} does not exist either"
    return "check the path"


def unpacked(source: Source) -> bytes:
    """Bytes of the text in a file: those of the file, or what is packed in it when it is gzip.

    Raises :class:`DataFileError` for a truncated or damaged gzip file, and for a name ending in .gz
    whose content is not gzip.
    """
    packed = source.content.startswith(b"\x1f\x8b")
    if not packed:
        if source.path.lower().endswith(".gz"):
            raise DataFileError(
                f"{source.path}: the name ends in .gz but the content is not gzip",
                seen=repr(source.content[:4]),
                cure="compress it with gzip, or take .gz off its name",
            )
        return source.content
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(source.content)) as stream:
            content = stream.read(LARGEST + 1)
    except EOFError:
        raise DataFileError(
            f"{source.path}: the gzip file is truncated",
            seen=f"{len(source.content)} bytes without an end mark",
            cure="copy or export the file again",
        ) from None
    except (OSError, zlib.error) as error:
        raise DataFileError(
            f"{source.path}: the gzip file is damaged", seen=str(error), cure="copy or export the file again"
        ) from None
    if len(content) > LARGEST:
        raise DataFileError(
            f"{source.path}: too large when unpacked",
            allowed=f"{LARGEST} bytes",
            cure="split the record into several files",
        )
    if not content:
        raise DataFileError(
            f"{source.path}, row 1: the file is empty when unpacked",
            allowed="a header line and two or more rows",
            cure="export the record again",
        )
    return content
