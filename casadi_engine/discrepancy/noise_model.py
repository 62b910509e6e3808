"""The noise of the null residuals: level, colour, and the scatter of combustion from cycle to cycle.

V = sigma^2 (colour) + sum tau_c^2 g_c g_c^T: white or coloured measurement noise of each output (an autoregression, or
white noise plus slow wanders), and random amplitudes of known shapes g_c (the combustion of one cylinder in one cycle),
which are eliminated with their prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from casadi_engine.discrepancy.combustion_scatter import scatter_level
from casadi_engine.discrepancy.linear_algebra import REPEATED, Array, basis, svd, triangle, without
from casadi_engine.discrepancy.null_model import Index, NullModel, RecordNull, above_rounding
from casadi_engine.discrepancy.wander import Spectrum, Wander, information, spectrum, wander_of
from casadi_engine.estimation.autoregression import autoregression
from casadi_engine.validation.whitening import Whitener

_LOWEST = 1e-6
_FINE = 4096
# Of a prediction, what is forgotten.
_LITTLE = 1e-3
_ROUNDS = 3
# Rounds of level and colour; they end when no spectrum moves by this share of its standard error.
_COLOUR_ROUNDS, _CLOSE, _COARSE = 12, 0.05, 33


@dataclass(frozen=True, eq=False)
class Colour:
    """Linear predictors (1, -a_1, ..., -a_j) of order j = 0..p and their variances, as in Whitener.

    wander : white noise plus wanders, whose predictors these are; None for an autoregression
    covariance : (m, m) of what was estimated, a_1 ... a_p or the logarithms of the wanders' variances and time
    constants; None if it is known
    """

    predictors: tuple[Array, ...] = (np.ones(1),)
    variances: Array = field(default_factory=lambda: np.ones(1))
    covariance: Array | None = None
    wander: Wander | None = None
    _last: list[Whitener] = field(default_factory=list, repr=False)

    @property
    def order(self) -> int:
        """0 for white noise."""
        return len(self.predictors) - 1

    @property
    def memory(self) -> float:
        """By how much the mean square of this noise varies more than that of white noise: the sum of its squared
        autocorrelations."""
        density = self.density(np.linspace(0, np.pi, _FINE))
        return float(np.mean(density**2) / np.mean(density) ** 2)

    @property
    def reach(self) -> int:
        """From how far back a sample is predicted, but for a small share."""
        rest = np.cumsum(self.predictors[-1][::-1] ** 2)[::-1]
        return int(np.count_nonzero(rest[1:] > _LITTLE))

    def whitener(self, valid: NDArray[np.bool_]) -> Whitener:
        """What makes this noise white, of which the samples ``valid`` (n,) are there; the last one is kept."""
        if not self._last or not np.array_equal(self._last[0].valid, valid):
            self._last[:] = [Whitener(self.predictors, self.variances, valid)]
        return self._last[0]

    def density(self, frequency: Array) -> Array:
        """Spectrum (F,) at frequencies in rad per sample, of innovations of unit variance."""
        return np.asarray(1 / np.abs(_transfer(self.predictors[-1], frequency)) ** 2)

    def slopes(self, frequency: Array) -> Array:
        """(m, F) of the logarithm of the density in what was estimated, the innovations' variance held."""
        if self.wander is not None:
            grid = np.linspace(0, np.pi, _FINE)
            mean = self.wander.slopes((grid[1:] + grid[:-1]) / 2).mean(axis=1)
            return np.asarray(self.wander.slopes(frequency) - mean[:, None])
        turn = np.exp(-1j * np.outer(np.arange(1, self.order + 1), frequency))
        return np.asarray(2 * (turn / _transfer(self.predictors[-1], frequency)).real)


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """sigma : output -> standard deviation of the innovations; colour : (record, output) -> Colour (white if absent)
    scatter : standard deviations of the scatter directions in the amplitude's unit, one per kind
    source : "known" (given by the user) or "estimated" (from the null residuals)
    freedom : output -> degrees of freedom of an estimated sigma; those of a known one are not there
    """

    sigma: Mapping[str, float]
    colour: Mapping[tuple[str, str], Colour] = field(default_factory=dict)
    scatter: Mapping[str, float] = field(default_factory=dict)
    source: Literal["known", "estimated"] = "known"
    freedom: Mapping[str, float] = field(default_factory=dict)

    def whiten(self, record: RecordNull, output: str, columns: Array) -> Array:
        """Columns (N, k) at the valid samples, whitened to unit variance: (rows, k).

        With a colour the rows are all samples of the channel, missing ones included: their squares sum to x'V^-1 x.
        """
        colour = self.colour.get((record.name, output))
        if colour is None or colour.order == 0:
            return np.asarray(columns / self.sigma[output])
        valid = record.valid(output)
        full = np.zeros((len(valid), columns.shape[1]))
        full[valid] = columns
        return np.asarray(colour.whitener(valid).apply(full) / self.sigma[output])

    def cycles(self, record: RecordNull, output: str) -> Index:
        """The cycle number of each row that ``whiten`` gives."""
        colour = self.colour.get((record.name, output))
        cycle = record.cycle[output]
        if colour is None or colour.order == 0:
            return cycle
        samples = np.arange(record.length[output])
        at = np.searchsorted(record.index[output], samples, side="right") - 1
        return np.asarray(cycle[np.clip(at, 0, len(cycle) - 1)], dtype=np.intp)


def _transfer(predictor: Array, frequency: Array) -> Array:
    return np.asarray(np.polyval(predictor[::-1], np.exp(-1j * frequency)))


def fitted_colour(
    residual: Array,
    index: Index,
    length: int,
    uncertain: Array | None = None,
    before: tuple[float, Colour] | None = None,
) -> Colour:
    """The colour of a residual (N,) at the samples ``index`` of a channel.

    It is an autoregression, or white noise plus one or two slow wanders, by Akaike's criterion.

    uncertain : (N, q) the square root of the covariance with which the noise is known, given the data; None for zero
    before : level and colour of the noise with which that was found
    """
    # what is missing before the first sample and behind the last one tells nothing
    index, length = index - index[0], int(index[-1] - index[0]) + 1
    valid = np.zeros(length, dtype=bool)
    valid[index] = True
    full = np.zeros((length, 1 if uncertain is None else 1 + uncertain.shape[1]))
    full[valid, 0] = residual
    if uncertain is not None:
        full[valid, 1:] = uncertain
    found = autoregression(full, valid)
    made = Colour(found.predictors, found.variances / found.variances[-1], found.covariance)
    if not valid.all():
        full = Whitener(found.predictors, found.variances, valid).filled(full)
    level, old = (1.0, Colour()) if before is None else before
    power = spectrum(full, valid, level**2 * old.density(np.pi * np.arange(length) / length))
    return made if power is None else _best_of(made, power, length)


def _best_of(made: Colour, power: Spectrum, length: int) -> Colour:
    """The autoregression, or the wanders if Akaike's criterion prefers them."""
    least = float(power.deviance(made.density(power.frequency))) + 2 * made.order
    best: Wander | None = None
    start = None
    for count in (1, 2):
        start = wander_of(power, count, start)
        if start is None:
            break
        value = float(power.deviance(start.density(power.frequency))) + 4 * count
        if value < least:
            best, least = start, value
    if best is None:
        return made
    predictors, variances = best.predictors(length)
    covariance: Array = np.linalg.inv(information(power, best)).astype(float)
    return Colour(predictors, variances / variances[-1], covariance, best)


def estimated_noise(
    null: NullModel,
    *,
    explained: Mapping[str, Mapping[str, Array]],
    scatter: Mapping[str, Mapping[str, Array]] | None = None,
    kind: str = "combustion",
    colour: bool = False,
    sigma: Mapping[str, float] | None = None,
    start: NoiseModel | None = None,
) -> NoiseModel:
    """Level, colour and scatter of the null residuals, by the restricted likelihood given the columns that may explain
    part of them.

    explained : record -> output -> (N, k) these columns: the null slopes, and those of effects that are not to be
    counted as noise
    scatter : record -> output -> (N, g) columns of random amplitudes of one kind, or None
    colour : estimate a colour per record and output; sigma : known levels, kept as they are
    start : a noise to begin with

    Level, colour and scatter are settled in turn, each given the others.
    """
    names = sorted({name for record in null.records for name in record.outputs})
    if start is None:
        levels = above_rounding(null, sigma or {n: _first_level(null, explained, n) for n in names})
        start = NoiseModel(levels, {}, {kind: 0.0} if scatter else {}, "estimated")
    noise, levels = start, dict(start.sigma)
    for _ in range(_COLOUR_ROUNDS if colour else _ROUNDS if scatter else 1):
        tau = _scatter_of(null, noise, explained, scatter) if scatter else 0.0
        left = _left(null, noise, explained, scatter, tau)
        before, colours = noise.colour, _colours(null, noise, left) if colour else {}
        noise = NoiseModel(levels, colours, {kind: tau} if scatter else {}, "estimated")
        if sigma is None:
            levels, count = _levels(null, noise, left)
            noise = NoiseModel(levels, colours, noise.scatter, "estimated", count)
        if colour and not scatter and _settled(before, colours):
            break
    return noise


def _colours(null: NullModel, noise: NoiseModel, left: _Left) -> dict[tuple[str, str], Colour]:
    found = {}
    for record in null.records:
        for output in record.outputs:
            e, uncertain = left.noise[record.name][output], left.uncertain[record.name][output]
            old = noise.sigma[output], noise.colour.get((record.name, output), Colour())
            colour = fitted_colour(e, record.index[output], record.length[output], uncertain, old)
            if colour.order:
                found[record.name, output] = colour
    return found


def _settled(before: Mapping[tuple[str, str], Colour], after: Mapping[tuple[str, str], Colour]) -> bool:
    """True if no spectrum has moved by more than a small share of its standard error."""
    if before.keys() != after.keys():
        return False
    grid = np.linspace(0, np.pi, _COARSE)
    for key, colour in after.items():
        if colour.covariance is None or (colour.wander is None) != (before[key].wander is None):
            return False
        slope = colour.slopes(grid)
        error = np.sqrt(np.einsum("if,ij,jf->f", slope, colour.covariance, slope))
        moved = np.abs(np.log(colour.density(grid) / before[key].density(grid)))
        if (moved > _CLOSE * error + _LITTLE).any():
            return False
    return True


def left_over(
    null: NullModel,
    noise: NoiseModel,
    explained: Mapping[str, Mapping[str, Array]],
    scatter: Mapping[str, Mapping[str, Array]] | None = None,
) -> dict[str, dict[str, Array]]:
    """Residuals less what the columns explain and the most likely scatter: record -> output -> (N,); arguments as in
    ``estimated_noise``."""
    tau = max(noise.scatter.values(), default=0.0) if scatter else 0.0
    return _left(null, noise, explained, scatter, tau).noise


def deviance(
    null: NullModel,
    noise: NoiseModel,
    explained: Mapping[str, Mapping[str, Array]],
    held: int,
    scatter: Mapping[str, Mapping[str, Array]] | None = None,
) -> float:
    """-2 log restricted likelihood of the residuals, plus twice the number of colour parameters (Akaike).

    explained : record -> output -> (N, k) columns, of which the first ``held`` are free and the others zero; all count
    for the restriction, so that two deviances with other noises and other ``held`` compare (Welham & Thompson 1997)
    scatter : as in ``estimated_noise``
    """
    tau = max(noise.scatter.values(), default=0.0) if scatter else 0.0
    found = sum(2.0 * len(c.covariance) for c in noise.colour.values() if c.covariance is not None)
    for record in null.records:
        rows = _stacked(noise, record, explained, scatter)
        given = next(iter(explained[record.name].values())).shape[1]
        if tau > 0:
            random = np.concatenate([rows[:, given:-1] * tau, np.eye(rows.shape[1] - 1 - given)])
            found += 2 * float(np.log(np.abs(np.diag(np.linalg.qr(random, mode="r")))).sum())
            padded = np.zeros((len(random), rows.shape[1]))
            padded[: len(rows)] = rows
            rows = without(np.linalg.qr(random)[0], padded)
        size = np.sqrt(sum((part**2).sum(axis=0) for part in explained[record.name].values()))
        strength = np.linalg.svd(rows[:, :given] / np.where(size > 0, size, 1.0), compute_uv=False)
        found += 2 * float(np.log(np.maximum(strength, REPEATED * strength.max(initial=1e-300))).sum())
        rest = without(basis(rows[:, :held]), rows[:, -1:])
        found += float((rest**2).sum())
        for output in record.outputs:
            colour = noise.colour.get((record.name, output))
            found += 2 * len(record.residual[output]) * math.log(noise.sigma[output])
            if colour is not None:
                found += colour.whitener(record.valid(output)).log_determinant
    return found


@dataclass(frozen=True, eq=False)
class _Left:
    """noise : record -> output -> (N,) what columns and scatter leave; uncertain : (N, q) the square root of the
    covariance of what they took; freedom : how many numbers the columns took"""

    noise: dict[str, dict[str, Array]]
    uncertain: dict[str, dict[str, Array]]
    freedom: float


def _first_level(null: NullModel, explained: Mapping[str, Mapping[str, Array]], output: str) -> float:
    square, count = 0.0, 0.0
    for record in null.records:
        if output in record.residual:
            frame = basis(explained[record.name][output])
            e = without(frame, record.residual[output][:, None])
            square += float((e**2).sum())
            count += max(len(e) - frame.shape[1], 1)
    return math.sqrt(square / count)


def _stacked(
    noise: NoiseModel,
    record: RecordNull,
    explained: Mapping[str, Mapping[str, Array]],
    scatter: Mapping[str, Mapping[str, Array]] | None,
) -> Array:
    """Triangle of the whitened [explained | scatter | residual] of one record."""
    parts = []
    for output in record.outputs:
        columns = [explained[record.name][output]]
        if scatter:
            columns.append(scatter[record.name][output])
        columns.append(record.residual[output][:, None])
        parts.append(triangle(noise.whiten(record, output, np.concatenate(columns, axis=1))))
    return np.concatenate(parts)


def _scatter_of(
    null: NullModel,
    noise: NoiseModel,
    explained: Mapping[str, Mapping[str, Array]],
    scatter: Mapping[str, Mapping[str, Array]] | None,
) -> float:
    inner, slope = [], []
    for record in null.records:
        width = next(iter(explained[record.name].values())).shape[1]
        rows = _stacked(noise, record, explained, scatter)
        rest = without(basis(rows[:, :width]), rows[:, width:])
        inner.append(rest[:, :-1])
        slope.append(rest[:, -1])
    return scatter_level(block_diag(*inner), np.concatenate(slope))


def _left(
    null: NullModel,
    noise: NoiseModel,
    explained: Mapping[str, Mapping[str, Array]],
    scatter: Mapping[str, Mapping[str, Array]] | None,
    tau: float,
) -> _Left:
    """Residuals less the most likely scatter and what the columns explain."""
    out = _Left({}, {}, 0.0)
    freedom = 0.0
    for record in null.records:
        rows = _stacked(noise, record, explained, scatter)
        width = rows.shape[1] - 1
        given = next(iter(explained[record.name].values())).shape[1]
        prior = np.zeros((width - given if tau > 0 else 0, width + 1))
        prior[:, given:width] = np.eye(width - given)[: len(prior)] / max(tau, _LOWEST)
        rows = np.concatenate([rows, prior])
        use = width if tau > 0 else given
        found, root = _regressed(rows[:, :use], rows[:, -1])
        freedom += basis(rows[: len(rows) - len(prior), :given]).shape[1]
        out.noise[record.name], out.uncertain[record.name] = {}, {}
        for output in record.outputs:
            columns = [explained[record.name][output]]
            if scatter and tau > 0:
                columns.append(scatter[record.name][output])
            stacked = np.concatenate(columns, axis=1)
            out.noise[record.name][output] = record.residual[output] - stacked @ found
            out.uncertain[record.name][output] = stacked @ root
    return _Left(out.noise, out.uncertain, freedom)


def _regressed(columns: Array, target: Array) -> tuple[Array, Array]:
    """Least-squares coefficients (k,) of a target of unit variance, and a square root (k, r) of their covariance."""
    size = np.linalg.norm(columns, axis=0)
    scale = np.where(size > 0, size, 1.0)
    frame, strength, turn = svd(columns / scale)
    good = strength > REPEATED * strength.max(initial=0.0)
    root = (turn[good].T / strength[good]) / scale[:, None]
    return np.asarray(root @ (frame[:, good].T @ target)), np.asarray(root)


def _levels(null: NullModel, noise: NoiseModel, left: _Left) -> tuple[dict[str, float], dict[str, float]]:
    """Standard deviation of the whitened remainder, for each output, and its degrees of freedom."""
    square: dict[str, float] = {}
    count: dict[str, int] = {}
    for record in null.records:
        for output, e in left.noise[record.name].items():
            white = noise.whiten(record, output, e[:, None]) * noise.sigma[output]
            square[output] = square.get(output, 0.0) + float((white**2).sum())
            count[output] = count.get(output, 0) + len(e)
    total = sum(count.values())
    freedom = {name: max(number * (1 - left.freedom / total), 1.0) for name, number in count.items()}
    return above_rounding(null, {name: math.sqrt(square[name] / freedom[name]) for name in square}), freedom
