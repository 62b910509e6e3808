"""The score test of every candidate: what the null residual says of its amplitude, all parameters free.

With the whitened columns s, the residual e at the null optimum and M = I - S (S'S + P0^-1)^+ S':
q = s'M s, z = s'e / sqrt(q) ~ N(0, R) if nothing is missing, psi = s'e / q the one-step estimate of the amplitude,
z^2 the drop of chi-squared, and -(S'S + P0^-1)^-1 S's psi the shift of the old parameters. A prior is carried as
further rows, in which M is a projection; so is the scatter of combustion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.compression import Compressed, Reduced, shifts
from casadi_engine.discrepancy.linear_algebra import Array, basis, without
from casadi_engine.distributions import chi2_sf, normal_isf, normal_sf, t_sf

# Below this share of its sensitivity left after all parameters took theirs, a candidate cannot be tested.
TESTABLE = 1e-4


@dataclass(frozen=True, eq=False)
class Scores:
    """Statistics of k candidates.

    directions : (m, k) unit vectors; under the null z = directions' y with y ~ N(0, I_m), so R = directions'directions
    z : (k,), zero where not testable; amplitude : (k,) psi in the candidate's unit; error : (k,) its standard error
    information : (k,) q per unit^2; testability : (k,) sqrt(q)/|s| in 0..1; shift : (nz, k) predicted parameters'
    shift, in their units, when the candidate is added; y : (m,) the residual in the same frame
    freedom : (k,) degrees of freedom of the scores' variances; None where the noise is known
    """

    candidates: tuple[Candidate, ...]
    directions: Array
    y: Array
    z: Array
    amplitude: Array
    error: Array
    information: Array
    testability: Array
    shift: Array
    samples: int
    freedom: Array | None = None

    @property
    def testable(self) -> NDArray[np.bool_]:
        """(k,) False where the data cannot test the candidate, which is not to say that it is absent."""
        return self.testability > TESTABLE

    @cached_property
    def correlation(self) -> Array:
        """R (k, k); zero rows and columns where not testable."""
        return np.asarray(self.directions.T @ self.directions)

    @cached_property
    def _side(self) -> NDArray[np.intp]:
        return np.array([c.side for c in self.candidates], dtype=np.intp)

    @cached_property
    def statistic(self) -> Array:
        """(k,) |z|, or for one-sided candidates z in the allowed direction, not below 0."""
        side = self._side
        return np.where(side == 0, np.abs(self.z), np.maximum(side * self.z, 0.0))

    @cached_property
    def drop(self) -> Array:
        """(k,) predicted drop of chi-squared; zero for an amplitude of the forbidden sign."""
        return np.asarray(self.statistic**2)

    @cached_property
    def p_value(self) -> Array:
        """(k,) p-value of each candidate on its own; 1 where not testable. Normal where the noise is known, else by
        Student's t of its degrees of freedom."""
        side = self._side
        beyond = np.where(side == 0, np.abs(self.z), side * self.z)
        p = np.where(side == 0, 2.0, 1.0) * upper_tail(beyond, self.freedom)
        return np.where(self.testable, p, 1.0)

    def detectable(self, threshold: float, *, power: float = 0.95) -> Array:
        """(k,) smallest size found with probability ``power`` at the threshold c: (c + z_power)/sqrt(q), in units."""
        with np.errstate(divide="ignore"):
            found = (threshold - normal_isf(power)) / np.sqrt(self.information)
        return np.where(self.testable, found, np.inf)

    def subspace(self, members: Sequence[int]) -> Array:
        """(m, r) orthonormal basis of several candidates' directions, for a group test."""
        return basis(self.directions[:, list(members)])

    def group(self, members: Sequence[int]) -> tuple[float, int, float]:
        """chi-squared of several candidates together, its degrees of freedom and p-value."""
        frame = self.subspace(members)
        value = float(((frame.T @ self.y) ** 2).sum())
        return value, frame.shape[1], float(chi2_sf(value, frame.shape[1]) if frame.shape[1] else 1.0)


def upper_tail(z: Array, freedom: Array | float | None) -> Array:
    """P(a score > z): normal, or Student's t where its variance was estimated with so many degrees of freedom."""
    if freedom is None:
        return np.asarray(normal_sf(z))
    known = ~np.isfinite(freedom)
    return np.where(known, normal_sf(z), t_sf(z, np.where(known, 1.0, freedom)))


def score(compressed: Compressed, chosen: Sequence[tuple[str, int]] | None = None) -> Scores:
    """Scores of all candidates from all records, or from the chosen (record, cycle) alone."""
    return scores_of(compressed.reduced(chosen), compressed.candidates, compressed.turn, compressed.freedom)


def scores_of(
    reduced: Reduced, candidates: Sequence[Candidate], turn: Array, freedom: Array | None = None
) -> Scores:
    """Scores from reduced records; turn : (nz, n_theta); freedom : (k,) of the scores' variances."""
    n = reduced.parameters
    frame = basis(reduced.rows[:, :n])
    left = without(frame, reduced.rows[:, n:])
    s, e = left[:, :-1], left[:, -1]
    root = np.linalg.norm(s, axis=0)
    size = np.where(reduced.size > 0, reduced.size, 1.0)
    testability = root / size
    usable = testability > TESTABLE
    safe = np.where(usable, root, 1.0)
    directions = np.where(usable, s / safe, 0.0)
    z = directions.T @ e
    amplitude = np.where(usable, z / safe, 0.0)
    moved = -turn @ shifts(reduced)[:, :-1] * amplitude if n else np.zeros((len(turn), len(root)))
    with np.errstate(divide="ignore"):
        error = np.where(usable, 1 / safe, np.inf)
    # the frame of the candidates alone: what e has outside it tells nothing of them
    inner = basis(directions) if usable.any() else np.zeros((len(directions), 0))
    return Scores(
        tuple(candidates),
        inner.T @ directions,
        inner.T @ e,
        z,
        amplitude,
        error,
        np.where(usable, root**2, 0.0),
        testability,
        moved,
        reduced.samples,
        freedom,
    )


def separation(mu: Array | float, rho: Array | float) -> Array:
    """d = |mu| sqrt(1 - rho^2): of two effects that correlate by rho the true one, of mu standard errors, scores
    higher with probability about Phi(d/2)."""
    return np.asarray(np.abs(mu) * np.sqrt(np.maximum(1 - np.square(rho), 0.0)), dtype=np.float64)


def saturated_variance(reduced: Reduced) -> tuple[float, float]:
    """Variance of the whitened residual that parameters and all candidates together leave, and its degrees of
    freedom: 1 if the noise level is right, whatever effect of the library is there."""
    frame = basis(reduced.rows[:, :-1])
    rest = without(frame, reduced.rows[:, -1:])
    freedom = reduced.samples - reduced.starts - frame.shape[1]
    return float((rest**2).sum()) / max(freedom, 1), float(freedom)
