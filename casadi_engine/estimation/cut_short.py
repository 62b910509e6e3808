"""Searches that end early: one that costs many times what a better one did, and all of them once the time is over."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import Deadline, TimeUp, ask, best_wanted, late, lifted
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.ipopt import Solution
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.spectral_start import Begun
from casadi_engine.simulation.propagator import fineness_of

Array = NDArray[np.float64]
Made = TypeVar("Made")

# A start is given up that has cost, with those given up before it, so many times as much as the best one so far, and is
# not lower by this much of -2 log likelihood.
MANY, LOWER = 20.0, 1.0
# Units of work that any start may cost, a second or two: a search in the frequency domain integrates nothing.
FREE = 1e6
GIVEN_UP = (
    f"not converged: given up, for it cost, with others before it, {MANY:.0f} times as much as the best start and was "
    "not lower"
)


def in_time(work: Callable[[], Made], rest: Callable[[], Made] | None = None) -> Made:
    """What ``work`` makes; once the time is over what ``rest`` does (the same work), which no deadline holds.

    Raises TimeUp where the best so far is not wanted.
    """
    try:
        ask()
        return work()
    except TimeUp:
        if not best_wanted():
            raise
    with lifted():
        return (rest or work)()


def so_far(search: Search, z: Array, status: str) -> Attempt | None:
    """What the last run, from z (nz,), had come to when it was ended, without another evaluation; None for nothing.

    Where its intervals do not join yet its objective says nothing, and only one that is interrupted has nothing better.
    """
    best = search.solver.best or (None if search.reached else search.solver.last)
    reached = search.reached if best is None else (*best, search.sigma)
    if reached is None:
        return None
    objective, x, sigma = reached
    objective = np.inf if status == GIVEN_UP and search.solver.best is None else objective
    nothing = np.zeros(search.problem.rows), np.zeros(search.problem.size)
    solution = Solution(x, *nothing, status, search.solver.iterations, "")
    found = search.attempt(solution, objective, sigma.copy(), solution.iterations, z)
    found.cut = True
    return found


def fineness_kept(search: Search) -> Callable[[], None]:
    """What makes the integration as fine again as it is now: what one start asks for is not asked of the next."""
    before = [(record.propagator, fineness_of(record.propagator)) for record in search.records]

    def back() -> None:
        for record, (propagator, fineness) in zip(search.records, before, strict=True):
            known: Any = propagator
            if fineness is not None and hasattr(known, "refined"):
                known = known.refined(fineness)
            record.propagator = known
        search.problem.forget()

    return back


class Starts:
    """Runs one start after the other; the best one so far says what the next may cost."""

    def __init__(self, search: Search) -> None:
        self.search = search
        self._beside: Begun | None = None
        self._best: tuple[float, float] | None = None  # merit, and the least work that led to it
        self._lost = 0.0  # work of starts that were given up

    def __call__(
        self, starts: list[Array], first: bool, beside: Begun | None = None
    ) -> Iterator[Attempt | EstimationError]:
        """The outcome of every start; once the time is over that of the last one, if it has any."""
        self._beside = beside
        for k, start in enumerate(starts):
            try:
                attempt = self._run(start, first=first and k == 0)
            except EstimationError as error:
                yield error
                continue
            if attempt is None and first and k == 0:
                raise TimeUp
            if attempt is not None:
                yield attempt
            if attempt is None or attempt.solution.status == "interrupted":
                return

    def _run(self, start: Array, *, first: bool) -> Attempt | None:
        """One start; None where the time was over before it had come to anything."""
        allowed = np.inf if self._best is None else max(MANY * self._best[1] - self._lost, FREE)
        back = fineness_kept(self.search)
        attempt, work = self._within(start, allowed, first=first)
        if attempt is not None and attempt.cut and not late():
            back()
            if self._best is not None and attempt.merit < self._best[0] - LOWER:
                attempt, work = self._within(start, np.inf, first=first)
            else:
                self._lost += work
        if attempt is not None and attempt.solution.status == "converged":
            merit, least = self._best or (np.inf, np.inf)
            if attempt.merit < merit - LOWER:
                self._best = attempt.merit, work
            elif attempt.merit < merit + LOWER:  # the same optimum
                self._best = min(merit, attempt.merit), min(least, work)
        return attempt

    def _within(self, start: Array, allowed: float, *, first: bool) -> tuple[Attempt | None, float]:
        """One start that may cost so much, and its cost in units of work."""
        with Deadline(work=allowed) as own:
            try:
                found = self.search.run(start, first=first, beside=self._beside)
                return found, own.done
            except TimeUp:
                pass
        if not late():
            nothing = self._nothing(start)
            return so_far(self.search, start, GIVEN_UP) or nothing, own.done
        if not best_wanted():
            raise TimeUp
        return so_far(self.search, start, "interrupted"), own.done

    def _nothing(self, start: Array) -> Attempt:
        """A start that was given up before its first point."""
        search = self.search
        x = np.zeros(search.problem.size)
        x[: search.problem.nv] = search.coordinates.of(start)
        nothing = np.zeros(search.problem.rows), np.zeros(search.problem.size)
        solution = Solution(x, *nothing, GIVEN_UP, 0, "")
        found = search.attempt(solution, np.inf, search.sigma.copy(), 0, start)
        found.cut = True
        return found
