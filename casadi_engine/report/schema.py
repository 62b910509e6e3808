"""The published schema of result.json, and a check against it that needs no further package.

Only the words that schema.json uses are understood (a test compares the verdicts with those of jsonschema).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from typing import Any

_TYPES: dict[str, Any] = {
    "object": Mapping,
    "array": list,
    "string": str,
    "number": (int, float),
    "integer": int,
    "boolean": bool,
    "null": type(None),
}


@cache
def _text() -> str:
    return files("casadi_engine.report").joinpath("schema.json").read_text(encoding="utf-8")


def schema() -> dict[str, Any]:
    """Return a fresh copy of the JSON Schema (draft 2020-12) of result.json."""
    loaded: dict[str, Any] = json.loads(_text())
    return loaded


def faults(document: Any) -> Iterator[tuple[str, str, str]]:
    """Yield (place, what was seen, what is allowed) for every break of the schema."""
    whole = schema()
    yield from _faults(document, whole, whole["$defs"], "result")


def _faults(
    value: Any, rule: Mapping[str, Any], known: Mapping[str, Any], place: str
) -> Iterator[tuple[str, str, str]]:
    if "$ref" in rule:
        yield from _faults(value, known[rule["$ref"].removeprefix("#/$defs/")], known, place)
    if "const" in rule and value != rule["const"]:
        yield place, _shown(value), _shown(rule["const"])
    if "enum" in rule and not any(type(value) is type(entry) and value == entry for entry in rule["enum"]):
        yield place, _shown(value), ", ".join(_shown(entry) for entry in rule["enum"])
    if "type" in rule:
        names = [rule["type"]] if isinstance(rule["type"], str) else rule["type"]
        if not any(_is(value, name) for name in names):
            yield place, _shown(value), " or ".join(names)
            return
    if isinstance(value, Mapping):
        yield from _members(value, rule, known, place)
    if isinstance(value, list) and "items" in rule:
        for index, entry in enumerate(value):
            yield from _faults(entry, rule["items"], known, f"{place}[{index}]")
    for case in rule.get("allOf", ()):
        if not any(True for _ in _faults(value, case["if"], known, place)):
            yield from _faults(value, case["then"], known, place)


def _members(
    value: Mapping[str, Any], rule: Mapping[str, Any], known: Mapping[str, Any], place: str
) -> Iterator[tuple[str, str, str]]:
    for name in rule.get("required", ()):
        if name not in value:
            yield place, f"without {name!r}", f"an object with {', '.join(rule['required'])}"
    properties = rule.get("properties", {})
    for name, entry in value.items():
        inner = properties.get(name, rule.get("additionalProperties"))
        if inner is not None:
            yield from _faults(entry, inner, known, f"{place}.{name}")


def _is(value: Any, name: str) -> bool:
    if isinstance(value, bool):
        return name == "boolean"
    if name == "integer" and isinstance(value, float):
        return value.is_integer()
    return isinstance(value, _TYPES[name])


def _shown(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False, default=repr)
    return text if len(text) <= 60 else text[:59] + "…"
