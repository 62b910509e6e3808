"""The choice of a structure: rounds that add, drop or exchange an effect, by how probable the data make each model.

Every effect at every port is refitted beside the best structure so far (``path``), and its evidence counted with the
noise that it leaves itself (``evidence``). The most probable one is kept while something is missing: where the noise is
white the calibrated score test says so, where it is coloured the evidence has to gain a factor of 20 after all
candidates are paid for. Then each member is exchanged for, and tried without, what one step says might do as well.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from casadi_engine.deadline import Deadline, TimeUp, ask, late
from casadi_engine.discrepancy.assumed_pressure import settle_scatter
from casadi_engine.discrepancy.coloured_errors import coloured_errors
from casadi_engine.discrepancy.families import BEYOND, chosen_of, costs_of, families_of
from casadi_engine.discrepancy.linearised import OneStep, one_step, without_effect
from casadi_engine.discrepancy.membership import class_of, ordered, reached, simpler
from casadi_engine.discrepancy.noise_model import estimated_noise
from casadi_engine.discrepancy.null_model import null_at
from casadi_engine.discrepancy.pairs import price_of, tried_in_two
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.refit import Addition, Refitter, addition
from casadi_engine.discrepancy.refits import FACTOR, PART, Key, Refits, Tried, key_of
from casadi_engine.discrepancy.repaired import Round
from casadi_engine.discrepancy.score import score
from casadi_engine.discrepancy.screening import Screened, coloured
from casadi_engine.discrepancy.start import Start
from casadi_engine.discrepancy.station import Station
from casadi_engine.estimation import Fit

# Candidates that are refitted in the place of a member, the best by one step; times that a better one is looked from.
_EXCHANGED, _AGAIN = 6, 3
# A refit has arrived if chi-squared is no higher than without its effect, but for rounded corners; share of the
# one-step amplitude from which it is tried again.
_NESTED, _SMALL = 1.0, 0.02
# Log likelihood that a further effect has to promise to be refitted.
_NOTHING = 1.0
# Effects that are refitted first in a linear model; of others those that by one step take away all but ``PART`` of what
# the best one does.
_FIRST = 6
# Why a refit was not tried.
TIME_UP = "the time was up"
# Shares of the spare time behind a budget at which whole fits, and the search for the colour of the noise, have to end.
_FIT, _COLOUR = 0.35, 0.45
# Times the spare time that is kept before the end of the budget, for fresh data.
_KEPT = 0.5
_NO_FIT = "its fit of all data does not converge"
_NOTHING_LEFT = "its fit of all data leaves nothing of it"
# What the time did not allow where every effect was refitted once.
_OTHER_STARTS = "other starts of these effects"
# Share of where its search started at which an amplitude is none.
_GONE = 1e-6


@dataclass
class Choice:
    """The rounds, and what they found."""

    refitter: Refitter
    screen: Callable[[Fit], Screened]
    most: int
    tell: Callable[[str], None]
    deadline: Deadline = field(default_factory=Deadline)
    cylinders: object = "assumed"
    rounds: list[Round] = field(default_factory=list)
    timing: dict[str, float] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    best: Key = frozenset()
    _stations: dict[Key, Station] = field(default_factory=dict, repr=False)
    _asked: set[tuple[Key, Key]] = field(default_factory=set, repr=False)

    def run(self, null_fit: Fit) -> None:
        """Add, drop and exchange effects until no change is worth it."""
        self.null_fit = null_fit
        first = self._timed("score", lambda: self._screened(null_fit))
        self._stations[frozenset()] = Station(null_fit, (), first)
        self.refits = Refits(self.refitter, null_fit, first.noise, cylinders=self.cylinders, tell=self.tell)
        here = self.refits.none(null_fit)
        with self.deadline.spared(-_KEPT):  # time for what judges the answer
            self._rounds(here)
        self._with_colour()

    def _rounds(self, here: Tried) -> None:
        """Rounds from a structure on, until no change is worth it or the time is over."""
        beside = ""
        try:
            for _ in range(self.most):
                station = self._stations[here.key]
                if not self._asks(station.screened):
                    break
                if not here.effects:
                    station = self._by_windows(here) or station
                    here = self.pool[here.key]
                    if not self._asks(station.screened):
                        break
                beside = f" beside {here.label}" if here.effects else ""
                ask()
                made = self._round(here, station)
                if made is None:
                    break
                here = made
                self.best = here.key
            self._most_probable_first()
            self._in_two()
        except TimeUp:
            if TIME_UP not in self.failed.values():
                self.failed[f"any effect{beside}"] = TIME_UP

    def _most_probable_first(self) -> None:
        """Let a structure of as many effects that the last levels of the noise make more probable take the place of the
        chosen one: what is named first is to be what is most probable, or where that is not told the simplest."""
        for _ in range(_AGAIN if self.best else 0):
            now = self.pool[self.best]
            alike = [
                t for t in self.pool.values() if len(t.effects) == len(now.effects) and t.beyond > BEYOND
            ]
            top = max(alike, key=lambda one: one.log, default=now)
            told = top.log > now.log + 1
            top = top if told else simpler(now, alike, FACTOR)
            if late() or top is now:
                return
            if self._station(top) is None:
                self.failed.setdefault(top.label, _NO_FIT)
                top.failed = True
            else:
                self.best = top.key
            if not told:
                return

    def _in_two(self) -> None:
        """Let two effects take the place of one where that is more probable, and others in its class know of it."""
        now = self.pool[self.best]
        if not now.effects or len(now.effects) >= self.most or late():
            return
        screened = self._stations[frozenset()].screened
        families = families_of(screened)
        made = self._timed("exchange", lambda: tried_in_two(
            self.refits, now, screened, families, partial(chosen_of, screened), self.tell
        ))  # fmt: skip
        self.refits.weigh()
        ready = [one for one in made if one.beyond > BEYOND and one.log - self.price > now.log]
        for one in sorted(ready, key=lambda t: -t.log)[:1]:
            if self._station(one) is not None:
                self.best = one.key

    @property
    def price(self) -> float:
        """What a further effect has to gain in log probability."""
        return price_of(families_of(self._stations[frozenset()].screened))

    def _with_colour(self) -> None:
        """Score beside the chosen structure with the colour that its residual has, where that waited."""
        if self.chosen.screened.choice.waits:
            self.tell("the colour of the noise")
            try:
                with self.deadline.spared(_COLOUR):
                    self._in_colour(self.best)
            except TimeUp:
                self.failed["the colour of the noise"] = TIME_UP

    def _in_colour(self, key: Key) -> Screened:
        """A structure's scores with the colour that its residual has, where that waited."""
        station = self._stations[key]
        if station.screened.choice.waits:
            screened = self._timed("score", lambda: coloured(station.screened, station.fit))
            self._stations[key] = replace(station, screened=screened)
        return self._stations[key].screened

    def _scores_in_colour(self, here: Tried, best: Tried, tried: Sequence[Tried]) -> bool:
        """True if the calibrated test in coloured noise finds the most probable effect, or one that it does not
        exclude. Evidence counts fewer samples there, which for a fast effect in slow noise is too few."""
        screened = self._in_colour(here.key)
        if not screened.noise.colour:
            return False
        alike = [t for t in tried if t.log > best.log - math.log(FACTOR) and len(t.key) == len(best.key)]
        keys = {one.newest(here).candidate.key for one in alike if here.key < one.key}
        return any(screened.candidates[k].key in keys for k in screened.significant)

    @property
    def pool(self) -> dict[Key, Tried]:
        """Every structure that was refitted."""
        return self.refits.pool if self._stations else {}

    @property
    def scored(self) -> bool:
        """True once the model without effects is scored: from then on there is an answer."""
        return frozenset() in self.pool

    @property
    def null(self) -> Station:
        """The model without effects."""
        return self._stations[frozenset()]

    @property
    def chosen(self) -> Station:
        """The model of the best structure so far."""
        return self._stations[self.best]

    @property
    def fit(self) -> Fit:
        """The fit of the best structure so far; before any is scored, of the model without effects."""
        return self._stations[self.best].fit if self._stations else self.null_fit

    # ---- one round

    def _asks(self, screened: Screened) -> bool:
        """True if there may be something that the library names."""
        if not screened.scores.testable.any():
            return False
        return bool(screened.significant) or bool(screened.noise.colour) or bool(screened.leftover.alarms)

    def _round(self, here: Tried, station: Station) -> Tried | None:
        """The structure that takes the place of ``here``; None where none does."""
        screened = station.screened
        tried = self._timed("refit", lambda: self._added(here, screened))
        self._timed("evidence", self.refits.weigh)
        known = int(screened.scores.testable.sum())
        tried += self._timed("exchange", lambda: self._without_idle(tried))
        while True:
            best = self._most_probable(tried)
            gain = -math.inf if best is None else best.log - here.log
            if best is not None and not here.effects:
                gain = _together(best, tried) - here.log
            calibrated = (
                bool(screened.significant) and not screened.noise.colour and not self.refits.levels.memory
            )
            # that anything is missing is told by all together; one more effect has to show it alone
            price = math.log(max(known, 1)) if here.effects else self.price
            sure = calibrated or gain > math.log(FACTOR) + price
            in_colour = gain > 0 and not here.effects
            if best is None or not (sure or (in_colour and self._scores_in_colour(here, best, tried))):
                self._told(here, tried, None)
                return None
            if self._weak(best):
                best.failed = True
                continue
            best = self._timed("exchange", lambda: self._exchanged(best, here))  # noqa: B023
            self._timed("exchange", lambda: self._again_without(best, here))  # noqa: B023
            here = self.pool[here.key]
            renewed = self._renewed(here)
            if renewed is not None:
                return self._round(self.pool[here.key], renewed)
            if self._timed("refit", lambda: self._sharpened(best)):  # noqa: B023
                here, tried = self.pool[here.key], [self.pool[one.key] for one in tried]
                continue
            if self._weak(best):
                best.failed = True
                continue
            arrived = self._station(best)
            if arrived is not None and not vanished(best.effects, arrived.fit):
                self.refits.settled()
                break
            if self.refits.blunted():
                here, tried = self.pool[here.key], [self.pool[one.key] for one in tried]
                continue
            self.failed.setdefault(best.label, _NO_FIT if arrived is None else _NOTHING_LEFT)
            best.failed = True
            ask()
        self._told(here, tried, best)
        return best

    def _renewed(self, here: Tried) -> Station | None:
        """The structure fitted and scored anew, where what was tried beside it found a better optimum of it: what a
        poor one leaves is no missing effect. None where there is none, or where that fit does not converge."""
        if here.key not in self.refits.improved:
            return None
        self.refits.improved.clear()
        before, found = self._stations.pop(here.key), None
        try:
            found = self._station(self.refits.pool[here.key])
        finally:  # whatever ends it: the answer so far is asked of the stations
            if found is None:
                self._stations[here.key] = before
        if not here.effects and found is not None:
            self.null_fit = self.refits.null_fit = self.refitter.base = found.fit
        return found

    def _by_windows(self, here: Tried) -> Station | None:
        """The model without effects fitted anew, where the path of all refits leads to a better optimum of it."""
        for start in (None, Start(here.arrived.values, here.arrived.initial)):
            self._timed("refit", lambda: self.refits.tried((), start))  # noqa: B023
        return self._renewed(here)

    def _again_without(self, best: Tried, here: Tried) -> None:
        """Refit ``here`` from where the structure that is to take its place ended: an effect that only led out of a
        poor optimum is no missing one."""
        if here.key <= best.key and (here.key, best.key) not in self._asked and not late():
            self._asked.add((here.key, best.key))
            self.refits.tried(here.effects, Start(best.arrived.values, best.arrived.initial))
            self.refits.weigh()

    def _weak(self, best: Tried) -> bool:
        """True if an amplitude is no finding beside coloured noise, whose slow part may do as much."""
        refits = self.refits
        if not refits.levels.memory:
            return False
        try:
            with np.errstate(all="ignore"):
                null = refits.path.residuals(best.effects, best.arrived)
                slopes = {record.name: dict(record.slopes) for record in null.records}
                noise = estimated_noise(null, explained=slopes, colour=True)
                error = coloured_errors(null, best.arrived.levels, noise)
        except FAILURES:
            return False  # its whole fit has the last word
        values = best.arrived.values
        for one in best.effects:
            own = [n for n in values if n.partition("@")[0] == one.amplitude]
            # as certain as it is in white noise, by as much less as its error is larger
            plain, white = best.certainty(one), best.evidence.error
            size = max((abs(values[n]) / white.get(n, math.inf) for n in own), default=0.0)
            found = max((abs(values[n]) / error.get(n, math.inf) for n in own), default=0.0)
            if size > 0 and found * plain < BEYOND * size:
                return True
        return False

    def _without_idle(self, tried: Sequence[Tried]) -> list[Tried]:
        """The most probable structure without members of which it leaves next to nothing: what was added may do alone
        what they did."""
        top = max(tried, key=lambda one: one.log, default=None)
        if top is None or top.beyond > BEYOND or late():
            return []
        rest = tuple(one for one in top.effects if top.certainty(one) > BEYOND)
        if not rest or len(rest) == len(top.effects):
            return []
        made = self.refits.tried(rest, Start(top.arrived.values, top.arrived.initial))
        self.refits.weigh()
        return made

    def _sharpened(self, best: Tried) -> bool:
        """See ``Refits.sharpened``; False once the time is over."""
        try:
            ask()
            return self.refits.sharpened(best)
        except TimeUp:
            return False

    def _told(self, here: Tried, tried: Sequence[Tried], kept: Tried | None) -> None:
        order = sorted(tried, key=lambda one: -one.log)
        library = tuple((one.label, one.log - here.log) for one in order)
        refits = tuple((one.label, one.arrived.cost, one.arrived.settled) for one in order)
        gone = tuple(one.label for one in here.effects if kept and one.candidate.key not in kept.key)
        self.rounds.append(Round(library, refits, None if kept is None else kept.label, gone))

    def _most_probable(self, tried: Sequence[Tried]) -> Tried | None:
        found = [one for one in tried if one.beyond > BEYOND and math.isfinite(one.log)]
        return max(found, key=lambda one: one.log, default=None)

    def _added(self, here: Tried, screened: Screened) -> list[Tried]:
        """Every effect at every port beside ``here``, refitted.

        Of a linear model those are left out that explain far less than the best one by one step from either side: from
        ``here``, and in the place of the best one.
        """
        families = families_of(screened)
        white = screened.choice.white or screened.compressed
        scores = score(white)
        at_here = OneStep(here.arrived.cost - scores.drop, scores.amplitude, scores.error, here.arrived.cost)
        cost = costs_of(screened, at_here, families)
        order = sorted(families, key=lambda key: cost[key])
        if here.effects:
            # beside what was found the model is near the truth, and one step tells what has nothing to give
            least = here.arrived.cost - 2 * _NOTHING * max(self.refits.levels.memory.values(), default=1.0)
            order = [key for key in order if cost[key] < least]
        own = self._own_step(here, screened)
        start = Start(here.arrived.values, here.arrived.initial)
        todo, done = (order[:_FIRST] if self.refits.path.linear else order), list[tuple[str, str]]()
        try:
            while todo:
                many = len(done) + len(todo)
                for key in todo:
                    ask()
                    self.tell(f"refit {len(done) + 1} of {many}: {key[0]} at {key[1]}")
                    done.append(key)
                    self._try(here, chosen_of(screened, at_here, families[key]), start)
                rivals = self._promising(here, screened, families, at_here, todo)
                for key in todo:  # once every effect has an answer
                    ask()
                    elsewhere = own if key in rivals else None
                    self._from_elsewhere(here, screened, families[key], at_here, elsewhere)
                rest = [key for key in order if key not in done]
                todo = self._promising(here, screened, families, at_here, rest) if rest else []
            keys = [self._key(here, key) for key in done]
            self.refits.relevel([self.pool[key] for key in keys if key in self.pool])
            self._around(here, screened, families)
        except TimeUp:  # the best of those that were tried
            left = [f"{key[0]} at {key[1]}" for key in todo if key not in done]
            self.failed |= dict.fromkeys(left or [_OTHER_STARTS], TIME_UP)
        return [self.pool[key] for key in map(partial(self._key, here), done) if key in self.pool]

    def _from_elsewhere(
        self, here: Tried, screened: Screened, members: list[int], at_here: OneStep, own: OneStep | None
    ) -> None:
        """Refits of one effect from another start than ``here``: in windows from the parameters' own values; where none
        has arrived, from a small amplitude."""
        if own is not None:
            one = chosen_of(screened, own, members)
            self._try(here, one, None)
            # as sharp as it is: wide corners may lead to another valley; what has a special case starts from that
            if self.refits.path.cornered([one]) and not one.candidate.source.effect.limit:
                self._try(here, one, None, near=True)
        self._arrive(here, screened.candidates[members[0]].key, lambda: chosen_of(screened, at_here, members))

    def _promising(
        self,
        here: Tried,
        screened: Screened,
        families: dict[tuple[str, str], list[int]],
        at_here: OneStep,
        rest: list[tuple[str, str]],
    ) -> list[tuple[str, str]]:
        """The best effect so far, and those of the rest that may explain about as much by one step."""
        found = [self.pool[k] for key in families if (k := self._key(here, key)) in self.pool]
        best = min(found, key=lambda one: one.arrived.cost, default=None)
        if best is None:
            return rest
        null, states = self.refits.null(best), len(self.null_fit.model.states)
        gone = None if null is None else without_effect(null, best.newest(here), states)
        step = None if gone is None else one_step(gone, screened.candidates, self.refits.path.levels)
        if step is None:
            return rest
        most = self._rival(best.arrived.cost, here.arrived.cost, screened)
        costs = [costs_of(screened, one, families) for one in (at_here, step)]
        lead = best.newest(here).candidate.key
        return [key for key in rest if key == lead or min(cost[key] for cost in costs) < most]

    def _arrive(self, here: Tried, key: tuple[str, str], chosen: Callable[[], Addition]) -> None:
        """Another refit of an effect that has not come below the model without it, of which that is a special case,
        from a small amplitude; it has no answer if that fails too."""
        known = self.pool.get(self._key(here, key))
        if known is None or known.arrived.cost > here.arrived.cost + _NESTED:
            one = chosen()
            small = replace(one, start=_SMALL * one.start)
            self._try(here, small, Start(here.arrived.values, here.arrived.initial), near=True)
            known = self.pool.get(self._key(here, key))
        if known is None or known.arrived.cost > here.arrived.cost + _NESTED:
            self.failed[f"{key[0]} at {key[1]}"] = TIME_UP if late() else "no refit of it arrives"

    def _rival(self, least: float, none: float, screened: Screened) -> float:
        """Chi-squared by one step up to which an effect may well be a rival of one with chi-squared ``least``."""
        chance = (
            2
            * math.log(FACTOR * len(screened.candidates))
            * max(self.refits.levels.memory.values(), default=1.0)
        )
        return least + PART * max(none - least, 0.0) + chance

    def _around(self, here: Tried, screened: Screened, families: dict[tuple[str, str], list[int]]) -> None:
        """Refits from the parameters of the most probable one, in its place; again where that finds a better one."""
        for _ in range(_AGAIN):
            tried = [self.pool[k] for key in families if (k := self._key(here, key)) in self.pool]
            best = max(tried, key=lambda one: one.log, default=None)
            if best is None or late():
                return
            last = best.newest(here)
            for one in self._instead(best, last, screened, families):
                ask()
                self.tell(f"refit {one.label} from the parameters of {last.label}")
                start = {n: v for n, v in best.arrived.values.items() if not n.startswith(f"{last.key}.")}
                self._try(here, one, Start(start, best.arrived.initial))
            self._containing(here, screened, families)
            now = max(self.pool[k].log for key in families if (k := self._key(here, key)) in self.pool)
            if now <= best.log:
                return

    def _containing(
        self, here: Tried, screened: Screened, families: dict[tuple[str, str], list[int]]
    ) -> None:
        """Refits of effects that ended above a special case of theirs, from where that ended."""
        for key, members in families.items():
            effect = screened.candidates[members[0]].source.effect
            known, simple = (self.pool.get(self._key(here, k)) for k in (key, (effect.limit, key[1])))
            if simple is None or (known is not None and known.arrived.cost <= simple.arrived.cost + _NESTED):
                continue
            case = next(one for one in simple.effects if one.candidate.key == (effect.limit, key[1]))
            if case.candidate.key not in families:
                continue
            number = next(k for k in families[case.candidate.key])
            alike = np.abs(screened.scores.correlation[number, members])
            candidate = screened.candidates[members[int(np.argmax(alike))]]
            own = {n: v for n, v in simple.arrived.values.items() if not n.startswith(f"{case.key}.")}
            size = next(v for n, v in simple.arrived.values.items() if n.partition("@")[0] == case.amplitude)
            self._try(here, addition(candidate, size), Start(own, simple.arrived.initial))

    def _instead(
        self, tried: Tried, member: Addition, screened: Screened, families: dict[tuple[str, str], list[int]]
    ) -> list[Addition]:
        """The candidates that might do as well in the place of a member, the best by one step first."""
        null = self.refits.null(tried)
        states = len(self.null_fit.model.states)
        rest = None if null is None else without_effect(null, member, states)
        step = None if rest is None else one_step(rest, screened.candidates, self.refits.path.levels)
        if step is None:
            return []
        others = {key: own for key, own in families.items() if key != member.candidate.key}
        cost = costs_of(screened, step, others)
        most = self._rival(tried.arrived.cost, step.none, screened)
        order = [key for key in sorted(cost, key=lambda key: cost[key]) if cost[key] < most]
        found = [chosen_of(screened, step, families[key]) for key in order[:_EXCHANGED]]
        return [form for one in found for form in one.forms]

    def _exchanged(self, best: Tried, here: Tried) -> Tried:
        """The structure after its members were exchanged one by one, and each was left out, as far as time allows."""
        try:
            return self._exchanged_for(best, here)
        except TimeUp:
            return best

    def _exchanged_for(self, best: Tried, here: Tried) -> Tried:
        screened = self._stations[frozenset()].screened
        families = families_of(screened)
        while len(best.effects) > 1 and not late():
            made: list[Tried] = []
            for member in best.effects:
                rest = tuple(one for one in best.effects if one is not member)
                others = {k: v for k, v in families.items() if k not in key_of(rest)}
                start = {n: v for n, v in best.arrived.values.items() if not n.startswith(f"{member.key}.")}
                for one in self._instead(best, member, screened, others):
                    ask()
                    self.tell(f"exchange {member.label} for {one.label}")
                    made += self.refits.tried((*rest, one), Start(start, best.arrived.initial))
                made += self.refits.tried(rest, Start(start, best.arrived.initial))
            self.refits.weigh()
            ready = [one for one in made if one.beyond > BEYOND or not one.effects]
            top = max(ready, key=lambda one: one.log, default=None)
            # one more effect has to be worth it; one in place of another has to be more probable
            price = 0.0 if top is None else math.log(FACTOR) * (len(top.effects) - len(best.effects))
            if top is None or top.log - price <= best.log or top.key == here.key:
                return best
            best = top
        return best

    # ---- refits

    def _key(self, here: Tried, key: tuple[str, str]) -> Key:
        return here.key | {key}

    def _try(self, here: Tried, one: Addition, start: Start | None, *, near: bool = False) -> None:
        for form in one.forms:
            self.refits.tried((*here.effects, form), start, near=near)

    def _own_step(self, here: Tried, screened: Screened) -> OneStep | None:
        """One step from the parameters' own values, the effects so far as they were found."""
        fit, own = self._stations[here.key].fit, self.refitter.parameters
        z = np.array([float(own[n].value) if n in own else fit.values[n] for n in fit.free])
        try:
            with np.errstate(all="ignore"):
                null = null_at(fit.model, fit.data, fit.parameters, z, self.refits.path.first_states())
        except (*FAILURES, KeyError):
            return None
        return one_step(null, screened.candidates, self.refits.path.levels)

    # ---- whole fits

    def _screened(self, fit: Fit) -> Screened:
        self.tell("scores of all effects at all ports")
        return self.screen(fit)

    def _station(self, tried: Tried) -> Station | None:
        """The structure fitted as the null model is, and screened; None where that does not converge, or in time."""
        try:
            with self.deadline.spared(_FIT):
                return self._fitted(tried)
        except TimeUp:
            self.failed[tried.label] = TIME_UP
            return None

    def _fitted(self, tried: Tried) -> Station | None:
        if tried.key not in self._stations:
            self.tell(f"fit with {tried.label}")
            there = tried.arrived
            start = Start(there.values, there.initial, {}, there.settled, fineness=there.refit.fineness)
            fit = self._timed("fit", lambda: self.refitter(self.null_fit, tried.effects, start=start))
            if fit is None or not fit.converged:
                return None
            # before, the scatter of assumed pressures had to stand for the effect
            own, options = self.refitter.noise, self.refitter.options
            fit, _ = self._timed(
                "fit", lambda: settle_scatter(fit, fit.parameters, noise=own, options=options)
            )
            screened = self._timed("score", lambda: self._screened(fit))
            self._stations[tried.key] = Station(fit, tried.effects, screened)
        return self._stations[tried.key]

    def ranked(self) -> Iterator[Key]:
        """The structures in the order in which fresh data are asked: the chosen one, its rivals, its parts, none."""
        chosen = self.pool[self.best]
        yield self.best
        near = [t for t in self.pool.values() if t.effects and t.beyond > BEYOND and t.key != self.best]
        more = self.price
        near = [
            t for t in near
            if t.log - more * (len(t.key) - len(self.best)) > chosen.log - math.log(FACTOR) or t.key < self.best
        ]  # fmt: skip
        for one in sorted(near, key=lambda t: -t.log):
            yield one.key
        if self.best:
            yield frozenset()

    def way(self, key: Key) -> list[Station] | None:
        """The stations on the way to a structure, effect by effect, the most telling first; None where a fit of one
        does not converge."""
        found = [self._stations[frozenset()]]
        effects = ordered(self.pool[key].effects, self.pool)
        for count in range(1, len(effects) + 1):
            own = effects[:count]
            if key_of(own) not in self.pool:
                there = self.pool[key].arrived
                self.refits.tried(own, Start(there.values, there.initial))
            part = self.pool.get(key_of(own))
            station = None if part is None else self._station(part)
            if station is None:
                return None
            members = class_of(self.pool, key, own[-1], FACTOR, self.price)
            found.append(reached(found[-1], station, own, members))
        return found

    def _timed(self, what, work):  # type: ignore[no-untyped-def]
        begun = time.perf_counter()
        made = work()
        self.timing[what] = self.timing.get(what, 0.0) + time.perf_counter() - begun
        return made


def _together(best: Tried, tried: Sequence[Tried]) -> float:
    """The log evidence of the best structure and of its rivals together: that one of them is right is more probable
    than each alone."""
    rivals = [t.log for t in tried if t is not best and t.beyond > BEYOND and len(t.key) == len(best.key)]
    return float(np.logaddexp.reduce([best.log, *rivals]))


def vanished(effects: Sequence[Addition], fit: Fit) -> bool:
    """True if a fit leaves nothing of one of its effects: on the bound where it is none, or made smaller and smaller
    while the data were content."""
    for one in effects:
        own = [e for name, e in fit.estimates.items() if name.partition("@")[0] == one.amplitude]
        if own and all(abs(e.value) <= _GONE * abs(one.start) for e in own):
            return True
    return False
