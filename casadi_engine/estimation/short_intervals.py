"""Shooting intervals so short that a model which falls over can be followed from the start of one to its end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from casadi_engine.errors import EstimationError, ModelError
from casadi_engine.estimation.growth import in_their_sizes
from casadi_engine.estimation.search import Search

# Factor by which a change of an interval's start may grow until its end. The intervals of `auto` have 16 samples or
# more; where a change grows tenfold on the way, a start at other values than the best ones leads nowhere near.
_GROWN = 10.0
# Samples of the shortest interval.
_LEAST = 2


def short_enough(
    search: Search, arguments: dict[str, Any], make: Callable[[dict[str, Any]], Search]
) -> tuple[Search, dict[str, Any]]:
    """A search laid out in intervals from which its start can be followed, and its arguments.

    make : a search from such arguments. A model that is linear between its samples is followed however long they are.
    """
    if arguments["interval"] != "auto":
        return search, arguments
    while True:
        length = min((record.plan.length for record in search.records if not record.linear), default=0)
        if length < 2 * _LEAST or not _falls_over(search):
            return search, arguments
        seconds = min(r.plan.length * r.grid.step for r in search.records if not r.linear) / 2
        arguments = arguments | {"interval": f"{seconds:.9g} s"}
        search = make(arguments)


def _falls_over(search: Search) -> bool:
    """True where the start has no value, or changes grow too much within its intervals."""
    try:
        points = search.problem.at(search.first_point()).records
    except (FloatingPointError, EstimationError, ModelError, np.linalg.LinAlgError):
        return True
    for record, point in zip(search.records, points, strict=True):
        if record.linear or record.plan.m < 2:
            continue
        ends = in_their_sizes(point)
        if not np.isfinite(ends).all() or np.abs(np.linalg.eigvals(ends)).max(initial=0.0) > _GROWN:
            return True
    return False
