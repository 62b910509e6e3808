"""The model of a structure along all data, those of the search and fresh ones.

A law may do on the data of the search what effects do, and they be named for being fewer numbers. On other motions they
part: where fresh data confirm effects, both are held against each other by all data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from casadi_engine.discrepancy.evidence import Levels
from casadi_engine.discrepancy.noise_choice import is_white
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.path import FAILURES, Path
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.tried import Tried
from casadi_engine.estimation import Fit
from casadi_engine.experiment import Experiment, with_unique_names

# Times the noise of the search from which on fresh data are louder.
_LOUDER = 1.5
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
    or fails along them; and where these are louder, as what any function makes of that would count as a finding.

    before, after : the model without effects and the structure on fresh data, a record each
    """
    if len(after) != len(fresh) or any(one.placed for one in tried.effects):
        return None
    if any(_is_louder(null, refits.levels) for _, null in after):
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


def _is_louder(null: NullModel, levels: Levels) -> bool:
    """True for fresh data in which white noise alone is left, and an output has clearly more of it than in those of the
    search."""
    left = {o: float(np.sqrt(np.mean(np.square(e)))) for r in null.records for o, e in r.residual.items()}
    if not any(size > _LOUDER * levels.sigma.get(name, np.inf) for name, size in left.items()):
        return False
    sigma = {name: max(size, 1e-300) for name, size in left.items()}
    slopes = {record.name: dict(record.slopes) for record in null.records}
    return is_white(null, NoiseModel(sigma), slopes, None)
