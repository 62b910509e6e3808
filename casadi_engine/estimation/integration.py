"""How finely the records of a fit are integrated: as finely as the estimates can feel.

An integration error e of the outputs, weighted by the noise levels, moves no estimate by more than the norm of e in its
standard errors (by Cauchy and Schwarz: the estimate is a projection of the weighted residual). So the norm over all
samples is what is held to a tolerance, not the largest error: an error of a hundredth of the noise level in 10 000
samples can move an estimate by a whole standard error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.record import RecordTerm
from casadi_engine.simulation.error_estimate import (
    ErrorEstimate,
    SignedError,
    Stepped,
    shortened,
    signed_error,
    summed_up,
)
from casadi_engine.simulation.propagator import fineness_of

Array = NDArray[np.float64]

# Standard errors by which integration may move an estimate; steps are shortened until it is less.
SHIFT = 0.02
# Integration errors below this share of the outputs' size are not pursued: they are near the rounding of long runs.
_NEGLIGIBLE = 1e-9
# Chi-squared by which a simulation may differ from what a search found in intervals: within 0.1 standard errors, and a
# share for the rounding of long sums and the tolerance of continuity.
_ALIKE, SHARE = 1e-2, 1e-6


def alike(simulated: float, found: float) -> bool:
    """True if chi-squared of a simulation is the one that a search found with its intervals joined within a tolerance.

    >>> alike(100.0005, 100.0), alike(100.5, 100.0)
    (True, False)
    """
    return abs(simulated - found) <= _ALIKE + SHARE * abs(found)


def signed_errors(
    records: Sequence[RecordTerm], v: Array, nodes: Sequence[Array]
) -> list[SignedError | None]:
    """The estimated integration error of each record; None for one that is solved exactly."""
    return [
        _signed_error(record, v[record.active], at) if isinstance(record.propagator, Stepped) else None
        for record, at in zip(records, nodes, strict=True)
    ]


def _signed_error(record: RecordTerm, v: Array, nodes: Array) -> SignedError:
    """The error of one record. The last one is remembered: what ends the shortening of steps is also reported."""
    propagator: Any = record.propagator
    if record.last_error is not None:
        *place, before, steps, found = record.last_error
        same = before is propagator and steps == fineness_of(propagator)
        if same and all(np.array_equal(old, new) for old, new in zip(place, (v, nodes), strict=True)):
            known: SignedError = found
            return known
    error = signed_error(propagator, v, nodes)
    # the run may have refined the propagator's steps for stability
    record.last_error = (v.copy(), nodes.copy(), propagator, fineness_of(propagator), error)
    return error


def shift_of(record: RecordTerm, found: SignedError) -> float:
    """The most that a record's integration error moves any estimate, in its standard errors."""
    weighted = record.observation.observe(found.off) * record.weight
    norm = float(np.sqrt(np.sum(weighted**2)))
    return norm if np.isfinite(norm) else np.inf


def shorten_steps(
    records: Sequence[RecordTerm], v: Array, nodes: Sequence[Array], misfit: float = 1.0, shift: float = SHIFT
) -> bool:
    """Give shorter steps to records whose integration moves the estimates; True if any has them now.

    shift : standard errors by which it may move them
    misfit : chi-squared per sample; where it is above 1 the residuals are no noise of the levels by which records are
    weighed, and what is left of a wrong model tells the estimates so much less
    """
    errors = signed_errors(records, v, nodes)
    limit, changed = shift * np.sqrt(max(misfit, 1.0) / len(records)), False
    for record, found in zip(records, errors, strict=True):
        if found is None or record.limited:
            continue
        moved = shift_of(record, found)
        largest = float(np.abs(found.off).max(initial=0.0))
        if moved <= limit or largest <= _NEGLIGIBLE * float(np.abs(found.size).max(initial=0.0)):
            continue
        assert isinstance(record.propagator, Stepped)
        finer = shortened(record.propagator, found, min(4 * moved / limit, 1e8))
        if finer is not None:
            record.propagator = finer
        elif not record.step_in_places():
            continue
        changed = True
    return changed


def integration_of(
    records: Sequence[RecordTerm], v: Array, nodes: Sequence[Array]
) -> dict[str, ErrorEstimate]:
    """Record -> its integration error and what it does to the estimates, where a record is integrated at all."""
    about = {}
    for record, found in zip(records, signed_errors(records, v, nodes), strict=True):
        if found is None:
            continue
        assert isinstance(record.propagator, Stepped)
        estimate = summed_up(record.propagator, found, outputs=record.outputs, samples=record.grid.samples)
        about[record.experiment.name] = replace(estimate, shift=shift_of(record, found))
    return about
