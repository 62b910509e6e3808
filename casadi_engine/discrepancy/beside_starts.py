"""How much something moves the outputs of a record, beside what another start of the record does."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array, basis, without
from casadi_engine.discrepancy.null_model import NullModel, RecordNull

# Share of what moves an output that has to be left where another start takes the rest; with less of it the motion is
# unstable: all that acts is first of all another start, which no controller allows.
_LEFT = 0.01


def moved_by(null: NullModel, record: RecordNull, columns: Mapping[str, Array]) -> dict[str, Array]:
    """Output -> (k,) root mean square of columns (N, k) of each output, or of what is left of them beside another start
    of the record, where that is nearly nothing of it."""
    whole = {output: np.sqrt(np.mean(np.square(own), axis=0)) for output, own in columns.items()}
    count = null.turn.shape[1]
    starts = np.concatenate([record.slopes[output][:, count:] for output in columns])
    if not starts.shape[1]:
        return whole
    left = without(basis(starts), np.concatenate(list(columns.values())))
    found, at = {}, 0
    for output, own in columns.items():
        beside = np.sqrt(np.mean(np.square(left[at : at + len(own)]), axis=0))
        found[output] = np.where(beside < _LEFT * whole[output], beside, whole[output])
        at += len(own)
    return found
