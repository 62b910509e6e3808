"""An event beside what it is held against: something that comes gradually, in the same records at the same port.

A load that comes or goes has a time and often a size in each record, and bends to much that is no event: what a law
lacks along a motion that dies out, a constant that differs from record to record. An abrupt change is told from a
gradual one as any two explanations are: by how probable the data are with either.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casadi_engine.discrepancy.compression import candidate_columns
from casadi_engine.discrepancy.evidence import Columns, Digest, Levels, Prior, evidence
from casadi_engine.discrepancy.law_rival import (
    bare_digest,
    beside_it,
    counted_with,
    is_told,
    names_of,
    of_size,
    without_effects,
)
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.null_model import NullModel, RecordNull
from casadi_engine.discrepancy.random_families import TIME, Family, Signal, families_of, term_candidate
from casadi_engine.discrepancy.refit import Addition

# Cosines of the time in each record: a swing and a half.
_TERMS = 4
# Sizes of the course over which its evidence is averaged, beside that which moves an output by its own variation: two
# effects that nearly cancel are larger than what they move together.
_SIZES = np.logspace(-2, 2, 9)


@dataclass(frozen=True, eq=False)
class Gradual:
    """A structure with a smooth course in time of each record in the place of one of its events, at its largest size,
    and the terms of that course; event : the key of that event; bare : the structure with neither."""

    digest: Digest
    terms: tuple[str, ...]
    event: tuple[str, str] = ("", "")
    bare: Digest | None = None

    def is_told(self, levels: Levels, named: float, without: float) -> bool:
        """See ``law_rival.is_told``."""
        return self.bare is None or is_told(evidence(self.bare, levels).cost, named, without)

    def log(self, levels: Levels) -> float:
        """The log evidence, averaged over the size of the course."""
        logs = [evidence(of_size(self.digest, self.terms, share), levels).log for share in _SIZES]
        return float(np.logaddexp.reduce(logs)) - math.log(len(_SIZES))


def in_place_of_event(
    null: NullModel,
    one: Addition,
    priors: Mapping[str, Prior],
    held: frozenset[str],
    random: Columns | None,
) -> Gradual | None:
    """What an event of a structure is held against; None where that cannot be told.

    null : the structure, linearised where its refit ended; held : parameters at a bound
    """
    own = {name for name in null.parameters if name.startswith(f"{one.key}.")}
    bare = without_effects(null, [one.amplitude], own)
    if bare is None:
        return None
    courses = [_course(null, record, one.candidate.port) for record in null.records]
    terms = sum(len(family.members) for _, family in courses)
    columns: dict[str, dict[str, Array]] = {}
    first = 0
    for record, (made, family) in zip(null.records, courses, strict=True):
        last = first + len(family.members)
        columns[record.name] = {}
        for output, mine in made.items():
            placed = np.zeros((len(mine), terms))
            placed[:, first:last] = np.where(np.isfinite(mine).all(axis=0), mine, 0.0)
            columns[record.name][output] = placed
        first = last
    variances = np.concatenate([family.variances for _, family in courses])
    whole = Family(one.candidate.port, TIME, tuple(range(terms)), variances, 0.0, 1.0, np.ones(1))
    digest = counted_with(beside_it(bare, columns), dict(priors), whole, held - own, random)
    if digest is None:
        return None
    without = bare_digest(bare, priors, held - own, random)
    return Gradual(digest, tuple(names_of(whole)), one.candidate.key, without)


def _course(null: NullModel, record: RecordNull, port: str) -> tuple[Mapping[str, Array], Family]:
    """The terms of a course in time of one record: output -> (N, k), and the course."""
    time = record.path.grid.time
    signal = Signal(TIME, null.model.t, time)
    ((basis, family),) = families_of(port, signal, _TERMS)
    at = null.model.ports[port]
    candidates = [term_candidate(null.model, at, signal, k, term) for k, term in enumerate(basis)]
    with np.errstate(all="ignore"):
        return candidate_columns(record, candidates), Family(
            port, TIME, tuple(range(len(basis))), family.variances, family.low, family.high, family.visited
        )
