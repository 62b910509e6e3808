"""A reason why some standard errors are not those of the quadratic around an optimum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Curvature that passes, and up to which a profile still tells the interval; `tests/benchmarks/CALIBRATION.md` has the
# coverage of intervals on either side.
FLAT, RUGGED = 0.4, 1.5
# Share of a quantity's variance along a doubted direction from which its error is doubted: where optima may be twelve
# standard errors apart, that is a tenth of one; where an interval changes its shape, or to another optimum, a third.
_SHARE = {"rugged": 1e-4, "curved": 0.1, "bent": 0.1, "rival": 0.1}
CALL = "call ce.posterior(fit)"
OR_CALL = ", or ce.posterior(fit)"


def as_able(words: str, *, predicted: bool, robust: bool) -> str:
    """What is said of errors that are not known, for a fit that has no posterior: one of a predictor, whose profile
    there is, or of a robust loss, which has no likelihood.

    >>> as_able("the errors are not known; call ce.posterior(fit)", predicted=True, robust=False)
    'the errors are not known; call ce.profile(fit), which holds the gain'
    """
    if robust:
        asked = "mask the outliers and fit by squares, whose errors can be looked at"
        words = words.replace("call ce.profile(fit)" + OR_CALL, asked)
    elif predicted:
        asked = "call ce.profile(fit), which holds the gain"
        words = words.replace("call ce.profile(fit)" + OR_CALL, asked)
    else:
        return words
    return words.replace(CALL, asked)


@dataclass(frozen=True, eq=False)
class Doubt:
    """Why some standard errors are not those of the quadratic.

    kind : "rival" (another optimum was found), "lost" (a lower one was, or a constant explains an output better),
    "rugged" (noise makes optima), "curved", "bent" (by another parameter), "bound" or "uneven", for which an interval
    by profile will do
    text : for the reader; size : how grave; move : (N,) of [v; initial states], the direction in doubt, one standard
    error long (a rival's: to there; a bound's, and an uneven one's: the parameter)
    """

    kind: str
    text: str
    move: Array
    size: float = 0.0

    @property
    def shape(self) -> bool:
        """True if it is about the shape of an interval alone, which a profile tells."""
        return self.profiles and self.size <= FLAT

    @property
    def plain(self) -> bool:
        """True if how chi-squared rises beside a parameter tells that shape."""
        return self.kind == "uneven" or (self.kind == "curved" and self.shape)

    @property
    def profiles(self) -> bool:
        """True if a profile of the likelihood tells the interval."""
        return self.kind in ("curved", "bent", "bound", "uneven")

    def about(self, slope: Array, covariance: Array) -> bool:
        """True if this is about a quantity with this slope (N,)."""
        if self.kind == "lost":
            return True
        if self.kind == "bound":
            return bool(slope @ self.move)
        if self.kind == "uneven":  # what depends on others too may be even
            return np.array_equal(slope != 0, self.move != 0)
        return bool((slope @ self.move) ** 2 > _SHARE[self.kind] * (slope @ covariance @ slope))
