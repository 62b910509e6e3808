"""How estimates move with what is at a bound, or at the limit of an inequality, and may be inside of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.uncertainty import Covariance

Array = NDArray[np.float64]

# Chi-squared by which the data may ask for less than a bound by chance, and standard errors of 95 %: a range counts as
# an error of so much less.
_CHANCE, _TWO_SIDED = 4.0, 1.96
# A variance below this share of what its parts would give is rounding: the constraints leave nothing open.
HELD = 1e-12


@dataclass(frozen=True)
class Active:
    """What holds an estimate: closed (N,) entries that are fixed or at a bound, and ``held`` of these at one; rows
    (c, N) of constraints that act, the equalities first; spans (k,) from limit to limit, of ``held`` and of the
    inequalities."""

    closed: NDArray[np.bool_]
    held: NDArray[np.intp]
    rows: Array
    spans: Array

    def moves(self) -> Array:
        """(N, k) moves of which each leaves one of the limits by a unit, and none of the others."""
        equal = len(self.rows) - (len(self.spans) - len(self.held))
        others = np.setdiff1d(np.flatnonzero(self.closed), self.held)
        identity = np.eye(len(self.closed))
        stacked = np.vstack([identity[self.held], self.rows[equal:], self.rows[:equal], identity[others]])
        return np.asarray(np.linalg.pinv(stacked)[:, : len(self.spans)])


def inside_limits(
    information: Array, found: Covariance, active: Active, gradient: Array
) -> tuple[Array | None, list[Array]]:
    """How all move (N, k) with what is at a bound or at the limit of an inequality, in the standard errors that these
    have inside it, None where they add nothing; and directions (N,) of which they leave nothing known.

    The data say that such a quantity is at its limit or inside by as much as its own error, which may be all of its
    range: the others move with it. Nothing is added where the data pull it beyond the limit by more than chance does.
    gradient : (N,) of half chi-squared
    """
    if not len(active.spans) or not np.isfinite(information).all():
        return None, []
    alone = active.moves()
    moved = alone - found.matrix @ (information @ alone)
    own = moved.T @ information @ moved
    reach = _TWO_SIDED / active.spans
    values, vectors = np.linalg.eigh((own + own.T) / 2 + np.diag(reach**2))
    lost = values <= HELD * max(float(np.einsum("ak,ab,bk->k", alone, information, alone).max()), 1e-300)
    known = vectors[:, ~lost] / np.sqrt(values[~lost])
    if float(((known.T @ (moved.T @ gradient)) ** 2).sum()) > _CHANCE:
        return None, []
    rest = np.where(active.closed[:, None], 0.0, moved)
    return moved @ known, list((rest @ vectors[:, lost]).T)
