"""What whiteness does not see of fresh data: a residual that is off on average, and one that is too large.

Whiteness looks at a residual beside its own mean and by its own size. A sensor that reads 37 standard deviations too
high leaves white noise about a constant, and one reading of 9999 leaves next to nothing beside it. So the mean is held
against zero, and the size against the noise of the fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from casadi_engine.distributions import f_sf
from casadi_engine.estimation.fit_percent import FloatArray
from casadi_engine.validation.correlation import Correlation, autocorrelation
from casadi_engine.validation.projection import ABSORBED
from casadi_engine.validation.residual_tests import ResidualTest

# A residual is too large from so many times the noise of the fit: a sensor may be louder by half on another day.
LOUDER = 1.5
# Degrees of freedom of a level that was stated.
_STATED = 1e9
# Fewest samples, beyond the numbers that were fitted to them, that tell a mean or a size from chance.
_FEWEST = 8
# Lag-one correlation, in its standard errors, from which a residual counts as coloured; lags that are looked at.
_COLOUR, _LAGS = 3.0, 200


def mean_test(residual: FloatArray, correlation: Correlation, reach: float = 1.0) -> ResidualTest:
    """Test whether a residual is off on average.

    residual : (n,) valid samples y − ŷ; correlation : with its past, by which a mean is worth fewer samples
    reach : share of a constant, by its square, that parameters and first states cannot take within what the fit and all
        outputs say of them

    >>> import numpy as np
    >>> from casadi_engine.validation import autocorrelation
    >>> white = np.random.default_rng(0).standard_normal(400)
    >>> own = autocorrelation(white)
    >>> mean_test(white, own).p_value > 0.01, mean_test(white + 1, own).p_value < 1e-6
    (True, True)
    """
    count = len(residual)
    if count < _FEWEST:
        return ResidualTest(None, None, None, count, why=f"{count} valid samples: {_FEWEST} are needed")
    if reach <= ABSORBED:
        return ResidualTest(None, None, None, count, why="parameters and first states take what is constant")
    variance = float(residual.var()) * count / (count - 1)
    memory = _memory(_past(correlation))
    floor = (np.finfo(float).eps * float(np.abs(residual).max())) ** 2 + 1e-300
    ratio = float(residual.sum()) ** 2 / (reach * count * memory * max(variance, floor))
    chance = float(f_sf(ratio, 1, max(count / memory - 1, 1.0)))
    return ResidualTest(ratio, 1, chance, count)


def memory_of(residual: FloatArray) -> float:
    """How many samples (n,) of a residual count for one independent one in what is slow; 1 where neighbours go together
    by no more than chance makes them."""
    count = len(residual)
    rho = _past(autocorrelation(residual, lags=min(_LAGS, count // 2)))
    return max(_memory(rho), 1.0) if len(rho) and rho[0] > _COLOUR / math.sqrt(count) else 1.0


def _memory(rho: FloatArray) -> float:
    """The same from correlations with the past, up to where they first vanish."""
    stop = int(np.argmax(rho <= 0)) if (rho <= 0).any() else len(rho)
    return 1 + 2 * float(rho[:stop].sum())


def size_test(
    residual: FloatArray, level: float, dof: float, correlation: Correlation, fitted: int = 0
) -> ResidualTest:
    """Test whether a residual (n,) is larger than ``LOUDER`` times the noise of the fit.

    level, dof : standard deviation of that noise, and from how many degrees of freedom it was estimated, inf for one
    that was stated; correlation : with its past, by which its squares are worth fewer samples, as they are where its
    tails are heavy; fitted : how many numbers were fitted to these data
    """
    count = len(residual)
    if count < fitted + _FEWEST or not level > 0:
        why = (
            f"{count} valid samples: {fitted + _FEWEST} are needed"
            if level > 0
            else "the fit leaves no noise"
        )
        return ResidualTest(None, None, None, count, why=why)
    ratio = float(residual @ residual) / count / level**2
    worth = max(count / (1 + 2 * float((_past(correlation) ** 2).sum())) / _tails(residual), 1.0)
    chance = float(f_sf(ratio / LOUDER**2, worth, dof if math.isfinite(dof) else _STATED))
    return ResidualTest(ratio, 1, chance, count)


def worth_of(residuals: Sequence[FloatArray]) -> float:
    """The share of residuals (n,) of one output that counts for their level as white normal noise does: squares of
    coloured noise go together, and those of heavy tails scatter more."""
    whole, worth = 0, 0.0
    for one in residuals:
        whole += len(one)
        if len(one) < _FEWEST or not one.any():
            continue
        rho = _past(autocorrelation(one, lags=min(_LAGS, len(one) // 2)))
        coloured = len(rho) > 0 and abs(rho[0]) > _COLOUR / math.sqrt(len(one))
        stop = int(np.argmax(rho <= 0)) if (rho <= 0).any() else len(rho)
        memory = 1 + 2 * float((rho[: max(stop, 1)] ** 2).sum()) if coloured else 1.0
        worth += len(one) / memory / _tails(one)
    return worth / whole if whole else 1.0


def _tails(residual: FloatArray) -> float:
    """By how much squares scatter more than those of normal noise: from the fourth moment, beyond chance."""
    squares = residual**2
    size = float(squares.mean())
    excess = float((squares**2).mean()) / size**2 - 3 if size > 0 else 0.0
    return 1 + excess / 2 if excess > _COLOUR * math.sqrt(24 / len(residual)) else 1.0


def _past(correlation: Correlation) -> FloatArray:
    """(lags,) correlation of a residual with its past; none where that cannot be told."""
    if correlation.values is None:
        return np.zeros(0)
    return np.nan_to_num(np.asarray(correlation.values, dtype=float)[1:])
