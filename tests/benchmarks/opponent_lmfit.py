"""lmfit on the spectral formulation: the same residual and Jacobian behind lmfit's parameters.

`method="leastsq"` is lmfit's default (MINPACK's Levenberg-Marquardt with lmfit's own transformation of bounds);
its covariance comes with it and is counted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import lmfit
import numpy as np
from cases import Case
from chain import Array
from opponent_spectral import MOST_EVALUATIONS, _Problem
from opponent_spectral import fit as spectral_fit


def _minimise(
    problem: _Problem, point: Array, low: Array, high: Array, tolerance: float
) -> tuple[Array, int]:
    names = problem.case.free
    parameters = lmfit.Parameters()
    for name, value, least, most in zip(names, point, low, high, strict=True):
        parameters.add(name, value=float(value), min=float(least), max=float(most))

    def at(given: lmfit.Parameters) -> Array:
        return np.array([given[name].value for name in names])

    def residual(given: lmfit.Parameters) -> Array:
        return problem.residual(at(given))

    def jacobian(given: lmfit.Parameters) -> Array:
        return problem.jacobian(at(given)).copy()  # lmfit scales it in place

    minimizer = lmfit.Minimizer(residual, parameters, max_nfev=MOST_EVALUATIONS)
    found = minimizer.minimize(
        method="leastsq", Dfun=jacobian, col_deriv=0, ftol=tolerance, xtol=tolerance, gtol=0.0
    )
    return at(found.params), int(found.nfev)


def fit(case: Case, start: Array, mark: Callable[[], None]) -> dict[str, Any]:
    """As `opponent_spectral.fit`."""
    return spectral_fit(case, start, mark, _minimise)
