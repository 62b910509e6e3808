"""Records compressed for the score tests: triangles of the whitened columns [G | S | x0 | s | e], cycle by cycle.

A triangle has the inner products of the columns that it stands for, so that every statistic of the score test, for
all records or for some of their cycles, is found from a few hundred rows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.combustion_scatter import Scatter
from casadi_engine.discrepancy.freedom import freedom_of
from casadi_engine.discrepancy.linear_algebra import Array, basis, coefficients, triangle, without
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel, RecordNull

# Candidates that explain the residual while a level is estimated: no more than this share of an output's samples.
_SHARE = 0.25
_ROUNDS = 3
# Share of what a candidate does that is rounding where the record's start takes the rest.
_ROUNDED = 1e-9


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
    sigma : output -> the level by which white rows were divided, None where the noise is coloured
    freedom : (k,) degrees of freedom of each candidate's score, None where the noise is known
    """

    parts: tuple[Part, ...]
    parameters: int
    scatter: Mapping[str, Array]
    starts: Mapping[str, int]
    candidates: tuple[Candidate, ...]
    prior: Array
    turn: Array
    sigma: Mapping[str, float] | None = None
    freedom: Array | None = None

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
        freedom = None if self.freedom is None else self.freedom[list(members)]
        return replace(self, parts=tuple(parts), candidates=candidates, freedom=freedom)

    def relevelled(self, noise: NoiseModel, scatter: Sequence[Scatter] = ()) -> Compressed:
        """The same records with white noise of other levels, and other levels of the scatter: rows times a factor."""
        assert self.sigma is not None
        assert not noise.colour
        factor = {name: sigma / noise.sigma[name] for name, sigma in self.sigma.items()}
        parts = tuple(replace(p, triangle=p.triangle * factor[p.output]) for p in self.parts)
        levels = {record: scatter_levels(record, scatter, noise) for record in self.scatter}
        freedom = np.full(len(self.candidates), min(noise.freedom.values())) if noise.freedom else None
        return replace(self, parts=parts, scatter=levels, sigma=dict(noise.sigma), freedom=freedom)

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
            states = basis(rest[:, self.parameters : first])
            starts += states.shape[1]
            free = without(states, np.concatenate([rest[:, : self.parameters], rest[:, first:]], axis=1))
            kept.append(triangle(free))
            # what a candidate does is what no other start of the record does too: along an unstable motion all that
            # acts is first of all another start
            whole, own = (
                np.square(part).sum(axis=0) for part in (rest[:, first:-1], free[:, self.parameters : -1])
            )
            size += np.where(own > _ROUNDED**2 * whole, own, whole)
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
    freedom: bool = True,
) -> Compressed:
    """Whiten and compress all records.

    columns : record -> output -> (N, k) sensitivities of the candidates if they are known already
    freedom : count the scores' degrees of freedom
    """
    parts: list[Part] = []
    if columns is None:
        columns = {record.name: candidate_columns(record, candidates) for record in null.records}
    drawn = {record.name: scatter_columns(record, scatter) for record in null.records}
    levels = {record.name: scatter_levels(record.name, scatter, noise) for record in null.records}
    for record in null.records:
        known, random = columns[record.name], drawn[record.name]
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
        levels,
        {record.name: len(record.starts) for record in null.records},
        tuple(candidates),
        null.prior,
        null.turn,
        None if noise.colour else dict(noise.sigma),
        freedom_of(null, columns, noise, scatter=drawn, levels=levels) if freedom and noise.freedom else None,
    )


def white_levels(compressed: Compressed) -> tuple[dict[str, float], dict[str, float]]:
    """Standard deviation of each output's noise, and its degrees of freedom, where parameters and candidates together
    may explain the residual: with white noise it is independent of the scores, which are then Student's t.

    Where the candidates are too many for the samples, some that are least alike take part, whatever the residual is.
    """
    assert compressed.sigma is not None
    sigma = dict(compressed.sigma)
    rows, outputs, samples = _stacked(compressed)
    for _ in range(_ROUNDS if len(sigma) > 1 else 1):
        factor = np.array([compressed.sigma[name] / sigma[name] for name in outputs])
        scaled = rows * factor[:, None]
        frame = basis(scaled[:, :-1])
        rest = without(frame, scaled[:, -1:])[:, 0]
        taken = (frame**2).sum(axis=1)
        freedom = {}
        for name in sigma:
            own = outputs == name
            freedom[name] = max(samples[name] - float(taken[own].sum()), 1.0)
            sigma[name] *= math.sqrt(float((rest[own] ** 2).sum()) / freedom[name])
    return sigma, freedom


def _stacked(compressed: Compressed) -> tuple[Array, NDArray[np.str_], dict[str, int]]:
    """Rows of [S | x0 of each record | s | e], the output of each row, and the samples of each output."""
    n, wide = compressed.parameters, sum(compressed.starts.values())
    samples: dict[str, int] = {}
    stacked, names = [], []
    first = n
    for record, starts in compressed.starts.items():
        for output in dict.fromkeys(p.output for p in compressed.parts if p.record == record):
            parts = [p for p in compressed.parts if (p.record, p.output) == (record, output)]
            samples[output] = samples.get(output, 0) + sum(p.samples for p in parts)
            own = triangle(np.concatenate([p.triangle for p in parts]))[:, len(compressed.scatter[record]) :]
            rows = np.zeros((len(own), own.shape[1] + wide - starts))
            rows[:, :n] = own[:, :n]
            rows[:, first : first + starts] = own[:, n : n + starts]
            rows[:, n + wide :] = own[:, n + starts :]
            stacked.append(rows)
            names += [output] * len(own)
        first += starts
    rows = np.concatenate(stacked)
    known, tested = n + wide, rows.shape[1] - 1 - n - wide
    # of the samples that parameters leave: what candidates take beside these is no noise
    most = int(_SHARE * min(*samples.values(), sum(samples.values()) - known))
    if tested > max(most, 0):
        free = without(basis(rows[:, :known]), rows[:, known:-1])
        order = linalg.qr(free / np.maximum(np.linalg.norm(free, axis=0), 1e-300), mode="r", pivoting=True)[1]
        rows = rows[:, [*range(known), *(known + k for k in order[:most]), rows.shape[1] - 1]]
    return rows, np.array(names), samples


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


def scatter_levels(record: str, scatter: Sequence[Scatter], noise: NoiseModel) -> Array:
    """(g,) standard deviations of a record's random amplitudes."""
    own = [s for s in scatter if s.record == record]
    return np.array([noise.scatter.get(s.kind, 0.0) for s in own for _ in s.directions], dtype=float)


def shifts(reduced: Reduced) -> Array:
    """(n_theta, k + 1) least-squares coefficients of [s | e] in S."""
    n = reduced.parameters
    return coefficients(reduced.rows[:, :n], reduced.rows[:, n:])
