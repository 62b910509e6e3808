"""White noise plus slow wanders: its likelihood in the frequency domain, seen through a regression.

f(w) = r (1 + sum_k s_k c(w; tau_k)), c the spectrum of a first-order process (Ornstein-Uhlenbeck, sampled) of unit
variance. A low-order autoregression has no such spectrum: it forgets a weak wander within its order, takes the power at
low frequencies for too small, and what is slow looks significant. The cosine transform of a stretch of such noise has
independent coefficients to a good approximation (the slower the noise the better, other than Fourier's, which sees a
jump from the end to the start). Columns that were fitted take a share of each coefficient: only the rest counts, as in
the restricted likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from casadi_engine.discrepancy.linear_algebra import Array

# Coefficients that stand alone in the spectrum; above them bands of a tenth of their frequency.
_ALONE, _BAND = 20, 1.1
# Shares that the fit leaves below this tell nothing.
_LEAST = 0.05
# Time constants from so many samples to this share of the record: longer ones are trends.
_SHORTEST, _LONGEST = 1.5, 1 / 3
_STEPS, _CLOSE = 40, 1e-3
# A further wander that gains less than this at the best of the shapes that are tried is not worth a search: by it few
# gain as much again, and Akaike's criterion asks for twice as much.
_WORTH = 2.0
# Standard error of a logarithm of which the data tell nothing.
_DOUBT = 4.0
# Power at frequency zero beside the white noise, from which the fit starts.
_POWERS = 4.0 ** np.arange(-1, 7)
# Variance of a wander beside that of the white noise: outside, one of the two is not there.
_VARIANCE = 1e-6, 1e4
# A prediction from so much of the past is as good as from all; no longer one is kept.
_SETTLED, LONGEST_PAST = 1e-6, 200


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Power of a noise in bands of frequency.

    frequency : (b,) rad per sample; power : (b,) per coefficient; count : (b,) coefficients' worth of information;
    size : samples
    """

    frequency: Array
    power: Array
    count: Array
    size: int

    def deviance(self, density: Array) -> Array:
        """-2 log likelihood (..., ) of densities (..., b) of any level, at their best level."""
        level = (self.count * self.power / density).sum(axis=-1) / self.count.sum()
        out = (self.count * np.log(density)).sum(axis=-1) + self.count.sum() * (np.log(level) + 1)
        return np.asarray(out)


@dataclass(frozen=True, eq=False)
class Wander:
    """Shape of a white noise of unit variance plus wanders: variances (k,), and time constants (k,) in samples."""

    variance: Array
    time: Array

    def density(self, frequency: Array) -> Array:
        """(..., F) its spectrum."""
        return np.asarray(1 + (self.variance[:, None] * _process(self.time[:, None], frequency)).sum(axis=0))

    def slopes(self, frequency: Array) -> Array:
        """(2 k, F) of log density in log variance and log time constant, one wander after the other."""
        return _with_slopes(self.variance, self.time, 4 * np.sin(frequency / 2) ** 2)[1]

    def predictors(self, size: int) -> tuple[tuple[Array, ...], Array]:
        """(1, -a_1, ..., -a_j) for j = 0..p, and the variances of their errors (Levinson & Durbin)."""
        lags = np.arange(min(LONGEST_PAST, size - 1) + 1)
        products = (self.variance[:, None] * np.exp(-lags / self.time[:, None])).sum(axis=0)
        products[0] += 1
        predictor = np.ones(1)
        found, variances = [predictor], [float(products[0])]
        least = self._innovation()
        for j in lags[1:]:
            turn = -float(predictor @ products[j:0:-1]) / variances[-1]
            longer = np.append(predictor, 0.0)
            predictor = longer + turn * longer[::-1]
            found.append(predictor)
            variances.append(variances[-1] * (1 - turn**2))
            if variances[-1] < least * (1 + _SETTLED):
                break
        return tuple(found), np.array(variances)

    def _innovation(self) -> float:
        grid = np.linspace(0, np.pi, 4097)
        log = np.log(self.density(grid))
        return float(np.exp(log[1:-1].sum() / 4096 + (log[0] + log[-1]) / 8192))


def _process(time: Array, frequency: Array) -> Array:
    phi = np.exp(-1 / time)
    return np.asarray((1 - phi**2) / ((1 - phi) ** 2 + 4 * phi * np.sin(frequency / 2) ** 2))


def _with_slopes(variance: Array, time: Array, turned: Array) -> tuple[Array, Array]:
    """(F,) spectrum and (2 k, F) slopes of its logarithm; turned : (F,) 4 sin(w/2)^2."""
    phi = np.exp(-1 / time)[:, None]
    bottom = (1 - phi) ** 2 + phi * turned
    each = variance[:, None] * (1 - phi**2) / bottom
    longer = variance[:, None] * (-2 * phi - (1 - phi**2) * (turned - 2 * (1 - phi)) / bottom) / bottom
    whole = 1 + each.sum(axis=0)
    slopes = np.stack([each, longer * phi / time[:, None]], axis=1) / whole
    return whole, slopes.reshape(2 * len(time), -1)


def spectrum(noise: Array, valid: NDArray[np.bool_], density: Array | None = None) -> Spectrum | None:
    """The power of a noise in bands; None where too little is left.

    noise : (n, 1 + q) the remainder, complete, and columns that stand for what is not known of the rest
    valid : (n,) which samples were measured; density : (n,) the noise's own at the frequencies pi j / n
    """
    size = len(noise)
    turned = fft.dct(noise, type=2, norm="ortho", axis=0) ** 2
    known = np.ones(size)
    if density is not None:
        known = np.clip(1 - turned[:, 1:].sum(axis=1) / density, 0, 1)
    known = np.where(known > _LEAST, known, 0.0)
    edges = _edges(size)
    share = np.count_nonzero(valid) / size
    count = np.add.reduceat(known, edges)
    total = np.add.reduceat(np.where(known > 0, turned[:, 0], 0.0), edges)
    middle = np.add.reduceat(np.arange(size), edges) / np.diff(np.append(edges, size))
    used = count > 0
    if np.count_nonzero(used) < 8 or not total[used].any():
        return None
    power = total[used] / count[used] / share
    return Spectrum(np.pi * middle[used] / size, power + 1e-12 * power.mean(), count[used] * share, size)


def _edges(size: int) -> NDArray[np.intp]:
    edges = [*range(min(_ALONE, size))]
    while edges[-1] * _BAND < size - 1:
        edges.append(int(edges[-1] * _BAND) + (edges[-1] < _ALONE / (_BAND - 1)))
    return np.unique(edges)


def wander_of(found: Spectrum, count: int, start: Wander | None = None) -> Wander | None:
    """The most likely white noise plus ``count`` wanders, by Fisher scoring; None where it has none, or the last one is
    worth nothing beside ``start``.

    start : the most likely one with fewer
    """
    given = np.zeros((0,)) if start is None else start.variance
    times = np.zeros((0,)) if start is None else start.time
    first = 1.0 if start is None else start.density(found.frequency)
    longest = found.size * _LONGEST
    if longest <= _SHORTEST * 2:
        return None
    grid = _SHORTEST * 2.0 ** np.arange(np.log2(longest / _SHORTEST) + 1e-9)
    shape = _process(grid[:, None, None], found.frequency)
    variance = _POWERS[:, None] / (2 * grid[:, None, None])
    each = found.deviance(first + variance * shape)
    best = np.unravel_index(np.argmin(each), (len(grid), len(_POWERS)))
    made = Wander(np.append(given, variance[best[0], best[1], 0]), np.append(times, grid[best[0]]))
    if len(made.time) < count:
        return wander_of(found, count, made)
    if start is not None and float(found.deviance(start.density(found.frequency))) - each.min() < _WORTH:
        return None
    return _climbed(found, made, longest)


def _climbed(found: Spectrum, made: Wander, longest: float) -> Wander:
    """Fisher scoring, its steps shortened until they gain."""
    turned, total = 4 * np.sin(found.frequency / 2) ** 2, float(found.count.sum())
    weighed = found.count * found.power

    def at(variance: Array, time: Array) -> tuple[float, Array, Array]:
        """Deviance but for a constant, and what the step to the next point follows from."""
        density, slope = _with_slopes(variance, time, turned)
        ratio = weighed / density
        level = float(ratio.sum()) / total
        slope -= (slope @ found.count / total)[:, None]  # the level moves along
        value = float(found.count @ np.log(density)) + total * float(np.log(level))
        return value, slope @ (ratio / level - found.count), (slope * found.count) @ slope.T

    variance, time, damp = made.variance, made.time, 1e-3
    least, gain, known = at(variance, time)
    for _ in range(_STEPS):
        damped = known + damp * np.diag(known.diagonal() + 1e-6)
        step = np.clip(np.linalg.solve(damped, gain), -1.5, 1.5)
        wider = np.clip(variance * np.exp(step[::2]), *_VARIANCE)
        longer = np.clip(time * np.exp(step[1::2]), _SHORTEST, longest)
        value, *rest = at(wider, longer)
        if value < least:
            done = least - value < _CLOSE
            variance, time, least, (gain, known), damp = wider, longer, value, rest, damp / 10
            if done:
                break
        else:
            damp = max(10 * damp, 1e-3)
            if damp > 1e6:
                break
    return Wander(variance, time)


def information(found: Spectrum, made: Wander) -> Array:
    """(2 k, 2 k) what a spectrum tells of the logarithms of variances and time constants, its level free."""
    slope = made.slopes(found.frequency)
    slope = slope - (slope @ found.count / found.count.sum())[:, None]
    return np.asarray((slope * found.count) @ slope.T / 2 + np.eye(len(slope)) / _DOUBT**2)
