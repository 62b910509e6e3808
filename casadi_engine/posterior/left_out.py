"""What data that were left out of the likelihood say of draws that were made without them.

With all bins in use it is the last states alone that draws are made with as a quadratic foretells them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from casadi_engine.posterior.drawn import Drawn
from casadi_engine.posterior.psis import log_mean, pareto_smoothed
from casadi_engine.posterior.target import Target

Array = NDArray[np.float64]

# Draws at which nothing is left out, and more of them for each term of a quadratic; scatter of the log likelihood that
# the draws' weights follow.
LOOKED_AT, TERMS, FELT = 200, 4, 0.1
# Scatter of it with which more of the data have to be looked at before anything is drawn.
SCATTER = 1.0


def with_all_data(
    target: Target, drawn: Drawn, random: np.random.Generator, nearer: Callable[[], None] | None = None
) -> tuple[Drawn, float]:
    """The draws and their evidence with what was left out, and the scatter of its log likelihood over them.

    nearer : leaves less of the data out of the target's likelihood. All draws are evaluated so where a quadratic does
        not foretell what all data say, and it foretells the rest; without it, or where that does not do either, all
        data are looked at in every draw
    """
    if target.likelihood.bins is None:
        return drawn, 0.0
    count = max(LOOKED_AT, TERMS * quadratic(drawn.u[:1]).shape[1])
    some = random.choice(len(drawn.u), min(count, len(drawn.u)), replace=False)
    seen = target.full(drawn.u[some]) - drawn.density[some]
    scatter = float(seen.std())
    if not scatter > FELT:
        return drawn.with_evidence(log_mean(seen), scatter / np.sqrt(len(seen))), scatter
    rest = np.setdiff1d(np.arange(len(drawn.u)), some)
    known = np.zeros(len(drawn.u))
    foretold, error, beyond = foresee(drawn.u[some], seen, drawn.u[rest])
    if not error <= FELT and nearer is not None and len(rest):
        nearer()
        known = target.log_density(drawn.u) - drawn.density
        foretold, error, beyond = foresee(drawn.u[some], seen - known[some], drawn.u[rest])
    if not error <= FELT:
        error, beyond = 0.0, np.ones(len(rest), dtype=bool)
    foretold = known[rest] + foretold
    foretold[beyond] = target.full(drawn.u[rest[beyond]]) - drawn.density[rest[beyond]]
    ratio = np.concatenate([seen, foretold])
    smooth, _ = pareto_smoothed(ratio)
    drawn = drawn.reweighed(np.concatenate([some, rest]), smooth, random)
    return drawn.with_evidence(
        log_mean(ratio), float(np.hypot(scatter, error)) / np.sqrt(len(ratio))
    ), scatter


def foresee(x: Array, values: Array, others: Array) -> tuple[Array, float, NDArray[np.bool_]]:
    """Values (m,) at ``others`` (m, d) by a quadratic through those at x (n, d); how far it is off at each of x when
    that is left out (root mean square), infinite where they are too few; and which of the others (m,) lie beyond all of
    them, where it would be extrapolated."""
    mean, spread = x.mean(axis=0), x.std(axis=0) + 1e-300
    rows = quadratic((x - mean) / spread)
    if len(rows) < 2 * rows.shape[1]:
        return np.full(len(others), np.nan), np.inf, np.ones(len(others), dtype=bool)
    q, r = np.linalg.qr(rows)
    away, own = values - q @ (q.T @ values), np.square(q).sum(axis=1)
    alone = away / np.maximum(1 - own, 1e-9)
    back = np.linalg.pinv(r)
    turned = quadratic((others - mean) / spread) @ back
    beyond = np.square(turned).sum(axis=1) > own.max()
    return np.asarray(turned @ (q.T @ values)), float(np.sqrt(np.mean(np.square(alone)))), beyond


def quadratic(x: Array) -> Array:
    """Terms (n, 1 + d + d (d + 1) / 2) of a quadratic at x (n, d)."""
    first, second = np.triu_indices(x.shape[1])
    return np.concatenate([np.ones((len(x), 1)), x, x[:, first] * x[:, second]], axis=1)
