"""What errors of the parameters may explain of a gap on fresh data.

Parameters that are held on fresh data carry the errors of their estimates along, and at another load or speed these may
be larger than the noise. What lies in the directions of the parameters is therefore no sign of something missing: the
residual tests of fresh data take it away first, so that their false-alarm rate holds whatever the errors are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from casadi_engine.discrepancy.assumed_pressure import is_carried
from casadi_engine.discrepancy.confirmation import Residuals
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.null_model import NullModel, null_at, steps_of
from casadi_engine.distributions import chi2_sf
from casadi_engine.estimation import Fit
from casadi_engine.parameters import compile
from casadi_engine.validation.parameter_prior import PriorSplit


def doubted(fit: Fit, held: Fit) -> NullModel:
    """The null model of fresh data with slopes for what a fit estimated: parameters, and the fresh initial states.

    fit : on the data searched; held : its model on fresh data, parameters held. Amplitudes of events that do not act in
    the fresh data, and parameters at a bound, have no errors there.
    """
    names = tuple(record.name for record in held.data)
    pmap = compile(fit.parameters, held.model.parameter_names, names)
    values = held.values
    z = np.array([values[name] if name in values else values[name.partition("@")[0]] for name in pmap.free])
    sure = [name for name, value in zip(pmap.free, z, strict=True) if _is_sure(fit, name, float(value))]
    first = {name: np.array([e.value for e in held.initial[name].values()]) for name in names}
    # first states of fresh data are found there, also where a fit of theirs only simulated what had been found
    known = {name: tuple(s for s, e in held.initial[name].items() if e.at_bound) for name in names}
    return null_at(
        held.model, held.data, fit.parameters, z, first,
        held_starts=known, held_parameters=sure, steps=steps_of(held),
    )  # fmt: skip


def _is_sure(fit: Fit, name: str, value: float) -> bool:
    """True for what has no error on fresh data; a parameter that varies by experiment and was found there has one."""
    own = fit.estimates.get(name)
    if own is None or is_carried(name):
        return "@" in name and is_carried(name)
    return own.at_bound is not False or value != own.value


def within_errors(fit: Fit, null: NullModel, residuals: Sequence[Residuals]) -> PriorSplit:
    """The gap of a null model of fresh data, parted by what the fit knows of its parameters; see `parameter_prior`.

    null : made by ``doubted``; residuals : its residuals with their levels, colour and all
    """
    return _split(fit, null, {(one.record, one.output): one.sigma for one in residuals})


def _split(fit: Fit, null: NullModel, levels: Mapping[tuple[str, str], float]) -> PriorSplit:
    residual, slopes = _whitened(null, levels)
    rows, offset = _prior(fit, null)
    padded = np.zeros((len(rows), slopes.shape[1]))
    padded[:, : null.turn.shape[1]] = rows
    return PriorSplit.of(residual, slopes, padded, offset)


def left_within_errors(fit: Fit, null: NullModel, levels: Mapping[str, float]) -> float:
    """Chi-squared per sample that a fit leaves of fresh data, its parameters moved, and what moving them beyond their
    errors costs; arguments as in ``log_foretold``."""
    split = _split(fit, null, _of_records(null, levels))
    return (split.value + float(split.noise @ split.noise)) / len(split.noise)


def _of_records(null: NullModel, levels: Mapping[str, float]) -> dict[tuple[str, str], float]:
    return {(record.name, output): levels[output] for record in null.records for output in record.outputs}


def log_foretold(fit: Fit, null: NullModel, levels: Mapping[str, float]) -> float:
    """Log probability of fresh data by a fit, but for what all models have in common: its parameters move within their
    errors, and what the fit does not know (first states, when an event happens there) is known beforehand as well as
    one sample tells it.

    null : made by ``doubted``; levels : output -> standard deviation of the noise
    """
    residual, slopes = _whitened(null, _of_records(null, levels))
    rows, offset = _prior(fit, null)
    # errors by the level of the fit, which may be smaller
    known = [levels[name] / level for name, (level, _) in fit.noise.items() if name in levels]
    wider = max([1.0, *known])
    prior = np.zeros((len(rows) + slopes.shape[1], slopes.shape[1]))
    prior[: len(rows), : null.turn.shape[1]] = rows / wider
    prior[len(rows) :] = np.diag(np.linalg.norm(slopes, axis=0) / np.sqrt(len(residual)))
    acts = np.linalg.norm(prior, axis=0) > 0
    target = np.concatenate([residual, -offset / wider, np.zeros(slopes.shape[1])])
    size = np.linalg.norm(prior[:, acts], axis=0)
    prior, both = prior[:, acts] / size, np.vstack([slopes, prior])[:, acts] / size
    frame, root = np.linalg.qr(both)
    left = target - frame @ (frame.T @ target)
    spread = np.log(np.abs(np.diag(root))) - np.log(np.abs(np.diag(np.linalg.qr(prior, mode="r"))))
    return float(-0.5 * left @ left - spread.sum())


def _whitened(null: NullModel, levels: Mapping[tuple[str, str], float]) -> tuple[Array, Array]:
    """Residual (N,) in standard deviations, and its slopes (N, p) in parameters and all records' first states.

    levels : (record, output) -> standard deviation
    """
    residual, blocks = [], []
    size = null.turn.shape[1]
    wide = size + sum(len(record.starts) for record in null.records)
    at = size
    for record in null.records:
        for output, e in record.residual.items():
            level = levels[record.name, output]
            block = np.zeros((len(e), wide))
            block[:, :size] = record.slopes[output][:, :size]
            block[:, at : at + len(record.starts)] = record.slopes[output][:, size:]
            residual.append(e / level)
            blocks.append(block / level)
        at += len(record.starts)
    return np.concatenate(residual), np.concatenate(blocks)


def _prior(fit: Fit, null: NullModel) -> tuple[Array, Array]:
    """Rows (m, n_theta) of the fit's knowledge of the parameters, and of the priors of what is found on fresh data."""
    rows, offset = np.zeros((0, null.turn.shape[1])), np.zeros(0)
    known: tuple[str, ...] = ()
    if fit.errors is not None:
        known = fit.errors.names
        whole, shift = fit.errors.over(null.parameters)
        centre = np.array(
            [fit.values.get(name, value) for name, value in zip(null.parameters, null.values, strict=True)]
        )
        # of a parameter without error on fresh data, an event's size that is 0 there, nothing is known through others
        gone = np.flatnonzero(~null.turn.any(axis=1) & whole.any(axis=0))
        both = np.column_stack([whole[:, gone], whole @ null.turn, whole @ (null.values - centre) - shift])
        left = np.asarray(np.linalg.qr(both, mode="r"))[len(gone) :, len(gone) :]
        rows, offset = left[:, :-1], left[:, -1]
        acts = np.linalg.norm(rows, axis=1) > 0
        rows, offset = rows[acts], offset[acts]
    new = np.array([name not in known for name in null.parameters], dtype=bool)
    own = np.any(null.prior[:, :-1][:, np.any(null.turn[new] != 0, axis=0)] != 0, axis=1)
    return np.vstack([rows, null.prior[own, :-1]]), np.concatenate([offset, -null.prior[own, -1]])


def pooled(splits: Sequence[PriorSplit], memory: float) -> tuple[float | None, float | None]:
    """Of several records: chi-squared per sample within the errors of the parameters, and the chance that these have to
    move so far in any of them (Bonferroni), with noise as loud as it is there; None without fresh data, or without a
    direction that both sides tell.

    memory : how many samples of the noise, where it is coloured, count for one
    """
    count = sum(len(one.within) for one in splits)
    if not count:
        return None, None
    within = sum(float(one.within @ one.within) for one in splits) / count
    chances = [float(chi2_sf(one.value / _unit(one) / memory, one.dof)) for one in splits if one.dof > 0]
    return within, min(1.0, min(chances) * len(chances)) if chances else None


def _unit(split: PriorSplit) -> float:
    """The variance of how far parameters move, over that by the noise of the data searched: the fresh data's may be
    louder, which what no parameter reaches tells."""
    loud = float(split.noise @ split.noise) / max(len(split.noise) - split.rank, 1)
    return split.share + (1.0 - split.share) * max(loud, 1.0)
