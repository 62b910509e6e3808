"""How probable the data make a model: its log evidence by Laplace's method.

log Z = log L - 1/2 log det(1 + H/P) + log of the amplitudes' prior at the optimum,

where H is the information of all that is free (parameters, first states, random combustions) and P the precision of
their priors: each number costs what it was known better by. Constants that all models of the same records share are
left out.

Noise is a property of the sensors, not of the model: all models are held against the same one, which the most probable
of them leaves. A wrong model's residual is smooth, and an autoregression of its own predicts it well from one sample to
the next; counted as noise it would excuse any missing effect that is slow. Where what the best model leaves is
coloured, samples count as so many independent ones as they are worth (``Levels.memory``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import special

from casadi_engine.discrepancy.linear_algebra import Array, inverse, svd, triangle
from casadi_engine.discrepancy.noise_choice import is_white
from casadi_engine.discrepancy.noise_model import NoiseModel, estimated_noise, left_over
from casadi_engine.discrepancy.null_model import NullModel, RecordNull
from casadi_engine.discrepancy.selection import effective_samples
from casadi_engine.estimation.autoregression import autoregression

# Prior standard deviation of a first state, in the state's scale.
_STATE = 10.0
# What an effect's own state may start from where it never moves.
_STILL = 1e-9
_TINY = 1e-300
# Samples below which nothing can be said of colour.
_SHORT = 20
# A structure is excluded where another one is so many times more probable.
FACTOR = 20.0
# log of the height of a normal law over Cauchy's of the same width.
_HEAVY = 0.5 * math.log(math.pi / 2)

Columns = Mapping[str, Mapping[str, Array]]


@dataclass(frozen=True)
class Prior:
    """What is known of a free parameter before the data: its standard deviation, and for an amplitude that it is near
    a centre (heavy tails), and on one side of it; open : a parameter without bounds, which is near its start likewise.
    """

    deviation: float
    amplitude: bool = False
    one_sided: bool = False
    centre: float = 0.0
    open: bool = False


@dataclass(frozen=True)
class Levels:
    """The noise that models are held against: output -> standard deviation, and how many samples are worth one
    independent one; scatter : standard deviation of random amplitudes, in their unit; foretold : what the past of the
    residual foretells of chi-squared, which a better model may take away."""

    sigma: Mapping[str, float]
    memory: Mapping[str, float] = field(default_factory=dict)
    scatter: float = 0.0
    foretold: float = 0.0

    def weight(self, output: str) -> float:
        """What an output's residual is multiplied by."""
        return 1 / (self.sigma[output] * math.sqrt(self.memory.get(output, 1.0)))


@dataclass(frozen=True, eq=False)
class Digest:
    """A model linearised at its optimum, small enough to keep: for every record and output a triangle of
    [parameters | first states and random amplitudes of each record | residual].

    prior : rows of the priors in the same columns; random : which columns are random amplitudes; turn : (nz, n) from
    directions to parameters; amplitudes : log of the prior of amplitudes and of effects' first states at their
    values; held : columns of parameters at a bound
    """

    names: tuple[str, ...]
    parts: tuple[tuple[str, Array], ...]
    prior: Array
    random: Array
    turn: Array
    amplitudes: float
    held: tuple[int, ...] = ()

    def rows(self, levels: Levels) -> Array:
        """The rows of all outputs and priors, in standard deviations, without what is at a bound."""
        rows = np.concatenate([*(part * levels.weight(output) for output, part in self.parts), self.prior])
        return np.delete(rows, list(self.held), axis=1)


@dataclass(frozen=True, eq=False)
class Evidence:
    """log : log evidence but for a constant of the records; cost : chi-squared with priors at the optimum
    error : standard errors of the free parameters, inf where not known; alone : as if all others were known
    """

    log: float
    cost: float
    error: Mapping[str, float]
    alone: Mapping[str, float] = field(default_factory=dict)


def digest(
    null: NullModel,
    priors: Mapping[str, Prior],
    *,
    random: Columns | None = None,
    held: frozenset[str] = frozenset(),
    choices: float = 1.0,
) -> Digest:
    """What a model's evidence is counted from.

    priors : of every free parameter; random : record -> output -> (N, g) columns of random amplitudes
    held : parameters at a bound; choices : whole numbers from which the effects' were chosen
    """
    parts, is_random = rows_of(null, random=random)
    prior = _prior_rows(null, priors, is_random)
    at = _amplitudes(null, priors) - math.log(choices)
    # at their values, not linearised: what a state does is its product with an amplitude
    at -= sum(0.5 * float(np.sum((off / free) ** 2)) for off, free in map(_first_states, null.records))
    return Digest(null.parameters, parts, prior, is_random, null.turn, at, _columns_of(null, held))


def _columns_of(null: NullModel, names: frozenset[str]) -> tuple[int, ...]:
    """The columns in which nothing but a parameter of these moves, where each has one of its own."""
    if null.turn.shape[0] != null.turn.shape[1] or np.count_nonzero(null.turn) != len(null.turn):
        return ()
    return tuple(
        int(np.flatnonzero(row)[0])
        for name, row in zip(null.parameters, null.turn, strict=True)
        if name in names
    )


def rows_of(null: NullModel, *, random: Columns | None = None) -> tuple[tuple[tuple[str, Array], ...], Array]:
    """The parts and random columns of a model's ``Digest``."""
    n = null.turn.shape[1]
    drawn = {r.name: next(iter(random[r.name].values())).shape[1] if random else 0 for r in null.records}
    wide = n + sum(len(r.starts) + drawn[r.name] for r in null.records) + 1
    first, parts = n, []
    is_random = np.zeros(wide - 1, dtype=bool)
    for record in null.records:
        more = len(record.starts) + drawn[record.name]
        is_random[first + len(record.starts) : first + more] = True
        for output in record.outputs:
            slopes = record.slopes[output]
            own = [slopes, random[record.name][output]] if random else [slopes]
            rows = triangle(np.column_stack([*own, record.residual[output]]))
            placed = np.zeros((len(rows), wide))
            placed[:, :n] = rows[:, :n]
            placed[:, first : first + more] = rows[:, n:-1]
            placed[:, -1] = rows[:, -1]
            parts.append((output, placed))
        first += more
    return tuple(parts), is_random


def evidence(model: Digest, levels: Levels) -> Evidence:
    """The evidence of a model with this noise."""
    width = model.prior.shape[1] - 1
    prior = model.prior.copy()
    drawn = np.flatnonzero(model.random)
    last = [*(k for k in range(width) if k not in model.held), *model.held, width]
    used = np.ones(width + 1, dtype=bool)
    if len(drawn):
        extra = np.zeros((len(drawn), width + 1))
        extra[np.arange(len(drawn)), drawn] = 1 / max(levels.scatter, 1e-6)
        prior = np.concatenate([prior, extra])
        used[drawn] = levels.scatter > 0
    rows = np.concatenate([part * levels.weight(output) for output, part in model.parts])
    order = [k for k in last if used[k]]
    whole, prior = triangle(np.concatenate([rows, prior])[:, order]), prior[:, order]
    if not np.isfinite(whole).all():  # slopes along a motion that has run off
        return Evidence(-math.inf, math.inf, {}, {})
    free = len(order) - 1 - len(model.held)
    occam = _log_determinant(prior[:, :free]) - _log_determinant(whole[:free, :free])
    occam += _at_bounds(whole[free:-1, free:], np.linalg.norm(prior[:, free:-1], axis=0))
    cost = float((whole[free:, -1] ** 2).sum())
    turn = np.delete(model.turn, list(model.held), axis=1)
    error = dict(zip(model.names, _errors(whole[:free, :free], turn).tolist(), strict=True))
    alone = dict(zip(model.names, _errors_alone(whole[:free, :free], turn).tolist(), strict=True))
    return Evidence(-0.5 * cost + occam + model.amplitudes, cost, error, alone)


def _at_bounds(rows: Array, precision: Array) -> float:
    """log of the share of their prior that the data leave to parameters at a bound, each by itself: the likelihood
    falls from there to the inside, by its slope and its curvature.

    rows : (m, m + 1) of [parameters at a bound | residual], what all others explain taken out
    """
    if not len(precision):
        return 0.0
    curvature = np.maximum(np.linalg.norm(rows[:, :-1], axis=0), _TINY)
    beyond = np.abs(rows[:, :-1].T @ rows[:, -1]) / curvature
    inside = np.log(special.erfcx(beyond / math.sqrt(2)) / 2)
    return float((np.log(np.maximum(precision, _TINY) / curvature) + inside).sum())


def levels_left(
    null: NullModel, known: Mapping[str, float], scatter: float, random: Columns | None
) -> Levels:
    """The noise that a model leaves: no lower than what was stated, its memory where it is not white."""
    explained = {record.name: dict(record.slopes) for record in null.records}
    made = estimated_noise(null, explained=explained, scatter=random)
    sigma = {n: max(s, known.get(n, 0.0), _TINY) for n, s in made.sigma.items()}
    white = NoiseModel(sigma, {}, made.scatter, "estimated", made.freedom)
    if is_white(null, white, explained, random):
        return Levels(sigma, {}, scatter)
    count = dict.fromkeys(sigma, 0.0)
    worth = dict.fromkeys(sigma, 0.0)
    told = 0.0
    # what the slopes explain is no noise: a search may have ended short of its optimum
    left = left_over(null, white, explained, random)
    for record in null.records:
        for output, e in left[record.name].items():
            count[output] += len(e)
            worth[output] += effective_samples(e)
            told += foretold(e / sigma[output])
    memory = {n: count[n] / worth[n] for n in sigma if worth[n] > 0}
    return Levels(sigma, memory, scatter, told)


def innovations(null: NullModel, levels: Levels) -> float:
    """Minus the log likelihood of a model's residuals as noise of their own level and colour, but for a constant, and
    what the numbers cost that describe the colour: half the logarithm of the samples each (Schwarz 1978).

    levels : that the model leaves; its levels count where the residual is smaller, as one that was stated does.
    """
    squares, least = dict.fromkeys(levels.sigma, 0.0), dict.fromkeys(levels.sigma, 0.0)
    counts, paid = dict.fromkeys(levels.sigma, 0), 0.0
    for record in null.records:
        for output, e in record.residual.items():
            coloured = output in levels.memory and len(e) >= _SHORT
            own = max(float(e @ e), _TINY)
            told, order = _predicted(e) if coloured else (0.0, 0)
            share = 1 - told
            squares[output] += share * own
            least[output] += share * max(own, len(e) * levels.sigma[output] ** 2)
            counts[output] += len(e)
            paid += 0.5 * order * math.log(len(e))
    found = paid
    for name, count in counts.items():
        if count:
            level = max(least[name] / count, _TINY)
            found += 0.5 * (count * math.log(level) + squares[name] / level - count)
    return found


def foretold(e: Array) -> float:
    """What the past of a residual (N,) foretells of its squares; all where it is too short to tell."""
    squares = float(e @ e)
    if len(e) < _SHORT:
        return squares
    variance = _variances(e)
    return squares * float(1 - variance[-1] / max(variance[0], 1e-300))


def _predicted(e: Array) -> tuple[float, int]:
    """The share of a residual's squares that so many samples of its past foretell, as many as pay for themselves."""
    variance = _variances(e)
    orders = np.arange(len(variance))
    best = int(np.argmin(len(e) * np.log(variance) + orders * math.log(len(e))))
    return float(1 - variance[best] / variance[0]), best


def _variances(e: Array) -> Array:
    """(p + 1,) of the innovations of autoregressions of a residual, by their order."""
    found = autoregression(e[:, None], np.ones(len(e), dtype=bool)).variances
    return np.maximum(found, _TINY)


def _prior_rows(null: NullModel, priors: Mapping[str, Prior], random: Array) -> Array:
    """Rows of the priors, in standard deviations; those of the user with their residual."""
    width, turn = len(random), null.turn
    deviation = np.array([priors[name].deviation for name in null.parameters])
    weak = np.zeros((len(turn), width + 1))
    weak[:, : turn.shape[1]] = turn / deviation[:, None]
    states = [k for k in range(turn.shape[1], width) if not random[k]]
    start = np.zeros((len(states), width + 1))
    start[np.arange(len(states)), states] = 1 / np.concatenate([_first_states(r)[1] for r in null.records])
    blocks: Sequence[Array] = [weak, start]
    if len(null.prior):
        given = np.zeros((len(null.prior), width + 1))
        given[:, : turn.shape[1]], given[:, -1] = null.prior[:, :-1], null.prior[:, -1]
        blocks = [*blocks, given]
    return np.concatenate(blocks)


def _first_states(record: RecordNull) -> Array:
    """(2, n_start) of the free first states of a record: how far they are from where they may well begin, and the prior
    standard deviation of that, in their scales. An effect's own state has no scale that a user gave."""
    known = [record.begins.get(name, (0.0, _STATE)) for name in record.starts]
    return np.array([(off, max(free, _STILL)) for off, free in known]).reshape(-1, 2).T


def _log_determinant(rows: Array) -> float:
    """1/2 log det(R'R)."""
    if not rows.shape[1]:
        return 0.0
    strength = svd(rows)[1]
    return float(np.log(np.maximum(strength, _TINY)).sum())


def _errors(root: Array, turn: Array) -> Array:
    """(nz,) standard errors from the triangle of all columns."""
    if not turn.shape[1]:
        return np.full(len(turn), np.inf)
    inverse = np.linalg.pinv(root)[: turn.shape[1]]
    found = np.linalg.norm(turn @ inverse, axis=1)
    return np.where(found > 0, found, np.inf)


def _errors_alone(root: Array, turn: Array) -> Array:
    """(nz,) standard errors where all other parameters and the first states are known."""
    if not turn.shape[1]:
        return np.full(len(turn), np.inf)
    moved = np.linalg.norm(root[:, : turn.shape[1]] @ inverse(turn), axis=0)
    return np.where(moved > 0, 1 / np.maximum(moved, _TINY), np.inf)


def _amplitudes(null: NullModel, priors: Mapping[str, Prior]) -> float:
    """log of the amplitudes' prior, Cauchy's or the half of it where one-sided, at their values, over the height of
    the normal law that Occam's factor counts with; and what parameters without bounds pay that ran away: a storage with
    a millionth of its loss is the storage that a structure adds, under another name."""
    found = 0.0
    for name, value in zip(null.parameters, null.values, strict=True):
        own = priors[name]
        if own.amplitude:
            found -= math.log1p(((value - own.centre) / own.deviation) ** 2) + _HEAVY
            found += math.log(2) if own.one_sided else 0.0
        elif own.open:
            found -= math.log1p(((value - own.centre) / own.deviation) ** 2)
    return found
