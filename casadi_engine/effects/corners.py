"""How sharp the corner of a law may be in a fit: as sharp as the record passes through it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

# The corner is rounded over this share of what the signal changes by from the sample before it to the sample after.
_SHARE = 0.25
# And over no less than this share of its largest change: a torque that moves the signal so in one sample then needs a
# dozen steps of the integrator, no more.
_LEAST = 1 / 16
_LARGEST = 0.99


def narrow(courses: Sequence[NDArray[np.float64]], wide: float) -> float:
    """The width over which a law's corner at 0 is rounded, in the signal's unit; ``wide`` where nothing passes it.

    courses : the signal (N,) along each record. A signal that passes the corner within one sample does not see how the
    corner is rounded; one that turns near it, or comes to rest, does, and shows by its change how slow it is there.
    Rounded to two digits, so that a width does not hang on the last digits of a fit.

    >>> import numpy as np
    >>> swing = 2 * np.sin(1.5 * 0.01 * np.arange(1000))
    >>> narrow([swing], 0.5)
    0.015
    >>> narrow([swing + 100], 0.5)
    0.5
    """
    near, largest = [], 0.0
    for course in courses:
        x = np.asarray(course, dtype=float)
        if len(x) < 3 or not np.isfinite(x).all():
            continue
        change = np.abs(x[2:] - x[:-2])
        largest = max(largest, float(np.quantile(np.abs(np.diff(x)), _LARGEST)))
        middle = np.abs(x[1:-1])
        passes = (middle <= change) & (change > 0)
        near.append(change[passes])
    found = np.concatenate([*near, np.zeros(0)])
    if not len(found):
        return wide
    width = max(_SHARE * float(np.median(found)), _LEAST * largest)
    return min(wide, float(f"{width:.2g}"))
