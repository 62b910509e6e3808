"""Coordinates without bounds, in which draws are proposed where an optimum rests on bounds and most of what is proposed
about it lies outside. They bend straight valleys, and are tried second.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, log_expit

from casadi_engine.posterior.drawn import Drawn
from casadi_engine.posterior.mixture import Mixture

Array = NDArray[np.float64]
LogDensity = Callable[[Array], Array]

# A bound within so many standard errors of the optimum cuts its quadratic; points nearer than the second are moved in.
_NEAR, _OFF = 2.0, 0.5


@dataclass(frozen=True)
class Box:
    """y = log((u - low) / (high - u)) where both bounds are finite, else y = u; all (d,)."""

    low: Array
    high: Array

    @classmethod
    def none(cls, like: Array) -> Box:
        """That leaves all (d,) coordinates as they are."""
        return cls(np.full(len(like), -np.inf), np.full(len(like), np.inf))

    @classmethod
    def about(cls, at: Array, scale: Array, low: Array, high: Array) -> Box:
        """For the bounds that lie near an optimum u (d,) with covariance ``scale`` (d, d); others are left where they
        are."""
        room = np.minimum(at - low, high - at)
        far = room > _NEAR * np.sqrt(np.diag(scale))
        return cls(np.where(far, -np.inf, low), np.where(far, np.inf, high))

    @property
    def closed(self) -> NDArray[np.bool_]:
        """(d,) coordinates that have bounds."""
        return np.isfinite(self.low) & np.isfinite(self.high)

    def of(self, u: Array) -> Array:
        """y (..., d) at u (..., d) inside."""
        low, high = self._ends()
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.closed, np.log(u - low) - np.log(high - u), u)

    def back(self, y: Array) -> Array:
        """u (..., d) at y (..., d)."""
        low, high = self._ends()
        return np.where(self.closed, np.clip(low + (high - low) * expit(y), low, high), y)

    def log_slope(self, y: Array) -> Array:
        """Log of the volume du / dy (...,) at y (..., d)."""
        low, high = self._ends()
        logs = np.log(high - low) + log_expit(y) + log_expit(-y)
        return np.asarray(np.where(self.closed, logs, 0.0).sum(axis=-1))

    def density(self, log_density: LogDensity) -> LogDensity:
        """That of y, from that of u."""
        return lambda y: log_density(self.back(y)) + self.log_slope(y)

    def mixture(self, share: Array, at: Array, scale: Array) -> Mixture:
        """Components at u (k, d) with scale matrices (k, d, d), in y."""
        error = np.sqrt(np.diagonal(scale, axis1=1, axis2=2))
        off = np.minimum(_OFF * error, 0.4 * (self.high - self.low))
        y = self.of(np.clip(at, self.low + off, self.high - off))
        low, high = self._ends()
        slope = np.where(self.closed, (high - low) * expit(y) * expit(-y), 1.0)
        return Mixture.of(share, y, scale / (slope[:, :, None] * slope[:, None, :]))

    def drawn(self, found: Drawn) -> Drawn:
        """Draws of y as those of u."""
        chains = None if found.chains is None else self.back(found.chains)
        return replace(
            found, u=self.back(found.u), density=found.density - self.log_slope(found.u), chains=chains
        )

    def _ends(self) -> tuple[Array, Array]:
        return np.where(self.closed, self.low, 0.0), np.where(self.closed, self.high, 1.0)
