"""The model of a structure along all data, those of the search and fresh ones.

A law may do on the data of the search what effects do, and they be named for being fewer numbers. On other motions they
part: where fresh data confirm effects, both are held against each other by all data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.path import FAILURES, Path
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.tried import Tried
from casadi_engine.estimation import Fit
from casadi_engine.experiment import Experiment, with_unique_names

Pairs = Sequence[tuple[Fit, NullModel]]


@dataclass(frozen=True, eq=False)
class AllData:
    """A structure linearised along all data; without : chi-squared of the fresh ones by the model without effects."""

    null: NullModel
    without: float


def along_all_data(
    refits: Refits, tried: Tried, fresh: Sequence[Experiment], before: Pairs, after: Pairs
) -> AllData | None:
    """See ``AllData``; None where the structure has numbers that the fresh data do not have, as when an event happens,
    or fails along them.

    before, after : the model without effects and the structure on fresh data, a record each
    """
    if len(after) != len(fresh) or any(one.placed for one in tried.effects):
        return None
    own = refits.null(tried)
    if own is None or refits.random(own) is not None:  # combustions of every record scatter by themselves
        return None
    refitter = replace(refits.refitter, data=with_unique_names([*refits.refitter.data, *fresh]))
    initial = dict(tried.arrived.initial)
    for record, (fit, _) in zip(refitter.data[-len(fresh) :], after, strict=True):
        found = next(iter(fit.initial.values()))
        initial[record.name] = {name: one.value for name, one in found.items()}
    try:
        with np.errstate(all="ignore"):
            null = Path(refitter, refits.path.levels).null_at(
                tried.effects, replace(tried.arrived, initial=initial)
            )
    except (KeyError, *FAILURES):  # a parameter of every record has no value in fresh ones
        return None
    weight = refits.levels.weight
    rows = [(weight(o) * e) for _, own in before for r in own.records for o, e in r.residual.items()]
    return AllData(null, float(sum(one @ one for one in rows)))
