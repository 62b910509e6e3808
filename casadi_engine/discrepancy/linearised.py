"""Where a refit starts from: all candidates in one step along a model, beside its effects or in the place of one."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.compression import candidate_columns, compress
from casadi_engine.discrepancy.linear_algebra import Array, basis, without
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.refit import Addition
from casadi_engine.discrepancy.rehomed import at_home
from casadi_engine.discrepancy.score import scores_of
from casadi_engine.effects.protocol import moves
from casadi_engine.errors import CasadiEngineError


@dataclass(frozen=True, eq=False)
class OneStep:
    """Chi-squared (k,) with each candidate, its amplitude (k,) and the amplitude's error (k,); none : without any.

    between : (k,) the least of chi-squared with a candidate and with it and the next value of its grid, which what lies
    between the two is not far from; None where that was not asked
    """

    cost: Array
    amplitude: Array
    error: Array
    none: float
    between: Array | None = None


def one_step(
    null: NullModel,
    candidates: Sequence[Candidate],
    levels: Mapping[str, float],
    members: Sequence[int] | None = None,
) -> OneStep | None:
    """Candidates linearised along a model, at white levels; None where that fails.

    members : numbers of those that are asked for, None for all; the others come out as changing nothing
    """
    if members is not None and len(members) < len(candidates):
        return _step_of_members(null, candidates, levels, members)
    candidates = at_home(candidates, null.model)
    try:
        with np.errstate(all="ignore"):
            columns = {r.name: candidate_columns(r, candidates) for r in null.records}
    except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
        return None
    if not all(np.isfinite(part).all() for own in columns.values() for part in own.values()):
        return None
    reduced = compress(null, candidates, NoiseModel(dict(levels)), columns=columns).reduced()
    scores = scores_of(reduced, candidates, null.turn)
    left = without(basis(reduced.rows[:, : reduced.parameters]), reduced.rows[:, reduced.parameters :])
    none = float((left[:, -1] ** 2).sum())
    cost = none - scores.drop
    return OneStep(cost, scores.amplitude, scores.error, none, np.minimum(cost, _between(candidates, left)))


def _between(candidates: Sequence[Candidate], left: Array) -> Array:
    """(k,) Chi-squared with a candidate and the next value of its grid, both to the same side; inf for those that have
    no such neighbour. left : columns of the candidates and the residual, without what the parameters explain"""
    found, families = np.full(len(candidates), np.inf), dict[tuple[str, str], list[int]]()
    for k, one in enumerate(candidates):
        effect = None if one.source is None else one.source.effect
        grids = {} if effect is None else effect.nuisance
        if len(grids) == 1 and not any(grid.whole for grid in grids.values()) and not moves(effect):
            families.setdefault(one.key, []).append(k)
    for members in families.values():
        order = sorted(members, key=lambda k: next(iter(candidates[k].nuisance.values())))
        for pair in itertools.pairwise(order):
            both = left[:, pair]
            size = np.linalg.norm(both, axis=0)
            if size.min() <= 0:
                continue
            step = np.linalg.lstsq(both / size, left[:, -1], rcond=None)[0]
            if step[0] * step[1] > 0:
                found[list(pair)] = np.minimum(
                    found[list(pair)], float(np.sum((left[:, -1] - both @ (step / size)) ** 2))
                )
    return found


def _step_of_members(
    null: NullModel, candidates: Sequence[Candidate], levels: Mapping[str, float], members: Sequence[int]
) -> OneStep | None:
    own = one_step(null, [candidates[k] for k in members], levels)
    if own is None:
        return None
    cost, amplitude = np.full(len(candidates), own.none), np.zeros(len(candidates))
    error = np.full(len(candidates), np.inf)
    cost[members], amplitude[members], error[members] = own.cost, own.amplitude, own.error
    between = cost.copy()
    between[members] = own.cost if own.between is None else own.between
    return OneStep(cost, amplitude, error, own.none, between)


def without_effect(null: NullModel, one: Addition, only: str | None = None) -> NullModel | None:
    """The model linearised where an effect is, without it, or without it in one record: candidates are to take its
    place; what it does in other records stays as it is.

    What its amplitude does to the outputs is to be explained along with the residual, by the others' slopes; where
    states of its own began changes nothing then.
    """
    size = np.diag(null.turn)
    plain = null.turn.shape == (len(null.values),) * 2 and np.array_equal(null.turn, np.diag(size))
    if not plain:
        return None
    names = [name.partition("@")[0] for name in null.parameters]
    gone = [k for k, name in enumerate(names) if name.startswith(f"{one.key}.")]
    # a nuisance value moves nothing once its effect is gone; an amplitude goes to zero
    zero = [k for k in gone if names[k] == one.amplitude]
    stem = f"{one.key.replace('.', '_')}_"
    records = []
    for record in null.records:
        slopes, residual = {}, {}
        own_starts = [k for k, name in enumerate(record.starts, len(size)) if name.startswith(stem)]
        for output, own in record.slopes.items():
            done = own[:, zero] @ (null.values[zero] / size[zero]) if only in (None, record.name) else 0.0
            residual[output] = record.residual[output] + done
            slopes[output] = np.delete(own, gone + own_starts, axis=1)
        starts = tuple(name for name in record.starts if not name.startswith(stem))
        records.append(replace(record, slopes=slopes, residual=residual, starts=starts))
    return replace(
        null,
        turn=np.delete(null.turn, gone, axis=1),
        prior=np.delete(null.prior, gone, axis=1),
        records=tuple(records),
    )
