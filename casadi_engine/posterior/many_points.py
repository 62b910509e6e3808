"""The likelihood at many points at once, the initial states integrated out by Laplace's method at each: what
``laplace_likelihood`` says of one point after the other, where the steps of the integration run side by side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.levenberg_marquardt import Squares
from casadi_engine.estimation.single_shots import SingleShots
from casadi_engine.posterior.states import StatePrior

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Parts = Sequence[tuple[Index, StatePrior]]

# Numbers that are held at once.
_ROOM = 4_000_000
# Change of a coordinate by which its slopes are told, as a share of its size where that is more than 1.
_STEP = 1e-5
# Share of how far a point lies below the best one by which chi-squared may still fall there, where that will do.
_ROUGH = 0.1


class ManyPoints:
    """Points of records in the standard deviations of their outputs, a (P,) array for each name; places of the unknown
    initial states of each record in x, and their prior.

    steps, fall : Gauss-Newton steps in these at a point, and the fall of chi-squared that ends them
    """

    def __init__(self, shots: SingleShots, parts: Parts, steps: int, fall: float) -> None:
        self._shots, self._parts, self._steps, self._fall = shots, parts, steps, fall
        self._states = np.concatenate([np.zeros(0, np.intp), *(where for where, _ in parts)])

    @property
    def room(self) -> int:
        """How many points are looked at together: as many as there is room for what they leave."""
        return max(_ROOM // (max(self._shots.count, 1) * (1 + len(self._states))), 1)

    def logs(self, x: Array, sigma: Mapping[str, Array]) -> Array:
        """Log likelihood (P,), but for the levels' share, at points x (P, nx) where the best initial states are
        expected; NaN where it has to be looked for by itself."""
        found = np.full(len(x), np.nan)
        for busy, total, _, _ in self._settled(x, sigma, self._states):
            found[busy] = total
        return np.where(np.isfinite(found), found, np.nan)

    def squares(
        self, x: Array, sigma: Mapping[str, Array], size: int, top: float
    ) -> tuple[list[Squares | None], float]:
        """Half the sums of squares, with slopes in the first ``size`` coordinates, the initial states at their best,
        and the largest log likelihood so far.

        top : the largest one before, far below which points need not be known so well; inf where all are to be
        """
        places = np.concatenate([self._states, np.arange(size)])
        left, slopes = (
            np.full((len(x), self._shots.count), np.nan),
            np.zeros((len(x), len(places), self._shots.count)),
        )
        for busy, total, rest, rows in self._settled(x, sigma, places, top):
            left[busy], slopes[busy] = rest, rows
            top = max(top, float(np.max(total, initial=-np.inf, where=np.isfinite(total))))
        return [self._squares(*one, size) for one in zip(left, slopes, strict=True)], top

    def _squares(self, left: Array, slopes: Array, size: int) -> Squares | None:
        rows = np.concatenate([left[None], slopes[len(slopes) - size :]])
        with np.errstate(all="ignore"):
            gram, at = rows @ rows.T, 0
            if not np.isfinite(gram).all():
                return None
            for where, own in self._parts:
                gram -= own.without(slopes[at : at + len(where)], rows)
                at += len(where)
        return (
            Squares(0.5 * float(gram[0, 0]), gram[1:, 0], gram[1:, 1:]) if np.isfinite(gram).all() else None
        )

    def _settled(
        self, x: Array, sigma: Mapping[str, Array], places: Index, top: float = -np.inf
    ) -> Iterator[tuple[Index, Array, Array, Array]]:
        """Step by step, of the points that still move (P',): their numbers, log likelihoods, residuals (P', K) that a
        line leads to at the prior's mean of the initial states, and slopes (P', m, K) at the places (m,), which begin
        with those of the initial states. Every other step takes the slopes that there are.

        top : a log likelihood below which chi-squared may be off by a share; inf for slopes of their own at every step
        """
        x, busy = x.copy(), np.arange(len(x))
        with np.errstate(all="ignore"):
            for _ in range(self._steps):
                residual, slopes = self._with_slopes(x[busy], _of(sigma, busy), places)
                for last in (True,) if top == np.inf else (False, True):
                    left, total, fell = self._moved(x, busy, residual, slopes)
                    yield busy, total, left, slopes
                    below = np.maximum(top - total, 0.0) if np.isfinite(top) else np.zeros(len(total))
                    more = fell > self._fall + _ROUGH * below  # what is not finite is looked at by itself
                    busy, slopes = busy[more], slopes[more]
                    if not len(busy):
                        return
                    if not last:
                        residual = self._shots.side_by_side(x[busy], _of(sigma, busy))

    def _moved(self, x: Array, busy: Index, residual: Array, slopes: Array) -> tuple[Array, Array, Array]:
        """Move the initial states of some points to their best by a line; the residuals (P', K) to which it leads at
        the prior's mean, log likelihoods (P',), and how far they moved, in squared standard errors."""
        at, left = x[busy], residual
        ends = np.cumsum([0, *(len(where) for where, _ in self._parts)])
        each = [slopes[:, a:b] for a, b in pairwise(ends)]
        for (where, own), rows in zip(self._parts, each, strict=True):
            left = left - ((at[:, where] - own.mean)[:, None] @ rows)[:, 0]
        squares = np.square(left).sum(axis=1)
        total, fell = -0.5 * squares, np.zeros(len(busy))
        for (where, own), rows in zip(self._parts, each, strict=True):
            log, best = own.integral(rows, left - own.mean @ rows)
            step = best - at[:, where]
            total = total + log + 0.5 * squares
            fell += np.square((step[:, None] @ rows)[:, 0]).sum(axis=1)
            fell += np.square(np.linalg.solve(own.factor, step.T)).sum(axis=0)
            x[np.ix_(busy, where)] = best
        return left, total, fell

    def _with_slopes(self, x: Array, sigma: Mapping[str, Array], places: Index) -> tuple[Array, Array]:
        """Residuals (P, K) at x (P, nx) and their slopes (P, m, K) at the places (m,)."""
        count, steps = len(x), _STEP * np.maximum(np.abs(x[:, places]), 1.0)
        every = np.repeat(x[None], 1 + len(places), axis=0)
        for k, place in enumerate(places):
            every[1 + k, :, place] += steps[:, k]
        levels = {name: np.tile(own, len(every)) for name, own in sigma.items()}
        moved = np.append(-1, places)
        found = self._shots.side_by_side(every.reshape(-1, x.shape[1]), levels, moved).reshape(
            len(every), count, -1
        )
        return found[0], (found[1:] - found[0]).transpose(1, 0, 2) / steps[..., None]


def _of(sigma: Mapping[str, Array], which: Index) -> dict[str, Array]:
    """The levels of some points."""
    return {name: own[which] for name, own in sigma.items()}
