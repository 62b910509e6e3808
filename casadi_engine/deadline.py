"""One deadline for all that runs under it: every integration, step of a search and pass over candidates asks it.

``with Deadline(15.0):`` sets it, for everything that is called within, however deep; whatever may last calls ``ask()``,
which raises `TimeUp` once the time is over. Who has an answer without what was under way handles that, everyone else
lets it pass. Deadlines inside each other hold together: the first one that is over counts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar, Token


class TimeUp(BaseException):
    """The time is over. No Exception: what handles a model that fails is not to take it for one."""


class Deadline:
    """A time by which what runs under it ends, in seconds from when it is made, or in work.

    seconds : of ``clock``, which people wait for; spare : seconds of ``effort``, the processor's, behind the end in
    which an answer may be made of what was found
    work : units that ``ask(work)`` may count under it, about one a step of the integration of one interval, the same on
    every machine; done : units so far
    best : what runs directly under it gives the best that it has when the time is over, in place of `TimeUp`
    """

    def __init__(
        self,
        seconds: float = math.inf,
        *,
        spare: float = 0.0,
        work: float = math.inf,
        best: bool = False,
        clock: Callable[[], float] = time.perf_counter,
        effort: Callable[[], float] = time.process_time,
    ) -> None:
        self.spare, self.work, self.best, self.clock, self.effort = spare, work, best, clock, effort
        self.end = clock() + seconds
        self.done, self.stopped = 0.0, False
        self.outer: Deadline | None = None
        self._more, self._passed = 0.0, math.inf  # spare time that holds now; effort when the end had come
        self._token: Token[Deadline | None] | None = None

    def __enter__(self) -> Deadline:
        self.outer = _current.get()
        self._token = _current.set(self)
        return self

    def __exit__(self, *_: object) -> None:
        assert self._token is not None  # it was entered
        _current.reset(self._token)

    def stop(self) -> None:
        """The time is over now; at any instant, also between two steps of the program by a signal."""
        self.stopped = True
        self.end, self._passed = min(self.end, self.clock()), min(self._passed, self.effort())

    @property
    def over(self) -> bool:
        """True once this one is over, whatever those around it are."""
        if self.done > self.work:
            return True
        if self._passed == math.inf:
            if self.end == math.inf or self.clock() < self.end + min(self._more, 0.0):
                return False
            if self._more < 0:  # time that is kept for later
                return True
            self._passed = self.effort()
        return not self._more or self.effort() - self._passed >= self._more

    @property
    def late(self) -> bool:
        """True once this one or one around it is over."""
        return self.over or (self.outer is not None and self.outer.late)

    @property
    def left(self) -> float:
        """Seconds to the end, of this one and those around it, spare time included; inf without an end."""
        own = self.end + self._more - self.clock()
        return own if self.outer is None else min(own, self.outer.left)

    @contextmanager
    def spared(self, share: float) -> Iterator[None]:
        """Within it the end is later, by this share of the spare time; earlier, by as much, where it is negative."""
        before, self._more = self._more, share * self.spare
        try:
            yield
        finally:
            self._more = before


_current: ContextVar[Deadline | None] = ContextVar("deadline", default=None)


def ask(work: float = 0.0) -> None:
    """Raise `TimeUp` once the time is over; work : units that are about to be done."""
    here, over = _current.get(), False
    while here is not None:
        here.done += work
        over = over or here.over
        here = here.outer
    if over:
        raise TimeUp


def late() -> bool:
    """True once the time is over."""
    here = _current.get()
    return here is not None and here.late


def was_stopped() -> bool:
    """True if someone has stopped a deadline that holds here."""
    here = _current.get()
    while here is not None and not here.stopped:
        here = here.outer
    return here is not None


def is_set() -> bool:
    """True under a deadline."""
    return _current.get() is not None


def left() -> float:
    """Seconds that are left; inf without a deadline."""
    here = _current.get()
    return math.inf if here is None else here.left


def work_left() -> float:
    """Units of work that may still be done; inf where none are counted."""
    here, least = _current.get(), math.inf
    while here is not None:
        least, here = min(least, here.work - here.done), here.outer
    return max(least, 0.0)


def ending_before(seconds: float, share: float) -> AbstractContextManager[object]:
    """A deadline so many seconds before the one that holds, but for no more than a share of what is left until then;
    none where none holds."""
    until = left()
    return Deadline(until - min(seconds, share * until)) if math.isfinite(until) else nullcontext()


def best_wanted() -> bool:
    """True if what runs here is to give the best that it has once the time is over."""
    here = _current.get()
    return here is None or here.best


@contextmanager
def lifted() -> Iterator[None]:
    """Within it no deadline holds: the little without which there is no answer at all."""
    token = _current.set(None)
    try:
        yield
    finally:
        _current.reset(token)


@contextmanager
def unmetered() -> Iterator[None]:
    """Within it the innermost deadline counts no work; its time goes on."""
    here = _current.get()
    before = math.inf if here is None else here.work
    if here is not None:
        here.work = math.inf
    try:
        yield
    finally:
        if here is not None:
            here.work = before
