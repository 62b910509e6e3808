"""Fresh data choose: the first structure, in order of evidence, that they do not refuse."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from casadi_engine.deadline import Deadline, TimeUp, late, left
from casadi_engine.discrepancy.certificate import unknown_of
from casadi_engine.discrepancy.choice import NO_FIT, TIME_UP, Choice
from casadi_engine.discrepancy.confirmation import CHANCE, share_closed
from casadi_engine.discrepancy.evidence import FACTOR
from casadi_engine.discrepancy.families import BEYOND
from casadi_engine.discrepancy.fresh import Judgement, Portions, gap_of, judge, residuals, side, told_by_both
from casadi_engine.discrepancy.fresh_fits import fresh_sides
from casadi_engine.discrepancy.fresh_misfit import LOUDEST, MEMORY, SEEN, SURE, beyond_chance
from casadi_engine.discrepancy.fresh_weights import WIDER, FreshWeights
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.parameter_doubt import doubted, within_errors
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.refit import Addition
from casadi_engine.discrepancy.repaired import FRESH_DATA, Unknown
from casadi_engine.discrepancy.station import Station
from casadi_engine.discrepancy.tried import Key, key_of
from casadi_engine.discrepancy.unknown_law import does_more
from casadi_engine.discrepancy.ways import ranked, way_so_far
from casadi_engine.estimation import Fit

NO_RUN = "the repaired model cannot be simulated on the fresh data, which neither confirms nor refuses it"
LEFT_OUT = "is left out:"
CONFIRMED_ALONE = "fresh data confirm the second one, and not the first"
_UNSETTLED = (
    "its initial states on the fresh data had not settled, so that these neither confirm nor refuse it"
)
# Share of the spare time behind a budget at which fresh data have to be judged; evaluations of the model that they may
# cost at least.
_JUDGED, _EVALUATIONS = 0.6, 5000
# So many refits they may cost.
_REFITS = 100
# Rivals of a structure that does not stand as a whole, of which it is asked whether they do.
_RIVALS = 2
# Structures that are held against fresh data after one that these neither confirm nor refuse.
_FURTHER = 4
# Share of the time that has to be left for what comes after.
_HALF = 0.5
Pairs = list[tuple[Fit, NullModel]]


@dataclass(frozen=True, eq=False)
class Confirmation:
    """The stations that fresh data leave, the ones they refuse, what they say, and null and last model on them.

    denied : False where those of ``refused`` are not confirmed, and not contradicted either
    """

    kept: tuple[Station, ...]
    refused: tuple[Station, ...]
    judgement: Judgement | None
    before: Pairs = field(default_factory=list)
    after: Pairs = field(default_factory=list)
    denied: bool = False


@dataclass
class FreshChoice:
    """Structures put to the test of fresh data.

    messages : takes what they say of those that do not stand; work : of a start of the fit without effects, which says
    what a structure may cost here
    """

    search: Choice
    portion: Portions
    tell: Callable[[str], None]
    messages: list[str]
    work: float = math.inf
    _costly: bool = field(default=False, init=False)
    _denied: bool = field(default=False, init=False)
    _known: dict[tuple[Fit, NoiseModel], Pairs | None] = field(default_factory=dict, init=False)

    def run(self) -> Confirmation:
        """The first structure, in order of evidence, that fresh data do not refuse; unjudged once the time is over."""
        search, before = self.search, len(self.messages)
        try:
            with search.deadline.spared(_JUDGED):
                return self._judged_in_order()
        except TimeUp:
            search.failed[FRESH_DATA] = TIME_UP
            stations = way_so_far(search)
            search.best = key_of(stations[-1].effects)
            # what stays was not judged to the end, whatever its first look had said
            names = tuple(f"{name} at {port}: " for name, port in search.best)
            said = [words for words in self.messages[before:] if not names or not words.startswith(names)]
            self.messages[before:] = [
                *said,
                "the fresh data were not looked at to their end, as the time was up",
            ]
            return self._kept(stations, stations, None)

    def idle(self, key: Key) -> Key:
        """The effects that would be left out of a structure in the end; see ``_each_confirmed``."""
        if not self.portion.fresh or self.search.null.screened.request.blind:
            return frozenset()
        stations = self.search.way(key)
        if stations is None:
            return frozenset()
        kept = key_of(self._each_confirmed(stations)[-1].effects)
        return key - kept if kept in self.search.pool else frozenset()

    def _judged_in_order(self) -> Confirmation:
        search = self.search
        null = search.null
        if null.screened.request.blind and not _of_parameters(search):
            # none of these structures adds physics: what they found is told, and not claimed
            return Confirmation((null,), (), None)
        before = self._on_fresh(null) if self.portion.fresh else None
        if self.portion.fresh and before is None and not self._costly:
            self.messages.append("the model without effects cannot be simulated on the fresh data")
        self._weighed(before)
        first: list[Station] | None = None
        blind: list[Station] | None = None  # the first one of which fresh data can say nothing
        open_one: tuple[Key, list[Station], Judgement, Pairs] | None = None  # neither confirmed nor refused
        asked, time_left = 0, left()
        for key in ranked(search):
            if open_one is not None:
                if asked == _FURTHER or late() or left() < _HALF * time_left:
                    break
                if len(key) >= len(open_one[1]) or not self._closes_as_much(key, open_one[0]):
                    continue
                asked += 1
            stations = search.way(key)
            if stations is None:
                label = search.pool[key].label
                self.messages.append(f"{label}: {search.failed.get(label, NO_FIT)}")
                continue
            first = stations if first is None else first
            if blind is not None and len(stations) == 1:
                break
            if before is None or len(stations) == 1:
                return self._kept(stations, first, before)
            said, stations = len(self.messages), self._of_confirmed_parts(key, stations)
            judged, after = self._of_structure(stations, before)
            if after is None:
                blind = stations if blind is None else blind
                continue
            if blind is not None and not judged.confirmed:
                break
            if open_one is not None:  # it is confirmed, or no better
                if judged.confirmed:
                    best, now = search.pool[open_one[0]].name, search.pool[key].name
                    self.messages.append(
                        f"the data of the search alone prefer {best} to {now}; {CONFIRMED_ALONE}"
                    )
                    return self._kept(stations, first, before, judged, after)
                del self.messages[said:]
                continue
            if not judged.refused:
                if judged.confirmed is False:
                    open_one = key, stations, judged, after
                    continue
                self.messages += [judged.why] if judged.why else []
                return self._kept(stations, first, before, judged, after)
            self._denied = True
            self.messages.append(f"{search.pool[key].name}: {judged.why}")
        if open_one is not None:
            _, stations, judged, after = open_one
            self.messages += [judged.why] if judged.why else []
            return self._kept(stations, first or stations, before, judged, after)
        return self._without_verdict(blind, first, before)

    def _without_verdict(
        self, blind: list[Station] | None, first: list[Station] | None, before: Pairs | None
    ) -> Confirmation:
        """What is kept where fresh data confirm nothing: the structure of which they can say nothing, if any."""
        if blind is None:
            null = [self.search.null]
            return self._kept(null, first or null, before)
        self.messages += [] if self._costly else [NO_RUN]
        return self._kept(blind, first or blind, before, Judgement(None, None, False, NO_RUN))

    def _of_confirmed_parts(self, key: Key, stations: list[Station]) -> list[Station]:
        """A structure less the effects that fresh data do not confirm, or in its place a rival that is whole."""
        parts, search = self._each_confirmed(stations), self.search
        if len(parts) == len(stations) or key != search.best or (rival := self._whole_rival()) is None:
            return parts
        search.best = rival
        return search.way(rival) or parts

    def _weighed(self, before: Pairs | None) -> None:
        """Let fresh data say which structure comes first."""
        search = self.search
        self._shortened(before)
        if self.portion.fresh and not search.null.screened.choice.scatter:
            sure = self._confirms(before)
            try:
                FreshWeights(search, self._sides, self.messages).run(sure=sure)
            except TimeUp:
                for one in search.pool.values():
                    one.fresh = 0.0
                self.messages.append("fresh data weigh no structure against another, as the time was up")

    def _closes_as_much(self, key: Key, other: Key) -> bool:
        """True if a structure closes as much of the gap of the search as another one, as a person sees it."""
        none, one, best = (self.search.pool[k].evidence.cost for k in (frozenset(), key, other))
        return none - one >= (1 - SEEN) * (none - best)

    def _shortened(self, before: Pairs | None) -> None:
        """Let the most probable structure of the effects that stand by themselves take the place of the chosen one, and
        a law's special case that of the law where this is not seen to do more."""
        search = self.search
        while before is not None and not late():
            stations = search.way(search.best)
            if stations is None or len(stations) == 1:
                return
            kept = self._bent_together(self._each_confirmed(stations))
            search.misfit = self._misfit(kept[-1], self._on_fresh(kept[-1]))
            if len(kept) < len(stations):
                whole = self._whole_rival()
                if whole is not None:
                    search.best = whole
                    return
                gone = {one.candidate.key for one in stations[-1].effects[len(kept) - 1 :]}
                search.prefer(key_of(kept[-1].effects), without=gone)
            elif not self._in_special_case(stations[-1]):
                return

    def _whole_rival(self) -> Key | None:
        """The most probable structure of as many effects as the chosen one, not all of which stand by themselves, of
        which all do; None where none comes as near as fresh data are asked of rivals."""
        search = self.search
        now = search.pool[search.best]
        least = now.log - WIDER * math.log(FACTOR)
        alike = [
            t for t in search.pool.values()
            if t.key != now.key and len(t.key) == len(now.key) and t.log > least and t.beyond > BEYOND
        ]  # fmt: skip
        for one in sorted(alike, key=lambda t: -t.log)[:_RIVALS]:
            stations = search.way(one.key)
            if stations is not None and len(self._each_confirmed(stations)) == len(stations):
                return one.key
        return None

    def _in_special_case(self, last: Station) -> bool:
        """Let a law's special case take its place where more is missing than effects explain, and on fresh data the law
        closes no more than a person would see: what it has more may imitate the rest."""
        cases = self.search.special_cases_of(key_of(last.effects))
        after = self._on_fresh(last) if cases else None
        if after is None or not (self.search.misfit > 1 or unknown_of(last.screened)):
            return False
        for one in cases:
            stations = self.search.way(one)
            case = None if stations is None else self._on_fresh(stations[-1])
            if case is not None and not self._seen(case, after, last):
                self.search.best = one
                return True
        return False

    def _each_confirmed(self, stations: list[Station]) -> list[Station]:
        """The stations up to the last effect that stands by itself.

        It stands where chance does as much less often than what fresh data confirm, and no more is missing than
        effects explain, which others would imitate, in these data or the fresh ones; or where fresh data confirm it,
        and where more is missing it closes a part of their gap that a person would see.
        """
        while len(stations) > 2:
            base, last = stations[-2:]
            one, screened = last.effects[-1], base.screened
            weak = last.lead is not None and screened.pooled(last.lead) >= CHANCE * screened.alpha
            part, after = self._on_fresh(base), self._on_fresh(last)
            # errors of parameters do not excuse it here: those of a doubtful effect are as large as it is vague
            more = unknown_of(last.screened) is not None or self._misfit(last, after, excused=False) > 1
            if (not weak and not more) or part is None or after is None:
                break
            judged = self._judged(part, after, last)
            # an event of one record is confirmed by no other
            stands = judged.confirmed or (judged.confirmed is None and not (weak and one.moves))
            if more and not weak:
                stands = self._seen(part, after, last) if judged.confirmed else stands
                if one.moves and not judged.confirmed:
                    stands = _seen_by_itself(base, last)
            if stands:
                break
            why = "more is missing than effects explain" if more and not weak else "chance may make it"
            said = (
                "fresh data show next to nothing of it"
                if judged.confirmed
                else "fresh data do not confirm it by itself"
            )
            self.messages.append(f"{one.name} {LEFT_OUT} {why}, and {said}")
            stations = stations[:-1]
        return stations

    def _bent_together(self, stations: list[Station]) -> list[Station]:
        """The stations without effects that only together with others of their port come near to a law of no name: what
        they leave is again a function of a signal there. One that does what no function of that signal does stays."""
        while len(stations) > 2:
            last = stations[-1]
            unknown = unknown_of(last.screened)
            at = [one.candidate.port for one in last.effects]
            if unknown is None or unknown.port != at[-1] or at.count(at[-1]) < 2:
                break
            if self._does_more(last, unknown):
                break
            self.messages.append(
                f"{last.effects[-1].name} {LEFT_OUT} with it, too, what is left depends on {unknown.signal} there, "
                "so that these effects together only approximate a law that the library lacks"
            )
            stations = stations[:-1]
        return stations

    def _does_more(self, last: Station, unknown: Unknown) -> bool:
        """True if the last effect is missing beside the law of no name, not instead of it."""
        tried = self.search.pool.get(key_of(last.effects))
        if tried is None or unknown.port is None or unknown.signal is None:
            return False
        return does_more(self.search.refits, tried, last.effects[-1], unknown.port, unknown.signal)

    def _misfit(self, station: Station, pairs: Pairs | None, *, excused: bool = True) -> float:
        """Chi-squared per sample of the fresh data, over that of the noise or of the search, where it is beyond chance
        and no louder noise; else 1. excused : beyond what errors of the parameters do, too"""
        noise = station.screened.noise
        if not pairs or noise.scatter:
            return 1.0
        own, fresh = gap_of([station.screened.null], noise), gap_of([null for _, null in pairs], noise)

        def ratio(found: float) -> float:
            beyond = beyond_chance(found, fresh.samples, own, memory=MEMORY if noise.colour else 1.0)
            return found / min(own.chi2_per_sample, 1.0) if beyond else 1.0

        whole = ratio(fresh.chi2_per_sample)
        if whole == 1.0:
            return whole
        if not excused:
            return 1.0 if self._is_noise(station, pairs, whole) else whole
        try:
            with np.errstate(all="ignore"):
                nulls = [doubted(station.fit, held) for held, _ in pairs]
                parts = [within_errors(station.fit, null, residuals([null], noise)) for null in nulls]
        except FAILURES:
            return whole
        left = sum(part.value + float(part.noise @ part.noise) for part in parts)
        whole = ratio(left / sum(len(part.noise) for part in parts))
        return 1.0 if whole > 1 and self._is_noise(station, pairs, whole) else whole

    @staticmethod
    def _is_noise(station: Station, pairs: Pairs, much: float) -> bool:
        """True where what is left of fresh data is white, and so may be noise that is louder there."""
        if much > LOUDEST or not any(estimated for _, estimated in station.fit.noise.values()):
            return False
        white = side(pairs, station.screened.choice, source=station.fit).whiteness_p
        every = [p for own in white.values() for p in own.values()]
        known = [p for p in every if p is not None]
        return bool(known) and min(known) >= SURE

    @staticmethod
    def _seen(old: Pairs, new: Pairs, here: Station) -> bool:
        """True if a structure closes a part of the gap on fresh data, above the noise, that a person would see."""
        noise = here.screened.noise
        both = told_by_both([null for _, null in old], [null for _, null in new])
        first, then = (gap_of(nulls, noise) for nulls in both)
        closed = share_closed(first, then, noise.sigma, coloured=bool(noise.colour))
        return closed >= 1 - (1 - SEEN) ** 2

    def _confirms(self, before: Pairs | None) -> bool:
        """True if fresh data confirm the chosen structure."""
        stations = self.search.way(self.search.best)
        if before is None or stations is None or len(stations) == 1:
            return False
        return bool(self._of_structure(stations, before)[0].confirmed)

    def _kept(
        self,
        stations: list[Station],
        first: list[Station],
        before: Pairs | None,
        judged: Judgement | None = None,
        after: Pairs | None = None,
    ) -> Confirmation:
        refused = tuple(first[1:]) if stations[-1] is not first[-1] else ()
        same = len(stations) == 1
        if judged is None and before is not None:
            judged = Judgement(None, None)
        return Confirmation(
            tuple(stations),
            refused,
            judged,
            before or [],
            after or (before if same else []) or [],
            self._denied,
        )

    def _on_fresh(self, station: Station) -> Pairs | None:
        """A station on the fresh data; None where it cannot be simulated there, or at too high a cost."""
        return self._sides(station.fit, station.effects, station.screened.noise)

    def _sides(self, fit: Fit, effects: Sequence[Addition], noise: NoiseModel | None = None) -> Pairs | None:
        """A fit with its effects on the fresh data; noise : None for that of the chosen structure."""
        noise = self.search.chosen.screened.noise if noise is None else noise
        if (fit, noise) not in self._known:
            self._known[fit, noise] = self._found_on_fresh(fit, effects, noise)
        return self._known[fit, noise]

    def _found_on_fresh(self, fit: Fit, effects: Sequence[Addition], noise: NoiseModel) -> Pairs | None:
        self.tell("fresh data")
        try:
            with Deadline(work=self._allowed, best=True):
                return fresh_sides(fit, effects, self.portion, noise, self.search.refitter)
        except TimeUp:
            if late():
                raise
            self._costly = True
            names = " + ".join(one.name for one in effects) or "the model without effects"
            self.messages.append(
                f"{names} was not judged on the fresh data: looking for its initial states there had cost too "
                "much; give shorter fresh records"
            )
            return None

    @property
    def _allowed(self) -> float:
        """Work that one structure may cost on the fresh data: that of a start of the first fit or, as corners may be
        sharper by now, of a few refits, by samples."""
        fresh, own = (
            sum(len(record[name].time) for record in records for name in record.names)
            for records in (self.portion.fresh, self.portion.data)
        )
        usual = _REFITS * self.search.refits.path.usual
        return max(self.work, _EVALUATIONS * own, usual) * max(fresh / own, 1.0)

    def judged(self, stations: Sequence[Station], before: Pairs) -> tuple[Judgement, Pairs | None]:
        """See ``_of_structure``."""
        return self._of_structure(list(stations), before)

    def _of_structure(self, stations: list[Station], before: Pairs) -> tuple[Judgement, Pairs | None]:
        """What fresh data say of a structure, against none and against its parts; None where it cannot be simulated."""
        last, base = stations[-1], stations[-2]
        after = self._on_fresh(last)
        if after is None:
            return Judgement(None, None, False, NO_RUN), None
        if base.effects:
            part = self._on_fresh(base)
            judged = self._judged(part, after, last)
            if judged.refused:
                return judged, after
        return self._judged(before, after, last), after

    def _judged(self, old: Pairs | None, new: Pairs | None, here: Station) -> Judgement:
        if not old or not new:
            return Judgement(None, None, False, NO_RUN)
        last = here.effects[-1]  # one with a time in each of several records may have one in fresh ones too
        event = last.placed and not last.times and self.portion.source == "records"
        noise = here.screened.noise
        judged = judge([n for _, n in old], [n for _, n in new], noise)
        if judged.refused and not all(fit.converged for fit, _ in new):
            return Judgement(None, None, False, _UNSETTLED)
        both = told_by_both([null for _, null in old], [null for _, null in new])
        first, then = (_rmse(nulls, noise) for nulls in both)
        if judged.confirmed and then > first:  # errors of parameters may foretell a gap that grows
            why = f"fresh data do not confirm it: the gap there grows by {100 * (then / first - 1):.2g} %"
            return replace(judged, confirmed=False, why=why)
        unsaid = not judged.confirmed and not judged.refused and not event
        if unsaid and then > (1 + SEEN) * first:
            why = f"fresh data refuse it: the gap there grows by {100 * (then / first - 1):.0f} %"
            judged = replace(judged, confirmed=False, refused=True, why=why)
        if event and not judged.confirmed and not judged.refused:
            why = "it is an event of one record, which no other record can confirm"
            return replace(judged, confirmed=None, why=f"{here.effects[-1].name}: {why}")
        return judged


def _of_parameters(search: Choice) -> bool:
    """True if the chosen structure says that stated numbers are wrong, and nothing else."""
    effects = search.pool[search.best].effects
    return bool(effects) and all(one.kind == "parameter" for one in effects)


def _seen_by_itself(base: Station, last: Station) -> bool:
    """True if the last effect closes a part of the whole gap on the data of the search that a person would see."""
    noise = last.screened.noise
    both = told_by_both([base.screened.null], [last.screened.null])
    first, then = (gap_of(nulls, noise).chi2_per_sample for nulls in both)
    return then <= (1 - SEEN) ** 2 * first


def _rmse(nulls: Sequence[NullModel], noise: NoiseModel) -> float:
    """The gap of all outputs, in standard deviations of the noise."""
    return math.sqrt(gap_of(nulls, noise).chi2_per_sample)
