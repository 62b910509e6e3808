"""A function of one signal in the place of effects, each held against the colour of the noise that it leaves itself."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from casadi_engine.discrepancy.beside_starts import moved_by
from casadi_engine.discrepancy.evidence import Columns, Digest, Levels, Prior, digest, evidence, rows_of
from casadi_engine.discrepancy.linear_algebra import Array, inverse
from casadi_engine.discrepancy.noise_model import NoiseModel, estimated_noise
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.random_families import Family

# Sizes of the function over which its evidence is averaged: what moves an output by its own variation, down to the
# ten-thousandth of it.
SIZES = np.logspace(-4, 0, 9)
LAW = "law"
# Share of what effects leave beyond white noise that a function has to take for that to be no noise of the sensors.
TAKEN = 0.8
# Share of what chi-squared rises by without effects that slopes have to say it rises by.
_TOLD = 0.01
LAW = "law"


@dataclass
class Rival:
    """A function in the place of effects: its log odds, its model, and what its evidence is counted from, at its
    largest and at the size that serves best; price : log of among how many it is one; far : it is none of what a port
    itself knows."""

    log: float
    family: Family
    null: NullModel
    largest: Digest
    digest: Digest
    price: float = 0.0
    far: bool = False


def with_own_colour(rival: Rival, null: NullModel, effects: Digest, own: frozenset[str]) -> float:
    """The log odds of a function that takes most of the colour that effects leave, where either is held against the
    colour that it leaves itself; -inf for one that leaves most of it, which is then the sensors' own.

    own : the effects' numbers
    """
    taken = _own_columns(null, own)
    n, terms = rival.null.turn.shape[1], len(rival.family.members)
    law = {r.name: {o: c[:, n - terms : n] for o, c in r.slopes.items()} for r in rival.null.records}
    rest = {
        r.name: {o: np.delete(c, np.s_[n - terms : n], axis=1) for o, c in r.slopes.items()}
        for r in rival.null.records
    }
    with_law, with_effects = _stacked(rest, law), _stacked(rest, taken)
    ours = estimated_noise(rival.null, explained=with_law, colour=True)
    theirs = estimated_noise(null, explained=with_effects, colour=True)
    white = (estimated_noise(rival.null, explained=with_law), estimated_noise(null, explained=with_effects))
    power = [np.array([one.sigma[name] for name in sorted(one.sigma)]) ** 2 for one in (*white, ours)]
    if ((power[1] - power[0]) / power[2]).sum() < TAKEN * ((power[1] - power[2]) / power[2]).sum():
        return -math.inf
    found, at = _in_white(rival.null, ours, rival.largest)
    unit = Levels(dict.fromkeys(ours.sigma, 1.0))
    logs = [evidence(of_size(found, names_of(rival.family), share), unit).log for share in SIZES]
    named, there = _in_white(null, theirs, effects)
    return (
        float(np.logaddexp.reduce(logs)) - math.log(len(SIZES)) - evidence(named, unit).log
        + 0.5 * (there - at)
    )  # fmt: skip


def _in_white(null: NullModel, noise: NoiseModel, made: Digest) -> tuple[Digest, float]:
    """What evidence is counted from with rows that this noise makes white, and -2 log of what the whitening changes the
    samples' density by, plus twice the number of colour parameters (Akaike)."""
    constant = sum(2.0 * len(c.covariance) for c in noise.colour.values() if c.covariance is not None)
    records = []
    for record in null.records:
        residual, slopes = {}, {}
        for output, e in record.residual.items():
            rows = noise.whiten(record, output, np.column_stack([record.slopes[output], e]))
            slopes[output], residual[output] = rows[:, :-1], rows[:, -1]
            constant += 2 * len(e) * math.log(noise.sigma[output])
            colour = noise.colour.get((record.name, output))
            if colour is not None:
                constant += colour.whitener(record.valid(output)).log_determinant
        records.append(replace(record, residual=residual, slopes=slopes))
    whitened = replace(null, records=tuple(records))
    return replace(made, parts=rows_of(whitened)[0]), constant


def _own_columns(null: NullModel, own: Collection[str]) -> Columns:
    """What the effects' numbers move: record -> output -> (N, k)."""
    n = null.turn.shape[1]
    mine = [k for k, name in enumerate(null.parameters) if name in own]
    moved = linalg.null_space(free_of(null.turn, mine).T)
    return {r.name: {o: every[:, :n] @ moved for o, every in r.slopes.items()} for r in null.records}


def _stacked(columns: Columns, more: Columns) -> dict[str, dict[str, Array]]:
    return {
        r: {o: np.column_stack([c, more[r][o]]) for o, c in outputs.items()} for r, outputs in columns.items()
    }


def free_of(turn: Array, mine: Sequence[int]) -> Array:
    """(n, m) the directions in which some parameters do not move."""
    apart = ~turn[list(mine)].any(axis=0)
    alone = [bool(mine) and not np.delete(column, mine).any() for column in turn.T]
    if np.all(apart | np.array(alone)):
        return np.asarray(np.eye(turn.shape[1])[:, apart])
    rows = turn[list(mine)]
    size = np.abs(rows).max(axis=1, keepdims=True, initial=0.0)
    return np.asarray(linalg.null_space(rows / np.where(size > 0, size, 1.0)))


def of_size(made: Digest, terms: Sequence[str], share: float) -> Digest:
    """The same with a prior of the function's terms that is so much narrower."""
    prior = made.prior.copy()
    prior[[made.names.index(name) for name in terms]] /= share
    return replace(made, prior=prior)


def names_of(family: Family) -> list[str]:
    """The terms of a function as parameters."""
    return [f"{LAW} {k}" for k in range(len(family.members))]


def without_effects(null: NullModel, amplitudes: Sequence[str], own: Collection[str]) -> NullModel | None:
    """The model without its effects' numbers, and with what their laws did left to the residual; None where an
    amplitude is not free."""
    mine = [k for k, name in enumerate(null.parameters) if name in own]
    rest = [k for k in range(len(null.parameters)) if k not in mine]
    step = np.zeros(len(null.parameters))
    for k, name in enumerate(null.parameters):
        step[k] = null.values[k] if name.partition("@")[0] in amplitudes else 0.0
    n = null.turn.shape[1]
    taken = inverse(null.turn) @ step
    # each parameter in the size of its own
    off = np.abs(null.turn @ taken - step)
    if not (off <= 1e-6 * np.abs(step) + 1e-9 * np.abs(null.turn).max(axis=1, initial=0.0)).all():
        return None
    inside = free_of(null.turn, mine)
    records = []
    for record in null.records:
        slopes, residual = {}, {}
        for output, every in record.slopes.items():
            slopes[output] = np.column_stack([every[:, :n] @ inside, every[:, n:]])
            residual[output] = record.residual[output] + every[:, :n] @ taken
        records.append(replace(record, slopes=slopes, residual=residual))
    prior = null.prior
    if len(prior):
        prior = np.column_stack([prior[:, :-1] @ inside, prior[:, -1]])
    return replace(
        null,
        parameters=tuple(null.parameters[k] for k in rest),
        units=tuple(null.units[k] for k in rest),
        values=null.values[rest],
        turn=null.turn[rest] @ inside,
        prior=prior,
        records=tuple(records),
    )


def bare_digest(
    bare: NullModel, priors: Mapping[str, Prior], held: frozenset[str], random: Columns | None
) -> Digest:
    """What the evidence of a model without its effects is counted from."""
    own = {name: prior for name, prior in priors.items() if name in bare.parameters}
    return digest(bare, own, random=random, held=held)


def is_told(linear: float, named: float, without: float) -> bool:
    """True unless slopes say that a model without its effects is next to as good, where a refit says it is not.

    Where outputs do not change if effects and parameters grow together, the others by their slopes make up for effects
    of any size, and what takes the place of these has nothing to explain.

    linear : chi-squared without the effects by the slopes; named, without : of the refits with them and without
    """
    return linear - named >= _TOLD * (without - named)


def beside_it(bare: NullModel, columns: Columns) -> NullModel:
    """The model with the terms of a function as further parameters."""
    terms = next(iter(next(iter(columns.values())).values())).shape[1]
    names = tuple(f"{LAW} {k}" for k in range(terms))
    n = bare.turn.shape[1]
    records = []
    for record in bare.records:
        slopes = {
            output: np.column_stack([every[:, :n], columns[record.name][output], every[:, n:]])
            for output, every in record.slopes.items()
        }
        records.append(replace(record, slopes=slopes))
    prior = bare.prior
    if len(prior):
        prior = np.column_stack([prior[:, :-1], np.zeros((len(prior), terms)), prior[:, -1]])
    return replace(
        bare,
        parameters=(*bare.parameters, *names),
        units=(*bare.units, *["1"] * terms),
        values=np.concatenate([bare.values, np.zeros(terms)]),
        turn=linalg.block_diag(bare.turn, np.eye(terms)),
        prior=prior,
        records=tuple(records),
    )


def counted_with(
    null: NullModel,
    priors: dict[str, Prior],
    family: Family,
    held: frozenset[str],
    random: Columns | None,
) -> Digest | None:
    """What the evidence of a function is counted from, at its largest size; None where it moves no output."""
    names = names_of(family)
    first = null.turn.shape[1] - len(names)
    size = math.inf
    for record in null.records:
        terms = {
            o: s[:, first : first + len(names)] * np.sqrt(family.variances) for o, s in record.slopes.items()
        }
        for output, sizes in moved_by(null, record, terms).items():
            moved = float(np.linalg.norm(sizes))
            varied = float(np.std(record.path.grid.measured[output].values))
            if moved > 0 and varied > 0:
                size = min(size, varied / moved)
    if not math.isfinite(size):
        return None
    own = {name: Prior(size * math.sqrt(v)) for name, v in zip(names, family.variances, strict=True)}
    return digest(null, priors | own, random=random, held=held)
