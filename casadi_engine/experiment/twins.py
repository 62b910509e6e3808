"""Records that hold the same measurement: counted twice they make errors that are too small, and confirm nothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from casadi_engine.errors import ExperimentError
from casadi_engine.experiment.experiment import Experiment


def twin_of(record: Experiment, others: Iterable[Experiment], outputs: Sequence[str]) -> Experiment | None:
    """The first of the others whose outputs have the same samples as those of the record, all that both hold, at least
    one of them moving: two sensors at rest may well show the same."""
    return next((one for one in others if _same(record, one, outputs)), None)


def refuse_twins(records: Sequence[Experiment], outputs: Sequence[str]) -> None:
    """Raise ExperimentError for a measurement that is given twice."""
    for k, record in enumerate(records):
        twin = twin_of(record, records[:k], outputs)
        if twin is not None:
            raise ExperimentError(
                f"{record.place} is given twice",
                seen=f"the measurements of {twin.place}, sample by sample",
                allowed="records that were measured apart: the same one twice makes errors that are too small",
                cure="leave one of them out",
            )


def _same(one: Experiment, other: Experiment, outputs: Sequence[str]) -> bool:
    pairs = [(one[name], other[name]) for name in outputs if name in one and name in other]
    return any(np.ptp(a.values[a.mask]) > 0 for a, _ in pairs if a.mask.any()) and all(
        np.array_equal(a.time, b.time) and np.array_equal(a.values, b.values, equal_nan=True)
        for a, b in pairs
    )
