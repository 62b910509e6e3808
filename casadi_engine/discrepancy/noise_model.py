"""The noise of the null residuals: level, colour, and the scatter of combustion from cycle to cycle.

V = sigma^2 (colour) + sum tau_c^2 g_c g_c^T: white or autoregressive measurement noise of each output, and random
amplitudes of known shapes g_c (the combustion of one cylinder in one cycle), which are eliminated with their prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.linalg import block_diag

from casadi_engine.discrepancy.combustion_scatter import scatter_level
from casadi_engine.discrepancy.linear_algebra import Array, basis, coefficients, triangle, without
from casadi_engine.discrepancy.null_model import Index, NullModel, RecordNull
from casadi_engine.validation.whitening import Whitener

_LOWEST = 1e-6
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Colour:
    """An autoregression: predictors (1, -a_1, ..., -a_j) of order j = 0..p and their variances, as in Whitener."""

    predictors: tuple[Array, ...] = (np.ones(1),)
    variances: Array = field(default_factory=lambda: np.ones(1))

    @property
    def order(self) -> int:
        """0 for white noise."""
        return len(self.predictors) - 1


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """sigma : output -> standard deviation of the innovations; colour : (record, output) -> Colour (white if absent)
    scatter : standard deviations of the scatter directions in the amplitude's unit, one per kind
    source : "known" (given by the user) or "estimated" (from the null residuals)
    """

    sigma: Mapping[str, float]
    colour: Mapping[tuple[str, str], Colour] = field(default_factory=dict)
    scatter: Mapping[str, float] = field(default_factory=dict)
    source: Literal["known", "estimated"] = "known"

    def whiten(self, record: RecordNull, output: str, columns: Array) -> Array:
        """Columns (N, k) at the valid samples, whitened to unit variance: (rows, k).

        With a colour the rows are all samples of the channel, missing ones included: their squares sum to x'V^-1 x.
        """
        colour = self.colour.get((record.name, output))
        sigma = self.sigma[output]
        if colour is None or colour.order == 0:
            return np.asarray(columns / sigma)
        size = record.length[output]
        valid = np.zeros(size, dtype=bool)
        valid[record.index[output]] = True
        full = np.zeros((size, columns.shape[1]))
        full[valid] = columns
        return np.asarray(Whitener(colour.predictors, colour.variances, valid).apply(full) / sigma)

    def cycles(self, record: RecordNull, output: str) -> Index:
        """The cycle number of each row that ``whiten`` gives."""
        colour = self.colour.get((record.name, output))
        cycle = record.cycle[output]
        if colour is None or colour.order == 0:
            return cycle
        samples = np.arange(record.length[output])
        at = np.searchsorted(record.index[output], samples, side="right") - 1
        return np.asarray(cycle[np.clip(at, 0, len(cycle) - 1)], dtype=np.intp)


def fitted_colour(residual: Array, index: Index, length: int) -> Colour:
    """The autoregression of a residual (N,) at the samples ``index`` of a channel, its order by Akaike's criterion."""
    valid = np.zeros(length, dtype=bool)
    valid[index] = True
    full = np.zeros(length)
    full[valid] = residual
    found = Whitener.of(full, valid)
    innovation = float(found.variances[-1])
    return Colour(found.predictors, found.variances / innovation)


def estimated_noise(
    null: NullModel,
    *,
    explained: Mapping[str, Mapping[str, Array]],
    scatter: Mapping[str, Mapping[str, Array]] | None = None,
    kind: str = "combustion",
    colour: bool = False,
    sigma: Mapping[str, float] | None = None,
) -> NoiseModel:
    """Level, colour and scatter of the null residuals.

    explained : record -> output -> (N, k) columns that may explain part of the residual: the null slopes, and those of
    the whole library, so that an effect in it costs no power by being counted as noise
    scatter : record -> output -> (N, g) columns of random amplitudes of one kind, or None
    colour : estimate an autoregression per record and output; sigma : known levels, kept as they are

    Level, colour and scatter are settled in turn, each given the others (three rounds).
    """
    names = {name for record in null.records for name in record.outputs}
    levels = (
        dict(sigma) if sigma is not None else {n: _first_level(null, explained, n) for n in sorted(names)}
    )
    noise = NoiseModel(levels, {}, {kind: 0.0} if scatter else {}, "estimated")
    for _ in range(_ROUNDS if (colour or scatter) else 1):
        tau = _scatter_of(null, noise, explained, scatter) if scatter else 0.0
        left, freedom = _left(null, noise, explained, scatter, tau)
        colours = {}
        if colour:
            for record in null.records:
                for output in record.outputs:
                    e = left[record.name][output]
                    found = fitted_colour(e, record.index[output], record.length[output])
                    if found.order:
                        colours[record.name, output] = found
        noise = NoiseModel(levels, colours, {kind: tau} if scatter else {}, "estimated")
        if sigma is None:
            levels = _levels(null, noise, left, freedom)
            noise = NoiseModel(levels, colours, noise.scatter, "estimated")
    return noise


def left_over(
    null: NullModel,
    noise: NoiseModel,
    explained: Mapping[str, Mapping[str, Array]],
    scatter: Mapping[str, Mapping[str, Array]] | None = None,
) -> dict[str, dict[str, Array]]:
    """Residuals less what the columns explain and the most likely scatter: record -> output -> (N,); arguments as in
    ``estimated_noise``."""
    tau = max(noise.scatter.values(), default=0.0) if scatter else 0.0
    return _left(null, noise, explained, scatter, tau)[0]


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
) -> tuple[dict[str, dict[str, Array]], float]:
    """Residuals less the most likely scatter and what the columns explain, and how many numbers that took."""
    left: dict[str, dict[str, Array]] = {}
    freedom = 0.0
    for record in null.records:
        rows = _stacked(noise, record, explained, scatter)
        width = rows.shape[1] - 1
        given = next(iter(explained[record.name].values())).shape[1]
        prior = np.zeros((width - given if tau > 0 else 0, width + 1))
        prior[:, given:width] = np.eye(width - given)[: len(prior)] / max(tau, _LOWEST)
        rows = np.concatenate([rows, prior])
        use = width if tau > 0 else given
        found = coefficients(rows[:, :use], rows[:, -1])
        freedom += basis(rows[: len(rows) - len(prior), :given]).shape[1]
        left[record.name] = {}
        for output in record.outputs:
            columns = [explained[record.name][output]]
            if scatter and tau > 0:
                columns.append(scatter[record.name][output])
            model = np.concatenate(columns, axis=1) @ found
            left[record.name][output] = record.residual[output] - model
    return left, freedom


def _levels(
    null: NullModel, noise: NoiseModel, left: Mapping[str, Mapping[str, Array]], freedom: float
) -> dict[str, float]:
    """Standard deviation of the whitened remainder, for each output."""
    square: dict[str, float] = {}
    count: dict[str, int] = {}
    for record in null.records:
        for output, e in left[record.name].items():
            white = noise.whiten(record, output, e[:, None]) * noise.sigma[output]
            square[output] = square.get(output, 0.0) + float((white**2).sum())
            count[output] = count.get(output, 0) + len(e)
    total = sum(count.values())
    return {n: math.sqrt(square[n] / max(count[n] * (1 - freedom / total), 1.0)) for n in square}
