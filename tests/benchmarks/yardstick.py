"""One yardstick for everybody: chi-squared of given parameters with the best initial states, and the Cramér-Rao bound.

The exact discretisation is stepped sample by sample; the initial states enter linearly and are solved for. It is
slow and plain, and shares no line with the package or an opponent.
"""

from __future__ import annotations

import numpy as np
from cases import Case, Record
from chain import Array, discretise


def _responses(case: Case, full: Array, record: Record) -> tuple[Array, Array]:
    """Forced response (N,) and free responses (N, states), orthonormalised."""
    f, g, h = discretise(case.shape, full, case.step)
    push = g @ record.drives[:, :-1] + h @ record.drives[:, 1:]
    x, row = np.zeros(case.shape.states), np.eye(1, case.shape.states)[0]
    forced, free = np.empty(record.samples), np.empty((record.samples, case.shape.states))
    forced[0], free[0] = 0.0, row
    for k in range(record.samples - 1):
        x = f @ x + push[:, k]
        row = row @ f
        forced[k + 1], free[k + 1] = x[0], row
    return forced, np.linalg.qr(free / np.linalg.norm(free, axis=0))[0]


def chi_squared(case: Case, values: Array) -> float:
    """Sum of squared weighted residuals and priors at free `values`, the initial states at their best."""
    total = float((case.prior_residual(values) ** 2).sum()) if case.priors else 0.0
    for record in case.records:
        forced, free = _responses(case, case.full(values), record)
        rest = record.speed - forced
        rest = rest - free @ (free.T @ rest)
        total += float(rest @ rest) / case.sigma**2
    return total


def covariance_bound(case: Case) -> Array:
    """Cramér-Rao bound (free, free) at the truth, initial states free, priors counted: central differences."""
    values = case.true_values
    information = np.zeros((values.size, values.size))
    for record in case.records:
        forced, free = _responses(case, case.full(values), record)
        # the state at the first sample that made the record, for it carries sensitivity as well
        rest = record.speed - forced
        start = free @ (free.T @ rest)
        columns = []
        for i, value in enumerate(values):
            moved = []
            for sign in (1.0, -1.0):
                shifted = values.copy()
                shifted[i] = value * (1 + sign * 1e-4)
                there, basis = _responses(case, case.full(shifted), record)
                # of the free response only what the truth's cannot imitate counts: both are projected below
                moved.append(there + basis @ (basis.T @ start))
            columns.append((moved[0] - moved[1]) / (2e-4 * value))
        rows = np.array(columns).T
        rows = rows - free @ (free.T @ rows)
        information += rows.T @ rows / case.sigma**2
    if case.priors:
        prior = case.prior_jacobian()
        information += prior.T @ prior
    return np.asarray(np.linalg.inv(information))
