"""How many samples of each output the parameters and initial states take: the trace of the hat matrix there.

A level is known by the squares of its residuals over the samples that are left. All outputs together lose as many as
there are free parameters and initial states, but a parameter that acts in one output alone takes its samples alone: of
few, that is much of what they tell of the noise. With such degrees of freedom the levels are those of the restricted
likelihood (Harville 1977, J. Am. Stat. Assoc. 72, 320).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.chained import chained_slopes
from casadi_engine.estimation.uncertainty import invert

if TYPE_CHECKING:
    from casadi_engine.estimation.laid_problem import LaidProblem

Array = NDArray[np.float64]

# Samples of an output from which on its level is known well enough: Student's t is within 3 % of the normal law.
MANY = 60


def are_few(laid: LaidProblem) -> bool:
    """True where several levels are estimated, one of them of few samples: what is taken of each counts then."""
    counts = laid.levels.counts[np.array(laid.levels.estimated) & (laid.levels.counts > 0)]
    few = len(counts) > 1 and bool(counts.min() < MANY)
    return few and not laid.loss.robust and laid.predictor.kind == "none"


def taken(laid: LaidProblem, x: Array) -> Array | None:
    """(ny,) samples of each output that the free parameters and initial states take at x; None where no slopes are to
    be had there."""
    nv = laid.problem.nv
    try:
        grams = grams_of(laid, x)
        information = np.sum(grams, axis=0)
        information[:nv, :nv] += laid.problem.priors.evaluate(x[:nv])[3]
        rows = np.zeros((0, len(information)))
        if laid.constraints.count:
            equal = laid.constraints.lower == laid.constraints.upper
            rows = np.zeros((int(equal.sum()), len(information)))
            rows[:, :nv] = laid.constraints.evaluate(x[:nv])[1][equal]
        matrix = invert(information, _closed(laid, x), rows).matrix
    except (FloatingPointError, np.linalg.LinAlgError):
        return None
    found = np.array([float(np.sum(matrix * gram)) for gram in grams])
    return found if np.isfinite(found).all() else None


def grams_of(laid: LaidProblem, x: Array) -> list[Array]:
    """What each output says of [v; first states of each record], (N, N)."""
    at = laid.problem.nv
    size = at + sum(record.n for record in laid.records)
    found = [np.zeros((size, size)) for _ in laid.levels.outputs]
    for record, point in zip(laid.records, laid.problem.at(x).records, strict=True):
        rows = chained_slopes(record, point).reshape(-1, record.weight.size)
        place = np.concatenate([record.active, np.arange(at, at + record.n)])
        valid = record.observation.valid.ravel()
        for output, where in record.observation.where.items():
            own = rows[:, where[valid[where]]]
            found[laid.levels.outputs.index(output)][np.ix_(place, place)] += own @ own.T
        at += record.n
    return found


def _closed(laid: LaidProblem, x: Array) -> NDArray[np.bool_]:
    """(N,) of [v; first states]: fixed, or on a bound."""
    entries = np.concatenate(
        [np.arange(laid.problem.nv), *[np.arange(one.at, one.at + one.n) for one in laid.problem.layouts]]
    )
    entries = entries.astype(np.intp)
    return np.asarray((x[entries] <= laid.lower[entries]) | (x[entries] >= laid.upper[entries]))
