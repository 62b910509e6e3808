"""How many degrees of freedom the level of the noise has, as a parameter sees it: those of all outputs together are not
those of a parameter that hangs on one of few samples, whose level is estimated by itself.

The error of a parameter is a sum over outputs; each level is known by its samples less what the parameters take of them
(the trace of the hat matrix there), and the sum is worth as many degrees of freedom as Satterthwaite has it (1946,
Biometrics Bulletin 2, 110): the square of the sum over the sum of the squares, each over its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.doubt import Doubt
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.taken import are_few, grams_of, taken

if TYPE_CHECKING:
    from casadi_engine.estimation.standard_errors import Uncertainty

Array = NDArray[np.float64]

# A level has at least so many degrees of freedom; and of fewer than the second it is no level, for the fit may have
# made it as small as it likes.
_LEAST, _KNOWN = 1.0, 1.5
# How that is said.
UNKNOWN = "is not known, and so no error"


def freedom_of(search: Search, errors: Uncertainty) -> float:
    """Degrees of freedom of the noise behind the error of a parameter, of the one with the fewest; all samples less
    what is estimated where there is one level, or enough samples for each."""
    pooled = float(search.problem.samples - errors.covariance.rank)
    estimated, counts = np.array(search.levels.estimated), search.levels.counts
    if not are_few(search) or pooled <= 0 or not errors.optimal:
        return pooled
    matrix = errors.covariance.matrix
    grams = grams_of(search, errors.x)
    taken = np.array([float(np.sum(matrix * gram)) for gram in grams])
    shares = np.array([np.diag(matrix @ gram @ matrix) for gram in grams])[:, : search.problem.nv]
    freedom = np.maximum(counts - taken, _LEAST)
    whole = np.diag(matrix)[: search.problem.nv]
    unsure = (np.square(shares)[estimated] / freedom[estimated, None]).sum(axis=0)
    told = (whole > 0) & np.isfinite(unsure) & (unsure > 0)
    fewest = float((whole[told] ** 2 / unsure[told]).min(initial=pooled))
    # a sum has no fewer than its worst part: less is the rounding of a matrix that is all but singular
    return min(pooled, max(fewest, float(freedom[estimated].min(initial=pooled))))


def interpolated(search: Search, errors: Uncertainty) -> list[Doubt]:
    """Outputs with an estimated level of whose samples the parameters leave next to none to tell it: the fit goes
    through them, with a level near 0 that draws all else to them."""
    if not are_few(search) or not errors.optimal:
        return []
    own, counts = taken(search, errors.x), search.levels.counts
    if own is None:
        return []
    found = []
    for k, name in enumerate(search.levels.outputs):
        if search.levels.estimated[k] and counts[k] - own[k] < _KNOWN:
            text = (
                f"the noise level of {name} {UNKNOWN}: of its {counts[k]} samples parameters and "
                f"initial states take {own[k]:.3g}; state it, noise=ce.Noise({name}=...)"
            )
            found.append(Doubt("lost", text, np.zeros(len(errors.covariance.matrix))))
    return found
