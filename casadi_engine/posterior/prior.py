"""The prior of free parameters in the coordinates of a fit, normalised: what a posterior is made of beside the data."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from casadi_engine.errors import PosteriorError
from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.parameters.compiled import ParameterMap

Array = NDArray[np.float64]


class Prior:
    """Log density over v (nv,), the parameters' coordinates: logarithms of those with a positive lower bound.

    Flat between the bounds; a normal prior that the parameter set states is normal in the parameter itself, cut at the
    bounds. One on a tied parameter multiplies that of what it is tied to.
    Raises PosteriorError for a parameter without bounds and without a prior.

    words : name -> what it is
    """

    def __init__(self, pmap: ParameterMap, coordinates: Coordinates) -> None:
        self._coordinates = coordinates
        self.low, self.high = coordinates.of(pmap.lower), coordinates.of(pmap.upper)
        self._bounds = list(zip(pmap.lower.tolist(), pmap.upper.tolist(), strict=True))
        own = {one.label: (one.mean, one.sigma) for one in pmap.priors if one.label in pmap.free}
        self._normal = np.array([name in own for name in pmap.free], dtype=bool)
        self._mean, self._sigma = (
            np.array([own.get(name, (0.0, 1.0))[k] for name in pmap.free]) for k in (0, 1)
        )
        width = self.high - self.low
        open_ends = [
            name
            for name, wide, normal in zip(pmap.free, width, self._normal, strict=True)
            if not np.isfinite(wide) and not normal
        ]
        if open_ends:
            raise PosteriorError(
                "parameters without bounds have no posterior",
                seen=", ".join(
                    f"{name} from {pmap.lower[k]:g} to {pmap.upper[k]:g}"
                    for k, name in enumerate(pmap.free)
                    if name in open_ends
                ),
                allowed="finite bounds on both sides, or a normal prior, for every free parameter",
                cure=f'give bounds, pars["{open_ends[0]}"].set(min=..., max=...), or a prior, and fit again',
            )
        flat = ~self._normal
        self._constant = -float(np.log(width[flat]).sum())
        mean, sigma = self._mean[self._normal], self._sigma[self._normal]
        lower, upper = pmap.lower[self._normal], pmap.upper[self._normal]
        self._constant -= float(np.sum(_log_share((lower - mean) / sigma, (upper - mean) / sigma)))
        self._constant -= float(np.log(sigma * np.sqrt(2 * np.pi)).sum())
        tied = [one for one in pmap.priors if one.label not in pmap.free]
        self._tied = None
        if tied:
            rows = [(coordinates.substitute(one.expression) - one.mean) / one.sigma for one in tied]
            self._tied = ca.Function("tied", [coordinates.symbol], [ca.vertcat(*rows)])
            self._constant -= float(sum(np.log(one.sigma * np.sqrt(2 * np.pi)) for one in tied))
        self.words = {
            name: f"normal, {own[name][0]:.4g} ± {own[name][1]:.4g}"
            if name in own
            else f"flat in {'the logarithm' if log else 'the value'}, {low:.4g} to {high:.4g}"
            for name, log, low, high in zip(pmap.free, coordinates.log, pmap.lower, pmap.upper, strict=True)
        }

    def log_density(self, v: Array) -> Array:
        """(k,) at v (k, nv); -inf outside the bounds."""
        z, slope = (one[:, self._normal] for one in (self._coordinates.values(v), self._coordinates.slope(v)))
        total = self._constant - 0.5 * np.square(
            (z - self._mean[self._normal]) / self._sigma[self._normal]
        ).sum(axis=1)
        total += np.log(np.abs(slope)).sum(axis=1)
        if self._tied is not None:
            total -= 0.5 * np.square([np.asarray(self._tied(own))[:, 0] for own in v]).sum(axis=1)
        return np.where(((v >= self.low) & (v <= self.high)).all(axis=1), total, -np.inf)

    def marginal(self, k: int, values: Array) -> Array:
        """Density of one parameter at values in its unit, in its coordinate (v), without that of the tied ones."""
        if self._normal[k]:
            mean, sigma = self._mean[k], self._sigma[k]
            slope = (
                np.abs(values)
                if self._coordinates.log[k]
                else np.full_like(values, self._coordinates.scale[k])
            )
            return np.asarray(
                np.exp(-0.5 * ((values - mean) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi)) * slope
            )
        return np.full_like(values, 1.0 / (self.high[k] - self.low[k]))

    def share(self, k: int, low: float, high: float) -> float:
        """Probability of one parameter between two values in its unit, without that of the tied ones."""
        if self._normal[k]:
            ends = (np.array([low, high]) - self._mean[k]) / self._sigma[k]
            return float(np.exp(_log_share(ends[:1], ends[1:]))[0])
        width = self.high[k] - self.low[k]
        if self._coordinates.log[k]:
            return float(np.log(high / low) / width)
        return float((high - low) / self._coordinates.scale[k] / width)

    def bounds(self, k: int) -> tuple[float, float]:
        """The bounds of one parameter in its unit, infinite where there are none."""
        return self._bounds[k]

    def along(self, k: int, values: Array) -> Array:
        """(n,) values of one parameter, in its unit, in the coordinate in which the prior is flat."""
        return np.log(values) if self._coordinates.log[k] else np.asarray(values, dtype=float)

    def coordinate_slope(self, k: int, values: Array) -> Array:
        """dv/dz of one parameter at values in its unit: what makes a density in v one in the unit."""
        if self._coordinates.log[k]:
            return 1.0 / np.abs(values)
        return np.full_like(values, 1.0 / self._coordinates.scale[k])


def _log_share(low: Array, high: Array) -> Array:
    """Log probability of a standard normal variable between two numbers."""
    swap = low > 0
    upper, lower = np.where(swap, -low, high), np.where(swap, -high, low)
    a, b = log_ndtr(upper), log_ndtr(lower)
    return np.asarray(a + np.log1p(-np.exp(np.minimum(b - a, -1e-300))))
