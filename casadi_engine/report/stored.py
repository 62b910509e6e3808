"""Reading result.json back: checked, frozen, and enough for a warm start."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import CasadiEngineError, ResultError
from casadi_engine.parameters import Parameters
from casadi_engine.report.result_file import SCHEMA
from casadi_engine.report.schema import faults

AGAIN = "run the command again to write it anew"
_NO_RESULT = "give the result.json that a command wrote, or its folder; this file is none"


@dataclass(frozen=True, eq=False)
class Result(Mapping[str, Any]):
    """A stored result: a read-only mapping with the keys of result.json.

    path : the file it came from.  document : its content, nested read-only mappings and tuples
    """

    path: str
    document: Mapping[str, Any]

    def __getitem__(self, key: str) -> Any:
        return self.document[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self.document)

    def __len__(self) -> int:
        return len(self.document)

    def __repr__(self) -> str:
        return f"Result({self.path!r}: {self['command']}, {self['status']})"

    def __str__(self) -> str:
        """What the result printed when it was made, where that is stored (a repair, a posterior)."""
        return str(self.document.get("summary", repr(self)))

    @property
    def values(self) -> dict[str, float]:  # type: ignore[override]
        """Name -> value of every parameter, ``name@record`` too; NaN where the file has null."""
        return {name: _number(entry["value"]) for name, entry in self["parameters"].items()}

    @property
    def stderr(self) -> dict[str, float | None]:
        """Name -> standard error, None where there is none (``result["parameters"][name]["why"]``)."""
        return {name: entry["stderr"] for name, entry in self["parameters"].items()}

    @property
    def records(self) -> tuple[str, ...]:
        """Names of the records whose initial states are stored."""
        return tuple(self._of_fit("initial_states"))

    @property
    def initial(self) -> dict[str, dict[str, float]]:
        """Record -> state -> initial value, for ``estimate(initial=...)`` or a warm start."""
        return {
            record: {state: _number(entry["value"]) for state, entry in states.items()}
            for record, states in self._of_fit("initial_states").items()
        }

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the estimated parameters, in the order of ``covariance``."""
        return tuple(self._of_fit("free"))

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(nz, nz) covariance of the free parameters, NaN where the file has null."""
        rows = [[_number(entry) for entry in row] for row in self._of_fit("covariance")]
        return np.array(rows, dtype=float).reshape(len(rows), len(rows))

    @property
    def draws(self) -> dict[str, NDArray[np.float64]]:
        """Name -> (n,) draws of a stored posterior, in the parameter's unit; those of one number belong together."""
        if "posterior" not in self.document:
            raise ResultError(
                f"{self.path}: this result has no draws",
                seen=f"a result of {self['command']}",
                allowed="a posterior that was saved",
                cure="write one, ce.posterior(fit).save(path)",
            )
        return {name: np.array(own, dtype=float) for name, own in self["posterior"]["draws"].items()}

    def parameter_set(self) -> Parameters:
        """Return a fresh, changeable set of parameters at the stored optimum, with ties and constraints.

        Raises ResultError if the file does not hold one that can be read.
        """
        stored = self._of_fit("parameter_set")
        if stored is None:
            raise ResultError(
                f"{self.path}: the set of parameters is not stored",
                seen=str(self["why"].get("parameter_set", "null")),
                allowed="a set whose ties and constraints are text",
                cure="build the set again and copy result.values into it",
            )
        try:
            return Parameters.from_dict(_thawed(stored))
        except CasadiEngineError as error:
            raise ResultError(
                f"{self.path}: the stored set of parameters cannot be read", seen=str(error), cure=AGAIN
            ) from None

    def to_dict(self) -> dict[str, Any]:
        """Return the content as plain dicts and lists that may be changed."""
        made: dict[str, Any] = _thawed(self.document)
        return made

    def _of_fit(self, key: str) -> Any:
        if key not in self.document:
            raise ResultError(
                f"{self.path}: this result has no {key}",
                seen=f"a result of {self['command']}",
                allowed="a result of fit",
                cure="give the result.json of a fit",
            )
        return self.document[key]


def load_result(path: Any) -> Result:
    """Read a result.json and return it as a frozen Result.

    path : the file, or the folder that holds it
    Raises ResultError with the path for a missing or unreadable file, broken JSON (with line and column),
    another version of the schema, and content that breaks the schema (with the place).
    """
    text = _path_text(path)
    document = _parsed(text, _read(text))
    if not isinstance(document, dict):
        raise ResultError(
            f"{text}: not a result", seen=type(document).__name__, allowed="a JSON object", cure=AGAIN
        )
    if document.get("schema") != SCHEMA:
        raise ResultError(
            f"{text}: another version of the result file",
            seen=repr(document.get("schema")),
            allowed=repr(SCHEMA),
            cure="run the command again, or read it with the version of casadi-engine that wrote it",
        )
    for place, seen, allowed in faults(document):
        raise ResultError(f"{text}: {place} does not fit the schema", seen=seen, allowed=allowed, cure=AGAIN)
    return Result(text, _frozen(document))


def _path_text(path: Any) -> str:
    try:
        text = os.fsdecode(os.fspath(path))
    except TypeError:
        raise ResultError(
            "not the path of a result",
            seen=type(path).__name__,
            allowed="text or a pathlib.Path",
            cure='give a path such as "results/two_mass-fit/result.json"',
        ) from None
    return os.path.join(text, "result.json") if os.path.isdir(text) else text


def _read(text: str) -> str:
    try:
        with open(text, "rb") as stream:
            return stream.read().decode("utf-8")
    except FileNotFoundError:
        raise ResultError(
            f"{text}: no such file", cure="check the path; fit writes DIR/result.json"
        ) from None
    except UnicodeDecodeError as error:
        raise ResultError(
            f"{text}: not UTF-8 text", seen=f"byte {error.start}", allowed="result.json", cure=AGAIN
        ) from None
    except (OSError, ValueError) as error:
        raise ResultError(
            f"{text}: cannot be read", seen=str(error), cure="check the path and its permissions"
        ) from None


def _parsed(path: str, text: str) -> Any:
    def refuse(word: str) -> Any:
        raise ResultError(
            f"{path}: a number that is no number",
            seen=word,
            allowed="finite numbers, or null with a reason under why",
            cure=AGAIN,
        )

    def finite(word: str) -> float:
        value = float(word)
        return value if math.isfinite(value) else refuse(word)

    try:
        return json.loads(text, parse_constant=refuse, parse_float=finite)
    except json.JSONDecodeError as error:
        raise ResultError(
            f"{path}: broken JSON at line {error.lineno}, column {error.colno}",
            seen=error.msg,
            cure=AGAIN if text.lstrip().startswith("{") else _NO_RESULT,
        ) from None
    except (RecursionError, ValueError) as error:  # nested too deep, or an integer of too many digits
        raise ResultError(f"{path}: cannot be read as JSON", seen=str(error), cure=AGAIN) from None


def _frozen(value: Any) -> Any:
    if isinstance(value, dict):
        return MappingProxyType({key: _frozen(entry) for key, entry in value.items()})
    return tuple(_frozen(entry) for entry in value) if isinstance(value, list) else value


def _thawed(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _thawed(entry) for key, entry in value.items()}
    return [_thawed(entry) for entry in value] if isinstance(value, tuple) else value


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
