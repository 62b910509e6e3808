"""The folder of the results: tried before the work, made when there is something to put into it."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
from collections.abc import Iterable
from pathlib import Path

from casadi_engine.errors import OutputError


def check_folder(folder: Path, *, files: tuple[str, ...] = ("result.json", "report.html")) -> None:
    """Try to write into `folder`, and leave the disk as it was.

    OutputError with the path if it cannot be made or written, or if one of `files` is a folder there.
    """
    made: list[Path] = []
    try:
        for path in reversed([folder, *folder.parents]):
            if not path.exists():
                path.mkdir()
                made.append(path)
        trial = folder / f".trial.{secrets.token_hex(6)}.tmp"
        trial.write_bytes(b"trial")
        trial.unlink()
        for name in files:
            if (folder / name).is_dir():
                raise IsADirectoryError(f"{name} is a folder there")
    except (OSError, ValueError) as error:
        raise _unwritable(folder, error) from None
    finally:
        for path in reversed(made):
            with contextlib.suppress(OSError):
                path.rmdir()


def refuse_others(folder: Path, names: Iterable[str]) -> None:
    """OutputError if one of the files that are to be written is there, and no command of this program made it."""
    for name in sorted(names):
        if (folder / name).exists():
            raise OutputError(
                f"a file of this name would be lost: {folder / name}",
                seen="a file that no earlier result in this folder lists as its own",
                allowed="a folder in which only earlier results of this program are replaced",
                cure="give another folder by --out DIR, or take the file out of there",
            )


def keep_source(folder: Path, source: Path) -> None:
    """OutputError if the result that the values are taken from would be written over."""
    file = source / "result.json" if source.is_dir() else source
    with contextlib.suppress(OSError):
        if file.samefile(folder / "result.json"):
            raise OutputError(
                f"the result that the values are taken from would be lost: {file}",
                seen=f"--from {source} and --out {folder}",
                allowed="another folder for what is written",
                cure="give another folder by --out DIR",
            )


def keep_others(folder: Path, command: str) -> None:
    """OutputError if the result of another command would be written over."""
    with contextlib.suppress(OSError, ValueError):
        earlier = json.loads((folder / "result.json").read_text(encoding="utf-8")).get("command")
        if earlier != command:
            raise OutputError(
                f"the result of another command would be lost: {folder / 'result.json'}",
                seen=f"a result of {earlier} there, and the command {command}",
                allowed="a folder without a result, or with an earlier one of the same command",
                cure="give another folder by --out DIR",
            )


def is_ours(folder: Path, name: str = "result.json") -> bool:
    """True if a file of results in a folder is one of this program's."""
    try:
        found = json.loads((folder / name).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and {"schema", "command"} <= set(found)


def make_folder(folder: Path) -> None:
    """Make `folder` and its parents; OutputError if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise _unwritable(folder, error) from None


def simulated_files(folder: Path) -> tuple[str, ...]:
    """The data files that an earlier `simulate` left in `folder`, by its own result.json; none in doubt."""
    try:
        earlier = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return ()
    if not isinstance(earlier, dict) or earlier.get("command") != "simulate":
        return ()
    names = earlier.get("files")
    listed = names if isinstance(names, list) else []
    return tuple(n for n in listed if isinstance(n, str) and n.endswith(".csv") and n == os.path.basename(n))


def remove_files(folder: Path, names: Iterable[str]) -> None:
    """Take files out of `folder`; one that is gone, or that cannot be removed, is left as it is."""
    for name in names:
        with contextlib.suppress(OSError):
            (folder / name).unlink()


def _unwritable(folder: Path, error: Exception) -> OutputError:
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    at = error.filename if isinstance(error, OSError) and error.filename else None
    if at is not None and os.path.basename(str(at)).startswith(".trial."):
        at = folder
    if at is not None and Path(str(at)) != folder:
        reason = f"{reason}: {at}"
    return OutputError(
        f"the folder of the results cannot be written: {folder}",
        seen=reason,
        allowed="a folder that may be made and written",
        cure="give another one by --out DIR",
    )
