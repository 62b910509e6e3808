"""Colour of a noise in which effects may hide.

A colour fitted with the whole library in the model has nothing left at low frequencies and comes out too white there:
false alarms. Fitted without any effect, it takes a large one for noise. So effects are held beside the noise one by
one, each only if the likelihood of both together, each with the colour that is fitted beside it, is beyond chance: by
its own score alone, a step whose colour has no slow part left would always beat a slow wander.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from casadi_engine.deadline import ask
from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.combustion_scatter import Scatter
from casadi_engine.discrepancy.compression import Compressed, Reduced, compress
from casadi_engine.discrepancy.freedom import freedom_of
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.noise_model import NoiseModel, deviance, estimated_noise
from casadi_engine.discrepancy.null_distribution import NullDistribution, library_rows
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.score import Scores, scores_of, upper_tail

Columns = Mapping[str, Mapping[str, Array]]

# Effects held at most; candidates tried for each, the best by coloured and by white noise; of those alike, one.
_EFFECTS, _TRIED, _ALIKE = 4, 3, 0.95
# An effect is held if chance does as much, anywhere in the library, less often than this.
_CHANCE = 0.01


def coloured_noise(
    null: NullModel,
    candidates: Sequence[Candidate],
    columns: Columns,
    white: Compressed,
    *,
    scatter: Sequence[Scatter] = (),
    random: Columns | None = None,
) -> tuple[NoiseModel, list[int]]:
    """The noise with its colour, and the numbers of the candidates that were held beside it.

    white : the records compressed with white noise; scatter, random : random amplitudes and their columns
    """
    held: list[int] = []
    noise = estimated_noise(null, explained=beside(null, columns, held), scatter=random, colour=True)
    while len(held) < _EFFECTS:
        every = compress(null, candidates, noise, scatter=scatter, columns=columns, freedom=False)
        scores = _given(every, held)
        if not scores.testable.any():
            break
        law = NullDistribution(library_rows(scores))
        tried = list(dict.fromkeys([*_best(scores), *_best(_given(white, held))]))
        freedom = freedom_of(null, _only(columns, tried), noise, scatter=random, levels=every.scatter)
        found: list[tuple[float, int, NoiseModel]] = []
        for k, known in zip(tried, freedom, strict=True):
            ask()
            left = beside(null, columns, [*held, k])
            own = estimated_noise(null, explained=left, scatter=random, colour=True, start=noise)
            if _allowed(null, candidates, columns, own, scatter, held, k):
                sides = 2 if candidates[k].side == 0 else 1
                width = next(iter(left[null.records[0].name].values())).shape[1]
                gain = deviance(null, noise, left, width - 1, random) - deviance(
                    null, own, left, width, random
                )
                found.append((sides * _by_likelihood(gain, float(known)), k, own))
        if not found:
            break
        p, k, own = min(found, key=lambda one: one[0])
        if law.pooled(p) > _CHANCE:
            break
        held.append(k)
        noise = own
    return noise, held


def beside(null: NullModel, columns: Columns, held: Sequence[int]) -> dict[str, dict[str, Array]]:
    """Null slopes and candidates' columns by number: record -> output -> (N, k)."""
    return {
        record.name: {
            output: np.concatenate(
                [record.slopes[output], columns[record.name][output][:, list(held)]], axis=1
            )
            for output in record.outputs
        }
        for record in null.records
    }


def _only(columns: Columns, members: Sequence[int]) -> Columns:
    """The columns of some candidates."""
    return {record: {o: c[:, members] for o, c in outputs.items()} for record, outputs in columns.items()}


def _given(compressed: Compressed, held: Sequence[int]) -> Scores:
    """Scores with the held candidates free like parameters."""
    whole = compressed.reduced()
    n = whole.parameters
    rows = whole.rows
    if held:
        rows = np.concatenate([rows[:, :n], rows[:, [n + k for k in held]], rows[:, n:]], axis=1)
    reduced = Reduced(rows, n + len(held), whole.size, whole.samples, whole.starts)
    return scores_of(reduced, compressed.candidates, np.zeros((0, n + len(held))), compressed.freedom)


def _best(scores: Scores) -> list[int]:
    """The candidates of the largest statistics that are not alike."""
    chosen: list[int] = []
    statistic = np.where(scores.testable, scores.statistic, 0.0)
    for k in np.argsort(-statistic):
        if len(chosen) == _TRIED or statistic[k] <= 0:
            break
        if not chosen or np.abs(scores.correlation[k, chosen]).max() < _ALIKE:
            chosen.append(int(k))
    return chosen


def _by_likelihood(gain: float, freedom: float) -> float:
    """The one-sided p-value of an amplitude that lowers -2 log likelihood by ``gain``.

    The noise was estimated with the amplitude and without it, with so many degrees of freedom: Student's t, of which
    the gain is a function.
    """
    if not np.isfinite(freedom):
        return float(upper_tail(np.sqrt(max(gain, 0.0)), None))
    squared = freedom * np.expm1(min(max(gain, 0.0) / (freedom + 1), 700.0))
    return float(upper_tail(np.sqrt(squared), freedom))


def _allowed(
    null: NullModel,
    candidates: Sequence[Candidate],
    columns: Columns,
    noise: NoiseModel,
    scatter: Sequence[Scatter],
    held: Sequence[int],
    k: int,
) -> bool:
    """True if one candidate beside the held ones can be tested and has an amplitude of the allowed sign."""
    members = [*held, k]
    chosen = [candidates[j] for j in members]
    own = _only(columns, members)
    compressed = compress(null, chosen, noise, scatter=scatter, columns=own, freedom=False)
    scores = _given(compressed, range(len(held)))
    return bool(scores.testable[-1] and scores.statistic[-1] > 0)
