"""Fresh data that a model from which nothing seems missing does not fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scipy import stats

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import Repair

# The gap on fresh data is larger by at least this factor, and chance would do as much less often than this. Samples of
# coloured noise count less by a memory that is generous.
_LARGER, _SURE, _MEMORY = 1.5, 1e-4, 20.0


def fresh_misfit(repair: Repair) -> str | None:
    """What to say where nothing is missing in the data of the search but the gap on fresh data is beyond the noise.

    The ratio of both chi-squared per sample is held against Fisher's F. None where it is by chance, where there are no
    fresh data, or where combustion scatters: that gap is not of the noise alone.
    """
    gaps = repair.gaps
    if repair.verdict != "nothing missing" or gaps is None or gaps.validation_after is None:
        return None
    if repair.noise is None or repair.noise.scatter:
        return None
    own, other = gaps.estimation_after.gap, gaps.validation_after.gap
    if not own.chi2_per_sample > 0:
        return None
    ratio = other.chi2_per_sample / own.chi2_per_sample
    memory = _MEMORY if repair.noise.colour else 1.0
    chance = stats.f.sf(ratio, max(other.samples / memory, 1.0), max(own.samples / memory, 1.0))
    if not (ratio > _LARGER and chance < _SURE):
        return None
    return (
        f"the fresh data do not fit: chi2/N is {other.chi2_per_sample:.3g} there and {own.chi2_per_sample:.3g} on the "
        "data of the search; something acts in them alone, or the parameters are known too little"
    )
