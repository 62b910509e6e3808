"""Whether the data tell two effects that act on one equation from one law of both signals, which is their product.

About where a rig works, c x y is c ȳ x + c x̄ y but for c (x - x̄)(y - ȳ): a loss of what a vapour carries, by its flow
and its concentration, was "a loss proportional to the concentration, and the steam acts there too". That last term
tells them apart. It is written of what the effects add, A and B, as (A - mean A)(B - mean B)/mean A: its coefficient is
0 for their sum and 1 for the product of A's signal and one of B's kind with another zero.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import combinations
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from casadi_engine.discrepancy.null_model import Array, NullModel, null_model
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.estimation.corner_widths import courses
from casadi_engine.simulation.candidate_sensitivities import Direction

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import FoundEffect
    from casadi_engine.estimation import Fit

# Standard errors within which the product may be the law.
_MAY = 2.0
# Of a direction's size, what is left of it beside the fit's own that is rounding.
_ROUNDING = 1e-9


def may_be_a_product(fit: Fit | None, effects: Sequence[FoundEffect]) -> str:
    """What is said of two effects that may be one law of both signals; "" where none are, or the data tell."""
    if fit is None or len(effects) < 2:
        return ""
    with suppress(*FAILURES), np.errstate(all="ignore"):
        null = null_model(fit)
        for one, other, terms in _pairs(fit, effects):
            for first, second in (terms, terms[::-1]):
                if _fits(null, fit, first, second):
                    return (
                        f"{one.name} at {one.at} and {other.name} at {other.at} act on one equation, by signals that "
                        "vary too little for the data to tell their sum from a product: one law of both signals, that "
                        "the library lacks, may be the true one there"
                    )
    return ""


def _pairs(
    fit: Fit, effects: Sequence[FoundEffect]
) -> Iterator[tuple[FoundEffect, FoundEffect, tuple[ca.SX, ca.SX]]]:
    """Two effects and what they add to an equation (n, 1), each by other states and inputs, without a memory."""
    model, names = fit.model, list(fit.model.parameter_names)
    moving = ca.vertcat(model.x, model.u)
    ode = ca.substitute(model.closed_ode, model.d, model.drive_expressions)
    found = []
    for one in effects:
        amplitude = next(iter(one.parameters))
        memory = any(state.name.startswith(f"{one.at}_{one.name}_") for state in model.states)
        if amplitude not in names or memory:
            continue
        size = model.p[names.index(amplitude)]
        found.append((one, ca.jacobian(ode, size) * size))  # laws are in proportion to their amplitudes
    for (one, a), (other, b) in combinations(found, 2):
        rows = [k for k in range(a.numel()) if a.has_nz(k, 0) and b.has_nz(k, 0)]
        if len(rows) != 1:
            continue
        read = [
            {i for i in range(moving.numel()) if ca.depends_on(part[rows[0]], moving[i])} for part in (a, b)
        ]
        if all(read) and not read[0] & read[1] and not ca.depends_on(ca.vertcat(a, b), model.t):
            yield one, other, (_alone(a, rows[0]), _alone(b, rows[0]))


def _alone(column: ca.SX, row: int) -> ca.SX:
    kept = ca.SX.zeros(column.numel(), 1)
    kept[row] = column[row]
    return kept


def _fits(null: NullModel, fit: Fit, first: ca.SX, second: ca.SX) -> bool:
    """True where the product of the first's signal and the second's is within errors of the data."""
    means = []
    for term in (first, second):
        course = np.concatenate(courses([record.path for record in null.records], ca.sum1(term)))
        means.append(float(course.mean()))
    if not means[0]:
        return False
    bent = (first - _at(first, means[0])) * (second - _at(second, means[1])) / means[0]
    one = Direction("product", ca.densify(bent), ca.SX.zeros(len(null.model.outputs), 1))
    column, left, base = _stacked(null, fit, one)
    basis = np.linalg.qr(base)[0]
    free = column - basis @ (basis.T @ column)
    strength = float(free @ free)
    if strength <= _ROUNDING * float(column @ column):
        return True  # they are one and the same to first order
    return bool(abs(float(free @ left) / strength - 1) * np.sqrt(strength) < _MAY)


def _at(term: ca.SX, mean: float) -> ca.SX:
    """The mean in the row of a term."""
    return ca.SX(ca.DM([mean if term.has_nz(k, 0) else 0.0 for k in range(term.numel())]))


def _stacked(null: NullModel, fit: Fit, one: Direction) -> tuple[Array, Array, Array]:
    """Of all records and outputs, in units of the noise: the direction (N,), the residual, and the fit's own slopes."""
    columns, left, base = list[Array](), list[Array](), list[Array]()
    starts, many = [len(record.starts) for record in null.records], null.turn.shape[1]
    for k, record in enumerate(null.records):
        found = record.columns([one])
        for output, residual in record.residual.items():
            sigma = fit.noise[output][0]
            columns.append(found[output][:, 0] / sigma)
            left.append(residual / sigma)
            own = record.slopes[output] / sigma
            wide = np.zeros((len(residual), many + sum(starts)))
            wide[:, :many] = own[:, :many]
            begin = many + sum(starts[:k])
            wide[:, begin : begin + starts[k]] = own[:, many:]
            base.append(wide)
    prior = null.prior
    if len(prior):
        columns.append(np.zeros(len(prior)))
        left.append(prior[:, -1])
        base.append(np.concatenate([prior[:, :-1], np.zeros((len(prior), sum(starts)))], axis=1))
    return np.concatenate(columns), np.concatenate(left), np.concatenate(base)
