"""What innovations add to the shooting problem: a closed loop that must forget, and the likelihood of their size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.constraints import Priors
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.simulation import jets
from casadi_engine.simulation.discretisation import DiscreteCore
from casadi_engine.simulation.gain import Gain, RiccatiGain, Seen, corrected
from casadi_engine.simulation.gappy import GappyPredictor
from casadi_engine.simulation.linear import LinearPropagator
from casadi_engine.simulation.riccati import over_steps
from casadi_engine.simulation.stability import log_decay

Array = NDArray[np.float64]

# The closed loop's radius is judged over at least this many doublings of a sample, and no more than that many.
_LEAST, _MOST = 8, 16

# How the constraint that keeps a predictor from running away is called.
STABLE = "the predictor is stable"


class StableLoop:
    """The constraint that a predictor forgets: log_decay of its closed loop from one output sample to the next < 0."""

    min, max = -np.inf, 0.0

    def __init__(self, record: RecordTerm, every: int, size: int, *, alone: bool) -> None:
        self._record, self._every, self._size = record, every, size
        samples = max(record.grid.samples // every, 2)
        self._doublings = int(np.clip(np.ceil(np.log2(samples)), _LEAST, _MOST))
        self.label = STABLE + ("" if alone else f" in {record.experiment.name}")

    def _decay(self, v: Array, order: int) -> Array:
        loop, d = closed_loop(self._record, v, self._every, order)
        return log_decay(loop, d, self._doublings)

    def evaluate(self, v: Array) -> tuple[float, Array]:
        """Value and gradient (nv,)."""
        jet, active = self._decay(v, 1), self._record.active
        slope = np.zeros(self._size)
        slope[active] = jet[1 : 1 + len(active)]
        return float(jet[0]), slope

    def hessian(self, v: Array) -> Array:
        """(nv, nv)."""
        jet, active = self._decay(v, 2), self._record.active
        return _spread(jet[1 + len(active) :], active, self._size)


def of_predictor(record: RecordTerm) -> tuple[DiscreteCore, Gain]:
    """The linear core and the gain of a record that is predicted."""
    propagator = record.propagator
    if isinstance(propagator, (LinearPropagator, GappyPredictor)) and propagator.gain is not None:
        return propagator.core, propagator.gain
    raise TypeError("this record is simulated: it has no predictor")


def closed_loop(record: RecordTerm, v: Array, every: int, order: int) -> tuple[Array, int]:
    """Jet of the predictor's transition from one output sample to the next, and the number of its entries."""
    core, gain = of_predictor(record)
    z, d = v[record.active], len(record.active)
    discrete = core.at(z, order)
    loop = corrected(discrete, gain.at(z, core, discrete, (True,) * core.outputs)).f
    if every > 1:
        rest = over_steps(discrete.f, np.zeros_like(discrete.f), every - 1, d)[0]
        loop = jets.product(rest, loop, d)
    return loop, d


def _spread(pairs: Array, active: NDArray[np.intp], size: int) -> Array:
    """The symmetric matrix (size, size) of second derivatives in jet order."""
    total = np.zeros((size, size))
    i, j = jets.pairs(len(active))
    total[active[i], active[j]] = pairs
    total[active[j], active[i]] = pairs
    return total


class SizedPriors:
    """Priors, and half the sum of log det S over all samples, S the covariance of the innovations there.

    With residuals whitened by S it makes the objective the negative log likelihood. The interface is that of Priors.
    """

    def __init__(self, priors: Priors, records: list[RecordTerm], level: Array) -> None:
        self._priors, self.count = priors, priors.count
        self._level = level
        self._terms = [(record, _patterns(record)) for record in records]

    def evaluate(self, v: Array) -> tuple[float, Array, Array, Array]:
        """As Priors.evaluate; the Gauss-Newton Hessian holds what the residuals' own does not."""
        cost, gradient, hessian, gauss_newton = self._priors.evaluate(v)
        gradient, hessian, gauss_newton = gradient.copy(), hessian.copy(), gauss_newton.copy()
        for record, patterns in self._terms:
            z, active, d = v[record.active], record.active, len(record.active)
            core, gain = of_predictor(record)
            if not isinstance(gain, RiccatiGain):
                raise TypeError("only a gain of the Riccati equation knows the size of its innovations")
            discrete = core.at(z, 2)
            for seen, count in patterns:
                value, own = gain.log_determinant(z, core, discrete, seen)
                reference = 2 * float(np.log(self._level[list(seen)]).sum())
                cost += 0.5 * count * (value[0] - reference)
                gradient[active] += 0.5 * count * value[1 : 1 + d]
                hessian += 0.5 * count * _spread(value[1 + d :], active, len(v))
                gauss_newton[np.ix_(active, active)] += count * own
        return cost, gradient, hessian, gauss_newton

    def size(self, v: Array) -> float:
        """The sum of log det S alone, at the reference levels zero: what twice the objective has beside chi-squared."""
        return 2 * (self.evaluate(v)[0] - self._priors.evaluate(v)[0])


def _patterns(record: RecordTerm) -> list[tuple[Seen, int]]:
    """Sets of outputs that were measured at the same samples, and the number of these."""
    seen = np.zeros((len(record.outputs), record.grid.samples), dtype=bool)
    for k, name in enumerate(record.outputs):
        if name in record.grid.measured:
            seen[k, record.grid.measured[name].position] = True
    kinds, counts = np.unique(seen.T, axis=0, return_counts=True)
    return [
        (tuple(bool(part) for part in kind), int(count))
        for kind, count in zip(kinds, counts, strict=True)
        if kind.any()
    ]


def loop_of(
    record: RecordTerm, v: Array, covariance: Array, every: int
) -> tuple[Array, Array, Array, Array | None, float]:
    """L, K = A_D L and its standard errors (n, ny) in the states' units, the innovations' levels (ny,) where the gain
    knows them, and the closed loop's spectral radius.

    covariance : (nv, nv) of the fit's vector, NaN where there is none
    """
    core, gain = of_predictor(record)
    z, active, d = v[record.active], record.active, len(record.active)
    discrete = core.at(z, 1)
    lift = gain.at(z, core, discrete, (True,) * core.outputs).lift
    kalman = jets.product(discrete.f, lift, d) * record.scale[:, None]
    slope = kalman[1 : 1 + d].reshape(d, kalman[0].size)
    variance = np.einsum("ik,ij,jk->k", slope, covariance[np.ix_(active, active)], slope)
    variance = np.where(np.abs(slope).max(axis=0, initial=0.0) > 0, variance, np.nan)
    with np.errstate(invalid="ignore"):
        stderr = np.sqrt(variance).reshape(kalman.shape[1:])
    sigma = None
    if isinstance(gain, RiccatiGain):
        sigma = np.sqrt(np.diag(gain.stationary(z, core, discrete).innovation[0]))
    loop = closed_loop(record, v, every, 0)[0][0]
    radius = float(np.abs(np.linalg.eigvals(loop)).max())
    return lift[0] * record.scale[:, None], kalman[0], stderr, sigma, radius
