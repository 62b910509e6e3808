"""A few Gauss-Newton steps by single shooting from a point near the optimum, for refits of initial states and tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array, coefficients
from casadi_engine.discrepancy.null_model import NullModel, null_at
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model

_HALVINGS = 12


def chi_squared(null: NullModel, sigma: Mapping[str, float]) -> float:
    """Sum of ((y - y_hat)/sigma)^2 and of the priors."""
    total = float((null.prior[:, -1] ** 2).sum())
    for record in null.records:
        total += sum(float(e @ e) / sigma[name] ** 2 for name, e in record.residual.items())
    return total


def settle(
    model: Model,
    data: Sequence[Experiment],
    parameters: Any,
    z: Array,
    first: Mapping[str, Array],
    *,
    sigma: Mapping[str, float],
    starts_only: bool = False,
    held_starts: Mapping[str, tuple[str, ...]] | None = None,
    iterations: int = 12,
    tolerance: float = 1e-4,
) -> tuple[NullModel, dict[str, Array], float]:
    """Minimise chi-squared from z : (nz,) and first states record -> (n,).

    starts_only : move the initial states alone. tolerance : promised drop of chi-squared at which to stop
    Returns the null model at the optimum, the first states, and chi-squared. A step that makes chi-squared larger is
    halved; where no part of it helps the best point so far is returned.
    """
    held = tuple(parameters) if starts_only else ()
    z, first = np.array(z, dtype=float), {name: np.array(x, dtype=float) for name, x in first.items()}

    def at(z: Array, first: Mapping[str, Array]) -> NullModel:
        return null_at(model, data, parameters, z, first, held_parameters=held, held_starts=held_starts)

    here = at(z, first)
    cost = chi_squared(here, sigma)
    for _ in range(iterations):
        step, moves, promised = _step(here, sigma)
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
            new = chi_squared(there, sigma)
            if np.isfinite(new) and new <= cost:
                found = (there, z + share * step, trial, new)
                break
            share /= 2
        if found is None:
            break
        here, z, first, cost = found
    return here, first, cost


def _step(null: NullModel, sigma: Mapping[str, float]) -> tuple[Array, dict[str, Array], float]:
    """The least-squares step of z (nz,) and of the first states record -> (n,), and the drop that it promises."""
    shared = null.turn.shape[1]
    width = shared + sum(len(record.starts) for record in null.records)
    if width == 0:
        return np.zeros(len(null.values)), {}, 0.0
    rows, right, at = [], [], shared
    for record in null.records:
        own = len(record.starts)
        for name, e in record.residual.items():
            part = np.zeros((len(e), width))
            own_slopes = record.slopes[name] / sigma[name]
            part[:, :shared], part[:, at : at + own] = own_slopes[:, :shared], own_slopes[:, shared:]
            rows.append(part)
            right.append(e / sigma[name])
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
