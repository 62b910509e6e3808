"""Estimates whose errors are doubted have no standard error, and an interval by profile where one is quickly found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casadi_engine.distributions import chi2_isf
from casadi_engine.estimation.answer_notes import UNTOLD
from casadi_engine.estimation.beside_optimum import UNEVEN, entries_of
from casadi_engine.estimation.doubt import CALL, FLAT, Doubt
from casadi_engine.estimation.error_check import doubts_of, words_of
from casadi_engine.estimation.few_samples import freedom_of
from casadi_engine.estimation.fit import Estimate, Optimum
from casadi_engine.estimation.foreseen_ends import Rises
from casadi_engine.estimation.options import USUAL
from casadi_engine.estimation.profile_interval import LEVEL, LowerOptimumError, Profiles, root_of
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.standard_errors import Uncertainty

Array = NDArray[np.float64]

# Seconds that a look beside an optimum may take at least.
_LEAST = 3.0
# Searches of which one may have met a lower optimum than the first.
_SEVERAL = 2
_UNKNOWN, _UNEVEN = "not known (see note)", "not symmetric (see note)"


@dataclass(frozen=True)
class Judged:
    """Estimates with the errors that hold, initial states likewise, what is said of those that do not, and variables
    (size,) at which a profile came below the optimum."""

    estimates: dict[str, Estimate]
    initial: dict[str, dict[str, Estimate]]
    said: tuple[str, ...] = ()
    lower: Array | None = None

    def as_told(self, notes: Sequence[str]) -> Judged:
        """The same without errors where these are said to be none."""
        if not any(UNTOLD in words for words in notes):
            return self
        estimates = {name: _untold(one) for name, one in self.estimates.items()}
        initial = {
            record: {name: _untold(one) for name, one in own.items()} for record, own in self.initial.items()
        }
        return replace(self, estimates=estimates, initial=initial)


def _untold(one: Estimate) -> Estimate:
    return replace(one, stderr=None, why=_UNKNOWN, interval=None, quadratic=one.stderr) if one.stderr else one


def judged(
    search: Search,
    best: Attempt,
    white: Uncertainty,
    errors: Uncertainty,
    optima: Sequence[Optimum],
    residuals: Sequence[Array],
    *,
    check: float | None,
    spent: float = 0.0,
) -> Judged:
    """The estimates of an optimum; see ``doubts_of``.

    white : the errors that the likelihood has, which is asked about its shape; errors : those that count with the noise
    of the residuals; check : seconds of processor time for intervals by profile, None for the errors of the quadratic
    as they are; spent : seconds that the search took, which a look beside its optimum may take too, or a part of it
    where fewer seconds than usual are for intervals
    """
    estimates, initial = errors.estimates(), errors.initial_estimates()
    limit = 0.0 if check is None else (_LEAST + spent) * min(check / USUAL, 1.0)
    doubts, rises, of_states, unchecked = (
        ((), {}, {}, None)
        if check is None
        else doubts_of(search, best, white, optima, residuals, wider=errors, seconds=limit)
    )
    few = _few(search, white)
    told = (*(() if unchecked is None else (unchecked,)), *few)
    if not doubts or check is None:
        return Judged(_bent_ties(search, white, errors, estimates), initial, told)
    doubts = tuple(sorted(doubts, key=lambda one: one.profiles))  # the graver ones first
    matrix, slopes = white.covariance.matrix, errors.slopes()
    with_error = [name for name, one in estimates.items() if one.stderr]
    free = [name for name in search.pmap.free if name in with_error and _of(doubts, slopes[name], matrix)]
    ends: dict[str, tuple[float, float]] = {}
    alike: set[str] = set()
    below: Array | None = None
    grave = [doubt for doubt in doubts if not doubt.profiles]
    told_by_profile = [name for name in free if _of(grave, slopes[name], matrix) is None]
    if told_by_profile:
        profiles = Profiles(search, best, white, seconds=check, stretch=_stretch(white, errors))
        if all(
            one.are_mild for one in rises.values()
        ):  # else the others bend, to which they are held by slopes
            plain = [
                name for name in told_by_profile if name in rises and _all_plain(doubts, slopes[name], matrix)
            ]
            ends = _foreseen(search, profiles, {name: rises[name] for name in plain})
        try:
            ends |= profiles.intervals([name for name in told_by_profile if name not in ends])
        except LowerOptimumError as met:
            doubts, below = (_lower(doubts),), met.x
        alike = {name for name, one in ends.items() if _alike(estimates[name], one, profiles.root)}
    about = {}
    for name in with_error:
        on = _only(search, slopes[name])
        about[name] = _of(doubts, slopes[name], matrix, but_shape=on in alike)
    for name, doubt in about.items():
        if doubt is not None:
            interval = _through_ties(search, errors, name, slopes[name], ends)
            estimates[name] = _without_error(estimates[name], doubt, interval)
    felt = [doubt for doubt in about.values() if doubt is not None]
    # states go along with parameters whose intervals are not symmetric
    even = bool(alike) and alike == set(ends)
    of_first = _states_judged(search, white, errors, doubts, of_states, initial, but_shape=even)
    alone = sum(one.starts for one in optima) < _SEVERAL and not all(one.linear for one in search.records)
    missing = [name for name in free if about[name] is not None and name not in ends]
    said = _said(doubts, felt, of_first, initial, missing, alone=alone and bool(ends))
    if not any(one.stderr for one in estimates.values()):  # none is left that could be of the curvature
        told = few
    return Judged(_bent_ties(search, white, errors, estimates), initial, (*said, *told), below)


def _said(
    doubts: Sequence[Doubt],
    felt: Sequence[Doubt],
    of_first: Sequence[Doubt],
    initial: Mapping[str, Mapping[str, Estimate]],
    missing: list[str],
    *,
    alone: bool,
) -> list[str]:
    """What is said of the doubts that took errors of parameters and of first states away.

    missing : parameters that have no interval by profile; alone : intervals are of an optimum of one search
    """
    # what is about first states alone hides nothing that is said of parameters; an interval tells it by itself
    states = [one for own in initial.values() for one in own.values()]
    untold = any(one.why in (_UNKNOWN, _UNEVEN) and one.interval is None for one in states)
    apart = untold and bool(felt) and all(one.profiles for one in felt)
    beside = [one for one in of_first if one not in felt] if apart else []
    own = [one for one in doubts if one in (*felt, *of_first) and one not in beside]
    said = words_of(own, missing)
    if said and alone and any(one.profiles and one.size > FLAT for one in own):
        said[-1] += "; the intervals are of the one optimum that was found: starts=10 looks for others"
    of_states = ("the errors are not known", "the errors of first states are not known")
    return said + [words.replace(*of_states, 1) for words in words_of(beside, [])]


def _few(search: Search, errors: Uncertainty) -> tuple[str, ...]:
    """That an interval is wider than ± says, of samples so few that the level of their noise is hardly known."""
    root, plain = root_of(search, errors), float(np.sqrt(chi2_isf(1 - LEVEL, 1)))
    if not errors.optimal or root < (1 + UNEVEN) * plain:
        return ()
    freedom = freedom_of(search, errors)
    return (
        f"few samples: with a noise level from {freedom:.3g} degrees of freedom an interval of 95 % goes {root:.2g} "
        "standard errors to either side (Student's t)",
    )


def _bent_ties(
    search: Search, white: Uncertainty, errors: Uncertainty, estimates: dict[str, Estimate]
) -> dict[str, Estimate]:
    """The estimates with an interval of what a tie makes of parameters where it bends so much that ± does not tell its
    ends: it is followed along the way of the parameters that moves it most."""
    if not errors.optimal:
        return estimates
    pmap, scale, root = search.pmap, search.coordinates.slope(errors.v), root_of(search, white)
    z, low, high = (
        search.coordinates.values(x[: len(scale)]) for x in (errors.x, search.lower, search.upper)
    )
    matrix, found = errors.of_parameters(), dict(estimates)
    for name, slope in errors.slopes().items():
        one, own = estimates[name], slope / scale
        if name in pmap.free or not one.stderr or not own.any():
            continue
        way = root * (matrix @ own) / np.sqrt(own @ matrix @ own)
        ends = sorted(float(pmap.values(np.clip(z + side * way, low, high))[name]) for side in (-1, 1))
        if np.isfinite(ends).all() and not _alike(one, (ends[0], ends[1]), root):
            interval = ends[0], ends[1]
            found[name] = replace(one, stderr=None, why=_UNEVEN, interval=interval, quadratic=one.stderr)
    return found


def _states_judged(
    search: Search,
    white: Uncertainty,
    errors: Uncertainty,
    doubts: Sequence[Doubt],
    rises: Mapping[int, Rises],
    initial: dict[str, dict[str, Estimate]],
    *,
    but_shape: bool,
) -> list[Doubt]:
    """Take the errors of initial states that are doubted out of ``initial``; the doubts that did so."""
    matrix, at, felt = white.covariance.matrix, search.problem.nv, []
    low, high = (entries_of(search, x) for x in (search.lower, search.upper))
    for record, states in zip(search.records, initial.values(), strict=True):
        for k, (state, one) in enumerate(states.items()):
            doubt = _of(doubts, np.eye(len(matrix))[at + k], matrix, but_shape=but_shape)
            if doubt is None or one.stderr is None:
                continue
            felt.append(doubt)
            risen, wide = rises.get(at + k), errors.covariance.matrix[at + k, at + k]
            ends = None
            if risen is not None and risen.are_mild and doubt.plain:
                ends = risen.ends(root_of(search, white) * float(np.sqrt(wide)) / risen.size)
            inside = ends is not None and low[at + k] < ends[0] and ends[1] < high[at + k]
            scaled = (
                tuple(float(end * record.scale[k]) for end in ends) if inside and ends is not None else None
            )
            states[state] = _without_error(one, doubt, scaled)  # type: ignore[arg-type]
        at += record.n
    return felt


def _foreseen(
    search: Search, profiles: Profiles, rises: Mapping[str, Rises]
) -> dict[str, tuple[float, float]]:
    """Name -> the ends of its interval, of parameters beside which chi-squared rises so mildly that no refit tells
    more."""
    found = {}
    for name, own in rises.items():
        k = search.pmap.free.index(name)
        ends = own.ends(profiles.root * float(profiles.stretch[k]))
        if ends is not None and search.lower[k] < ends[0] and ends[1] < search.upper[k]:
            found[name] = (profiles.value(k, ends[0]), profiles.value(k, ends[1]))
    return found


def _stretch(white: Uncertainty, errors: Uncertainty) -> Array:
    """(nv,) by how much the errors of the parameters are larger than those of the likelihood."""
    nv = len(white.v)
    own, wide = (np.sqrt(np.diag(one.covariance.matrix)[:nv]) for one in (white, errors))
    return np.where(own > 0, wide / np.where(own > 0, own, 1.0), 1.0)


def _only(search: Search, slope: Array) -> str | None:
    """The free parameter that a quantity with this slope (nv,) depends on, if it is one alone."""
    (on,) = np.nonzero(slope)
    return search.pmap.free[on[0]] if len(on) == 1 else None


def _alike(one: Estimate, interval: tuple[float, float], root: float) -> bool:
    """True if an interval by profile is the one that ± means, ``root`` standard errors to either side."""
    half = root * (one.stderr or 0.0)
    return all(abs(abs(end - one.value) / half - 1) < UNEVEN for end in interval)


def _of(doubts: Sequence[Doubt], slope: Array, matrix: Array, *, but_shape: bool = False) -> Doubt | None:
    """The first doubt about a quantity with this slope (nv,) or (N,); but_shape : that is not on its shape alone."""
    wide = np.zeros(len(matrix))
    wide[: len(slope)] = slope
    return next((one for one in doubts if not (but_shape and one.shape) and one.about(wide, matrix)), None)


def _all_plain(doubts: Sequence[Doubt], slope: Array, matrix: Array) -> bool:
    """True if all doubts about a quantity with this slope (nv,) are told by how chi-squared rises beside it."""
    wide = np.zeros(len(matrix))
    wide[: len(slope)] = slope
    return all(one.plain for one in doubts if one.about(wide, matrix))


def _lower(doubts: Sequence[Doubt]) -> Doubt:
    """What is doubted where a profile came below the optimum."""
    text = f"the errors are not known: a profile met a lower optimum near by; search again with starts=10, or {CALL}"
    return Doubt(
        "lost", text, np.zeros_like(doubts[0].move)
    )  # none of the values is that of the lowest optimum


def _without_error(one: Estimate, doubt: Doubt, interval: tuple[float, float] | None) -> Estimate:
    why = _UNEVEN if doubt.profiles else _UNKNOWN
    return replace(one, stderr=None, why=why, interval=interval, quadratic=one.stderr)


def _through_ties(
    search: Search, errors: Uncertainty, name: str, slope: Array, ends: dict[str, tuple[float, float]]
) -> tuple[float, float] | None:
    """The interval of a reported quantity that depends on one parameter alone; None of any other."""
    only = _only(search, slope)
    if only not in ends:
        return None
    z, found = search.coordinates.values(errors.v), []
    for end in ends[only]:
        z[search.pmap.free.index(only)] = end
        found.append(search.pmap.values(z)[name])
    return min(found), max(found)
