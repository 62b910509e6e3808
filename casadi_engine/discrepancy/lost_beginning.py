"""A beginning of a record that no structure describes, and that a late sensor shows nothing of."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from casadi_engine.discrepancy.wording import HINT

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import Repair
    from casadi_engine.discrepancy.tried import Tried

# Part of the squares that the best structure without a late sensor leaves of an output, and how many times the part of
# the samples, from which a beginning is what is wrong: of a sensor that is late all of the motion is.
_HOLDS, _TIMES = 0.25, 4.0


def with_lost_beginning(repair: Repair, tried: Tried | None) -> Repair:
    """The repair with a doubt at its top where a delay leaves out what the other structures are off by.

    tried : the structure that was found
    """
    if tried is None or tried.beside is None or HINT in repair.options or not repair.effects:
        return repair
    for record in tried.beside[0].null.records:
        for output, e in record.residual.items():
            lost = np.isin(record.index[output], tried.lost.get((record.name, output), ()))
            if not lost.any() or not np.square(e).sum() > 0:
                continue
            share = float(np.square(e[lost]).sum() / np.square(e).sum())
            if share < _HOLDS or share < _TIMES * lost.mean():
                continue
            span = record.time[output][lost]
            words = (
                f"{output} of {record.name} from {span[0]:.3g} to {span[-1]:.3g} s, which a sensor that late shows "
                f"nothing of, holds {100 * share:.0f} % of what the best model without a delay leaves: look whether "
                "something else acts there, a hand or a start, and repair again without that part"
            )
            return replace(repair, options={**repair.options, HINT: words[0].upper() + words[1:]})
    return repair
