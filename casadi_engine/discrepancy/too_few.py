"""Fresh data that cannot tell: too few, or too quiet, for what was found to show there."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from casadi_engine.discrepancy.fresh import NOT_CONFIRMED
from casadi_engine.discrepancy.fresh_misfit import fresh_misfit

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import Repair

# Standard errors of an effect from which fresh data would tell it as a rule; and those of a gain by which it may stay
# behind what was foretold, and be no contradiction.
_TOLD, _BEHIND = 4.0, 2.0


def held_to_what_fresh_data_tell(repair: Repair) -> Repair:
    """The repair with ``confirmed`` None in place of False, where fresh data say as little against it as for it.

    Two simulations that differ by D in chi-squared are told apart by the data with a gain of D in twice the log
    likelihood, give or take 2 sqrt(D), if the second is right. A gain that is not beyond chance but not behind that
    either contradicts nobody.
    """
    gaps = repair.gaps
    gain = None if gaps is None else gaps.gain_per_cycle
    if repair.confirmed is not False or not repair.effects or gaps is None or gain is None:
        return repair
    if gain.confirmed is not False or gain.refused or fresh_misfit(repair) is not None:
        return repair
    apart, gained = _apart(repair)
    spread = 2 * math.sqrt(apart)
    if not apart <= _TOLD**2 or gained < apart - _BEHIND * spread:
        return repair
    words = (
        f"the fresh data cannot tell: if what was found is right, 2 ln(likelihood) changes there by {apart:.2g} ± "
        f"{spread:.2g}, and it does by {gained:.2g}; longer records, or such as move more, tell"
    )
    kept = [one for one in repair.messages if not one.startswith(NOT_CONFIRMED)]
    return replace(repair, confirmed=None, messages=(words, *kept))


def _apart(repair: Repair) -> tuple[float, float]:
    """Chi-squared between the simulations of fresh data with and without the effects, and the gain of the data."""
    gaps, noise = repair.gaps, repair.noise
    if gaps is None or gaps.validation_before is None or gaps.validation_after is None or noise is None:
        return math.nan, math.nan
    apart = gained = 0.0
    for record, traces in gaps.validation_before.traces.items():
        for output, before in traces.items():
            after, level = (
                gaps.validation_after.traces[record][output],
                noise.sigma.get(output, (math.nan, False))[0],
            )
            one, other = before.residual / level, after.residual / level
            counts = np.isfinite(one) & np.isfinite(other)
            apart += float(np.sum((one - other)[counts] ** 2))
            gained += float(np.sum(one[counts] ** 2 - other[counts] ** 2))
    return apart, gained
