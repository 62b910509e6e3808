"""A gap on fresh data, parted into what errors of the parameters explain and the rest; linear, and exact for that.

The residual on fresh data is r = e + A (z_fit - z_true), with e white of unit variance and P (z_fit - z_true) ~ N(0, I)
from the fit; initial states, and directions that the fit's data do not determine, are columns of A without a row in P.
What A does not reach is noise alone, and the tests of the residual look at it. How far the parameters have to be moved
for the rest is judged by P: with

    T = min |r - A d|^2 + |P d|^2  -  min |r - A d|^2,

T is chi-squared with as many degrees of freedom as directions that the fit and the fresh data both determine, and
independent of the first part. Both together use all that the data say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casadi_engine.distributions import chi2_sf, f_sf
from casadi_engine.estimation.fit_percent import FloatArray
from casadi_engine.validation.projection import REPEATED, orthonormal

# Share of the information on a direction below which an output's residual is not moved by fitting it.
_FELT = 0.01


def felt(own: FloatArray) -> FloatArray:
    """(n, k) of the directions (n, r) that one output determines by a share that counts: what the other ones and the
    fit determine takes nothing of its residual."""
    _, share, right = np.linalg.svd(own, full_matrices=False)
    return np.asarray(own @ right[share**2 > _FELT].T)


@dataclass(frozen=True, eq=False)
class PriorSplit:
    """value : T; dof : its degrees of freedom; share : of its variance that comes from errors of the fit; step : (p,)
    of the columns at the least sum, covariance : (p, p) of it; within : (N,) what it leaves of the residual; noise :
    (N,) what A does not reach, and rank : of A; frame : (N, r) orthonormal directions that data and fit determine,
    where they move the data"""

    value: float
    dof: int
    share: float
    step: FloatArray
    covariance: FloatArray
    within: FloatArray
    noise: FloatArray
    rank: int
    frame: FloatArray

    @staticmethod
    def of(residual: FloatArray, slopes: FloatArray, rows: FloatArray, offset: FloatArray) -> PriorSplit:
        """residual (N,), slopes A (N, p), rows P (m, p), offset (m,): P d + offset ~ N(0, I)."""
        reach = orthonormal(slopes) if slopes.size else np.zeros((len(residual), 0))
        noise = residual - reach @ (reach.T @ residual)
        both = np.vstack([slopes, rows])
        size = np.linalg.norm(both, axis=0)
        size = np.where(size > 0, size, 1.0)
        left, strength, right = np.linalg.svd(both / size, full_matrices=False)
        seen = strength > REPEATED * strength.max(initial=0.0)
        left, right, strength = left[:, seen], right[seen], strength[seen]
        root = (right.T / strength) / size[:, None]
        target = np.concatenate([residual, -offset])
        step = root @ (left.T @ target)
        within = residual - slopes @ step
        pull = rows @ step + offset
        value = float(within @ within + pull @ pull - noise @ noise)
        dof = reach.shape[1] + len(rows) - len(strength)
        lever = float(np.sum(left[len(residual) :] ** 2))
        share = float(np.clip((len(rows) - lever) / dof, 0.0, 1.0)) if dof > 0 else 0.0
        frame = left[: len(residual)]
        return PriorSplit(
            max(value, 0.0), dof, share, step, root @ root.T, within, noise, reach.shape[1], frame
        )

    def p_value(self, of_fit: float, of_fresh: float) -> float | None:
        """Chance of a larger T, with noise levels estimated with so many degrees of freedom (infinite: known) from the
        data of the fit and from the fresh ones; None if there is nothing to compare.

        Exact where the errors of one side alone matter; in between the degrees of freedom are Welch's.
        """
        if self.dof <= 0:
            return None
        doubt = self.share**2 / of_fit + (1.0 - self.share) ** 2 / of_fresh
        if doubt <= 0:
            return float(chi2_sf(self.value, self.dof))
        return float(f_sf(self.value / self.dof, self.dof, max(1.0 / doubt, 1.0)))
