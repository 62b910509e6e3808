"""Standard errors of a fit whose noise is coloured, or larger than stated: those of white noise are too small.

A fit weighs all samples alike. With J the slopes of the outputs, sigma their level in the fit and V the covariance of
the noise, its estimates scatter by A^-1 B A^-1, A = J'J/sigma^2 and B = J'VJ/sigma^4, priors in both.
Source: White, Econometrica 48 (1980) 817; with autoregressions, Newey & West (1987).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from casadi_engine.discrepancy.linear_algebra import REPEATED, Array
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel, RecordNull
from casadi_engine.estimation import Estimate, Fit
from casadi_engine.estimation.all_pole import all_pole

# Errors are said to count with the colour where it changes one by more than this share.
_SEEN = 0.1
# How what an estimate says of a coloured residual ends.
_TOO_SMALL = "and the standard errors are too small"


def with_coloured_errors(
    fit: Fit, null: NullModel, noise: NoiseModel, rounded: Collection[str] = ()
) -> tuple[Fit, str]:
    """The fit with errors that count with the noise's colour, and with its level where a smaller one was stated or a
    sensor's steps ask for a larger one, and what to say of it; none smaller than before.

    null : the model linearised at this fit; noise : as it was estimated beside it; rounded : outputs with such steps
    """
    louder = any(
        noise.sigma.get(n, 0.0) > (1 + _SEEN) * level
        for n, (level, own) in fit.noise.items()
        if not own or n in rounded
    )
    if not (noise.colour or louder) or null.parameters != fit.free:
        return fit, ""
    of_parameters, of_starts = _ratios({name: level for name, (level, _) in fit.noise.items()}, null, noise)
    own = fit.own_noise  # what the errors of the fit count with already
    ratio = {n: max(r / own.get(n, 1.0), 1.0) for n, r in zip(fit.free, of_parameters.tolist(), strict=True)}
    most = max(ratio.values(), default=1.0)
    if most < 1 + _SEEN:
        return fit, ""
    estimates = {name: _wider(one, ratio.get(name, most)) for name, one in fit.estimates.items()}
    initial = {
        record: {
            state: _wider(one, of_starts.get((record, state), 1.0) / own.get(f"{record}/{state}", 1.0))
            for state, one in states.items()
        }
        for record, states in fit.initial.items()
    }
    scale = np.array([ratio[name] for name in fit.free])
    errors = fit.errors and replace(
        fit.errors, rows=fit.errors.rows / np.array([ratio[n] for n in fit.errors.names])
    )
    told = replace(
        fit,
        estimates=estimates,
        initial=initial,
        covariance=fit.covariance * np.outer(scale, scale),
        errors=errors,
    )
    if not noise.colour:
        which = "the rounded residual" if rounded else "the level that was stated"
        return told, f"{_LOUDER}: they are up to {most:.2g} times those of {which}"
    return with_colour_told(told), f"{_TOLD}: they are up to {most:.2g} times those of white noise"


_LOUDER = "the standard errors count with the noise that is left"
_TOLD = "the standard errors count with the colour of the noise"


def _covariances(
    null: NullModel, levels: Mapping[str, float], noise: NoiseModel
) -> tuple[Array, Array, dict[str, int]]:
    """Of steps of the parameters and first states: with the noise's colour, and with white noise of these levels;
    record -> where its states begin."""
    nz, places, size = null.turn.shape[1], {}, null.turn.shape[1]
    for record in null.records:
        places[record.name] = size
        size += len(record.starts)
    prior = null.prior[:, :nz].T @ null.prior[:, :nz]
    flat, coloured = np.zeros((size, size)), np.zeros((size, size))
    for one in (flat, coloured):
        one[:nz, :nz] = prior
    for record in null.records:
        at = np.concatenate([np.arange(nz), places[record.name] + np.arange(len(record.starts))])
        for output in record.outputs:
            level = levels[output]
            slopes = record.slopes[output] / level
            flat[np.ix_(at, at)] += slopes.T @ slopes
            own = _coloured(record, output, slopes, noise) / level
            coloured[np.ix_(at, at)] += own.T @ own
    spread = np.sqrt(np.maximum(np.diag(flat), 1e-300))
    values, vectors = np.linalg.eigh(flat / np.outer(spread, spread))
    seen = values > REPEATED * values.max(initial=0.0)
    inverse = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T / np.outer(spread, spread)
    return inverse @ coloured @ inverse, inverse, places


def with_colour_told(fit: Fit) -> Fit:
    """A fit that no longer says that its errors are too small, for they count with the colour."""
    told = [_TOLD if _TOO_SMALL in words else words for words in fit.messages]
    return replace(fit, messages=tuple(dict.fromkeys(told)))


def coloured_errors(null: NullModel, levels: Mapping[str, float], noise: NoiseModel) -> dict[str, float]:
    """Free parameter -> its standard error in this noise, of least squares weighted by ``levels``."""
    nz = null.turn.shape[1]
    own = null.turn @ _covariances(null, levels, noise)[0][:nz, :nz] @ null.turn.T
    return dict(zip(null.parameters, np.sqrt(np.maximum(np.diag(own), 0.0)).tolist(), strict=True))


def _ratios(
    levels: Mapping[str, float], null: NullModel, noise: NoiseModel
) -> tuple[Array, dict[tuple[str, str], float]]:
    """By how much errors of the free parameters (nz,), and of record's states, are larger than with white noise."""
    nz = null.turn.shape[1]
    sandwich, inverse, places = _covariances(null, levels, noise)
    turned = [null.turn @ one[:nz, :nz] @ null.turn.T for one in (sandwich, inverse)]
    ratio = [_ratio(*numbers) for numbers in zip(*map(np.diag, turned), strict=True)]
    starts = {
        (record.name, state): _ratio(sandwich[k, k], inverse[k, k])
        for record in null.records
        for k, state in enumerate(record.starts, places[record.name])
    }
    return np.array(ratio), starts


def _ratio(then: float, now: float) -> float:
    return float(np.sqrt(max(then / now, 1.0))) if now > 0 else 1.0


def _coloured(record: RecordNull, output: str, slopes: Array, noise: NoiseModel) -> Array:
    """L' J, (n, k), where the noise of an output is L times white noise of unit variance."""
    colour = noise.colour.get((record.name, output))
    if colour is None or colour.order == 0:
        return slopes * noise.sigma[output]
    full = np.zeros((record.length[output], slopes.shape[1]))
    full[record.valid(output)] = slopes
    return all_pole(colour.predictors[-1], full[::-1], noise.sigma[output])


def _wider(one: Estimate, ratio: float) -> Estimate:
    """The estimate with errors so many times as large."""
    if ratio <= 1:
        return one
    own: Mapping[str, Any] = {
        "stderr": one.stderr and one.stderr * ratio,
        "quadratic": one.quadratic and one.quadratic * ratio,
        "interval": one.interval and tuple(one.value + ratio * (end - one.value) for end in one.interval),
    }
    return replace(one, **own)
