"""Several searches: from drawn starts, from either side of an optimum along what the data tell least of, and in the
frequency domain from all around it.

Where a mode is buried in noise, its frequency is at an optimum on many lines of the noise, and a search ends at the one
that its start leads to. How far apart these lie, what is told by the frequencies below the mode says: the best optimum
is left by steps that are drawn from there, and the search goes on from a lower one (basin hopping; Wales & Doye 1997).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import TimeUp, best_wanted
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.cut_short import LOWER, Starts, in_time
from casadi_engine.estimation.fit import Optimum
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.spectral_start import Begun
from casadi_engine.estimation.standard_errors import uncertainty

Array = NDArray[np.float64]

# Two optima are one when their costs and their scaled parameters agree to these shares.
_SAME_COST, _SAME_PLACE = 1e-6, 1e-3
# So they are when a move from one to the other changes chi-squared by less than this, and their costs by no more.
_SAME_NOISE = 1e-2
# Distance of a neighbouring start from the optimum in standard errors.
_APART = 5.0
# A lower cost than this counts as another optimum to go on from; a valley is followed over at most so many.
_LOWER, _MOST = 1e-3, 8
# Cosine of the angle within which a direction leads back to where the search came from.
_BACK = 0.5
# Searches around an optimum that are enough where all of them came back to it; otherwise so many in a row, where there
# are fewer parameters. They may cost as much as those before, or this many steps times bins, some seconds.
_BACK_HOME, _FEWEST, _WORK = 3, 8, 6e6


# The outcomes of several starts, the set's own among them or not, each an Attempt or the error that it met; beside an
# optimum in the frequency domain, a lower one than which is looked for.
Outcomes = Callable[[list[Array], bool, "Begun | None"], Iterator[Attempt | EstimationError]]


def attempts_from(
    search: Search,
    starts: list[Array],
    neighbours: int = 0,
    *,
    outcomes: Outcomes | None = None,
    enough: Callable[[Search, Attempt], bool] | None = None,
) -> list[Attempt]:
    """The outcome of every start up to an interruption; starts at which the model fails are passed over, if it does not
    fail at all of them.

    Around an optimum in the frequency domain, where a look costs little, others are always looked for if low
    frequencies leave room for some; what is found there counts as an attempt only if it is another optimum.
    outcomes : runs several starts at a time, in their order (see ``workers``); None runs one after the other
    enough : says of the first attempt that no other start is asked for
    """
    attempts: list[Attempt] = []
    run = outcomes or Starts(search)
    try:
        try:
            if enough is not None and len(starts) > 1:
                with suppress(EstimationError):  # the others may do
                    _tried(run, attempts, starts[:1])
                if attempts:
                    starts = [] if enough(search, attempts[0]) else starts[1:]
            if not interrupted(attempts) and _tried(run, attempts, starts):
                if neighbours:
                    _follow(search, run, attempts, neighbours)
                if best_of(attempts).pending and not interrupted(attempts):
                    search.quiet, asked = True, len(attempts)
                    _hop(search, run, attempts)
                    attempts[asked:] = _others(attempts, asked)
        except TimeUp:
            if not attempts or not best_wanted():
                raise
        finally:
            search.quiet = False
        return in_time(lambda: _finished(search, attempts))
    finally:
        search.close()


def _others(attempts: list[Attempt], asked: int) -> list[Attempt]:
    """Of the attempts beyond those that were asked for, the optima at which none before has ended."""
    return [
        one
        for k, one in enumerate(attempts[asked:], start=asked)
        if one.solution.status in ("converged", "interrupted")
        and not any(_alike(before, one) for before in attempts[:k])
    ]


def _finished(search: Search, attempts: list[Attempt]) -> list[Attempt]:
    """The attempts, those at the best optimum with their last steps on all samples."""
    while (best := best_of(attempts)).pending:
        last = search.finished(best)
        attempts = [
            replace(last, start=attempt.start, iterations=attempt.iterations)
            if _alike(best, attempt)
            else attempt
            for attempt in attempts
            if attempt is not best
        ] + [last]
    return attempts


def _alike(one: Attempt, other: Attempt) -> bool:
    """True if two searches ended at one optimum, within a tenth of a standard error, as far as that is known."""
    begun = one.begun or other.begun
    if begun is None or abs(one.merit - other.merit) > _SAME_NOISE:
        return False
    apart = other.v - one.v
    return bool(apart @ begun.found.information @ apart < _SAME_NOISE)


def interrupted(attempts: list[Attempt]) -> bool:
    """True if a search was ended by the user."""
    return any(attempt.solution.status == "interrupted" for attempt in attempts)


def _tried(run: Outcomes, attempts: list[Attempt], starts: list[Array], beside: Begun | None = None) -> bool:
    """Add the outcomes of these starts, beside an optimum up to one that is lower; False if the user ended them."""
    first, fault = not attempts, None
    known = best_of(attempts).merit if attempts else -np.inf
    for outcome in run(starts, first, beside):
        if isinstance(outcome, EstimationError):
            fault = fault or outcome
            continue
        attempts.append(outcome)
        if beside is not None and best_of(attempts).merit < known - _LOWER:
            break
    if fault is not None and not attempts:  # the set's own values, and all that were drawn
        raise fault
    return not interrupted(attempts)


def _follow(search: Search, run: Outcomes, attempts: list[Attempt], neighbours: int) -> None:
    """Search from either side of the best optimum, and on from a lower one found so."""
    before = None
    for _ in range(_MOST):
        best = best_of(attempts)
        if best.solution.status != "converged":
            return
        beside = best.begun if best.pending else None
        if not _tried(run, attempts, _neighbours(search, best, neighbours, before), beside):
            return
        if best_of(attempts).merit > best.merit - _LOWER:
            return
        before = best.v


def _hop(search: Search, run: Outcomes, attempts: list[Attempt]) -> None:
    """Search in the frequency domain from where the low frequencies alone lead, and from draws around the best optimum,
    and on from a lower one, until as many in a row as there are parameters have led to none; a few are enough where all
    came back."""
    random, low, high = np.random.default_rng(0), *_ends(search)
    best, least, fruitless, strayed, first = best_of(attempts), best_of(attempts).merit, 0, False, True
    enough, left = max(len(best.v), _FEWEST), max(_work(attempts), _WORK)
    while best.begun is not None and fruitless < enough and left > 0:
        others = search.spectral.others(best.begun)
        if not others.ways or (fruitless >= _BACK_HOME and not strayed):
            return
        if not first:
            at = best.v + others.ways[random.integers(len(others.ways))] @ random.standard_normal(len(best.v))
        else:
            at = search.spectral.from_below(best.start, best.begun)
        start, before = search.coordinates.values(np.clip(at, low, high)), len(attempts)
        if not _tried(run, attempts, [start], best.begun):
            return
        left -= max(_work(attempts[before:]), 1)
        strayed = strayed or any(
            one.begun.found.strayed for one in attempts[before:] if one.begun is not None
        )
        best, fruitless = best_of(attempts), fruitless + 1
        if best.merit < least - LOWER:
            least, fruitless = best.merit, 0
            strayed = strayed and not first  # where low frequencies lead is a start like any other
        first = False


def _work(attempts: list[Attempt]) -> float:
    """The steps of searches in the frequency domain, times the bins that they looked at."""
    return sum(one.begun.steps * one.begun.found.kept for one in attempts if one.begun is not None)


def _ends(search: Search) -> tuple[Array, Array]:
    """The bounds of all coordinates (nv,)."""
    return search.coordinates.of(search.pmap.lower), search.coordinates.of(search.pmap.upper)


def _neighbours(search: Search, best: Attempt, count: int, before: Array | None) -> list[Array]:
    """Points (nz,) on either side of an optimum along the ``count`` directions of the largest errors, but for those
    that lead back to where the search came from (nv,)."""
    steps, information = _steps(search, best, count)
    low, high = _ends(search)
    found = []
    for step in steps:
        for side in (-1.0, 1.0):
            if before is None or _cosine(side * step, before - best.v, information) < _BACK:
                at = np.clip(best.v + side * step, low, high)
                found.append(search.coordinates.values(at))
    return found


def _steps(search: Search, best: Attempt, count: int) -> tuple[list[Array], Array]:
    """Steps (nv,) to neighbouring starts, and the information (nv, nv) that they are measured in."""
    nv = len(best.v)
    if best.begun is not None and best.pending:
        covariance = np.asarray(np.linalg.pinv(best.begun.found.information), dtype=np.float64)
    else:
        search._weigh(best.sigma)
        covariance = uncertainty(search, best).covariance.matrix[:nv, :nv]
    if not np.isfinite(covariance).all():  # no slopes at this optimum: there is no direction to go
        return [], covariance
    values, vectors = np.linalg.eigh(covariance)
    sizes = _APART * np.sqrt(np.maximum(values, 0.0))
    order = np.argsort(values)[::-1][:count]
    return [sizes[k] * vectors[:, k] for k in order], np.asarray(np.linalg.pinv(covariance))


def _cosine(one: Array, other: Array, metric: Array) -> float:
    size = np.sqrt((one @ metric @ one) * (other @ metric @ other))
    return float(one @ metric @ other / size) if size > 0 else 0.0


def best_of(attempts: list[Attempt]) -> Attempt:
    """The best optimum; without one, the best point."""
    return min(attempts, key=lambda a: (a.solution.status != "converged", not a.run, a.merit))


def settled(search: Search, attempts: list[Attempt]) -> tuple[Attempt, list[Attempt]]:
    """The best optimum, integrated finely and in one run, and all attempts; where a simulation from its first states is
    another than its intervals, the next best one."""
    while (found := best_of(attempts)).run:
        best = search.integrated(found)
        attempts = [best if attempt is found else attempt for attempt in attempts]
        if best.run:
            return best, attempts
    return found, attempts


def distinct_optima(search: Search, attempts: list[Attempt], best: Attempt) -> tuple[Optimum, ...]:
    """Distinct optima by rising cost at the best one's noise levels, and how many starts ended there."""
    compared = [best]
    if len(attempts) > 1:
        compared = [replace(attempt, cost=search.cost_of(attempt, best.sigma)) for attempt in attempts]
    groups: list[list[Attempt]] = []
    for attempt in sorted(compared, key=lambda a: a.cost):
        for group in groups:
            gap = abs(attempt.cost - group[0].cost)
            apart = np.abs(attempt.v - group[0].v).max(initial=0.0)
            near = gap <= _SAME_COST * abs(group[0].cost) and apart <= _SAME_PLACE
            if near or _alike(group[0], attempt):
                group.append(attempt)
                break
        else:
            groups.append([attempt])
    names = search.pmap.free
    reference = search.coordinates.values(best.v)
    # an optimum is shown as the fit has it, where that is one of those that ended there
    shown = [next((a for a in group if np.array_equal(a.v, best.v)), group[0]) for group in groups]
    return tuple(
        Optimum(
            one.cost,
            dict(zip(names, (z := search.coordinates.values(one.v)).tolist(), strict=True)),
            len(group),
            one.solution.status,
            _apart(names, reference, z),
            _begun(search, one),
        )
        for one, group in zip(shown, groups, strict=True)
    )


def _begun(search: Search, one: Attempt) -> dict[str, dict[str, float]]:
    """The first states of an attempt, record -> state -> value; none before it has looked at all samples."""
    if len(one.solution.x) != search.problem.size:
        return {}
    states = [state.name for state in search.model.states]
    return {
        record.experiment.name: dict(
            zip(states, (lay.take(one.solution.x)[0] * record.scale).tolist(), strict=True)
        )
        for record, lay in zip(search.records, search.problem.layouts, strict=True)
    }


def _apart(names: tuple[str, ...], best: Array, z: Array) -> str:
    """How a point differs from the best one, in words: the three largest changes."""
    size = np.where(best == 0, 1.0, np.abs(best))
    change = (z - best) / size
    order = [k for k in np.argsort(-np.abs(change)) if abs(change[k]) > _SAME_PLACE][:3]
    return ", ".join(f"{names[k]} {100 * change[k]:+.3g} %" for k in order)
