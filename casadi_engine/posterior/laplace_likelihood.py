"""The likelihood of any model, the initial states integrated out by Laplace's method.

The integral over the initial states is that of a normal density about their best values at each point of the
parameters, with their prior (``states``). For a linear model it is exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.levenberg_marquardt import Squares
from casadi_engine.estimation.single_shots import SingleShots
from casadi_engine.posterior.states import StatePrior

Array = NDArray[np.float64]

# Gauss-Newton steps in the initial states at a point, and the fall of chi-squared that ends them.
_STEPS, _FALL = 5, 0.02


class LaplaceLikelihood:
    """Log likelihood of records at parameters v (nv,) and noise levels (ny,), the initial states integrated out."""

    bins: tuple[int, int] | None = None

    def untold(self, v: Array, sigma: Array) -> tuple[int, int]:  # noqa: ARG002
        """Not counted here."""
        return 0, 0

    def __init__(
        self,
        shots: SingleShots,
        first: Mapping[str, Array],
        v: Array,
        held: Mapping[str, NDArray[np.bool_]],
        states: Sequence[StatePrior],
    ) -> None:
        """first : record -> (n,) initial states of the optimum v, scaled; held : record -> (n,) those that are known;
        states : the prior of those of each record"""
        self._shots, self._size = shots, len(v)
        self._outputs = tuple(dict.fromkeys(output for _, output in shots.places))
        self._best, self._at = np.concatenate([v, *first.values()]), v
        self._last = self._best  # where the model was looked at last
        residual, slopes = shots.evaluate(self._best)
        # of each record: the places of its unknown initial states in x, and their prior; those that are known are
        # held, and take no part in the others' prior
        self._parts: list[tuple[NDArray[np.intp], StatePrior]] = []
        at = self._size
        for known, state in zip(held.values(), states, strict=True):
            moving = np.flatnonzero(~known)
            if len(moving):
                rows = slopes[:, at + moving].T
                rest = residual - self._best[at + moving] @ rows
                self._parts.append((at + moving, state.part(moving).settled(rows, rest)))
            at += len(known)
        # how the best initial states follow v
        self._turn = [
            own.best(slopes[:, where].T, one) - own.mean
            for one in slopes[:, : self._size].T
            for where, own in self._parts
        ]

    @property
    def states(self) -> list[StatePrior]:
        """Of each record with unknown initial states, their prior."""
        return [own for _, own in self._parts]

    def choose(self, points: object, sigma: Array, left_out: float = 0.0) -> None:
        """Nothing is left out here; see ``SpectralLikelihood``."""

    def integrate_finely(self, v: Array, sigma: Array) -> bool:
        """Shorter steps where those there are are too long for points v (P, nv), an optimum first; True if any are
        shorter now."""
        changed, lowest = False, np.inf
        for one in v:
            if self._settled(one, sigma) is None:
                continue
            with np.errstate(all="ignore"):
                try:
                    lowest = min(lowest, float(np.square(self._shots.residuals(self._last)).sum()))
                    changed |= self._shots.integrate_finely(self._last, lowest)
                except (FloatingPointError, np.linalg.LinAlgError):
                    continue
        return changed

    def value(self, v: Array, sigma: Array) -> Array:
        """Log likelihood (P,) at v (P, nv) and noise levels (P, ny); -inf where the model cannot be evaluated."""
        return np.array([self._value(*one) for one in zip(v, sigma, strict=True)])

    def _value(self, v: Array, sigma: Array) -> float:
        total = (
            self._without_slopes(v, sigma) if not self._parts else (self._settled(v, sigma) or [-np.inf])[0]
        )
        for (_, name), at in self._shots.places.items():
            total -= (at.stop - at.start) * float(np.log(self._level(sigma, name)))
        return total if np.isfinite(total) else -np.inf

    def _without_slopes(self, v: Array, sigma: Array) -> float:
        """The same where no initial state is unknown."""
        self._shots.weigh({name: self._level(sigma, name) for name in self._outputs})
        with np.errstate(all="ignore"):
            try:
                return -0.5 * float(np.square(self._shots.residuals(self._from(v))).sum())
            except (FloatingPointError, np.linalg.LinAlgError):
                return -np.inf

    def _from(self, v: Array) -> Array:
        """x where the best initial states are expected."""
        return np.concatenate([v, self._best[self._size :]])

    def full(self, v: Array, sigma: Array) -> Array:
        """The same: all samples are looked at anyway."""
        return self.value(v, sigma)

    def squares(self, v: Array, sigma: Array) -> Squares | None:
        """Half the sum of squares with slopes, the initial states at their best; None where there is none."""
        found = self._settled(v, sigma)
        if found is None:
            return None
        _, left, slopes = found
        rows = np.concatenate([left[None], slopes[:, : self._size].T])
        gram = rows @ rows.T
        for where, own in self._parts:
            gram -= own.without(slopes[:, where].T, rows)
        if not np.isfinite(gram).all():
            return None
        return Squares(0.5 * float(gram[0, 0]), gram[1:, 0], gram[1:, 1:])

    def _level(self, sigma: Array, name: str) -> float:
        return float(sigma[self._outputs.index(name)])

    def _settled(self, v: Array, sigma: Array) -> tuple[float, Array, Array] | None:
        """Log likelihood but for the noise levels' share, the residual (K,) that a line leads to from the best initial
        states at the prior's mean of them, and the slopes (K, nx)."""
        self._shots.weigh({name: self._level(sigma, name) for name in self._outputs})
        x = self._from(v)
        for i, (where, _) in enumerate(self._parts):
            for k, step in enumerate(v - self._at):
                x[where] += step * self._turn[k * len(self._parts) + i]
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                try:
                    residual, slopes = self._shots.evaluate(x)
                    left = residual.copy()
                    for where, own in self._parts:
                        left -= slopes[:, where] @ (x[where] - own.mean)
                    total, fall = -0.5 * float(left @ left), 0.0
                    for where, own in self._parts:
                        rows = np.ascontiguousarray(slopes[:, where].T)
                        alone = left - own.mean @ rows
                        (log,), (best,) = own.integral(rows[None], alone[None])
                        total, step = total + float(log) + 0.5 * float(left @ left), best - x[where]
                        fall += float(np.sum((step @ rows) ** 2))
                        fall += float(np.sum(np.linalg.solve(own.factor, step) ** 2))
                        x[where] = best
                except (FloatingPointError, np.linalg.LinAlgError):
                    return None
                if not fall > _FALL:
                    break
        self._last = x
        return (total, left, slopes) if np.isfinite(total) else None
