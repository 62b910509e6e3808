"""The likelihood of any model, the initial states integrated out by Laplace's method.

The integral over the initial states is that of a normal density about their best values at each point of the
parameters, with their prior (``states``). For a linear model it is exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from casadi_engine.estimation.levenberg_marquardt import Squares
from casadi_engine.estimation.single_shots import SingleShots
from casadi_engine.posterior.states import StatePrior

Array = NDArray[np.float64]

# Gauss-Newton steps in the initial states at a point, and the fall of chi-squared that ends them.
_STEPS, _FALL = 5, 0.02


class LaplaceLikelihood:
    """Log likelihood of records at parameters v (nv,) and noise levels (ny,), the initial states integrated out."""

    bins: tuple[int, int] | None = None

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
        moving = ~np.concatenate(list(held.values()))
        self._free = self._size + np.flatnonzero(moving)
        # those that are known are held, and take no part in the others' prior
        mean, factor = (
            np.concatenate([one.mean for one in states]),
            block_diag(*(one.factor for one in states)),
        )
        covariance = (factor @ factor.T)[np.ix_(moving, moving)]
        self.states = StatePrior(mean[moving], np.linalg.cholesky(covariance))
        slopes = shots.evaluate(self._best)[1]
        # how the best initial states follow v
        seen = self.states.factor.T @ slopes[:, self._free].T
        known = np.eye(len(seen)) + seen @ seen.T
        self._turn = -self.states.factor @ np.linalg.solve(known, seen @ slopes[:, : self._size])

    def choose(self, points: object, sigma: Array, left_out: float = 0.0) -> None:
        """Nothing is left out here; see ``SpectralLikelihood``."""

    def value(self, v: Array, sigma: Array) -> float:
        """Log likelihood; -inf where the model cannot be evaluated."""
        found = self._settled(v, sigma)
        if found is None:
            return -np.inf
        total = -0.5 * (found[0] + found[1])
        for (_, name), at in self._shots.places.items():
            total -= (at.stop - at.start) * float(np.log(self._level(sigma, name)))
        return total if np.isfinite(total) else -np.inf

    def full(self, v: Array, sigma: Array) -> float:
        """The same: all samples are looked at anyway."""
        return self.value(v, sigma)

    def squares(self, v: Array, sigma: Array) -> Squares | None:
        """Half the sum of squares with slopes, the initial states at their best; None where there is none."""
        found = self._settled(v, sigma)
        if found is None:
            return None
        _, _, rest, slopes = found
        rows = np.concatenate(
            [(rest + slopes[:, self._free] @ self.states.mean)[None], slopes[:, : self._size].T]
        )
        seen = self.states.factor.T @ slopes[:, self._free].T
        cross = seen @ rows.T
        gram = rows @ rows.T - cross.T @ np.linalg.solve(np.eye(len(seen)) + seen @ seen.T, cross)
        if not np.isfinite(gram).all():
            return None
        return Squares(0.5 * float(gram[0, 0]), gram[1:, 0], gram[1:, 1:])

    def _level(self, sigma: Array, name: str) -> float:
        return float(sigma[self._outputs.index(name)])

    def _settled(self, v: Array, sigma: Array) -> tuple[float, float, Array, Array] | None:
        """Chi-squared at the best initial states, the log determinant of their integral, the residual (K,) that a line
        leads to from there at states of zero, and the slopes (K, nx)."""
        self._shots.weigh({name: self._level(sigma, name) for name in self._outputs})
        x = np.concatenate([v, self._best[self._size :]])
        x[self._free] += self._turn @ (v - self._at)
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                try:
                    residual, slopes = self._shots.evaluate(x)
                    rows = np.ascontiguousarray(slopes[:, self._free].T)
                    rest = residual - x[self._free] @ rows
                    squares, volume = self.states.marginal(rows, rest)
                    apart = np.linalg.solve(self.states.factor, x[self._free] - self.states.mean)
                    if float(residual @ residual + apart @ apart) - squares < _FALL:
                        break
                    x[self._free] = self.states.best(rows, rest)
                except (FloatingPointError, np.linalg.LinAlgError):
                    return None
        return squares, volume, rest, slopes
