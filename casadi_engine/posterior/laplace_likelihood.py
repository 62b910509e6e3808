"""The likelihood of any model, the initial states integrated out by Laplace's method.

The integral over the initial states is that of a normal density about their best values at each point of the
parameters, with their prior as in ``spectral_likelihood``. For a linear model it is exact.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.levenberg_marquardt import Squares
from casadi_engine.estimation.single_shots import SingleShots
from casadi_engine.posterior.modal import least_squares

Array = NDArray[np.float64]

# Gauss-Newton steps in the initial states at a point, and the fall of chi-squared that ends them.
_STEPS, _FALL = 5, 0.02


class LaplaceLikelihood:
    """Log likelihood of records at parameters v (nv,) and noise levels (ny,), the initial states integrated out."""

    bins: tuple[int, int] | None = None

    def __init__(
        self, shots: SingleShots, first: Mapping[str, Array], v: Array, held: Mapping[str, NDArray[np.bool_]]
    ) -> None:
        """first : record -> (n,) initial states of the optimum v, scaled; held : record -> (n,) those that are known"""
        self._shots, self._size = shots, len(v)
        self._outputs = tuple(dict.fromkeys(output for _, output in shots.places))
        self._best, self._at = np.concatenate([v, *first.values()]), v
        moving = ~np.concatenate(list(held.values()))
        self._free = self._size + np.flatnonzero(moving)
        slopes = shots.evaluate(self._best)[1]
        # how the best initial states follow v
        self._turn = -np.linalg.lstsq(slopes[:, self._free], slopes[:, : self._size], rcond=1e-10)[0]

    def choose(self, points: object, sigma: Array, left_out: float = 0.0) -> None:
        """Nothing is left out here; see ``SpectralLikelihood``."""

    def value(self, v: Array, sigma: Array) -> float:
        """Log likelihood; -inf where the model cannot be evaluated."""
        found = self._settled(v, sigma)
        if found is None:
            return -np.inf
        total = -0.5 * found[0]
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
        _, residual, slopes = found
        rows = np.concatenate([residual[None], slopes[:, : self._size].T])
        starts = slopes[:, self._free]
        basis = np.linalg.qr(starts)[0] if starts.size else starts
        rows = rows - (rows @ basis) @ basis.T
        gram = rows @ rows.T
        if not np.isfinite(gram).all():
            return None
        return Squares(0.5 * float(gram[0, 0]), gram[1:, 0], gram[1:, 1:])

    def _level(self, sigma: Array, name: str) -> float:
        return float(sigma[self._outputs.index(name)])

    def _settled(self, v: Array, sigma: Array) -> tuple[float, Array, Array] | None:
        """Chi-squared at the best initial states, residual (K,) and slopes (K, nx)."""
        self._shots.weigh({name: self._level(sigma, name) for name in self._outputs})
        x = np.concatenate([v, self._best[self._size :]])
        x[self._free] += self._turn @ (v - self._at)
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                try:
                    residual, slopes = self._shots.evaluate(x)
                    starts = slopes[:, self._free]
                    squares = least_squares(np.ascontiguousarray(starts.T), residual)
                    if float(residual @ residual) - squares < _FALL:
                        break
                    x[self._free] -= np.linalg.lstsq(starts, residual, rcond=1e-10)[0]
                except (FloatingPointError, np.linalg.LinAlgError):
                    return None
        return squares, residual, slopes
