"""Effects that were not looked for, and do in these data what was found: no name is surer than its rivals are known."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.compression import candidate_columns
from casadi_engine.discrepancy.evidence import FACTOR
from casadi_engine.discrepancy.in_place import start_without
from casadi_engine.discrepancy.library_candidates import library_candidates
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.refit import Addition, addition
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.screening import Screened
from casadi_engine.discrepancy.station import Station
from casadi_engine.discrepancy.tried import key_of
from casadi_engine.effects import Effect, library

# Correlation of what two effects do to the outputs from which they are called alike.
_ALIKE = 0.999


def left_out_alike(null: Station, last: Station, refits: Refits) -> str:
    """What to say of effects that were left out by effects=, without= or at=, and are like one that was found: the
    simpler one that it becomes at an end of its range, by a refit, or the same one at another port; "" where there are
    none."""
    screened = null.screened
    found: dict[str, list[str]] = {}
    for one in last.effects:
        own = next((k for k, c in enumerate(screened.candidates) if c.label == one.label), None)
        if own is None:
            continue
        others = _alike(screened, null, one.candidate.source.effect, own)
        others += [name for name in _limits(null, last, one, refits) if name not in others]
        if others:
            found[f"{one.candidate.effect} at {one.candidate.port}"] = others
    if not found:
        return ""
    words = [
        f"{name} does in these data what {' or '.join(others)} would do" for name, others in found.items()
    ]
    return f"{'; '.join(words)}, which the search left out: the name is no surer than that. Allow it, and repair again"


def _limits(null: Station, last: Station, one: Addition, refits: Refits) -> list[str]:
    """Labels of what was left out of which an effect is the wider form, where a refit of that is not clearly less
    probable."""
    screened, effect = null.screened, one.candidate.source.effect
    known = refits.pool.get(key_of(last.effects))
    if known is None or not effect.limit or not _is_known(effect.limit, {}):
        return []
    every = _left_out(screened, null, library(effect.limit), [one.candidate.port])
    if not every:
        return []
    size = next(v for n, v in known.arrived.values.items() if n.partition("@")[0] == one.amplitude)
    rest = tuple(own for own in last.effects if own is not one)
    start = start_without(known.arrived, one)
    found = [made for case in every for made in refits.tried((*rest, addition(case, size)), start, near=True)]
    return [
        f"{made.effects[-1].candidate.effect} at {made.effects[-1].candidate.port}"
        for made in found
        if made.log > known.log - math.log(FACTOR)
    ]


def _left_out(
    screened: Screened, null: Station, effects: Sequence[Effect], ports: Sequence[str] | None = None
) -> list[Candidate]:
    """Candidates of effects that were not looked for at their ports."""
    where = screened.request.where
    every = library_candidates(screened.null, null.fit.data, effects) if effects else []
    return [c for c in every if c.port not in where.get(c.effect, ()) and (ports is None or c.port in ports)]


def _alike(screened: Screened, null: Station, effect: Effect, own: int) -> list[str]:
    """Labels of effects like the candidate of this number, each once."""
    known = {one.name: one for one in screened.request.effects}
    names = [name for name in (effect.name, effect.limit) if name]
    kinds = [known[name] if name in known else library(name)[0] for name in names if _is_known(name, known)]
    others = _left_out(screened, null, kinds)
    if not others:
        return []
    mine, theirs = _columns(screened, own), _stacked(screened, others)
    size = np.linalg.norm(theirs, axis=0) * np.linalg.norm(mine)
    with np.errstate(all="ignore"):
        rho = np.abs(mine @ theirs) / size
    return list(
        dict.fromkeys(f"{c.effect} at {c.port}" for c, r in zip(others, rho, strict=True) if r > _ALIKE)
    )


def _is_known(name: str, known: dict[str, Effect]) -> bool:
    """True for an effect that was asked for or is in the library; an effect of the user's own may have any name."""
    return name in known or name in [one.name for one in library()]


def _columns(screened: Screened, number: int) -> Array:
    """What a candidate does to all outputs, in standard deviations of their noise."""
    sigma = screened.noise.sigma
    return np.concatenate(
        [
            values[:, number] / sigma[output]
            for record in screened.null.records
            for output, values in screened.columns[record.name].items()
        ]
    )


def _stacked(screened: Screened, candidates: Sequence[Candidate]) -> Array:
    sigma = screened.noise.sigma
    return np.concatenate(
        [
            values / sigma[output]
            for record in screened.null.records
            for output, values in candidate_columns(record, candidates).items()
        ]
    )
