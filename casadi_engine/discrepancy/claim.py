"""What a repair claims: the effects it names, and what is missing beside them or in their place."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from casadi_engine.discrepancy.certificate import unknown_of
from casadi_engine.discrepancy.confirmation import share_closed
from casadi_engine.discrepancy.fresh import gap_of, told_by_both
from casadi_engine.discrepancy.fresh_choice import Confirmation
from casadi_engine.discrepancy.fresh_misfit import GROWN, HALF, SEEN, SURE
from casadi_engine.discrepancy.no_noise import why_no_noise
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.repaired import (
    BENT,
    LEAVING,
    TOO_LITTLE,
    UNTOLD,
    FoundEffect,
    Nearest,
    Unknown,
)
from casadi_engine.discrepancy.selection import effective_samples
from casadi_engine.discrepancy.station import Station
from casadi_engine.discrepancy.wording import is_early
from casadi_engine.distributions import chi2_sf
from casadi_engine.estimation import Fit

# How often white noise of the level that was stated may be found larger.
_BY_CHANCE = 0.01
_FAR = (
    "one of them an error far larger than a sensor or an input may well have: together they bend to what is missing, "
    "and no fresh data show that they are more than that"
)
_FULL = (
    "a storage that would begin far beyond what is ever stored there: it bends to what is missing, whatever fades or "
    "comes slowly"
)
_NOT_ALL = "not all of it"
_CUT = "explains, and the time was up before it was identified"


@dataclass(frozen=True, eq=False)
class Claim:
    """What is said: the structures that fresh data kept, the last of them, the effects found and those withdrawn, and
    what is missing beside the found ones, or at all; nearest : the structure whose effects were withdrawn as they leave
    too much, and nearest_proof : what fresh data said of it."""

    proof: Confirmation
    last: Station
    found: tuple[FoundEffect, ...]
    withdrawn: tuple[FoundEffect, ...]
    unknown: Unknown | None
    nearest: Station | None = None
    nearest_proof: Confirmation | None = None

    def withdrawn_as(self, doubt: Unknown, null: Station) -> Claim:
        """Without any effect, for what ``reason_to_withdraw`` says."""
        left = LEAVING if _NOT_ALL in doubt.sentence else TOO_LITTLE
        bent = _FAR in doubt.sentence or _FULL in doubt.sentence
        return self.withdrawn_for(doubt, null, BENT if bent else left)

    def withdrawn_for(self, unknown: Unknown | None, null: Station, why: str) -> Claim:
        """Without any effect: something else is missing."""
        gone = [replace(one, why_withdrawn=why) for one in self.found]
        if gone and unknown is not None and unknown.sentence == UNTOLD:  # it was told by what is withdrawn
            unknown = replace(unknown, sentence=f"more than {' and '.join(_names(self.found))} {_CUT}")
        proof = replace(self.proof, kept=self.proof.kept[:1], after=self.proof.before)
        near = (self.last, self.proof) if self.found else (self.nearest, self.nearest_proof)
        return Claim(proof, null, (), (*gone, *self.withdrawn), unknown, *near)

    @property
    def is_bent(self) -> bool:
        """True where effects were withdrawn that bend to what is missing by an error far larger than there is."""
        said = "" if self.found or self.unknown is None else self.unknown.sentence
        return _FAR in said or _FULL in said

    def nearest_of(self) -> Nearest | None:
        """The model with the effects that were withdrawn; None without any."""
        if self.found or self.nearest is None or self.nearest_proof is None:
            return None
        noise, after = self.nearest.screened.noise, self.nearest_proof.after
        names = tuple(f"{one.candidate.effect} at {one.candidate.port}" for one in self.nearest.effects)
        fresh = gap_of([one for _, one in after], noise) if after else None
        return Nearest(names, self.nearest.fit, gap_of([self.nearest.screened.null], noise), fresh)


def reason_to_withdraw(
    claim: Claim, null: Station, confirmed: bool, *, cut: bool = False, far: bool = False, full: bool = False
) -> Unknown | None:
    """Why the effects found are no answer: they close next to nothing, or less than what they leave, which is no noise,
    or are errors of sensors and inputs alone, or several that nothing confirms, and leave more than noise, or of which
    one is an error far larger than it may well be, where fresh data do not confirm and fit them; or leave more than a
    person would overlook, where the noise is known, or a sensor would be early; None where they are one.

    cut : the search ended before all were refitted; far : an effect is far larger than it may well be; full : one is a
    storage that begins far beyond what is stored there
    """
    if full:
        return Unknown(f"{' and '.join(_names(claim.found))} explains the gap best, {_FULL}", {})
    if not confirmed and not _visible(claim.found):
        small, beside = _too_small(claim.found), unknown_of(null.screened)
        return small if beside is None else replace(beside, sentence=f"{beside.sentence}; {small.sentence}")
    if far and len(claim.found) > 1 and not (confirmed and _fits_fresh(claim)):
        names = " and ".join(_names(claim.found))
        return Unknown(f"{names} explain the gap best, {_FAR}", {})
    noise, proof = claim.last.screened.noise, claim.proof
    ports = null.fit.model.ports
    instruments = all(ports[one.at].kind in ("sensor", "cross", "input") for one in claim.found)
    told = claim.unknown is not None
    if not told and not (instruments and claim.last.screened.choice.is_coloured):
        return None
    stated = {name: sigma for name, (sigma, estimated) in null.fit.noise.items() if not estimated}
    known = bool(stated) and told and not cut
    if known:  # what is left beyond it is no noise, whatever its colour
        noise = NoiseModel({**noise.sigma, **stated})
    closed = _closed([null.screened.null], [claim.last.screened.null], noise)
    fresh = closed_on_fresh(proof, noise) if confirmed else None
    if fresh is not None:  # which show more of it, or as much
        closed = fresh if told and not known else min(closed, fresh)
    # it bends to something else, or is the time of another clock
    early = far or any(is_early(one) for one in claim.found)
    if closed >= 1 - (SEEN**2 if known or early else SEEN):
        return None
    # an offset or a delay bends to what any missing law does, and so do several effects together: these are all that
    # is wrong, or none of it, unless fresh data have confirmed several; of what may be noise, most of it
    enough = closed >= HALF and (not instruments or not told) and (confirmed or len(claim.found) == 1)
    enough = enough and not early
    # several that leave what its own past foretells follow it for a part of the way, each
    if enough and not known and (len(claim.found) == 1 or no_noise(claim.last) is None):
        return None
    names = " and ".join(_names(claim.found))
    more = _NOT_ALL if closed >= HALF else "less of it than is left"
    words = f"{names} explains the gap best and closes {more}, which is no noise"
    unknown = claim.unknown or Unknown("what is left is coloured", {})
    return replace(unknown, sentence=f"{unknown.sentence}; {words}")


def _fits_fresh(claim: Claim) -> bool:
    """True unless fresh data leave a residual that is no noise of the same sensors."""
    noise = claim.last.screened.noise
    fresh = gap_of([one for _, one in claim.proof.after], noise).chi2_per_sample
    return not fresh > GROWN**2 * gap_of([claim.last.screened.null], noise).chi2_per_sample


def _names(found: Sequence[FoundEffect]) -> list[str]:
    return [f"{one.name} at {one.at}" for one in found]


def closed_on_fresh(proof: Confirmation, noise: NoiseModel) -> float | None:
    """The share of the gap on fresh data that is closed; None without fresh data."""
    if not proof.before or not proof.after:
        return None
    return _closed([one for _, one in proof.before], [one for _, one in proof.after], noise)


def _closed(before: Sequence[NullModel], after: Sequence[NullModel], noise: NoiseModel) -> float:
    """The share of the gap that is closed, what is coloured counted as gap."""
    first, then = (gap_of(nulls, noise) for nulls in told_by_both(before, after))
    return share_closed(first, then, noise.sigma, coloured=True)


def missing_beside(
    last: Station,
    null: Station,
    found: Sequence[FoundEffect],
    withdrawn: Sequence[FoundEffect],
    *,
    cut: bool = False,
    least: float = 1.0,
) -> Unknown | None:
    """What is missing beside the effects found; cut : the search ended before all were refitted; least : p-value that a
    score has to be below which no refit bears out."""
    unknown = unknown_of(last.screened)
    if unknown is not None or found:
        return unknown or no_noise(last)
    above = above_stated(null.fit, null.screened.choice.rounded)
    if above is not None:
        return above
    if withdrawn:
        words = f"{withdrawn[0].name} at {withdrawn[0].at} explains these data best, but fresh data refuse it"
        return Unknown(words, {})
    screened = null.screened
    if screened.significant and (cut or screened.pooled(screened.significant[0]) < least):
        best = screened.significant[0]
        label = screened.candidates[best].label
        words = f"{label} scores beyond chance, but no refit with it is better than none"
        words = f"{label} scores beyond chance; the search ended before refits could tell" if cut else words
        return Unknown(words, {label: screened.pooled(best)})
    return no_noise(null)


def more_than_stated(last: Station) -> Unknown | None:
    """What is said of effects that leave more than the noise that was stated, beyond chance."""
    left, words = last.screened.noise.sigma, []
    stated = {name: sigma for name, (sigma, estimated) in last.fit.noise.items() if not estimated}
    for name in stated.keys() - last.screened.choice.rounded.keys():
        count = sum(len(record.residual.get(name, ())) for record in last.screened.null.records)
        chance = float(chi2_sf(count * (left[name] / stated[name]) ** 2, count))
        if chance < _BY_CHANCE / len(stated):
            words.append(f"{name}, {left[name]:.4g} in place of {stated[name]:.4g}")
    return Unknown(f"more is left than the noise that was stated: {'; '.join(words)}", {}) if words else None


def above_stated(fit: Fit, rounded: Collection[str] = ()) -> Unknown | None:
    """What is said of a model that leaves more than the noise that was stated, beyond chance; None where no level is
    stated, or no more is left.

    rounded : outputs whose level is that of rounding; samples of what is coloured count as fewer independent ones
    """
    words = []
    stated = {name: sigma for name, (sigma, estimated) in fit.noise.items() if not estimated}
    for name in stated.keys() - set(rounded):
        left = [own[name].residual[own[name].mask] for own in fit.traces.values() if name in own]
        count, worth = (
            sum(len(e) for e in left),
            sum(min(effective_samples(e), len(e)) for e in left if len(e)),
        )
        size = math.sqrt(sum(float(e @ e) for e in left) / max(count, 1))
        if worth and float(chi2_sf(worth * (size / stated[name]) ** 2, worth)) < SURE / len(stated):
            words.append(f"{name}, {size:.4g} in place of {stated[name]:.4g}")
    return Unknown(f"more is left than the noise that was stated: {'; '.join(words)}", {}) if words else None


def no_noise(null: Station) -> Unknown | None:
    """What is said of a coloured residual that is no noise, and not as large as was stated."""
    screened = null.screened
    for record in screened.null.records:
        for output, e in record.residual.items():
            if (record.name, output) not in screened.noise.colour or _is_as_stated(null, record.name, output):
                continue
            share = null.fit.fit_percent[record.name][output]["simulation"]
            words = why_no_noise(record.name, output, e, share, screened.noise.sigma[output])
            if words is not None:
                return Unknown(words, {})
    return None


def _is_as_stated(null: Station, record: str, output: str) -> bool:
    """True where the level of an output's noise was stated and no more is left."""
    stated = not null.fit.noise[output][1]
    return stated and (record, output) not in null.screened.choice.larger


def _visible(found: Sequence[FoundEffect]) -> bool:
    """True if the effects together close a part of the gap that a person would see."""
    left = math.prod(1 - min(max(one.share_explained, 0.0), 1.0) for one in found)
    return 1 - left >= 1 - (1 - SEEN) ** 2


def _too_small(found: Sequence[FoundEffect]) -> Unknown:
    """What is said of effects that are beyond chance and close next to nothing of the gap."""
    names = " and ".join(f"{one.name} at {one.at}" for one in found)
    words = (
        f"{names} is beyond chance, but closes next to nothing of the gap, and fresh data do not confirm it"
    )
    return Unknown(words, {one.key: one.p_value for one in found})


def at_own_port(null: Station, unknown: Unknown | None) -> bool:
    """True if what is missing is a law at a port of the user's own kind, where the library has no effects."""
    ports = null.fit.model.ports
    return unknown is not None and unknown.port in ports.names and ports[str(unknown.port)].is_own


def behind_a_sensor(null: Station, station: Station) -> Unknown:
    """Something is missing, and what describes it best is an error of a sensor, beside which nothing was tested."""
    one = station.effects[-1]
    words = f"{one.label} describes the gap best, but no physical effect could be tested against it"
    assert station.lead is not None
    return Unknown(words, {one.label: null.screened.pooled(station.lead)})
