"""How well the variance of each score is known where level and colour of the noise were estimated.

The variance v of a score depends on the noise's parameters phi (levels, colours); with
their covariance C, log v has the variance g'C g, g = d(log v)/d(phi), as a chi-squared variable over its degrees of
freedom nu has 2/nu: so the score is Student's t with nu = 2/(g'C g) (Satterthwaite 1946; Kenward & Roger 1997). How the
weights of the estimate move with phi does not count: they are at an optimum. A direction of low frequency has few
degrees of freedom: as many as there are stretches of noise that do not remember one another.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy import fft

from casadi_engine.discrepancy.linear_algebra import Array, basis, without
from casadi_engine.discrepancy.noise_model import Colour, NoiseModel
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.validation.whitening import Whitener

# Below this share of its norm left after the parameters took theirs, a column has no direction.
_NOTHING = 1e-6
# Points of a spectrum for each sample, which keep its ends apart; columns at a time.
_FINE, _BLOCK = 4, 16

Columns = Mapping[str, Mapping[str, Array]]


def freedom_of(
    null: NullModel,
    columns: Columns,
    noise: NoiseModel,
    *,
    scatter: Columns | None = None,
    levels: Mapping[str, Array] | None = None,
) -> Array:
    """Degrees of freedom (k,) of the scores of columns: record -> output -> (N, k); infinite for a known noise.

    scatter : record -> output -> (N, g) columns of random amplitudes; levels : record -> (g,) their standard deviations
    """
    count = next(iter(next(iter(columns.values())).values())).shape[1]
    if count == 0 or (not noise.freedom and all(c.covariance is None for c in noise.colour.values())):
        return np.full(count, np.inf)
    if not noise.colour:
        return np.full(count, min(noise.freedom.values()))
    direction = _directions(null, columns, noise, scatter, levels)
    spread = np.zeros(count)
    first = 0
    for record in null.records:
        for output in record.outputs:
            colour = noise.colour.get((record.name, output))
            rows = len(record.residual[output]) if colour is None else record.length[output]
            d = direction[first : first + rows]
            first += rows
            if colour is not None and colour.covariance is not None:
                slope = _slopes(colour, d)
                spread += np.einsum("ki,ij,kj->k", slope, colour.covariance, slope)
            if output in noise.freedom:
                spread += 2 / noise.freedom[output] * (d**2).sum(axis=0) ** 2
    with np.errstate(divide="ignore"):
        return np.where(spread > 0, 2 / spread, np.inf)


def _directions(
    null: NullModel,
    columns: Columns,
    noise: NoiseModel,
    scatter: Columns | None,
    levels: Mapping[str, Array] | None,
) -> Array:
    """(m, k) whitened columns of unit norm, free of what the parameters and random amplitudes take; zero where nothing
    is left. Below the rows of all channels there are those of the priors."""
    theta = null.turn.shape[1]
    own = {r.name: r.slopes[r.outputs[0]].shape[1] - theta for r in null.records}
    random = (
        {} if scatter is None or levels is None else {r: np.flatnonzero(tau > 0) for r, tau in levels.items()}
    )
    drawn = sum(len(k) for k in random.values())
    width = theta + sum(own.values()) + drawn
    held, tested = [], []
    start, amplitude = theta, width - drawn
    for record in null.records:
        picked = random.get(record.name, np.zeros(0, dtype=int))
        for output in record.outputs:
            slopes = record.slopes[output]
            wide = np.zeros((len(slopes), width))
            wide[:, :theta] = slopes[:, :theta]
            wide[:, start : start + own[record.name]] = slopes[:, theta:]
            if scatter is not None and levels is not None:
                known = scatter[record.name][output][:, picked] * levels[record.name][picked]
                wide[:, amplitude : amplitude + len(picked)] = known
            held.append(noise.whiten(record, output, wide))
            tested.append(noise.whiten(record, output, columns[record.name][output]))
        start, amplitude = start + own[record.name], amplitude + len(picked)
    priors = np.zeros((len(null.prior) + drawn, width))
    priors[: len(null.prior), :theta] = null.prior[:, :theta]
    priors[len(null.prior) :, width - drawn :] = np.eye(drawn)
    frame = np.concatenate([*held, priors])
    free = np.concatenate([*tested, np.zeros((len(priors), tested[0].shape[1]))])
    size = np.linalg.norm(free, axis=0)
    free = without(basis(frame), free)
    left = np.linalg.norm(free, axis=0)
    usable = left > _NOTHING * size
    return np.where(usable, free / np.where(usable, left, 1.0), 0.0)


def _slopes(colour: Colour, direction: Array) -> Array:
    """(k, m) d(log variance)/d(what was estimated) of scores with whitened directions (n, k).

    With x = W'd it is x'(dV)x, the power of x weighted by the slope of the spectrum.
    """
    size = len(direction)
    # no sample is missing here: what fills the gaps is in the whitened rows
    whitener = Whitener(colour.predictors, colour.variances, np.ones(size, dtype=bool))
    points = fft.next_fast_len(_FINE * size, real=True)
    frequency = 2 * np.pi * np.arange(points // 2 + 1) / points
    weight = colour.density(frequency) * np.where((frequency > 0) & (frequency < np.pi), 2.0, 1.0) / points
    slope = colour.slopes(frequency) * weight
    x = whitener.matrix.T @ direction
    power = (
        np.abs(fft.rfft(part, points, axis=0)) ** 2
        for part in np.array_split(x, -(-x.shape[1] // _BLOCK), axis=1)
    )
    return np.concatenate([part.T @ slope.T for part in power])
