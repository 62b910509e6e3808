"""A few Gauss-Newton steps by single shooting from a point near the optimum, for noise with memory and scatter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from casadi_engine.discrepancy.combustion_scatter import Scatter
from casadi_engine.discrepancy.linear_algebra import Array, coefficients, without
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel, null_at
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model

_HALVINGS = 12


def settle(
    model: Model,
    data: Sequence[Experiment],
    parameters: Any,
    z: Array,
    first: Mapping[str, Array],
    *,
    sigma: Mapping[str, float] | None = None,
    noise: NoiseModel | None = None,
    scatter: Sequence[Scatter] = (),
    starts_only: bool = False,
    held_starts: Mapping[str, tuple[str, ...]] | None = None,
    iterations: int = 12,
    tolerance: float = 1e-4,
) -> tuple[NullModel, dict[str, Array], float]:
    """Minimise chi-squared from z : (nz,) and first states record -> (n,).

    sigma : output -> standard deviation of white noise; or noise and the scatter that it has levels for: chi-squared
    is then e'V^-1 e, and a scatter of combustion moves no parameter that it can explain
    starts_only : move the initial states alone. tolerance : promised drop of chi-squared at which to stop
    Returns the null model at the optimum, the first states, and chi-squared. A step that makes chi-squared larger is
    halved; where no part of it helps the best point so far is returned.
    """
    known = NoiseModel(sigma or {}) if noise is None else noise
    held = tuple(parameters) if starts_only else ()
    z, first = np.array(z, dtype=float), {name: np.array(x, dtype=float) for name, x in first.items()}

    def at(z: Array, first: Mapping[str, Array]) -> NullModel:
        return null_at(model, data, parameters, z, first, held_parameters=held, held_starts=held_starts)

    here = at(z, first)
    random = _random(here, known, scatter)
    rows = _rows(here, known, random)
    cost = _cost(here, rows)
    for _ in range(iterations):
        step, moves, promised = _step(here, rows)
        if promised < tolerance:
            break
        share, found = 1.0, None
        for _ in range(_HALVINGS):
            trial = {name: first[name] + share * move for name, move in moves.items()}
            try:
                there = at(z + share * step, trial)
            except FloatingPointError:
                share /= 2
                continue
            # with the scatter's shapes as they were: a step does not answer for how it changes them
            new = _cost(there, _rows(there, known, random))
            if np.isfinite(new) and new <= cost:
                found = (there, z + share * step, trial)
                break
            share /= 2
        if found is None:
            break
        here, z, first = found
        random = _random(here, known, scatter)
        rows = _rows(here, known, random)
        cost = _cost(here, rows)
    return here, first, cost


def _random(null: NullModel, noise: NoiseModel, scatter: Sequence[Scatter]) -> list[dict[str, Array]]:
    """For each record output -> (N, g) its random amplitudes' columns, per standard deviation."""
    found = []
    for record in null.records:
        own = [s for s in scatter if s.record == record.name and noise.scatter.get(s.kind, 0.0) > 0]
        columns = record.columns([direction for s in own for direction in s.directions])
        size = np.array([noise.scatter[s.kind] for s in own for _ in s.directions])
        found.append({name: values * size for name, values in columns.items()})
    return found


def _rows(null: NullModel, noise: NoiseModel, random: Sequence[Mapping[str, Array]]) -> list[Array]:
    """For each record the whitened rows [slopes | e], free of what its scatter explains at the cost of its prior."""
    found = []
    for record, drawn in zip(null.records, random, strict=True):
        count = next(iter(drawn.values())).shape[1] if drawn else 0
        parts = []
        for name, e in record.residual.items():
            columns = [drawn[name], record.slopes[name], e[:, None]]
            parts.append(noise.whiten(record, name, np.concatenate(columns, axis=1)))
        rows = np.concatenate(parts)
        if count:
            # an amplitude of unit variance: its prior is one more row
            prior = np.eye(count, rows.shape[1])
            rows = np.concatenate([rows, prior])
            rows = without(np.linalg.qr(rows[:, :count])[0], rows[:, count:])
        found.append(rows)
    return found


def _cost(null: NullModel, rows: Sequence[Array]) -> float:
    return float((null.prior[:, -1] ** 2).sum()) + sum(float(r[:, -1] @ r[:, -1]) for r in rows)


def _step(null: NullModel, given: Sequence[Array]) -> tuple[Array, dict[str, Array], float]:
    """The least-squares step of z (nz,) and of the first states record -> (n,), and the drop that it promises."""
    shared = null.turn.shape[1]
    width = shared + sum(len(record.starts) for record in null.records)
    if width == 0:
        return np.zeros(len(null.values)), {}, 0.0
    rows, right, at = [], [], shared
    for record, inside in zip(null.records, given, strict=True):
        own = len(record.starts)
        part = np.zeros((len(inside), width))
        part[:, :shared], part[:, at : at + own] = inside[:, :shared], inside[:, shared:-1]
        rows.append(part)
        right.append(inside[:, -1])
        at += own
    if len(null.prior):
        extra = np.zeros((len(null.prior), width))
        extra[:, :shared] = null.prior[:, :-1]
        rows.append(extra)
        right.append(null.prior[:, -1])
    slopes, residual = np.concatenate(rows), np.concatenate(right)
    step = coefficients(slopes, residual)
    promised = float(residual @ (slopes @ step))
    moves, at = {}, shared
    states = [state.name for state in null.model.states]
    for record in null.records:
        move = np.zeros(len(states))
        for k, name in enumerate(record.starts):
            move[states.index(name)] = step[at + k] * null.model.states[states.index(name)].scale
        moves[record.name] = move
        at += len(record.starts)
    return null.turn @ step[:shared], moves, promised
