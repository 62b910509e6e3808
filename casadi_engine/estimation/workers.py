"""The searches of one fit in several processes, each with a problem of its own."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import Deadline, TimeUp, ask, best_wanted, late, left
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.cut_short import so_far
from casadi_engine.estimation.interrupts import Interrupts
from casadi_engine.estimation.parallel import spread
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.spectral_start import Begun

Array = NDArray[np.float64]

# The search of the fit that this process (or thread of a cluster's worker) works on.
_own = threading.local()


@dataclass(frozen=True)
class _Piece:
    fit: str
    arguments: Mapping[str, Any]
    start: Array
    first: bool
    seconds: float
    beside: Begun | None = None


@dataclass
class Workers:
    """Runs starts of one fit in several processes (`spread`).

    arguments : of Search, but for progress and interrupts; jobs : as in `spread`
    interrupts : of this process; finished : called with every attempt when it is there
    """

    arguments: Mapping[str, Any]
    jobs: int | None
    interrupts: Interrupts
    finished: Callable[[Attempt], Any] | None = None
    _fit: str = field(default_factory=lambda: uuid.uuid4().hex)

    def outcomes(
        self, starts: list[Array], first: bool, beside: Begun | None = None
    ) -> Iterator[Attempt | EstimationError]:
        """The outcomes in the starts' order; after Ctrl-C, or once the time is over, those that are there."""
        pieces = [
            _Piece(self._fit, self.arguments, z, first and k == 0, left(), beside)
            for k, z in enumerate(starts)
        ]
        found: dict[int, Attempt | EstimationError] = {}
        try:
            for k, outcome in spread(_outcome, pieces, jobs=self.jobs):
                if outcome is None:  # the time was over before it had come to anything
                    continue
                found[k] = outcome
                if isinstance(outcome, Attempt) and self.finished is not None:
                    self.finished(outcome)
                # Ctrl-C on a terminal reaches the workers too, who end what they do; a signal to this process does not.
                if self.interrupts.stopped and not _ended(outcome):
                    break
        except Exception:
            if not self.interrupts.stopped:
                raise
        if not found or (late() and not best_wanted()):
            raise TimeUp
        yield from (found[k] for k in sorted(found))


def _ended(outcome: Attempt | EstimationError) -> bool:
    return isinstance(outcome, Attempt) and outcome.solution.status == "interrupted"


def _outcome(piece: _Piece) -> Attempt | EstimationError | None:
    """In the worker: the problem is set up once for a fit. None where the time was over before the first point."""
    with Deadline(piece.seconds):
        try:
            ask()
            if getattr(_own, "fit", None) != piece.fit:
                _own.interrupts = Interrupts()
                _own.search = Search(**piece.arguments, progress=None, interrupts=_own.interrupts)
                _own.fit = piece.fit
            with _own.interrupts:
                return _own.search.run(piece.start, first=piece.first, beside=piece.beside)
        except EstimationError as error:
            return error
        except TimeUp:
            known = getattr(_own, "fit", None) == piece.fit
            return so_far(_own.search, piece.start, "interrupted") if known else None
