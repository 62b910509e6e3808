"""One step of all candidates in the place of a function that follows the motion: where the model without effects is far
from what was measured, what is linearised along its own simulation tells nothing, and along that of the model with the
function it tells what the function stands for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from casadi_engine.discrepancy.law_race import Race
from casadi_engine.discrepancy.linearised import OneStep, one_step
from casadi_engine.discrepancy.null_model import NullModel, null_at
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.screening import Screened
from casadi_engine.discrepancy.start import Start


def in_place_of_function(
    refits: Refits,
    functions: Sequence[tuple[str, str]],
    screened: Screened,
    families: Mapping[tuple[str, str], list[int]],
) -> tuple[OneStep, Start, float] | None:
    """One step of the candidates of some families in the place of the function that leaves least, where it ended but
    for its terms, and what it leaves; None where none had arrived on the whole record, or its slopes fail.

    functions : ports and signals of those that may serve
    """
    race = Race.of(refits)
    there = [one for at in functions if (one := race.whole.get(at)) is not None]
    if not there:
        return None
    best = min(there, key=lambda one: one.found.cost)
    model, terms = best.setup.model, set(best.setup.terms)
    names = [state.name for state in model.states]
    values = {name: value for name, value in best.found.values.items() if name not in terms}
    first = {record: np.array([own[n] for n in names]) for record, own in best.found.initial.items()}
    try:
        with np.errstate(all="ignore"):
            null = null_at(model, refits.refitter.data, best.setup.parameters, best.null.values, first)
    except FAILURES:
        return None
    gone = _without(null, terms)
    if gone is None:
        return None
    members = sorted(k for own in families.values() for k in own)
    step = one_step(gone, screened.candidates, refits.path.levels, members)
    return None if step is None else (step, Start(values, best.found.initial), best.found.cost)


def _without(null: NullModel, terms: set[str]) -> NullModel | None:
    """The model without a function: what it does to the outputs is to be explained along with the residual."""
    size = np.diag(null.turn)
    if null.turn.shape != (len(null.values),) * 2 or not np.array_equal(null.turn, np.diag(size)):
        return None
    gone = [k for k, name in enumerate(null.parameters) if name in terms]
    records = []
    for record in null.records:
        slopes, residual = {}, {}
        for output, own in record.slopes.items():
            residual[output] = record.residual[output] + own[:, gone] @ (null.values[gone] / size[gone])
            slopes[output] = np.delete(own, gone, axis=1)
        records.append(replace(record, slopes=slopes, residual=residual))
    kept = ~null.prior[:, gone].any(axis=1)  # those of the terms go with them
    return replace(
        null,
        turn=np.delete(null.turn, gone, axis=1),
        prior=np.delete(null.prior[kept], gone, axis=1),
        records=tuple(records),
    )
