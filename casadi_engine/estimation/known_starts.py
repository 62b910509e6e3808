"""Initial states of a fresh record for a fit: where the measurement gives none to begin at, those of its records."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from casadi_engine.errors import EstimationError
from casadi_engine.estimation.fit import Fit

# Records of the fit from whose initial states the search goes on.
_MOST = 3
# Seconds of the processor that searches may have taken for a further one to begin.
_PATIENT = 10.0


@dataclass(frozen=True)
class _Start:
    """What ``estimate`` takes of a warm start."""

    initial: Mapping[str, Mapping[str, Any]]
    values: Mapping[str, float] = field(default_factory=dict)


def found_from_known(source: Any, find: Callable[..., Fit], names: Sequence[str]) -> Fit:
    """The fit of initial states alone, or a better one from those of the records of a fit with these parameters, where
    it did not converge or where states are left that the outputs do not depend on, and where the model has no value
    from where the search begins.

    An output may have no slope where a search begins, as a logarithm that is kept away from 0.

    source : the fit whose parameters are held, or what is none; find(warm=...) : a fit of the records called ``names``
    from there; EstimationError where none of them begins
    """
    known = list(source.initial.values())[:_MOST] if isinstance(source, Fit) else []
    starts = [_Start(dict.fromkeys(names, states)) for states in known]
    begun = time.process_time()
    try:
        found = find()
    except EstimationError:
        made = (_or_none(find, start) for start in starts)
        if (other := next((one for one in made if one is not None), None)) is None:
            raise
        return other
    if found.converged and not found.undetermined:
        return found
    for start in starts:
        # a model that is far from these records takes as long from anywhere
        if time.process_time() - begun > _PATIENT:
            break
        other = find(warm=start)
        if other.converged and (not found.converged or other.cost < found.cost):
            return other
    return found


def _or_none(find: Callable[..., Fit], start: _Start) -> Fit | None:
    """The fit from a start, None where the model has no value there either."""
    try:
        return find(warm=start)
    except EstimationError:
        return None
