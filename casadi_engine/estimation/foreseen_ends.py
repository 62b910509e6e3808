"""Ends of an interval from how chi-squared rises two standard errors to either side, without a refit.

Between the optimum and there a profile of the likelihood is s^2 (1 + a s + b s^2) of the standard errors s: two rises
tell a and b. Where they are mild, ends by refits lie within 3 % of half an interval of those of this quartic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Standard errors to either side at which the rises are seen.
FAR = 2.0
# Rises of chi-squared over the quadratic's 4 that pass: the ends of an interval are then within 15 % of where ± has
# them.
RISES = 0.75, 1.3
# Rises for which the quartic tells the ends.
_MILD = 0.65, 1.5


@dataclass(frozen=True)
class Rises:
    """How chi-squared rises beside one parameter, the others at their best.

    at, size : its value and standard error, as it is searched; low, high : rises over those of the quadratic
    """

    at: float
    size: float
    low: float
    high: float

    @property
    def are_mild(self) -> bool:
        """True if the quartic tells the ends."""
        return all(_MILD[0] < rise < _MILD[1] for rise in (self.low, self.high))

    def ends(self, root: float) -> tuple[float, float] | None:
        """Where chi-squared has risen by the square of ``root``, on both sides; None where the quartic does not."""
        a = (self.high - self.low) / (2 * FAR)
        b = ((self.high + self.low) / 2 - 1) / FAR**2
        found = np.roots([b, a, 1.0, 0.0, -(root**2)])
        real = found[np.abs(found.imag) < 1e-9 * np.abs(found)].real
        if not ((real < 0).any() and (real > 0).any()):
            return None
        own = real[real < 0].max(), real[real > 0].min()
        return self.at + float(own[0]) * self.size, self.at + float(own[1]) * self.size
