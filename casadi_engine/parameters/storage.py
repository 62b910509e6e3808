"""A parameter set as JSON-able data and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from casadi_engine.errors import ParameterError
from casadi_engine.parameters.expression import write_expression
from casadi_engine.parameters.parameter import Parameter, own_values

if TYPE_CHECKING:
    from casadi_engine.parameters.collection import Parameters

PARTS = ("parameters", "constraints", "frequency_constraints")
# key -> kind of its entry, for every part
PARAMETER_KEYS = {
    "name": "text",
    "value": "number",
    "unit": "text",
    "min": "bound",
    "max": "bound",
    "vary": "flag",
    "fixed_by_user": "flag",
    "varies_by_experiment": "flag or values",  # record -> [value, min, max] where they were given
    "tie": "text or null",
    "prior": "pair or null",
    "description": "text",
}
CONSTRAINT_KEYS = {"name": "text or null", "expression": "text", "min": "bound", "max": "bound"}
FREQUENCY_KEYS = {"mode": "number", "min": "bound", "max": "bound"}


def to_dict(parameters: Parameters) -> dict[str, Any]:
    """Write the set as lists and dicts of text, numbers, flags and None (an infinite bound)."""
    return {
        "parameters": [_parameter(parameters, name) for name in parameters],
        "constraints": [
            {
                "name": constraint.name,
                "expression": constraint.text
                if constraint.readable
                else write_expression(constraint.expression),
                "min": _finite(constraint.min),
                "max": _finite(constraint.max),
            }
            for constraint in parameters.constraints
        ],
        "frequency_constraints": [
            {"mode": constraint.mode, "min": _finite(constraint.min), "max": _finite(constraint.max)}
            for constraint in parameters.frequency_constraints
        ],
    }


def _parameter(parameters: Parameters, name: str) -> dict[str, Any]:
    parameter = parameters[name]
    tie = parameters._tie_text(name)
    return {
        "name": name,
        "value": parameter._value,  # a tied one's stored value is what untie falls back to
        "unit": parameter.unit,
        "min": _finite(parameter.min),
        "max": _finite(parameter.max),
        "vary": parameter._vary,
        "fixed_by_user": parameter._explicit,
        "varies_by_experiment": {
            record: [value, _finite(low), _finite(high)]
            for record, (value, low, high) in parameter._own.items()
        }
        or parameter._varies,
        "tie": tie,
        "prior": None if parameter.prior is None else list(parameter.prior),
        "description": parameter.description,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def from_dict(data: Mapping[str, Any], parameters: Parameters) -> Parameters:
    """Fill the empty set `parameters` from what `to_dict` wrote, and return it."""
    _check_keys(data, PARTS, "the data")
    entries = [
        _entry(entry, PARAMETER_KEYS, f"parameters[{index}]")
        for index, entry in enumerate(_list(data, "parameters"))
    ]
    for entry in entries:
        parameters._insert(
            Parameter(
                entry["name"],
                entry["value"],
                unit=entry["unit"],
                min=-math.inf if entry["min"] is None else entry["min"],
                max=math.inf if entry["max"] is None else entry["max"],
                vary=entry["vary"],
                prior=entry["prior"],
                description=entry["description"],
            )
        )
    for entry in entries:  # a tie may refer to names that come later
        if entry["tie"] is not None:
            parameters.tie(entry["name"], entry["tie"])
        if entry["fixed_by_user"]:
            parameters.fix(entry["name"])
        _vary_by_experiment(parameters[entry["name"]], entry["varies_by_experiment"])
    for index, raw in enumerate(_list(data, "constraints")):
        entry = _entry(raw, CONSTRAINT_KEYS, f"constraints[{index}]")
        low, high = _bounds(entry)
        parameters.constrain(entry["expression"], low, high, name=entry["name"])
    for index, raw in enumerate(_list(data, "frequency_constraints")):
        entry = _entry(raw, FREQUENCY_KEYS, f"frequency_constraints[{index}]")
        low, high = _bounds(entry)
        parameters.constrain_frequency(entry["mode"], low, high)
    return parameters


def _vary_by_experiment(parameter: Parameter, stored: Any) -> None:
    parameter._varies = bool(stored)
    if isinstance(stored, Mapping):
        values = {}
        for record, given in stored.items():
            if not isinstance(given, list | tuple) or len(given) != 3:
                raise _bad(f"{parameter.name}.varies_by_experiment", given, "[value, min, max]")
            value, low, high = given
            values[record] = (value, -math.inf if low is None else low, math.inf if high is None else high)
        parameter._own = own_values(parameter, values)


def received(data: Mapping[str, Any], frozen: bool) -> Parameters:
    """A set that came from another process."""
    from casadi_engine.parameters.collection import Parameters

    found = from_dict(data, Parameters())
    return found.frozen() if frozen else found


def _bounds(entry: Mapping[str, Any]) -> tuple[float, float]:
    low, high = entry["min"], entry["max"]
    return -math.inf if low is None else low, math.inf if high is None else high


def _list(data: Mapping[str, Any], part: str) -> list[Any]:
    found = data[part]
    if not isinstance(found, list | tuple):
        raise _bad(part, found, "a list")
    return list(found)


def _entry(entry: Any, keys: Mapping[str, str], place: str) -> Mapping[str, Any]:
    _check_keys(entry, tuple(keys), place)
    for key, kind in keys.items():
        value = entry[key]
        fits = {
            "text": isinstance(value, str),
            "text or null": value is None or isinstance(value, str),
            "flag": isinstance(value, bool),
            "flag or values": isinstance(value, bool | Mapping),
            "number": isinstance(value, int | float) and not isinstance(value, bool),
            "bound": value is None or (isinstance(value, int | float) and not isinstance(value, bool)),
            "pair or null": value is None or (isinstance(value, list | tuple) and len(value) == 2),
        }[kind]
        if not fits:
            raise _bad(
                f"{place}.{key}", value, {"bound": "a number, or null for none"}.get(kind, f"a {kind}")
            )
    return entry


def _check_keys(entry: Any, keys: tuple[str, ...], place: str) -> None:
    if not isinstance(entry, Mapping):
        raise _bad(place, entry, "an object with the keys " + ", ".join(keys))
    if set(entry) != set(keys):
        missing, strange = [k for k in keys if k not in entry], [str(k) for k in entry if k not in keys]
        seen = "; ".join(
            f"{what} {', '.join(found)}" for what, found in (("lacks", missing), ("has", strange)) if found
        )
        raise _bad(place, seen, "exactly the keys " + ", ".join(keys), shown=True)


def _bad(place: str, seen: Any, allowed: str, *, shown: bool = False) -> ParameterError:
    return ParameterError(
        f"stored parameters do not fit at {place}",
        seen=seen if shown else repr(seen),
        allowed=allowed,
        cure="write them with to_dict()",
    )
