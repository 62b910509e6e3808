"""Sensors whose residuals move together: their noise does not, whatever its colour, so that the model lacks something.

Where the noise is coloured, an autoregression may take up what is missing, output by output. It takes up nothing of
what several outputs show at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import Any

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.validation.residual_tests import independence

# How the test of two outputs is named, behind the record and the first of them.
BESIDE = "beside "
# Samples by which one output may follow the other.
_LAGS = 5


def common_tests(records: Any, left: Mapping[str, Mapping[str, Array]]) -> Iterator[tuple[str, float]]:
    """("record/output/beside other", p-value) for each pair of outputs that were sampled together: whether the residual
    of the one follows that of the other, up to five samples behind it, or the other way round.

    left : record -> output -> (N,) residuals
    """
    for record in records:
        for one, other in combinations(record.outputs, 2):
            if not np.array_equal(record.index[one], record.index[other]) or not np.array_equal(
                record.time[one], record.time[other]
            ):
                continue
            pairs = ((one, other), (other, one))
            found = [p for a, b in pairs if (p := _follows(record, a, b, left[record.name])) is not None]
            if found:
                yield f"{record.name}/{one}/{BESIDE}{other}", min(1.0, len(found) * min(found))


def _follows(record: Any, one: str, other: str, left: Mapping[str, Array]) -> float | None:
    """The p-value of the test whether the residual of one output is free of that of the other; None without one."""
    length, index = record.length[one], record.index[one]
    residual, drive, valid = np.zeros(length), np.zeros(length), np.zeros(length, dtype=bool)
    slopes = np.zeros((length, record.slopes[one].shape[1]))
    residual[index], drive[index], valid[index] = left[one], left[other], True
    slopes[index] = record.slopes[one]
    return independence(residual, drive, mask=valid, jacobian=slopes, lags=_LAGS).p_value
