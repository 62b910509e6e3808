"""Initial states of a fresh record for a fit: where the measurement gives none to begin at, those of its records."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from casadi_engine.estimation.fit import Fit

# Records of the fit from whose initial states the search goes on.
_MOST = 3


@dataclass(frozen=True)
class _Start:
    """What ``estimate`` takes of a warm start."""

    initial: Mapping[str, Mapping[str, Any]]
    values: Mapping[str, float] = field(default_factory=dict)


def found_from_known(source: Any, found: Fit, again: Callable[[_Start], Fit]) -> Fit:
    """The fit of initial states alone, or a better one from those of the records of a fit with these parameters, where
    it did not converge or where states are left that the outputs do not depend on.

    An output may have no slope where a search begins, as a logarithm that is kept away from 0.

    source : the fit whose parameters are held, or what is none; again(warm) : the same fit from there
    """
    if (found.converged and not found.undetermined) or not isinstance(source, Fit):
        return found
    for states in list(source.initial.values())[:_MOST]:
        other = again(_Start({record.name: states for record in found.data}))
        if other.converged and (not found.converged or other.cost < found.cost):
            return other
    return found
