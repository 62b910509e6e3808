"""How probable the data make a model: its log evidence by Laplace's method, with the noise that it leaves itself.

log Z = log L - 1/2 log det(1 + H/P) + log of the amplitudes' prior at the optimum,

where H is the information of all that is free (parameters, first states, random combustions) and P the precision of
their priors: each number costs what it was known better by. Constants that all models of the same records share are
left out. Level and colour of the noise are those of the model's own residual: noise that a model has to invent costs
it likelihood, and colour that another model does not need costs as many numbers as it has (Schwarz 1978).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array, triangle
from casadi_engine.discrepancy.noise_choice import is_white
from casadi_engine.discrepancy.noise_model import NoiseModel, estimated_noise
from casadi_engine.discrepancy.null_model import NullModel

# Prior standard deviation of a first state, in the state's scale.
_STATE = 10.0
_TINY = 1e-300

Columns = Mapping[str, Mapping[str, Array]]


@dataclass(frozen=True, eq=False)
class Evidence:
    """log : log evidence but for a constant of the records; likelihood : log likelihood at the optimum, likewise
    noise : under which both are counted; error : (nz,) standard errors of the free parameters, inf where not known
    """

    log: float
    likelihood: float
    noise: NoiseModel
    error: Mapping[str, float]


@dataclass(frozen=True)
class Prior:
    """What is known of a free parameter before the data: its standard deviation, and for an amplitude that it is near
    zero (heavy tails) and on one side."""

    deviation: float
    amplitude: bool = False
    one_sided: bool = False


def evidence(
    null: NullModel,
    priors: Mapping[str, Prior],
    *,
    known: Mapping[str, float],
    random: Columns | None = None,
    held: frozenset[str] = frozenset(),
    colour: bool | None = None,
    drawn: float = 0.0,
) -> Evidence:
    """The evidence of a model linearised at its optimum.

    priors : of every free parameter; known : output -> stated standard deviation, the least that is counted with
    random : record -> output -> (N, g) columns of random amplitudes
    held : parameters at a bound; colour : None for a colour where the residual is not white; drawn : log of the share
    of whole numbers that were chosen
    """
    noise = own_noise(null, known, random=random, colour=colour)
    columns = [k for k, name in enumerate(null.parameters) if name not in held]
    turn = null.turn
    if turn.shape[0] == turn.shape[1] and np.count_nonzero(turn) == len(turn):
        turn = turn[:, columns]
    else:
        columns = list(range(turn.shape[1]))
    rows, count, deviance = _stacked(null, noise, columns, random)
    width = rows.shape[1] - 1
    prior = _prior_rows(null, priors, turn, width, noise, random)
    whole = triangle(np.concatenate([rows, prior]))
    value = _log_determinant(prior[:, :width]) - _log_determinant(whole[:width, :width])
    square = float((whole[width:, width] ** 2).sum())
    spent = sum(len(c.covariance) for c in noise.colour.values() if c.covariance is not None)
    likelihood = -0.5 * (deviance + square + spent * math.log(max(count, 2)))
    error = _errors(whole[:width, :width], turn)
    known_error = {name: float(e) for name, e in zip(null.parameters, error, strict=True)}
    at = _amplitudes(null, priors)
    return Evidence(likelihood + value + at - drawn, likelihood, noise, known_error)


def own_noise(
    null: NullModel,
    known: Mapping[str, float],
    *,
    random: Columns | None = None,
    colour: bool | None = None,
) -> NoiseModel:
    """The noise that a model leaves: white if its residual is, else with its colour; levels no lower than the stated."""
    explained = {record.name: dict(record.slopes) for record in null.records}
    made = estimated_noise(null, explained=explained, scatter=random)
    least = NoiseModel(
        {n: max(s, known.get(n, 0.0), _TINY) for n, s in made.sigma.items()}, {}, made.scatter, "estimated", made.freedom
    )  # fmt: skip
    if colour is False or (colour is None and is_white(null, least, explained, random)):
        return least
    return estimated_noise(null, explained=explained, scatter=random, colour=True, start=least)


def _stacked(
    null: NullModel, noise: NoiseModel, columns: list[int], random: Columns | None
) -> tuple[Array, int, float]:
    """Rows [parameters | first states and random amplitudes of each record | residual], number of samples, and the
    part of -2 log likelihood that the noise alone has."""
    own = [
        len(r.starts) + (next(iter(random[r.name].values())).shape[1] if random else 0) for r in null.records
    ]
    wide = len(columns) + sum(own) + 1
    first, parts, deviance, count = len(columns), [], 0.0, 0
    size = null.turn.shape[1]
    for record, more in zip(null.records, own, strict=True):
        for output in record.outputs:
            slopes = record.slopes[output]
            blocks = [slopes[:, columns], slopes[:, size:]]
            if random:
                blocks.append(random[record.name][output])
            stacked = np.column_stack([*blocks, record.residual[output]])
            white = triangle(noise.whiten(record, output, stacked))
            placed = np.zeros((len(white), wide))
            placed[:, : len(columns)] = white[:, : len(columns)]
            placed[:, first : first + more] = white[:, len(columns) : -1]
            placed[:, -1] = white[:, -1]
            parts.append(placed)
            samples = len(record.residual[output])
            count += samples
            deviance += 2 * samples * math.log(noise.sigma[output])
            colour = noise.colour.get((record.name, output))
            if colour is not None:
                deviance += colour.whitener(record.valid(output)).log_determinant
        first += more
    return np.concatenate(parts), count, deviance


def _prior_rows(
    null: NullModel,
    priors: Mapping[str, Prior],
    turn: Array,
    width: int,
    noise: NoiseModel,
    random: Columns | None,
) -> Array:
    """Rows of the priors in the same columns, in standard deviations; those of the user with their residual."""
    deviation = np.array([priors[name].deviation for name in null.parameters])
    tau = max(max(noise.scatter.values(), default=0.0), 1e-6)
    blocks = []
    first = turn.shape[1]
    weak = np.zeros((len(turn), width + 1))
    weak[:, :first] = turn / deviation[:, None]
    blocks.append(weak)
    for record in null.records:
        drawn = next(iter(random[record.name].values())).shape[1] if random else 0
        more = len(record.starts) + drawn
        own = np.zeros((more, width + 1))
        own[:, first : first + more] = np.diag([1 / _STATE] * len(record.starts) + [1 / tau] * drawn)
        blocks.append(own)
        first += more
    if len(null.prior) and null.prior.shape[1] == turn.shape[1] + 1:
        given = np.zeros((len(null.prior), width + 1))
        given[:, : turn.shape[1]], given[:, -1] = null.prior[:, :-1], null.prior[:, -1]
        blocks.append(given)
    return np.concatenate(blocks)


def _log_determinant(rows: Array) -> float:
    """1/2 log det(R'R)."""
    if not rows.shape[1]:
        return 0.0
    strength = np.linalg.svd(rows, compute_uv=False)
    return float(np.log(np.maximum(strength, _TINY)).sum())


def _errors(root: Array, turn: Array) -> Array:
    """(nz,) standard errors from the triangle of all columns."""
    if not turn.shape[1]:
        return np.full(len(turn), np.inf)
    inverse = np.linalg.pinv(root)[: turn.shape[1]]
    found = np.linalg.norm(turn @ inverse, axis=1)
    return np.where(found > 0, found, np.inf)


def _amplitudes(null: NullModel, priors: Mapping[str, Prior]) -> float:
    """log of the amplitudes' prior at their values over its height at zero: Cauchy's, one half where one-sided."""
    found = 0.0
    for name, value in zip(null.parameters, null.values, strict=True):
        own = priors[name]
        if own.amplitude:
            found -= math.log1p((value / own.deviation) ** 2)
            found += math.log(2) if own.one_sided else 0.0
    return found
