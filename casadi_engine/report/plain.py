"""Turning results into plain JSON data: no NaN, no infinity, no arrays."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from casadi_engine.errors import ResultError


def plain(value: Any, place: str = "result") -> Any:
    """Return dicts, lists, text, numbers, flags and None alone.

    A number that is not finite becomes None, and the object that holds it gets (or extends) the entry
    ``why``, a mapping from key to reason. Raises ResultError with the place of anything else.
    """
    if isinstance(value, Mapping):
        return _object(value, place)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple | set | frozenset):
        entries = sorted(value, key=str) if isinstance(value, set | frozenset) else value
        return [plain(entry, f"{place}[{index}]") for index, entry in enumerate(entries)]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, os.PathLike):
        return os.fsdecode(os.fspath(value))
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, str):
        # A file name that is no valid text reaches here with lone surrogates, which JSON cannot hold.
        return value.encode(errors="replace").decode()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    raise ResultError(
        f"{place} cannot be written as JSON",
        seen=type(value).__name__,
        allowed="numbers, text, flags, None, and lists, arrays or mappings of them",
        cure="convert it first",
    )


def _object(value: Mapping[Any, Any], place: str) -> dict[str, Any]:
    made = {str(key): plain(entry, f"{place}.{key}") for key, entry in value.items()}
    reasons: dict[str, str] = {}
    for key, entry in value.items():
        if _of_numbers(entry):
            # Names to numbers, such as times: the reason must not stand among the names, so it moves up.
            moved = made[str(key)].get("why")
            if isinstance(moved, dict):
                del made[str(key)]["why"]
                reasons |= {f"{key}.{name}": reason for name, reason in moved.items()}
        elif (reason := _lost(entry)) is not None:
            reasons[str(key)] = reason
    if reasons:
        given = made.get("why")
        made["why"] = reasons | (given if isinstance(given, dict) else {})
    return made


def _of_numbers(entry: Any) -> bool:
    return isinstance(entry, Mapping) and all(
        isinstance(one, float | np.floating | None) for one in entry.values()
    )


def _lost(entry: Any) -> str | None:
    """Why an entry (a number, or an array of them) has a null in its place; None if it has not."""
    if isinstance(entry, float | np.floating):
        return None if math.isfinite(entry) else f"not a finite number ({float(entry)})"
    if isinstance(entry, np.ndarray):
        broken = entry.dtype.kind == "f" and not np.isfinite(entry).all()
        return "entries that are null are not finite numbers" if broken else None
    if isinstance(entry, list | tuple) and any(_lost(part) is not None for part in entry):
        return "entries that are null are not finite numbers"
    return None
