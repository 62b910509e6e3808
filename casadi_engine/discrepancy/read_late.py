"""Refits that end with an input read off the record, which began with the law of its delay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# Chi-squared of a record that the three first states of the law of a late input may well take away.
_FEWER = 12.0


def leaves_more(cost: float, by_law: float | None, records: int) -> bool:
    """True where an input that is read late leaves more than the law of its delay did: what is no delay may look like
    that law; by_law : None where there was none."""
    return by_law is not None and not cost <= by_law + _FEWER * records


def are_of(model: Any, initial: Mapping[str, Mapping[str, float]]) -> bool:
    """True if the first states of all records are those of a model: a law has states that the record stands for."""
    names = {one.name for one in model.states}
    return all(set(own) == names for own in initial.values())
