"""Parameter values of an earlier fit, from its result.json."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from casadi_engine.cli.options import Options
from casadi_engine.errors import ResultError

if TYPE_CHECKING:
    from casadi_engine.parameters import Parameters

From = Annotated[
    Path | None,
    typer.Option(
        "--from",
        metavar="RESULT",
        help="result.json of an earlier fit (or its folder) that gives the values.",
    ),
]


def values_of(path: Path, parameters: Parameters, *, given: Options) -> Parameters:
    """Return a copy of `parameters` with the values of a stored fit, but for those that `given` sets.

    path : a result.json, or the folder that holds one. ResultError if it holds no parameters, none for a
    parameter of the set, one that the set does not have, or values by record for one of the set.
    """
    from casadi_engine.parameters import near_matches

    stored = _stored(path)
    result = parameters.copy()
    chosen = {text.partition("=")[0].strip() for text in (*given.set, *given.fix) if "=" in text}
    unknown = [name for name in stored if name.partition("@")[0] not in result]
    if unknown:
        raise ResultError(
            f"{path}: the result has a parameter that the problem does not have",
            seen=unknown[0],
            allowed=near_matches(unknown[0], result),
            cure="give the problem file that the result was made with",
        )
    for name, parameter in result.items():
        if parameter.tie is not None or name in chosen:
            continue
        if name in stored:
            parameter.set(_within(stored[name], parameter.min, parameter.max))
        elif name not in given.free:
            by_record = [key for key in stored if key.startswith(f"{name}@")]
            raise ResultError(
                f"{path}: the result has no single value of the parameter {name}",
                seen=", ".join(by_record) or "none",
                allowed=f"a value of {name}",
                cure=f"give it by --set {name}=VALUE, or estimate it on these records by --free {name}",
            )
    return result


def _stored(path: Path) -> dict[str, float]:
    """Name -> value of a result."""
    from casadi_engine.report import load_result

    file = path / "result.json" if path.is_dir() else path
    stored: Any = load_result(file)
    entries = stored["parameters"] if isinstance(stored, Mapping) and "parameters" in stored else {}
    values = {
        name: entry["value"]
        for name, entry in entries.items()
        if isinstance(entry.get("value"), (int, float)) and math.isfinite(entry["value"])
    }
    if not values:
        raise ResultError(
            f"{file}: the result holds no parameter values",
            allowed="the result.json of a fit",
            cure="run `casadi-engine fit` first",
        )
    return values


def _within(value: float, low: float, high: float) -> float:
    """The value moved into its bounds if only the solver's tolerance took it out."""
    slack = 1e-6 * max(abs(value), 1e-12)
    if low - slack <= value < low:
        return low
    return high if high < value <= high + slack else value
