"""Doubts about standard errors that come from elsewhere than the optimum's own shape: other optima, outputs that are
not followed, intervals that are not symmetric, and bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from casadi_engine.distributions import chi2_isf
from casadi_engine.estimation.doubt import CALL, Doubt
from casadi_engine.estimation.exchanged import twins
from casadi_engine.estimation.fit import Optimum
from casadi_engine.estimation.foreseen_ends import FAR, Rises
from casadi_engine.estimation.innovations import STABLE
from casadi_engine.estimation.limited_ends import Limits
from casadi_engine.estimation.nothing_left import is_white
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.standard_errors import Uncertainty

Array = NDArray[np.float64]

# Relative error from which a parameter that is searched by its logarithm has no symmetric interval: the ends of what is
# symmetric in the logarithm are then off by that share.
_WIDE = 0.15
# Chi-squared above the lowest at which another optimum still counts: it has exp(-5) of the likelihood, and where there
# is one there may be others that no start has met.
_RIVAL = 10.0
# Standard errors within which the end of another search is the same optimum, reached less exactly along a valley.
_BESIDE = 0.5
# Size of a residual over what an output varies by that is worse than a constant; fewest samples that say so.
_WORSE, _FEW = 1.1, 8
# Share of an output's variance beyond which a residual that is no noise is more than what the simulation follows.
_MORE = 0.5
# Chi-squared below which a place is no lower.
_LOWER = 0.1
# Share of half an interval by which its ends may lie elsewhere than ± has them for ± to be printed: a fifth of a
# standard error, which moves what an interval holds by 1 %. The ends of what is symmetric in a logarithm lie elsewhere
# by as much as its relative error.
UNEVEN = 0.1


def entries_of(search: Search, x: Array) -> Array:
    """The parameters and initial states (N,) of variables (size,)."""
    return np.concatenate([x[: search.problem.nv], *[lay.take(x)[0] for lay in search.problem.layouts]])


def rivals(search: Search, best: Attempt, errors: Uncertainty, optima: Sequence[Optimum]) -> list[Doubt]:
    """Other optima that the starts found, the data hardly tell from the best, and the errors do not hold anyway."""
    limit = best.cost + max(_RIVAL, chi2_isf(0.05, search.problem.nv))
    size = np.sqrt(np.maximum(np.diag(errors.covariance.matrix)[: search.problem.nv], 0.0))
    places = {
        id(one): search.coordinates.of(np.array([one.values[name] for name in search.pmap.free]))
        for one in optima
        if one.status == "converged" and one.apart and one.cost <= limit
    }
    others = [
        one
        for one in optima
        if id(one) in places and (np.abs(places[id(one)] - errors.v) > _BESIDE * size).any()
    ]
    found = []
    ways = "; ".join(
        f"{one.apart} at a cost {max(one.cost - best.cost, 0.0):.2g} higher" for one in others[:3]
    )
    text = (
        f"{len(others)} other optim{'a explain' if len(others) > 1 else 'um explains'} the data as well: {ways}; "
        f"the errors are not known, {CALL}"
    )
    for one in others:
        found.append(Doubt("rival", text, _with_states(errors, places[id(one)])))
    return found


def lost(search: Search, errors: Uncertainty, residuals: Sequence[Array]) -> list[Doubt]:
    """Outputs that a constant explains better than the simulation does, and records of which more is left than
    followed: hardly the lowest optimum, unless the model is another one, and either way no place to take errors from.
    """
    found = []
    for record, left in zip(search.records, residuals, strict=True):
        for name, own in record.grid.measured.items():
            k, r = search.levels.outputs.index(name), record.observation.series(left, name)
            noise = 0.0 if search.levels.estimated[k] else _WORSE**2  # of the level that was stated
            size = float(np.mean(r**2)) if len(r) >= _FEW else 0.0
            if not size > max(noise, _WORSE**2 * float(np.var(own.values)) / float(search.sigma[k]) ** 2):
                continue
            text = (
                f"a constant explains {record.experiment.name}/{name} better than the simulation does: the errors are "
                "not known; search from elsewhere, as by starts=10 or approach='prediction', or look what the model "
                "lacks"
            )
            found.append(Doubt("lost", text, np.zeros(len(errors.covariance.matrix))))
    return found or _left(search, errors, residuals)


def _left(search: Search, errors: Uncertainty, residuals: Sequence[Array]) -> list[Doubt]:
    """Records of which the simulation leaves more of every output than it follows, where that is no noise."""
    if search.noise.predicts:
        return []
    for record, left in zip(search.records, residuals, strict=True):
        coloured, names = False, list(record.grid.measured)
        for name in names:
            r = record.observation.series(left, name)
            valid = record.observation.series(record.observation.valid, name).astype(bool)
            level = float(search.sigma[search.levels.outputs.index(name)])
            varies = float(np.var(record.grid.measured[name].values)) / level**2
            if valid.sum() < _FEW or float(np.mean(r[valid] ** 2)) < _MORE * varies:
                break
            coloured = coloured or not is_white(np.where(valid, r, 0.0), valid)
        else:
            if not coloured:
                continue
            text = (
                f"more than half of the variance of {record.experiment.name}/{', '.join(names)} is left, and the "
                "residual is not white: the errors are not known; search from elsewhere, as by starts=10 or "
                "approach='prediction', or look what the model lacks"
            )
            return [Doubt("lost", text, np.zeros(len(errors.covariance.matrix)))]
    return []


def unstable(errors: Uncertainty) -> list[Doubt]:
    """A predictor at the limit of its stability: no noise has such a gain, and what the limit holds is not known."""
    if not any(name.startswith(STABLE) for name in errors.acting):
        return []
    text = (
        "the predictor rests at the limit of its stability, with a gain that no noise has: the errors are not known; "
        'give process="estimate", whose gain is one that noise can have, or noise of the measurement alone'
    )
    return [Doubt("lost", text, np.zeros(len(errors.covariance.matrix)))]


def exchanged(search: Search, errors: Uncertainty) -> list[Doubt]:
    """What explains the data as well: parameters of one unit with their values exchanged, or other signs."""
    found = []
    for twin in twins(search, errors, _RIVAL):
        kind = "lost" if twin.higher < -_LOWER else "rival"
        if kind == "lost":
            text = (
                f"the data are explained better with {twin} (chi-squared {-twin.higher:.2g} "
                "lower): this is not the lowest optimum; start from there, or search with starts=10"
            )
        else:
            apart = "bounds or known first states"
            if twin.pairs:
                one, other = twin.pairs[0]
                apart = f'bounds, or by pars.constrain("{one} - {other}", min=0) or max=0'
            text = (
                f"the data are explained as well with {twin} (chi-squared at most {max(twin.higher, 0.0):.2g} higher): "
                f"the errors of what differs there are not known; tell them apart by {apart}, or {CALL}"
            )
        there = np.concatenate([twin.v, *twin.starts])
        here = np.concatenate([errors.v, *(lay.take(errors.x)[0] for lay in search.problem.layouts)])
        moved = _with_states(errors, twin.v) if twin.pairs else there - here
        found.append(Doubt(kind, text, moved))
    return found


def _with_states(errors: Uncertainty, v: Array) -> Array:
    """The move (N,) from an optimum to a point v (nv,), the initial states going with it."""
    matrix, nv, moved = errors.covariance.matrix, len(v), v - errors.v
    return np.concatenate([moved, matrix[nv:, :nv] @ np.linalg.pinv(matrix[:nv, :nv]) @ moved])


def uneven(search: Search, errors: Uncertainty, rises: Mapping[str, Rises]) -> list[Doubt]:
    """Parameters whose interval has its ends elsewhere than ± has them."""
    found, values = [], search.coordinates.values(errors.v)
    slopes = search.coordinates.slope(errors.v)
    for name, own in rises.items():
        k, ends = search.pmap.free.index(name), own.ends(FAR)
        one = np.eye(1, len(errors.covariance.matrix), k)[0]
        half = FAR * own.size * slopes[k]
        at = [errors.v + (end - own.at) * one[: len(values)] for end in ends or ()]
        off = [abs(abs(search.coordinates.values(v)[k] - values[k]) / half - 1) for v in at]
        if max(off, default=np.inf) > UNEVEN:
            found.append(Doubt("uneven", f"the likelihood is not symmetric in {name}", one))
    return found


def bounds(search: Search, errors: Uncertainty, rises: Mapping[str, Rises]) -> list[Doubt]:
    """Parameters whose interval of two standard errors reaches a bound, is too wide to be symmetric as far as no rises
    are known, or is wider to the side to which they go with what is at a bound and may be inside."""
    found, matrix, low, high = [], errors.covariance.matrix, search.lower, search.upper
    kept, limits = errors.kept, Limits.of(search, errors)
    resting = [f"{n}, at a bound" for n, side in zip(search.pmap.free, errors.bound, strict=False) if side]
    for k, name in enumerate(search.pmap.free):
        value, size = errors.v[k], float(np.sqrt(matrix[k, k]))
        if errors.bound[k] is not False or not size:
            continue
        if not low[k] <= value - FAR * size < value + FAR * size <= high[k]:
            side = "lower" if value - FAR * size < low[k] else "upper"
            found.append((k, f"{name} reaches its {side} bound within {FAR:g} standard errors"))
        elif search.coordinates.log[k] and size > _WIDE and name not in rises:
            found.append((k, f"{name} is known to {100 * size:.2g} %"))
        elif size > (1 + _WIDE) * np.sqrt(max(kept[k, k], 0.0)):
            found.append((k, f"{name} is correlated with {' and '.join([*resting, *errors.acting])}"))
        else:
            end, words = min((limits.end(k, sign, FAR) for sign in (-1.0, 1.0)), key=lambda one: one[0])
            if end < (1 - UNEVEN) * FAR:
                found.append((k, f"{name} is correlated with {words} within {FAR:g} standard errors"))
    return [Doubt("bound", text, np.eye(len(matrix))[k]) for k, text in found]


def state_bounds(search: Search, errors: Uncertainty) -> list[Doubt]:
    """Initial states whose interval of two standard errors reaches a bound."""
    matrix, at, found = errors.covariance.matrix, search.problem.nv, []
    here, low, high = (entries_of(search, x) for x in (errors.x, search.lower, search.upper))
    for record in search.records:
        for k, state in enumerate(record.model.states, start=at):
            size = float(np.sqrt(max(matrix[k, k], 0.0)))
            below = here[k] - FAR * size < low[k]
            if size and errors.bound[k] is False and (below or here[k] + FAR * size > high[k]):
                side = "lower" if below else "upper"
                text = f"the first {state.name} of {record.experiment.name} reaches its {side} bound"
                found.append(Doubt("bound", f"{text} within {FAR:g} standard errors", np.eye(len(matrix))[k]))
        at += record.n
    return found
