"""Tail probabilities of the distributions that tests use (sf), and the values that have them (isf).

They are the functions that scipy.stats calls; importing that package takes longer than a fit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

Numbers = float | NDArray[np.float64]


def p_words(p: float) -> str:
    """A probability in a sentence, with its sign: one that is 0 but for rounding is none.

    >>> p_words(0.0123), p_words(0.0)
    ('p = 0.012', 'p < 1e-300')
    """
    return "p < 1e-300" if p < 1e-300 else f"p = {p:.2g}"


def normal_sf(z: Numbers) -> Any:
    """P(Z > z) of a standard normal variable.

    >>> round(float(normal_sf(1.959964)), 6)
    0.025
    """
    return special.ndtr(-z)


def normal_isf(p: Numbers) -> Any:
    """Return the z with P(Z > z) = p."""
    return -special.ndtri(p)


def chi2_sf(value: Numbers, dof: Numbers) -> Any:
    """P(X > value) of a chi-squared variable with ``dof`` degrees of freedom; NaN where there are none."""
    found = special.gammaincc(np.divide(dof, 2), np.maximum(value, 0.0) / 2)
    return np.where(np.greater(dof, 0), found, np.nan)


def chi2_isf(p: Numbers, dof: Numbers) -> Any:
    """Return the value that a chi-squared variable exceeds with probability p."""
    return special.chdtri(dof, p)


def f_sf(ratio: Numbers, dof: Numbers, below: Numbers) -> Any:
    """P(F > ratio) of Fisher's F with ``dof`` degrees of freedom above and ``below`` below."""
    return special.fdtrc(dof, below, np.maximum(ratio, 0.0))


def f_isf(p: Numbers, dof: Numbers, below: Numbers) -> Any:
    """Return the ratio that Fisher's F exceeds with probability p."""
    return special.fdtri(dof, below, 1.0 - p)


def t_sf(t: Numbers, dof: Numbers) -> Any:
    """P(T > t) of Student's t."""
    return special.stdtr(dof, -t)


def beta_sf(share: Numbers, a: float, b: float) -> Any:
    """P(B > share) of a beta variable; NaN where ``b`` is not positive."""
    return special.betaincc(a, b, np.clip(share, 0.0, 1.0)) if b > 0 else np.nan
