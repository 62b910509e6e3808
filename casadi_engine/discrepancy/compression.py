"""Records compressed for the score tests: triangles of the whitened columns [G | S | x0 | s | e], cycle by cycle.

A triangle has the inner products of the columns that it stands for, so that every statistic of the score test, for
all records or for some of their cycles, is found from a few hundred rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.combustion_scatter import Scatter
from casadi_engine.discrepancy.linear_algebra import Array, basis, coefficients, triangle, without
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel, RecordNull


@dataclass(frozen=True, eq=False)
class Part:
    """One cycle of one output of one record: ``samples`` rows of [G | S | x0 | s | e] as a triangle (m, width)."""

    record: str
    output: str
    cycle: int
    samples: int
    triangle: Array


@dataclass(frozen=True, eq=False)
class Reduced:
    """All records with scatter and initial states eliminated: rows of [S | s | e].

    rows : (m, n_theta + k + 1); size : (k,) norms of the whitened s before anything was projected out
    samples : that went in; starts : how many of their dimensions the initial states took
    """

    rows: Array
    parameters: int
    size: Array
    samples: int
    starts: int


@dataclass(frozen=True, eq=False)
class Compressed:
    """What is left of the records for the score tests.

    parameters : n_theta free directions; scatter : record -> (g,) standard deviations of its random amplitudes
    starts : record -> number of free initial states; candidates : names of the k columns s
    prior : (r, n_theta + 1) rows of the priors; turn : (nz, n_theta) from directions to parameters
    """

    parts: tuple[Part, ...]
    parameters: int
    scatter: Mapping[str, Array]
    starts: Mapping[str, int]
    candidates: tuple[Candidate, ...]
    prior: Array
    turn: Array

    @property
    def bytes(self) -> int:
        """Memory of the triangles."""
        return sum(part.triangle.nbytes for part in self.parts)

    @property
    def cycles(self) -> tuple[tuple[str, int], ...]:
        """(record, cycle) of all parts, in order, each once."""
        return tuple(dict.fromkeys((part.record, part.cycle) for part in self.parts))

    def only(self, members: Sequence[int]) -> Compressed:
        """The same records with some of the candidates, by number."""
        parts = []
        for part in self.parts:
            before = len(self.scatter[part.record]) + self.parameters + self.starts[part.record]
            keep = [*range(before), *(before + k for k in members), part.triangle.shape[1] - 1]
            parts.append(replace(part, triangle=triangle(part.triangle[:, keep])))
        candidates = tuple(self.candidates[k] for k in members)
        return replace(self, parts=tuple(parts), candidates=candidates)

    def reduced(self, chosen: Sequence[tuple[str, int]] | None = None) -> Reduced:
        """Eliminate scatter and initial states; chosen : the (record, cycle) to use, None for all."""
        wanted = None if chosen is None else set(chosen)
        width = self.parameters + len(self.candidates) + 1
        kept, size, samples, starts = [], np.zeros(len(self.candidates)), 0, 0
        for record in dict.fromkeys(part.record for part in self.parts):
            parts = [
                part
                for part in self.parts
                if part.record == record and (wanted is None or (record, part.cycle) in wanted)
            ]
            if not parts:
                continue
            samples += sum(part.samples for part in parts)
            rows = triangle(np.concatenate([part.triangle for part in parts]))
            tau = self.scatter[record]
            drawn = tau > 0
            random, rest = rows[:, : len(tau)][:, drawn] * tau[drawn], rows[:, len(tau) :]
            if drawn.any():
                # an amplitude of unit variance: its prior is one more row
                random = np.concatenate([random, np.eye(int(drawn.sum()))])
                rest = np.concatenate([rest, np.zeros((len(random) - len(rest), rest.shape[1]))])
                rest = without(np.linalg.qr(random)[0], rest)
            first = self.parameters + self.starts[record]
            size += (rest[:, first:-1] ** 2).sum(axis=0)
            states = basis(rest[:, self.parameters : first])
            starts += states.shape[1]
            free = np.concatenate([rest[:, : self.parameters], rest[:, first:]], axis=1)
            kept.append(triangle(without(states, free)))
        rows = np.concatenate(kept) if kept else np.zeros((0, width))
        if len(self.prior):
            extra = np.zeros((len(self.prior), width))
            extra[:, : self.parameters], extra[:, -1] = self.prior[:, :-1], self.prior[:, -1]
            rows = np.concatenate([rows, extra])
        return Reduced(triangle(rows), self.parameters, np.sqrt(size), samples, starts)


def compress(
    null: NullModel,
    candidates: Sequence[Candidate],
    noise: NoiseModel,
    *,
    scatter: Sequence[Scatter] = (),
    columns: Mapping[str, Mapping[str, Array]] | None = None,
) -> Compressed:
    """Whiten and compress all records.

    columns : record -> output -> (N, k) sensitivities of the candidates if they are known already
    """
    parts: list[Part] = []
    for record in null.records:
        known = candidate_columns(record, candidates) if columns is None else columns[record.name]
        random = scatter_columns(record, scatter)
        for output in record.outputs:
            stacked = np.concatenate(
                [random[output], record.slopes[output], known[output], record.residual[output][:, None]],
                axis=1,
            )
            white = noise.whiten(record, output, stacked)
            cycle = noise.cycles(record, output)
            for number in np.unique(cycle):
                inside = cycle == number
                count = int((record.cycle[output] == number).sum())
                rows = triangle(np.ascontiguousarray(white[inside]))
                parts.append(Part(record.name, output, int(number), count, rows))
    return Compressed(
        tuple(parts),
        null.turn.shape[1],
        {record.name: scatter_levels(record, scatter, noise) for record in null.records},
        {record.name: len(record.starts) for record in null.records},
        tuple(candidates),
        null.prior,
        null.turn,
    )


def candidate_columns(record: RecordNull, candidates: Sequence[Candidate]) -> dict[str, Array]:
    """Sensitivities of the candidates in one record: output -> (N, k), zero for those that do not act there."""
    own = [(k, direction) for k, c in enumerate(candidates) if (direction := c.at(record.name)) is not None]
    found = record.columns([direction for _, direction in own])
    if len(own) == len(candidates):
        return found
    out = {}
    for name, values in found.items():
        out[name] = np.zeros((len(values), len(candidates)))
        out[name][:, [k for k, _ in own]] = values
    return out


def scatter_columns(record: RecordNull, scatter: Sequence[Scatter]) -> dict[str, Array]:
    """Sensitivities of a record's random amplitudes: output -> (N, g)."""
    return record.columns([d for s in scatter if s.record == record.name for d in s.directions])


def scatter_levels(record: RecordNull, scatter: Sequence[Scatter], noise: NoiseModel) -> Array:
    """(g,) standard deviations of a record's random amplitudes."""
    own = [s for s in scatter if s.record == record.name]
    return np.array([noise.scatter.get(s.kind, 0.0) for s in own for _ in s.directions], dtype=float)


def shifts(reduced: Reduced) -> Array:
    """(n_theta, k + 1) least-squares coefficients of [s | e] in S."""
    n = reduced.parameters
    return coefficients(reduced.rows[:, :n], reduced.rows[:, n:])
