"""Fresh data that a model from which nothing seems missing does not fit."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from casadi_engine.discrepancy.confirmation import Gap, share_closed
from casadi_engine.discrepancy.repaired import IN_PART, LAWS_CUT, REFUSED, UNCONFIRMED, Unknown, in_its_place
from casadi_engine.discrepancy.selection import numbers_of
from casadi_engine.discrepancy.withdrawal import withdrawn
from casadi_engine.distributions import f_sf
from casadi_engine.effects.protocol import moves

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import Repair

# The gap on fresh data is larger by at least this factor, and chance would do as much less often than this. Samples of
# coloured noise count less by a memory that is generous.
# Noise may be a little louder there, but what is not white is no noise: then the smaller factor counts.
LARGER, SMALLEST, SURE, MEMORY = 1.5, 1.05, 1e-4, 20.0
# Chi-squared per sample that is larger by more is no louder noise of the same sensor, five times at most.
LOUDEST = 25.0
# Share of what is beyond the noise there that errors of the parameters have to explain, to be said to do so.
_EXPLAINED = 0.5
# Share of the gap's squares above the noise that effects have to close where what they leave is no white noise.
HALF = 0.5
# Times by which the residual of fresh data is larger than that of the search where it is no noise of one sensor.
GROWN = 2.0
# A change of a gap that a person would see.
SEEN = 0.1
_TINY = 1e-300
# The test by which something is missing that the fresh data alone show.
FRESH = "fresh data"


def fresh_misfit(repair: Repair) -> str | None:
    """What to say where the fresh data are not described by the model that is the answer: the gap there is beyond the
    noise and beyond what errors of the parameters explain.

    The ratio of both chi-squared per sample is held against Fisher's F; parameters that must move too far count
    too. None where it is by chance, where there are no fresh data or no effect is named, or where combustion
    scatters: that gap is not of the noise alone.
    """
    gaps = repair.gaps
    if repair.verdict in (None, "unnamed") or gaps is None or gaps.validation_after is None:
        return None
    if repair.noise is None or repair.noise.scatter:
        return None
    own, fresh = gaps.estimation_after.gap, gaps.validation_after
    if not own.chi2_per_sample > 0:
        return None
    output, (first, found, left) = _worst(repair), _in_all(repair)
    where = "chi2/N"
    if not _beyond(repair, left) and output is not None:
        first, found, left = _of_output(repair, output)
        where = f"chi2/N of {output}"
    where = f"{where} is {found:.3g} there and {first:.3g} on the data of the search"
    if output is not None or _beyond(repair, left):
        within = "" if left == found else f", {left:.3g} within the errors of the parameters"
        if is_louder(repair):
            return f"the fresh data are noisier: {where}{within}, and what is left is white"
        return (
            f"the fresh data do not fit: {where}{within}; something acts in them alone or is still "
            "missing, or their noise is larger"
        )
    found = fresh.gap.chi2_per_sample
    far = fresh.parameters_p is not None and fresh.parameters_p < SURE
    if far and _beyond(repair, found, least=SMALLEST):
        return (
            f"the fresh data do not fit: {where}, and they ask for other parameters than the fit's, beyond their errors"
            f" (p {fresh.parameters_p:.2g})"
        )
    return None


def how_far(repair: Repair, *, within: bool = False) -> str:
    """Chi-squared per sample of the fresh data, of the output that is described worst where that of all is fine.

    within : that of what errors of the parameters leave, which is noise
    """
    output, (_, found, left) = _worst(repair), _in_all(repair)
    where = "chi2/N"
    if output is not None and not _beyond(repair, left):
        _, found, left = _of_output(repair, output)
        where = f"chi2/N of {output}"
    if within and f"{left:.3g}" != f"{found:.3g}":
        return f"{where} {left:.3g} within the errors of the parameters"
    return f"{where} {found:.3g}"


def _in_all(repair: Repair) -> tuple[float, float, float]:
    """Chi-squared per sample of all outputs, as in ``_of_output``."""
    assert repair.gaps is not None
    assert repair.gaps.validation_after is not None
    own, fresh = repair.gaps.estimation_after.gap.chi2_per_sample, repair.gaps.validation_after
    found = fresh.gap.chi2_per_sample
    # where the model bends, a step of the parameters may make it worse
    return own, found, found if fresh.within_errors is None else min(found, fresh.within_errors)


def fresh_doubt(repair: Repair) -> str | None:
    """What to say where the gap on fresh data is beyond the noise, and errors of the parameters explain it."""
    gaps = repair.gaps
    after = None if gaps is None else gaps.validation_after
    if gaps is None or after is None or after.within_errors is None or fresh_misfit(repair) is not None:
        return None
    if repair.verdict in (None, "unnamed") or repair.noise is None or repair.noise.scatter:
        return None
    found = after.gap.chi2_per_sample
    excess = found - gaps.estimation_after.gap.chi2_per_sample
    if not _beyond(repair, found) or found - after.within_errors < _EXPLAINED * excess:
        return None
    which = (
        "with parameters for all records, within their errors"
        if after.jointly
        else "within the errors of the parameters"
    )
    return (
        f"on the fresh data chi2/N is {found:.3g}, and {after.within_errors:.3g} {which}: "
        "these are known too little to describe fresh data, and what they hide cannot be seen"
    )


def is_far_beyond(repair: Repair) -> bool:
    """True where the fresh data are further off than any noise, though the search knows too few numbers to say that
    this is not by chance."""
    gaps = repair.gaps
    if gaps is None or gaps.validation_after is None or (repair.noise is not None and repair.noise.scatter):
        return False
    own = max(gaps.estimation_after.gap.chi2_per_sample, 1.0)
    return _in_all(repair)[2] > LOUDEST * own


def _beyond(
    repair: Repair, found: float, own: float | None = None, outputs: int = 1, *, least: float = LARGER
) -> bool:
    """True if a chi-squared per sample of the fresh data is larger than that of the search, beyond chance.

    own : of the search, of one of so many outputs; None for that of all; least : the factor from which on it is larger
    """
    gaps, noise = repair.gaps, repair.noise
    if gaps is None or gaps.validation_after is None or noise is None:
        return False
    first, fresh = gaps.estimation_after.gap, gaps.validation_after.gap
    memory = _memory(repair) if noise.colour else 1.0
    return beyond_chance(found, fresh.samples, first, memory=memory, own=own, outputs=outputs, least=least)


def _memory(repair: Repair) -> float:
    """How many samples of the coloured noise tell its size as well as one of white noise, twice over: as it is on the
    data of the search, of the output in which it is longest."""
    assert repair.gaps is not None
    found = 1.0
    for traces in repair.gaps.estimation_after.traces.values():
        for trace in traces.values():
            e = trace.residual[np.isfinite(trace.residual)]
            found = max(found, len(e) / (2 * numbers_of(e))) if len(e) else found
    return min(2 * found, MEMORY)


def beyond_chance(
    found: float,
    samples: int,
    first: Gap,
    *,
    memory: float,
    own: float | None = None,
    outputs: int = 1,
    least: float = LARGER,
) -> bool:
    """True if a chi-squared per sample of so many fresh ones is larger than that of the search, beyond chance.

    first : the gap of the search; own : chi-squared per sample there of one of so many outputs; None for that of all
    memory : how many samples of the noise count for one; least : the factor from which on it is larger
    """
    own = first.chi2_per_sample if own is None else own
    # where rounding counts as a larger noise, the residual is worth fewer samples by as much
    memory = max(memory, 1 / max(first.chi2_per_sample, _TINY))
    fresh, known = (max(count / outputs / memory, 1.0) for count in (samples, first.samples))
    ratio = found / own if own > 0 else 0.0
    return ratio > least and outputs * f_sf(ratio, fresh, known) < SURE


def _of_output(repair: Repair, output: str) -> tuple[float, float, float]:
    """Chi-squared per sample of an output: on the data of the search, on fresh data, and there within the errors of the
    parameters."""
    assert repair.gaps is not None
    assert repair.gaps.validation_after is not None
    assert repair.noise is not None
    fresh, sigma = repair.gaps.validation_after, repair.noise.sigma[output][0]
    own, found = ((gap.rmse[output] / sigma) ** 2 for gap in (repair.gaps.estimation_after.gap, fresh.gap))
    return own, found, found * min(1.0, fresh.left.get(output, 1.0))


def _worst(repair: Repair) -> str | None:
    """The output that the fresh data describe worst, if beyond chance: others that fit make up for none."""
    gaps = repair.gaps
    if gaps is None or gaps.validation_after is None or repair.noise is None:
        return None
    known = [name for name in gaps.validation_after.gap.rmse if name in gaps.estimation_after.gap.rmse]
    known = [name for name in known if name in repair.noise.sigma]
    beyond = {}
    for name in known:
        own, _, left = _of_output(repair, name)
        white = repair.noise.colour or _least_white(repair, name) >= SURE
        if _beyond(repair, left, own, len(known), least=LARGER if white else SMALLEST):
            beyond[name] = left / own
    return max(beyond, key=lambda name: beyond[name], default=None)


def _more_than_noise(repair: Repair) -> float | None:
    """How often chance would leave the fresh residual as far from white as it is, or as large where no noise is so much
    louder; None where it may be louder noise."""
    after, least = None if repair.gaps is None else repair.gaps.validation_after, _least_white(repair)
    if least < SURE:
        return least
    if repair.gaps is None or after is None:
        return None
    first, _, left = _in_all(repair)
    samples = repair.gaps.estimation_after.gap.samples, after.gap.samples
    return f_sf(left / first, samples[1], samples[0]) if left > LOUDEST * first > 0 else None


def _least_white(repair: Repair, output: str | None = None) -> float:
    """How often chance would leave the fresh residual as far from white, of an output; of that in which it is
    farthest."""
    after = None if repair.gaps is None else repair.gaps.validation_after
    rows = [] if after is None else [one for own in after.whiteness_p.values() for one in own.items()]
    every = [p for name, p in rows if output in (None, name)]
    return min((p for p in every if p is not None), default=1.0)


def is_louder(repair: Repair) -> bool:
    """True where the fresh residual is white as far as it is known, and not too large, and the parameters are those of
    the fit: a louder noise explains it, if none was stated."""
    gaps = repair.gaps
    if gaps is None or gaps.validation_after is None:
        return False
    if repair.noise is not None and not any(estimated for _, estimated in repair.noise.sigma.values()):
        return False
    own, after = gaps.estimation_after.gap.chi2_per_sample, gaps.validation_after
    if after.parameters_p is not None and after.parameters_p < SURE:  # no noise moves them so far
        return False
    known = any(p is not None for one in after.whiteness_p.values() for p in one.values())
    return known and after.gap.chi2_per_sample <= LOUDEST * own and _more_than_noise(repair) is None


def held_to_fresh_data(repair: Repair) -> Repair:
    """The repair with what its model does not describe of the fresh data said first.

    Where nothing was found, and that is no louder noise, something is missing. What was found is not confirmed where
    more of the gap is left there than the effects closed, as a person sees it, by its root mean square: a gain alone
    confirms nothing then, whether or not errors of the parameters would explain what is left. Errors of sensors alone
    are not named where fresh data do not confirm them, or do not fit with them: an offset or a delay bends to what any
    missing law does to one record. Nor is anything where the time was up before laws of no name were tried, nor are
    events, at times that one record alone knows, where fresh data do not fit, nor is what fresh data do not confirm and
    one of their outputs is further off with than without.
    """
    held = _with_what_is_worse(_held(repair))
    judged = held.gaps is not None and held.gaps.validation_after is not None
    as_noise = fresh_misfit(repair) is None or is_louder(repair)
    fits = (as_noise or _left(repair) ** 2 <= SEEN) and held.confirmed is not False
    names = " and ".join(f"{one.name} at {one.at}" for one in held.effects)
    if judged and not fits and _of_sensors(held):
        words = f"{names} describes the gap best, but fresh data do not confirm that a sensor is at fault"
    elif judged and not as_noise and _with_events(held):
        words = (
            f"{names} describes the gap best, but an event that happens in one record may imitate what is missing, "
            "no other record can confirm it, and the fresh data do not fit"
        )
    elif judged and not as_noise and laws_were_cut(repair):
        words = (
            f"{names} describes the gap best of what was tried, but fresh data do not fit, and the time was up before "
            "laws that no effect names were tried"
        )
    elif judged and _bent_in_colour(repair):
        words = (
            f"{names} describes the gap best, but several effects together may imitate another one, and more than a "
            "tenth of the squared gap of the fresh data is left, coloured"
        )
    elif judged and held.confirmed is not True and held.effects and (worse := _worse(held)) is not None:
        words = (
            f"{names} describes the gap best, but fresh data do not confirm it, and what it leaves of {worse} there is "
            "more than without it"
        )
    elif held.effects and held.unknown is not None and laws_were_cut(repair):
        return replace(held, confirmed=None)
    else:
        return held
    unknown = repair.unknown or Unknown(words, {one.key: one.p_value for one in held.effects})
    return withdrawn(held, _why(held), unknown)


def _worse(repair: Repair) -> str | None:
    """The output of which effects leave more on fresh data than the model without them does, as a person sees it."""
    gaps = repair.gaps
    if gaps is None or gaps.validation_before is None or gaps.validation_after is None:
        return None
    return _further_off(gaps.validation_before.gap, gaps.validation_after.gap)


def _further_off(before: Gap, after: Gap) -> str | None:
    grown = {n: after.rmse[n] / size for n, size in before.rmse.items() if n in after.rmse and size > 0}
    worst = max(grown, key=lambda name: grown[name], default=None)
    return worst if worst is not None and grown[worst] > 1 + SEEN else None


def _with_what_is_worse(repair: Repair) -> Repair:
    """The same, with a word on an output that is further off with the effects than without, in these data or fresh
    ones: what closes most of the gap elsewhere may be all that is said else."""
    gaps = repair.gaps
    if gaps is None or not repair.effects:
        return repair
    sides = [("", gaps.estimation_before, gaps.estimation_after)]
    if gaps.validation_before is not None and gaps.validation_after is not None:
        sides.append((" on fresh data", gaps.validation_before, gaps.validation_after))
    for where, before, after in sides:
        if (name := _further_off(before.gap, after.gap)) is not None:
            sizes = f"{before.gap.rmse[name]:.3g} to {after.gap.rmse[name]:.3g}"
            words = (
                f"the residual of {name} is larger with what was found than without it{where} (rmse {sizes})"
            )
            words += ": more is missing"
            return replace(repair, messages=(words, *repair.messages))
    return repair


def laws_were_cut(repair: Repair) -> bool:
    """True where the time was up before laws that no effect names were held against what was found."""
    return any(words in repair.messages for words in LAWS_CUT)


def _bent_in_colour(repair: Repair) -> bool:
    """True of several effects beside which something else is seen, and that leave more than a tenth of the squares of
    the fresh gap, which no white noise is."""
    if len(repair.effects) < 2 or repair.unknown is None or repair.noise is None:
        return False
    return repair.noise.is_coloured and _left(repair) ** 2 > SEEN and not is_louder(repair)


def _with_events(repair: Repair) -> bool:
    """True if an effect begins or ends at a time that is of one record."""
    return any(moves(one.effect) for one in repair.fit.model.effects)


def _of_sensors(repair: Repair) -> bool:
    """True if all effects are errors of sensors."""
    kinds = {repair.model.ports[one.at].kind for one in repair.effects}
    return bool(kinds) and kinds <= {"sensor", "cross"}


def _why(repair: Repair) -> str:
    """Why effects are withdrawn that fresh data do not confirm: only a loss beyond chance contradicts them, and a gain
    beyond it is no lack of one."""
    gain = None if repair.gaps is None else repair.gaps.gain_per_cycle
    if gain is not None and gain.refused:
        return REFUSED
    return IN_PART if gain is not None and gain.confirmed else UNCONFIRMED


def _held(repair: Repair) -> Repair:
    """The same, whatever the effects are."""
    misfit = fresh_misfit(repair)
    if misfit is None:
        doubt = fresh_doubt(repair) or _coloured_doubt(repair)
        if doubt is None:
            return repair
        if repair.verdict == "nothing missing" and _grows_in_colour(repair):
            words = (
                f"{doubt}; what is left of the data of the search is coloured: that may be what is missing"
            )
            return replace(repair, verdict="unnamed", unknown=Unknown(words, {}))
        # an error of a sensor bends to what a missing law does to one record
        weak = _mostly_left(repair) or _of_sensors(repair)
        sure = None if repair.confirmed and weak else repair.confirmed
        return replace(repair, confirmed=sure, messages=(doubt, *repair.messages))
    confirmed = repair.confirmed
    if repair.verdict == "nothing missing" and (p := _more_than_noise(repair)) is not None:
        return replace(repair, verdict="unnamed", unknown=Unknown(misfit, {FRESH: p}))
    if (
        confirmed and _mostly_left(repair) and not is_louder(repair)
    ):  # of louder noise all that is left is noise
        confirmed = False
    # several effects together bend to what none of them is, unless they close all but a tenth of the squares
    if confirmed and len(repair.effects) > 1 and not is_louder(repair) and _left(repair) ** 2 > SEEN:
        confirmed = False
    # what fresh data confirm is that something acts there: the law of no name as well as what it may stand for
    if confirmed and in_its_place(repair.unknown, repair.effects) and not is_louder(repair):
        confirmed = None
    unknown = repair.unknown
    if unknown is None and repair.effects and not is_louder(repair):  # what is left there has no name
        unknown = Unknown(misfit, {})
    return replace(repair, confirmed=confirmed, unknown=unknown, messages=(misfit, *repair.messages))


def _grows_in_colour(repair: Repair) -> bool:
    """True if a coloured residual is so much larger in fresh data that it is no noise of a sensor: parameters that are
    hardly known may explain it as well as what is missing."""
    gaps = repair.gaps
    if gaps is None or gaps.validation_after is None or repair.noise is None or not repair.noise.is_coloured:
        return False
    own, fresh = gaps.estimation_after.gap.rmse, gaps.validation_after.gap.rmse
    return any(fresh[name] > GROWN * size for name, size in own.items() if name in fresh)


def _coloured_doubt(repair: Repair) -> str | None:
    """What to say where what is left of fresh data is coloured, and more than what the effects closed."""
    if (
        not repair.confirmed
        or repair.noise is None
        or not repair.noise.is_coloured
        or not _mostly_left(repair)
    ):
        return None
    return (
        "what is left of the fresh data is coloured, and more than what was closed: noise of the sensors, or more that "
        "is missing"
    )


def _left(repair: Repair, noise: float = 0.0) -> float:
    """The gap on fresh data with the effects, by its root mean square, over that without; with parameters for all
    records where these were fitted together. noise : chi-squared per sample that is none of the gap"""
    gaps = repair.gaps
    before = None if gaps is None else gaps.validation_before
    after = None if gaps is None else gaps.validation_after
    if before is None or after is None or not before.gap.chi2_per_sample > noise:
        return 1.0
    found = after.gap.chi2_per_sample
    if after.jointly and after.within_errors is not None:
        found = min(found, after.within_errors)
    return math.sqrt(max(found - noise, 0.0) / (before.gap.chi2_per_sample - noise))


def _mostly_left(repair: Repair) -> bool:
    """True if more of the gap on fresh data is left than the effects closed, by its root mean square beyond noise."""
    gaps = repair.gaps
    before = None if gaps is None else gaps.validation_before
    after = None if gaps is None else gaps.validation_after
    if before is None or after is None:
        return True
    if repair.noise is None or not repair.noise.is_coloured:
        return _left(repair, noise=1.0) > HALF
    sigma = {name: level for name, (level, _) in repair.noise.sigma.items()}
    return share_closed(before.gap, after.gap, sigma, coloured=True) < HALF
