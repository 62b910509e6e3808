"""A checkpoint: the finished pieces of a study as lines of JSON in a file, appended whole, one for each piece."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from casadi_engine.errors import StudyError

_FORMAT = 1


def key_of(piece: Any) -> str:
    """A piece's key: a hash of its JSON text, whatever the order of its entries.

    Raises StudyError for a piece that JSON cannot hold.
    """
    return hashlib.sha256(_text(piece, "a piece of the study").encode()).hexdigest()[:32]


class Checkpoint:
    """The file of one study; the first line names the study, every other holds a key, a piece and its row.

    A process that is killed while it writes leaves at most one unfinished last line, whose piece counts as not done.
    While it is open no other process can open it.

    path : the file, made if it is not there; study : the name, and ``setting`` all else that the rows depend on
    Raises StudyError if the file belongs to another study, is damaged, in use, or cannot be written.
    """

    def __init__(self, path: Path | str, study: str, setting: Any = None) -> None:
        self.path = _path(path)
        self.rows: dict[str, Any] = {}
        _text(study, "the name of the study")
        head = {"checkpoint": _FORMAT, "study": study, "setting": key_of(setting)}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        except (OSError, ValueError) as error:
            raise self._unusable(error) from None
        try:
            self._lock()
            if not self._read(head):
                self._append(head)
        except OSError as error:  # a device, or a disk that is full
            os.close(self._file)
            raise self._unusable(error) from None
        except BaseException:
            os.close(self._file)
            raise

    def __enter__(self) -> Checkpoint:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file."""
        os.close(self._file)

    def add(self, piece: Any, row: Any) -> Any:
        """Write a finished piece to the disk, and return its row as it will be read again."""
        key = key_of(piece)
        text = _text(row, "the result of a piece")
        self._append({"key": key, "piece": piece, "row": json.loads(text)})
        self.rows[key] = json.loads(text)
        return self.rows[key]

    def _lock(self) -> None:
        try:
            import fcntl
        except ImportError:  # a system without such locks: one process at a time is then the user's care
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise StudyError(
                f"the checkpoint {self.path} is in use",
                seen="another process that has it open",
                allowed="one process for each checkpoint",
                cure="wait for that process, or name another file",
            ) from None

    def _unusable(self, error: OSError | ValueError) -> StudyError:
        return StudyError(
            f"the checkpoint {self.path} cannot be opened",
            seen=(error.strerror if isinstance(error, OSError) else None) or str(error),
            allowed="a file that can be read and written",
            cure="name another file",
        )

    def _append(self, entry: Mapping[str, Any]) -> None:
        """One line in one write, on the disk before anything else is done."""
        line = _line(entry)
        while line:
            line = line[os.write(self._file, line) :]
        os.fsync(self._file)

    def _read(self, head: Mapping[str, Any]) -> bool:
        """Read what is finished, cut off a line that is not; False for a new file."""
        whole = self.path.read_bytes()
        end = whole.rfind(b"\n") + 1
        lines = whole[:end].splitlines()
        if not lines and not _line(head).startswith(whole):
            raise self._damaged(whole, 1)  # some other file: not ours to cut
        entries = [self._entry(line, number) for number, line in enumerate(lines, 1)]
        if entries and entries[0] != head:
            raise StudyError(
                f"the checkpoint {self.path} belongs to another study",
                seen=", ".join(f"{key} {value}" for key, value in entries[0].items()),
                allowed=", ".join(f"{key} {value}" for key, value in head.items()),
                cure="name another file, or delete this one to begin again",
            )
        if end < len(whole):
            os.ftruncate(self._file, end)
        if not entries:
            return False
        self.rows = {entry["key"]: entry["row"] for entry in entries[1:]}
        return True

    def _entry(self, line: bytes, number: int) -> dict[str, Any]:
        wanted = {"checkpoint", "study", "setting"} if number == 1 else {"key", "piece", "row"}
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError):
            entry = None
        whole = isinstance(entry, dict) and set(entry) == wanted
        if whole and (number == 1 or entry["key"] == key_of(entry["piece"])):
            return entry
        raise self._damaged(line, number)

    def _damaged(self, line: bytes, number: int) -> StudyError:
        cure = "name another file, or delete the file if it is a checkpoint of no more use"
        return StudyError(
            f"the checkpoint {self.path} is damaged",
            seen=f"line {number}: {line[:60].decode(errors='replace')}",
            allowed="lines that a study has written",
            cure=f"delete line {number}, whose piece is then done again" if number > 1 else cure,
        )


def _line(entry: Mapping[str, Any]) -> bytes:
    return (json.dumps(entry, allow_nan=True) + "\n").encode()


def _path(path: Any) -> Path:
    if isinstance(path, (str, os.PathLike)) and str(path):
        return Path(path)
    raise StudyError(
        "the checkpoint is not the path of a file",
        seen=repr(path),
        allowed="text or a pathlib.Path",
        cure='give a path such as "study.jsonl", or leave it out',
    )


def _text(value: Any, what: str) -> str:
    try:
        return json.dumps(value, sort_keys=True)
    except (TypeError, ValueError, RecursionError) as error:
        raise StudyError(
            f"{what} cannot be written as JSON",
            seen=str(error),
            allowed="texts, numbers, flags, None, and lists and mappings of these",
            cure="give numbers by float(...) and arrays by .tolist()",
        ) from None
