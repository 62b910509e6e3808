"""Least squares in few unknowns within bounds, from Gram matrices alone: Levenberg-Marquardt steps.

The problem is given as half its summed squares, their gradient and the Gauss-Newton matrix: products of the residual
and its Jacobian, so that records of any length look alike, and unknowns that were projected out have left no trace
(Golub & Pereyra 1973). What Gauss-Newton leaves out of the Hessian is learnt from the gradients on the way by
symmetric rank-one updates, and used where it foretells the objective better (Dennis, Gay & Welsch 1981): where the
residual is large against weak directions, Gauss-Newton alone takes many times the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import ask

Array = NDArray[np.float64]

# Damping at first as a share of the diagonal, its least, and where the search gives up; its change after a step that
# falls as foretold, and after one that does not fall.
_DAMPING, _LEAST, _STUCK, _EASE, _HINDER = 1e-2, 1e-9, 1e9, 0.2, 6.0
# Damping with which a step that promises nothing is looked at again, and how often at most.
_SMALL, _LOOKS = 1e-6, 3
# Share of the foretold fall that makes a step, and the shares between which the damping stays.
_SHARE, _POOR, _GOOD = 1e-3, 0.25, 0.75
# Damping of the step back into a valley.
_STEEP = 1e-2
# A symmetric rank-one update is passed over where its denominator is so small a share of the sizes in it.
_SAFE = 1e-8
# Longest step after one that does not fall, as a share of that.
_SHORTER, _LONG = 0.5, 0.1


@dataclass(frozen=True)
class Squares:
    """Half the summed squares at a point, their gradient (n,) and Gauss-Newton matrix (n, n)."""

    cost: float
    gradient: Array
    matrix: Array


Evaluate = Callable[[Array], Squares | None]


@dataclass(frozen=True)
class Minimum:
    """Where a search ended: the point (n,), what it is worth, steps tried, and whether it is an optimum."""

    x: Array
    squares: Squares
    steps: int
    converged: bool


# Asks for points (n,), is sent what the problem is there, and ends with where it arrived.
Steps = Generator[Array, Squares | None, Minimum | None]


def minimise(evaluate: Evaluate, start: Array, low: Array, high: Array, **options: Any) -> Minimum | None:
    """A minimum within bounds from ``start`` (n,), or None where nothing can be evaluated there.

    evaluate : the problem at a point, None where it has no value; options : as ``steps_of`` has them
    """
    return driven([steps_of(start, low, high, **options)], lambda points: [evaluate(one) for one in points])[
        0
    ]


def driven(
    searches: Sequence[Steps], evaluate: Callable[[list[Array]], Sequence[Squares | None]]
) -> list[Minimum | None]:
    """Where searches end that go side by side: ``evaluate`` tells the problem at all points that they ask for."""
    found: list[Minimum | None] = [None] * len(searches)
    asked = {k: next(search) for k, search in enumerate(searches)}
    while asked:
        told, asked = dict(zip(asked, evaluate([*asked.values()]), strict=True)), {}
        for k, there in told.items():
            try:
                asked[k] = searches[k].send(there)
            except StopIteration as end:
                found[k] = end.value
    return found


def steps_of(
    start: Array,
    low: Array,
    high: Array,
    *,
    fall: float,
    steps: int = 100,
    damping: float = _DAMPING,
    longest: Callable[[Array], Array] = np.ones_like,
    stop: Callable[[float], bool] = lambda _: False,
    anew: Callable[[Array], Squares | None] = lambda _: None,
    round_bends: bool = True,
) -> Steps:
    """A search from ``start`` (n,) within bounds, which asks for the problem at a point and is sent it.

    fall : of the cost; a next step that promises less ends the search
    damping : of the first step, as a share of the diagonal
    longest : the longest change (n,) of each unknown in one step from a point
    stop : sees the cost before every step; True ends the search
    anew : the problem at a point from which a step did not fall, where it is known there more exactly by now
    round_bends : go on along valleys that bend; not where a part of the data leads, whose valleys lead nowhere
    """
    x = np.clip(start, low, high)
    here = yield x
    if here is None:
        return None
    learnt, trusted, reach, looked = np.zeros_like(here.matrix), False, 1.0, 0
    for count in range(steps):
        if stop(here.cost):
            return Minimum(x, here, count, converged=False)
        ask()
        room = (low - x, high - x, reach * longest(x))
        moved, foretold, short = _best_step(here, learnt if trusted else None, room, damping)
        if abs(foretold) < fall and not short and damping > _SMALL and looked < _LOOKS:
            damping, looked = _SMALL, looked + 1  # so much of it may hide what a weak direction promises
            moved, foretold, short = _best_step(here, learnt if trusted else None, room, damping)
        if abs(foretold) < fall and not short:
            return Minimum(x, here, count, converged=True)
        there = (yield x + moved) if foretold > 0 else None
        gained = -np.inf if there is None else here.cost - there.cost
        if there is not None:
            learnt, trusted = _learn(learnt, here, there, moved)
            if round_bends and gained < _SHARE * foretold:
                moved, there = yield from _back_into_valley(x, moved, there, (low, high, longest))
                gained = here.cost - there.cost
        if there is None or gained < _SHARE * foretold:
            if (exact := anew(x)) is not None:  # a value that is too low would refuse every step
                here = exact
                continue
            damping = max(_HINDER * damping, 1e-3)
            length = float(np.abs(moved / longest(x)).max(initial=0.0))
            reach = _SHORTER * min(length, 1.0) if length > _LONG else reach
            if damping > _STUCK:
                return Minimum(x, here, count, converged=foretold < fall)
            continue
        if gained > _GOOD * foretold:
            damping, reach = max(_EASE * damping, _LEAST), min(4 * reach, 1.0)
        elif gained < _POOR * foretold:
            damping = 2.0 * damping
        x, here = x + moved, there
    return Minimum(x, here, steps, converged=False)


def _back_into_valley(
    x: Array, moved: Array, there: Squares, limits: tuple[Array, Array, Callable[[Array], Array]]
) -> Generator[Array, Squares | None, tuple[Array, Squares]]:
    """A step that did not fall, and one more from where it ends, so damped that it goes along what is told well alone:
    a valley that bends is left by a straight step, and found again by this (Chamberlain et al. 1982). The first step
    as it was where the second does not help."""
    low, high, longest = limits
    at = x + moved
    back, promised, _ = _best_step(there, None, (low - at, high - at, longest(at)), _STEEP)
    again = (yield at + back) if promised > 0 else None
    return (moved, there) if again is None or again.cost >= there.cost else (moved + back, again)


def _best_step(
    here: Squares, learnt: Array | None, room: tuple[Array, Array, Array], damping: float
) -> tuple[Array, float, bool]:
    """The step with what was learnt, if that promises a fall, else Gauss-Newton's; see ``_step``."""
    found = None if learnt is None else _step(here, here.matrix + learnt, room, damping)
    if found is None or found[1] <= 0:
        found = _step(here, here.matrix, room, damping)
    return found or (np.zeros(len(here.gradient)), 0.0, False)


def _step(
    here: Squares, model: Array, room: tuple[Array, Array, Array], damping: float
) -> tuple[Array, float, bool] | None:
    """A damped step (n,), the fall that it foretells, and whether it was shortened; None where the model gives none.

    room : (n,) how far down and up the bounds are, and the longest change
    """
    low, high, longest = room
    moved, size, short = np.zeros(len(low)), np.diag(here.matrix), False
    free = (size > 0) & ~(((low >= 0) & (here.gradient > 0)) | ((high <= 0) & (here.gradient < 0)))
    while free.any():
        own, pull = model.copy(), here.gradient
        own.flat[:: len(own) + 1] += damping * size
        if not free.all():
            pull = (pull + model[:, ~free] @ moved[~free])[free]
            own = own[np.ix_(free, free)]
        try:
            factor = np.linalg.cholesky(own)
        except np.linalg.LinAlgError:
            return None
        moved[free] = -np.linalg.solve(factor.T, np.linalg.solve(factor, pull))
        share = float(np.abs(moved / longest).max())
        if share > 1.0:
            moved, short = moved / share, True
        over = free & ((moved < low) | (moved > high))
        if not over.any():
            break
        # what a bound cuts short stays there, the others make the best of it
        moved[over] = np.clip(moved[over], low[over], high[over])
        free &= ~over
    return moved, -float(here.gradient @ moved + 0.5 * moved @ model @ moved), short


def _learn(learnt: Array, here: Squares, there: Squares, moved: Array) -> tuple[Array, bool]:
    """What Gauss-Newton lacks, updated by a step, and whether the objective fell more as foretold with it."""
    gained = here.cost - there.cost
    plain = -float(here.gradient @ moved + 0.5 * moved @ here.matrix @ moved)
    better = abs(gained - plain + 0.5 * float(moved @ learnt @ moved)) < abs(gained - plain)
    wanted = there.gradient - here.gradient - there.matrix @ moved
    bent = float(moved @ learnt @ moved)
    if bent != 0:  # what was learnt far off may be far too large here
        learnt = learnt * min(1.0, abs(float(moved @ wanted) / bent))
    rest = wanted - learnt @ moved
    scale = float(rest @ moved)
    with np.errstate(over="ignore"):  # far off
        size = float(np.linalg.norm(rest) * np.linalg.norm(moved))
    if abs(scale) > _SAFE * size:
        learnt = learnt + np.outer(rest, rest) / scale
    return learnt, better
