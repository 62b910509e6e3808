"""The last steps of a repair: confirmation on fresh data, the gap before and after, the verdict."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from casadi_engine.deadline import TimeUp
from casadi_engine.discrepancy.all_data import AllData, along_all_data
from casadi_engine.discrepancy.answer_words import (
    ahead,
    at_bounds,
    elsewhere,
    odds_over_none,
    open_units,
    so_far,
    undetermined,
    untold,
    without_answer,
)
from casadi_engine.discrepancy.by_chance import held_to_chance
from casadi_engine.discrepancy.by_member import told_by_member, told_by_priors
from casadi_engine.discrepancy.certificate import (
    as_untried,
    class_matrix,
    equation_of,
    found_effects,
    in_place_of,
    noise_found,
    place_of,
    score_rows,
    unknown_of,
)
from casadi_engine.discrepancy.choice import ANY, TIME_UP, Choice
from casadi_engine.discrepancy.claim import (
    Claim,
    at_own_port,
    behind_a_sensor,
    closed_on_fresh,
    missing_beside,
    more_than_stated,
    no_noise,
    reason_to_withdraw,
)
from casadi_engine.discrepancy.coloured_errors import with_coloured_errors
from casadi_engine.discrepancy.common_delay import with_other_cause
from casadi_engine.discrepancy.confirmation import CHANCE, PairedGain
from casadi_engine.discrepancy.detectable import not_found
from casadi_engine.discrepancy.elsewhere_families import unused_everywhere
from casadi_engine.discrepancy.evidence import FACTOR
from casadi_engine.discrepancy.filters import behind_a_filter
from casadi_engine.discrepancy.fresh import (
    Portions,
    side,
)
from casadi_engine.discrepancy.fresh_choice import LEFT_OUT, NO_RUN, Confirmation, FreshChoice
from casadi_engine.discrepancy.fresh_fits import events_told
from casadi_engine.discrepancy.fresh_misfit import held_to_fresh_data
from casadi_engine.discrepancy.full_stores import is_overfull
from casadi_engine.discrepancy.joint_fit import asks_for_one, with_joint_fit
from casadi_engine.discrepancy.latent_torque import LatentTorque, latent_torques
from casadi_engine.discrepancy.law_refit import is_far, refitted_law
from casadi_engine.discrepancy.left_out import left_out_alike
from casadi_engine.discrepancy.next_experiment import next_experiment
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.only_rounding import without_what_rounding_leaves
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.priors import priors_of
from casadi_engine.discrepancy.random_families import ORDERS
from casadi_engine.discrepancy.repaired import (
    BEHIND_LAW,
    REFUSED,
    TOO_LITTLE,
    UNCONFIRMED,
    UNJUDGED,
    UNTOLD,
    FoundEffect,
    Gaps,
    NextExperiment,
    Repair,
    Unknown,
    Verdict,
    in_its_place,
)
from casadi_engine.discrepancy.short_delays import with_short_delays
from casadi_engine.discrepancy.station import Station
from casadi_engine.discrepancy.too_few import held_to_what_fresh_data_tell
from casadi_engine.discrepancy.tried import key_of
from casadi_engine.discrepancy.unknown_law import UnknownLaw, imitators, unknown_law
from casadi_engine.discrepancy.unseen_events import held_to_seen_events
from casadi_engine.discrepancy.vanishing import may_vanish
from casadi_engine.discrepancy.verdict_words import ENOUGH, may_hide
from casadi_engine.discrepancy.withdrawal import held_to_rivals

_MAY_HIDE = (
    "what the noise is taken to be is coloured: an effect that the library lacks may hide in it; a level of the noise "
    "that is stated, ce.Noise(...), or colour=False has it judged"
)
# Shares of the spare time behind a budget at which the tests beside the library have to be there, and the rest that an
# answer can do without.
_TESTS, _EXTRA = 0.75, 0.9
# Prior standard deviations beyond which an error of a sensor is no error that a sensor has: a quarter of what it shows.
_LARGE = 5.0
# Times the noise of the search that is left of an output, from which it is no noise: half more of its square.
_LOUD = 1.2
# What ± are worth where effects explain not all.
_MORE = "the ± cover noise alone; what is still unexplained may move the values by more"
_LEFT_OUT = {
    "leftover": "what no effect of the library names",
    "latent torque": "where something acts",
    "unknown law": "a law that no effect names, in the place of those found",
    "imitators": "what the effects do beside a law that no effect names",
    "refitted law": "what such a law does as a part of the equations",
    "left out": "what was left out and does the same",
    "rounding": "what rounded corners do that effects seem to",
}


@dataclass
class Answer:
    """What the search found, to be put to the test of fresh data and into words."""

    fresh: FreshChoice
    alpha: float
    options: dict[str, Any]
    timing: dict[str, float]
    begun: float
    tell: Any
    messages: list[str] = field(init=False)

    def __post_init__(self) -> None:
        self.messages = self.fresh.messages

    @property
    def search(self) -> Choice:
        """The search."""
        return self.fresh.search

    @property
    def portion(self) -> Portions:
        """The records that were searched, and fresh ones."""
        return self.fresh.portion

    def made(self) -> Repair:
        """The Repair."""
        null = self.search.null
        if self.portion.why is not None:
            self.messages.append(self.portion.why)
        proof = self._less_rounding(self._timed("confirm", self.fresh.run))
        proof, last = self._honest(proof)
        claim = self._claimed(proof, last)
        null = self.search.null  # in the colour of its noise by now
        claim = self._held_to_laws(claim, null)
        cut = self._was_cut("refitted law") or self._was_cut("unknown law")
        # what was found and closes too little is a sign that something is missing
        cut |= bool(claim.withdrawn) and TIME_UP in self.search.failed.values()
        if cut and not claim.found and claim.unknown is None and claim.last.screened.choice.is_coloured:
            # a law may be all of that colour
            claim = replace(claim, unknown=Unknown(untold(self.search), {}))
        if self._is_unjudged(claim):
            refused = [f"{one.name} at {one.at}: fresh data refuse it" for one in claim.found]
            why = REFUSED if any(w.startswith(tuple(refused)) for w in self.messages) else UNJUDGED
            claim = claim.withdrawn_for(claim.unknown or Unknown(untold(self.search), {}), null, why)
        if claim.found and claim.unknown is None:
            claim = replace(claim, unknown=self._behind_a_filter(claim) or more_than_stated(claim.last))
        found, last, proof = claim.found, claim.last, claim.proof
        if not found:  # there is no repaired model
            self.messages[:] = [words for words in self.messages if words != NO_RUN]
        named = tuple(
            f"{one.name} at {one.at} {LEFT_OUT}" for one in found
        )  # what was left out first, and came back
        self.messages[:] = [words for words in self.messages if not words.startswith(named or "\0")]
        refitter, told = self.search.refits.refitter, null.screened
        found = self._in_time("exchange", lambda: with_short_delays(found, last, refitter, told)) or found
        verdict = _verdict(found, claim.unknown)
        pool = {key: one.arrived.values for key, one in self.search.pool.items()}
        self.messages += told_by_member(found, key_of(last.effects), pool, last.fit)
        self.messages += told_by_priors(found, key_of(last.effects), self.search.pool)
        self._say(null, last, proof)
        if claim.unknown is not None:  # which is said in its own place
            known = {claim.unknown.sentence, _cut("leftover") if claim.unknown.port else ""}
            self.messages[:] = [words for words in self.messages if words not in known]
        blank = Repair(
            "answered" if verdict is not None else UNTOLD,
            verdict,
            proof.judgement.confirmed if proof.judgement and found else None,
            null.fit,
            last.fit,
            self.alpha,
            effects=found,
            withdrawn=claim.withdrawn,
            unknown=claim.unknown,
            gaps=self._timed("gap", lambda: self._gaps(null, last, proof)),
            rounds=tuple(self.search.rounds),
            data=self.portion.data,
            fresh=self.portion.fresh,
            options=self._options(null, last) if found else self.options,
            blind=null.screened.request.blind,
            nearest=claim.nearest_of(),
        )
        return self._finished(blank, null, last, proof)

    def _claimed(self, proof: Confirmation, last: Station) -> Claim:
        """What fresh data and the tests beside the library leave of what the search found."""
        null = self.search.null
        found, withdrawn = self._timed("certificate", lambda: _effects(proof))
        cut = TIME_UP in self.search.failed.values()
        unknown = None if found else Unknown(untold(self.search), {})
        if self._in_time("leftover", lambda: last.screened.leftover, _TESTS) is not None:
            unknown = missing_beside(last, null, found, withdrawn, cut=cut, least=self._rare)
            if unknown is None and not found and cut:
                words = so_far(self.search) or ([untold(self.search)] if ANY in self.search.failed else [])
                unknown = Unknown(words[0], {}) if words else None
        elif found:
            unknown = no_noise(last)
        if found and unknown is not None and self._may_be_rounding(last, unknown):
            self.messages.append(
                f"what is left at {unknown.port} depends on {unknown.signal}: the corners of the law there are "
                "rounded, which may cause it, and no fit with sharper corners was reached"
            )
            unknown = no_noise(last)  # rounding leaves no more than that
        if null.screened.request.blind and not found and not at_own_port(null, unknown):
            way = self.search.way(self.search.best)
            if way is not None and len(way) > 1:
                unknown = behind_a_sensor(null, way[1])
        if not found and cut and ahead(self.search) > 0:
            unknown = Unknown(so_far(self.search)[0], {} if unknown is None else unknown.tests)
        claim = Claim(proof, last, found, withdrawn, unknown)
        sure = proof.judgement is not None and bool(proof.judgement.confirmed)
        full = {r: {s: one.value for s, one in own.items()} for r, own in last.fit.initial.items()}
        far = {"far": self._is_large(last), "full": is_overfull(last.effects, full)}
        doubt = reason_to_withdraw(claim, null, sure, cut=cut, **far) if found else None
        if doubt is None:
            return claim
        seen = self._in_own_colour(null)
        if (
            not sure
            and seen is not null
            and not seen.screened.significant
            and unknown_of(seen.screened) is None
        ):
            doubt = None  # white noise alone had made findings of colour
        return (
            claim.withdrawn_for(None, seen, TOO_LITTLE) if doubt is None else claim.withdrawn_as(doubt, seen)
        )

    def _is_large(self, last: Station) -> bool:
        """True where an error of a sensor or an input is far larger than one may well be: none is so wrong, and a law
        that is missing looks like that."""
        null, path = last.screened.null, self.search.refits.path
        priors = priors_of(null, path.parameters(last.effects), last.effects)
        at_sensors = [one.amplitude for one in last.effects if one.kind in ("sensor", "cross", "input")]
        return any(
            abs(value - prior.centre) > _LARGE * prior.deviation
            for name, value in zip(null.parameters, null.values, strict=True)
            if name.partition("@")[0] in at_sensors and (prior := priors[name])
        )

    def _in_own_colour(self, null: Station) -> Station:
        """The model without effects, scored with the colour of its residual where that waited."""
        if not null.screened.choice.waits:
            return null
        seen: Station | None = self._in_time("leftover", lambda: self.search.as_chosen(frozenset()))
        return null if seen is None else seen

    def _may_be_rounding(self, last: Station, unknown: Unknown) -> bool:
        """True where a function at a port is what rounded corners leave of a law there, and sharper ones are felt."""
        refits = self.search.refits
        ports = {one.candidate.port for one in last.effects if refits.path.cornered([one])}
        return unknown.course is not None and unknown.port in ports and refits.may_be_rounding(last.effects)

    def _is_unjudged(self, claim: Claim) -> bool:
        """True where effects leave more than white noise, and the time was up before fresh data could say what they
        are worth: what the colour of a noise takes may be what is missing. What rounded corners leave has its own word.
        """
        cut = TIME_UP in self.search.failed.values() and claim.proof.judgement is None
        if not (claim.found and self.portion.fresh and cut):
            return False
        if claim.unknown is None:
            levels, left = self.search.refits.path.levels, claim.last.fit.residual_level
            more = any(left[name] > _LOUD * level for name, level in levels.items() if name in left)
            return more or claim.last.screened.choice.is_coloured
        return not self._may_be_rounding(claim.last, claim.unknown)

    def _behind_a_filter(self, claim: Claim) -> Unknown | None:
        search = self.search
        return behind_a_filter(claim.found, key_of(claim.last.effects), search.pool, search.refits.filters)

    def _held_to_laws(self, claim: Claim, null: Station, *, told: bool = False) -> Claim:
        """What is left where laws that no effect names are held against what is claimed.

        told : of effects that only stay if such a law can be told from them
        """
        found, unknown, last = claim.found, claim.unknown, claim.last
        coloured = last.screened.choice.is_coloured
        sure = unknown is not None and bool(unknown.tests) and not null.screened.request.blind
        # looked for everywhere: effects may imitate it, and what is coloured may hide it
        near = unknown_law if null.screened.request.blind else partial(unknown_law, everywhere=True)
        every = self._in_time("unknown law", lambda: self._along_all(claim)) if found else None
        near = near if every is None else partial(near, along=every)
        # effects that leave too much are still nearer than none, unless they bend to what is missing
        held = last if claim.is_bent else claim.nearest or last
        looked = bool(found) or sure or (unknown is None and coloured)
        law = self._law(held, near) if looked else None
        far = bool(law and not held.effects and self._in_time("unknown law", lambda: self._is_far(held)))
        rival = _said(claim, held, law, far=far)
        # what was recorded and acts on nothing may be all of the colour, by a law that slopes do not follow
        hidden = coloured and not found and unknown is None
        idle = tuple(unused_everywhere(last.fit.model, null.fit.free)) if hidden else ()
        close = rival is not None and every is None  # all data would tell it by slopes
        asked = close or bool(idle) or self._asks_refit(claim, law)
        if asked and not null.screened.request.blind:  # an error of a sensor may be all there is
            first = law if looked else self._law(held, near)
            others = (*idle, *(() if first is None else first.others))
            told_by = partial(refitted_law, others=others, fresh=self.portion.fresh)
            again = self._law(held, told_by, "refitted law")
            said = _said(claim, held, again, refitted=True)
            beside = law is not None and law.is_beside and rival is not None  # it is not in their place
            if (
                said is not None
                and again is not None
                and not beside
                and (rival is None or law is None or far or again.log > law.log)
            ):
                law, rival = again, said
            if rival is not None and said is None and self._was_cut("refitted law"):
                rival = replace(rival, sentence=as_untried(rival.sentence))
        if not found and law is not None and ahead(self.search) > law.log:
            return claim  # what was refitted says more than what a function does along the motion without it
        if rival is None or law is None:
            cut = self._was_cut("unknown law") or self._was_cut("refitted law")
            if unknown is not None and unknown.port and (looked or asked) and cut:
                claim = replace(claim, unknown=replace(unknown, sentence=as_untried(unknown.sentence)))
            return claim.withdrawn_for(claim.unknown, null, BEHIND_LAW) if told and law is None else claim
        if not found and unknown is None and law.log < -math.log(self._rare):  # by their odds alone
            return claim
        if unknown is not None and not found:
            rival = replace(rival, tests=unknown.tests)
        claim = replace(claim, unknown=rival if law.log >= 0 or unknown is None else unknown)
        law = replace(law, imitators=self._imitators(held, law)) if law.log >= math.log(FACTOR) else law
        judged = claim.proof.judgement  # what fresh data deny is no name for the law that is more probable
        denied = judged is not None and judged.confirmed is False and law.log >= math.log(FACTOR)
        # or show that they explain what they ought to, unless they are put there anew, at another time
        if judged is not None and judged.confirmed and not any(one.moves for one in last.effects):
            fresh = closed_on_fresh(claim.proof, last.screened.noise)
            law = law if fresh is None else law.on_fresh(fresh)
        if not law.excludes and not denied:
            return claim
        fewer = self._without_last(claim) if law.imitators > 1 else None
        kept = None if fewer is None else self._held_to_laws(fewer, null, told=True)
        return (
            kept if kept is not None and kept.found else claim.withdrawn_for(claim.unknown, null, BEHIND_LAW)
        )

    def _asks_refit(self, claim: Claim, law: UnknownLaw | None) -> bool:
        """True where a law is to be refitted, as slopes do not tell it from what is claimed: near the truth they do."""
        if claim.found and law is None:
            return True
        if claim.unknown is not None and not claim.found:
            return True
        coloured = claim.last.screened.choice.is_coloured
        return coloured and self._in_time("unknown law", lambda: self._is_far(claim.last)) is True

    def _along_all(self, claim: Claim) -> AllData | None:
        """All data, where fresh ones confirm effects: a law of no name may do what these imitate, which the data of the
        search alone do not tell."""
        proof = claim.proof
        tried = self.search.pool.get(key_of(claim.last.effects))
        if tried is None or proof.judgement is None or not proof.judgement.confirmed:
            return None
        return along_all_data(self.search.refits, tried, self.portion.fresh, proof.before, proof.after)

    def _without_last(self, claim: Claim) -> Claim | None:
        """The claim without the effect that was found last: one that comes near to a law of no name says more than
        several that imitate it. None where it was the only one."""
        kept, before = claim.proof.kept[:-1], claim.proof.before
        if len(kept) < 2 or not before:
            return None
        judged, after = self.fresh.judged(kept, before)
        if after is None or not judged.confirmed:
            return None
        proof = replace(claim.proof, kept=kept, judgement=judged, after=after)
        gone = [replace(one, why_withdrawn=BEHIND_LAW) for one in claim.found[len(kept) - 1 :]]
        found, _ = _effects(proof)
        return Claim(proof, kept[-1], found, (*gone, *claim.withdrawn), claim.unknown)

    def _less_rounding(self, proof: Confirmation) -> Confirmation:
        """Without effects that were added to what rounded corners of the others leave."""
        refits = self.search.refits
        kept = self._in_time("rounding", lambda: without_what_rounding_leaves(refits, tuple(proof.kept)))
        if kept is None or len(kept) == len(proof.kept):
            return proof
        called = [f"{one.candidate.effect} at {one.candidate.port}" for one in kept[-1].effects]
        self.messages += [
            f"{one.candidate.effect} at {one.candidate.port} {LEFT_OUT} it gains less than sharper corners of "
            f"{' and '.join(called)} may"
            for one in proof.kept[-1].effects
            if one not in kept[-1].effects
        ]
        self.search.best = key_of(kept[-1].effects)
        judged, after = proof.judgement, proof.after
        if judged is not None and proof.before:
            judged, again = self.fresh.judged(kept, proof.before)
            after = again or []
        return replace(proof, kept=kept, judgement=judged, after=after)

    @property
    def _rare(self) -> float:
        """How rare by chance that has to be, a score or odds, which nothing else bears out: as what tests find, and as
        what fresh data confirm where there are some."""
        return self.alpha * (CHANCE if self.portion.fresh else 1.0)

    def _finished(self, blank: Repair, null: Station, last: Station, proof: Confirmation) -> Repair:
        screened = null.screened
        latent: tuple[LatentTorque, ...] = ()
        place = None
        if blank.verdict != "nothing missing":
            latent = self._in_time("latent torque", lambda: self._latent(null, last)) or ()
            place = place_of(screened.null, _noise_of_place(last), latent)
        split = self._in_time("next experiment", lambda: _split(proof.kept))
        self.timing["total"] = time.perf_counter() - self.begun
        named = {(member.name, member.at) for one in blank.effects for member in one.members}
        done = replace(
            blank,
            threshold=screened.threshold,
            threshold_p=screened.threshold_p,
            candidates=len(screened.candidates),
            scores=score_rows(screened),
            matrix=class_matrix(screened),
            where=place,
            not_found=tuple(one for one in not_found(last.screened) if (one.name, one.at) not in named),
            not_applicable=screened.not_applicable,
            next_experiment=split,
            equation=equation_of(last.fit.model, null.fit.model) if blank.effects else None,
            noise=noise_found(_quietest(last, proof).screened, null.fit.noise),
            latent=latent,
            timing=self.timing,
            messages=tuple(dict.fromkeys(self.messages)),
        )
        if done.effects and done.unknown is not None:
            done = replace(done, messages=(_MORE, *done.messages))
        if may_hide(done):
            done = replace(done, messages=(*done.messages, _MAY_HIDE))
        done = held_to_chance(done, odds_over_none(self.search))
        if asks_for_one(done, last.effects):
            refitter = self.search.refits.refitter
            done = self._in_time("all records", lambda: with_joint_fit(done, refitter)) or done
        done = held_to_rivals(held_to_what_fresh_data_tell(held_to_fresh_data(done)))
        return held_to_seen_events(with_other_cause(done), last.effects)

    def _is_far(self, last: Station) -> bool:
        """See ``law_refit.is_far``."""
        tried = self.search.pool.get(key_of(last.effects))
        return tried is not None and is_far(self.search.refits.path.residuals(tried.effects, tried.arrived))

    def _law(
        self, last: Station, told: Callable[..., UnknownLaw | None], what: str = "unknown law"
    ) -> UnknownLaw | None:
        """A law that no effect names, in the place of those found, that these do not exclude."""
        search = self.search
        tried = search.pool.get(key_of(last.effects))
        if tried is None:
            return None
        found: UnknownLaw | None = self._in_time(what, lambda: told(search.refits, tried, search.price))
        return found

    def _imitators(self, last: Station, law: UnknownLaw) -> int:
        """See ``unknown_law.imitators``."""
        tried, family = self.search.pool.get(key_of(last.effects)), law.course.family
        if tried is None or len(tried.effects) < 2:
            return 0
        refits = self.search.refits
        found: int | None = self._in_time(
            "imitators", lambda: imitators(refits, tried, family.port, family.signal)
        )
        # not told by then, none of them is known to do anything beside the law
        return len(tried.effects) if found is None else found

    def _honest(self, proof: Confirmation) -> tuple[Confirmation, Station]:
        """The last model with errors that count with the colour of its noise."""
        last = proof.kept[-1]
        screened = last.screened
        fit, words = with_coloured_errors(last.fit, screened.null, screened.noise, screened.choice.rounded)
        if not words:
            return proof, last
        self.messages.append(words)
        last = replace(last, fit=fit)
        return replace(proof, kept=(*proof.kept[:-1], last)), last

    def _timed(self, what: str, work: Any) -> Any:
        begun = time.perf_counter()
        made = work()
        self.timing[what] = self.timing.get(what, 0.0) + time.perf_counter() - begun
        return made

    def _in_time(self, what: str, work: Any, share: float = _EXTRA) -> Any:
        """What an answer can do without; None where it is not there within a share of the spare time, or fails."""
        try:
            with self.search.deadline.spared(share):
                return self._timed(what, work)
        except TimeUp:
            self.messages.append(_cut(what))
        except FAILURES as fault:
            self.messages.append(f"{_LEFT_OUT.get(what, what)}: not told, as its numbers fail ({fault})")
        return None

    def _was_cut(self, what: str) -> bool:
        return _cut(what) in self.messages

    # ---- parts

    def _options(self, null: Station, last: Station) -> dict[str, Any]:
        """What was asked for, and what that may have cost: effects left out that are like those found."""
        words = self._in_time("left out", lambda: left_out_alike(null, last, self.search.refits))
        return {**self.options, "left out": words} if words else self.options

    def _gaps(self, null: Station, last: Station, proof: Confirmation) -> Gaps:
        choice = _quietest(last, proof).screened.choice
        gain: PairedGain | None = proof.judgement.gain if proof.judgement else None
        first, then = ([(one.fit, one.screened.null)] for one in (null, last))
        return Gaps(
            side(first, choice, other=then),
            side(then, choice, other=first),
            side(proof.before, choice, source=null.fit, other=proof.after) if proof.before else None,
            side(proof.after, choice, source=last.fit, other=proof.before) if proof.after else None,
            gain,
            self.portion.source if proof.before else None,
        )

    def _latent(self, null: Station, last: Station) -> tuple[LatentTorque, ...]:
        self.tell("where: what acts at each port, of unknown course")
        return tuple(latent_torques(null.screened.null, _noise_of_place(last)))

    def _say(self, null: Station, last: Station, proof: Confirmation) -> None:
        self.messages += [*last.screened.choice.messages, *without_answer(self.search), *elsewhere(last)]
        told = (proof.after, last.fit) if proof.after else (proof.before, null.fit)
        self.messages += [*so_far(self.search), *events_told(*told)]
        own = {
            record.name: {int(c) for n in record.cycle.values() for c in n}
            for record in null.screened.null.records
        }
        if sum(len(cycles) for cycles in own.values()) == 1:
            self.messages.append(
                "one engine cycle: in which cycles an effect acts, how combustion scatters and how often half of the "
                "data would choose the same effect cannot be told from it"
            )
        bound = [name for name, e in null.fit.estimates.items() if e.at_bound is not False]
        if bound and len(proof.kept) > 1:
            self.messages.append(
                f"without the effects {', '.join(bound)} went to a bound: the scores held them there"
            )
        if bound and not self.search.best:
            self.messages.append(
                f"{', '.join(bound)} went to a bound: the model may not describe these data, whatever was tested"
            )
        late = [
            name for name, e in last.fit.estimates.items() if e.at_bound is not False and name not in bound
        ]
        self.messages += undetermined(last.fit)
        self.messages += open_units(last.fit.model, [one.candidate.port for one in last.effects])
        if len(proof.kept) > 1:
            self.messages += may_vanish(last.fit)
            inside = [
                name for one in last.effects for name in late
                if name.partition("@")[0] == one.amplitude
                and last.fit.values[name] < one.candidate.source.effect.amplitude.max
            ]  # fmt: skip
            self.messages += at_bounds(late, inside)


def _quietest(last: Station, proof: Confirmation) -> Station:
    """The model that tells the noise: one that fresh data refuse still explains what was searched."""
    return proof.refused[-1] if proof.refused else last


def _noise_of_place(last: Station) -> NoiseModel:
    """The noise beside which a gap is looked for: the stated one where the residual is larger, as its colour would hide
    what is looked for."""
    return last.screened.choice.stated or last.screened.noise


def _cut(what: str) -> str:
    """That an answer does without something, for want of time."""
    return f"{_LEFT_OUT.get(what, what)}: not looked for, as the time was up"


def _said(
    claim: Claim, held: Station, law: UnknownLaw | None, *, refitted: bool = False, far: bool = False
) -> Unknown | None:
    """What is said of a law that is held against a structure; None where that, or what is known of what is missing
    beside it, says more. refitted : it stands in the equations, and makes lines of its own; far : as in_place_of"""
    if law is None or _comes_back(held, law):
        return None
    if not claim.found and not refitted and _has_a_line(held, law):
        return None
    if claim.nearest is not None and not claim.is_bent and not claim.found and law.log < math.log(FACTOR):
        return None
    return in_place_of(held, law, far=far)


def _comes_back(last: Station, law: UnknownLaw) -> bool:
    """True where what comes back with every turn of a shaft explains what is left better than a function of one signal
    without turns."""
    left = last.screened.leftover
    turns = left.family is not None and left.family.order > 0 and left.family.name in left.alarms
    return turns and not law.course.family.order and 0.5 * left.drop - math.log(ORDERS) > law.log


def _has_a_line(last: Station, law: UnknownLaw) -> bool:
    """True where a line in the spectrum of what is left explains it better than a function of one signal."""
    left = last.screened.leftover
    if left.line is None or left.lines is None:
        return False
    return 0.5 * left.lines[left.line] - math.log(last.screened.null.count) > law.log


def _effects(proof: Confirmation) -> tuple[tuple[FoundEffect, ...], tuple[FoundEffect, ...]]:
    """The effects found, and those withdrawn."""
    found = found_effects(proof.kept)
    if not proof.refused:
        return found, ()
    known = {one.key for one in found}
    everything = found_effects((proof.kept[0], *proof.refused))
    why = REFUSED if proof.denied else UNCONFIRMED
    return found, tuple(replace(one, why_withdrawn=why) for one in everything if one.key not in known)


def _verdict(found: Sequence[FoundEffect], unknown: Unknown | None) -> Verdict | None:
    if unknown is not None and unknown.sentence == UNTOLD and not found:
        return None
    if found:
        several = any(len(one.members) > 1 for one in found)
        # of no name, which is a member too
        law = in_its_place(unknown, found) or (unknown is not None and (unknown.odds or 0.0) >= 1)
        return "class" if several or law else "named"
    return "nothing missing" if unknown is None else "unnamed"


def _split(kept: Sequence[Station]) -> NextExperiment | None:
    """The experiment for the first class of more than one, where the members are not far apart already along the motion
    itself: what keeps such together is no lack of data."""
    for number, station in enumerate(kept):
        if number and len(station.members) > 1:
            made = next_experiment(kept[number - 1], station)
            return None if made is None or made.separation_now >= ENOUGH else made
    return None
