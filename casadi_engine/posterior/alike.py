"""The moment of a record at which its drives go on as they do at its beginning, and the states there.

A machine that runs is at any moment where its drives have led it, and what led it to the first sample led it as well to
later moments that are alike: the same angle of another cycle, the same phase of another period. The states there are
near the first ones as far as the drives repeat themselves, and how far that is the states tell that lie as long apart.
A record whose drives do not repeat themselves has states as far apart as all its motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate

from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.starts import chained_nodes
from casadi_engine.simulation.linear import LinearPropagator

Array = NDArray[np.float64]

# One part in so many of a record is compared with its beginning: some cycles of what repeats itself. Moments are looked
# for behind its middle, where the transients that hold the noise of the fit's first states have died out.
_COMPARED, _MIDDLE = 4, 2
# States along a record that are looked at, about; fewer samples than this in a comparison are none.
_STATES, _FEWEST = 500, 10
# Of a drive's size: what moves less is a constant.
_CONSTANT = 1e-9


@dataclass(frozen=True, eq=False)
class Alike:
    """The moment of a linear record that is most like its beginning.

    along : the record with states along it; shift : their number up to the moment
    first : (n,) scaled, where runs begin
    """

    along: RecordTerm
    shift: int
    first: Array

    @classmethod
    def of(cls, record: RecordTerm, v: Array, first: Array) -> Alike | None:
        """None where no drive moves at v (nv,)."""
        drives = cast(LinearPropagator, record.propagator).merged_drives(v[record.active]).value
        found = _moment(drives)
        if found is None:
            return None
        moment, length = found
        return cls(record.again(gain=record.gain, length=length), moment // length, first)

    def state(self, v: Array) -> Array:
        """(n,) scaled, that the drives lead to at that moment at v (nv,)."""
        return np.asarray(chained_nodes(self.along, v, self.first)[self.shift])

    def apart(self, v: Array, state: Array) -> Array:
        """States (M, n) so long after others less these, of a run that starts in ``state``: the first state that a fit
        found holds noise."""
        nodes = chained_nodes(self.along, v, state)
        return np.asarray(nodes[self.shift :] - nodes[: -self.shift])


def _moment(drives: Array) -> tuple[int, int] | None:
    """The sample behind which drives (m, N) are most like their beginning, and a number of samples that divides it, by
    which states along the record are taken."""
    count = drives.shape[1]
    size, middle = np.abs(drives).max(axis=1), count // _MIDDLE
    moving = drives[drives.std(axis=1) > _CONSTANT * size]
    window = count // _COMPARED
    if not len(moving) or window < _FEWEST:
        return None
    moving = (moving - moving.mean(axis=1, keepdims=True)) / moving.std(axis=1, keepdims=True)
    squares = np.concatenate([[0.0], np.cumsum(np.square(moving).sum(axis=0))])
    moments = np.arange(middle, count - window + 1)
    apart = squares[moments + window] - squares[moments]
    for one in moving:
        apart -= 2 * correlate(one[middle:], one[:window], mode="valid", method="fft")
    lengths = np.arange(1, 3) * max(count // _STATES, 1)
    divides = moments % np.arange(lengths[0], lengths[1] + 1)[:, None] == 0
    apart[~divides.any(axis=0)] = np.inf
    best = int(np.argmin(apart))
    return int(moments[best]), int(lengths[0] + np.argmax(divides[:, best]))
