"""Estimates whose errors are doubted have no standard error, and an interval by profile where one is quickly found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.error_check import CALL, Doubt, doubts_of, words_of
from casadi_engine.estimation.fit import Estimate, Optimum
from casadi_engine.estimation.profile_interval import LowerOptimumError, Profiles
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.standard_errors import Uncertainty

Array = NDArray[np.float64]

# Processor time that intervals by profile may take where the quadratic fails [s].
_SECONDS = 3.0
_UNKNOWN, _UNEVEN = "not known (see note)", "not symmetric (see note)"


@dataclass(frozen=True)
class Judged:
    """Estimates with the errors that hold, initial states likewise, and what is said of those that do not."""

    estimates: dict[str, Estimate]
    initial: dict[str, dict[str, Estimate]]
    said: tuple[str, ...] = ()


def judged(
    search: Search,
    best: Attempt,
    errors: Uncertainty,
    optima: Sequence[Optimum],
    residuals: Sequence[Array],
    *,
    check: bool,
) -> Judged:
    """The estimates of an optimum; see ``doubts_of``. check : False for the errors of the quadratic as they are."""
    estimates, initial = errors.estimates(), errors.initial_estimates()
    doubts = doubts_of(search, best, errors, optima, residuals) if check else ()
    if not doubts:
        return Judged(estimates, initial)
    matrix, slopes = errors.covariance.matrix, errors.slopes()
    about = {name: _of(doubts, slope, matrix) for name, slope in slopes.items() if estimates[name].stderr}
    free = [name for name in search.pmap.free if about.get(name)]
    ends: dict[str, tuple[float, float]] = {}
    if all(doubt.profiles for doubt in doubts):
        try:
            ends = Profiles(search, best, errors, seconds=_SECONDS).intervals(free)
        except LowerOptimumError:
            doubts = (_lower(doubts),)
            about = dict.fromkeys(about, doubts[0])
    for name, doubt in about.items():
        if doubt is not None:
            interval = _through_ties(search, errors, name, slopes[name], ends)
            estimates[name] = _without_error(estimates[name], doubt, interval)
    at = search.problem.nv
    for record, states in zip(search.records, initial.values(), strict=True):
        for k, (state, one) in enumerate(states.items()):
            doubt = _of(doubts, np.eye(len(matrix))[at + k], matrix)
            if doubt is not None and one.stderr is not None:
                states[state] = _without_error(one, doubt, None)
        at += record.n
    missing = [name for name in free if name not in ends]
    return Judged(estimates, initial, tuple(words_of(doubts, missing)))


def _of(doubts: Sequence[Doubt], slope: Array, matrix: Array) -> Doubt | None:
    """The first doubt about a quantity with this slope (nv,) or (N,)."""
    wide = np.zeros(len(matrix))
    wide[: len(slope)] = slope
    return next((doubt for doubt in doubts if doubt.about(wide, matrix)), None)


def _lower(doubts: Sequence[Doubt]) -> Doubt:
    """What is doubted where a profile came below the optimum."""
    text = f"the errors are not known: a profile met a lower optimum near by; search again with starts=10, or {CALL}"
    return Doubt("rugged", text, doubts[0].move)


def _without_error(one: Estimate, doubt: Doubt, interval: tuple[float, float] | None) -> Estimate:
    why = _UNEVEN if doubt.profiles else _UNKNOWN
    return replace(one, stderr=None, why=why, interval=interval, quadratic=one.stderr)


def _through_ties(
    search: Search, errors: Uncertainty, name: str, slope: Array, ends: dict[str, tuple[float, float]]
) -> tuple[float, float] | None:
    """The interval of a reported quantity that depends on one parameter alone; None of any other."""
    (on,) = np.nonzero(slope)
    if len(on) != 1 or search.pmap.free[on[0]] not in ends:
        return None
    z = search.coordinates.values(errors.v)
    found = []
    for end in ends[search.pmap.free[on[0]]]:
        z[on[0]] = end
        found.append(search.pmap.values(z)[name])
    return min(found), max(found)
