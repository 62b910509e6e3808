"""The choice of a structure: rounds that add, drop or exchange an effect, by how probable the data make each model.

Every effect at every port is refitted beside the best structure so far (``path``), and its evidence counted with the
noise that it leaves itself (``evidence``). The most probable one is kept while something is missing: where the noise is
white the calibrated score test says so, where it is coloured the evidence has to gain a factor of 20 after all
candidates are paid for. Then each member is exchanged for, and tried without, what one step says might do as well.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial

from casadi_engine.deadline import Deadline, TimeUp, ask, ending_before, late
from casadi_engine.discrepancy.additions import AGAIN, TIME_UP, Additions
from casadi_engine.discrepancy.arrived import Arrived
from casadi_engine.discrepancy.assumed_pressure import settle_scatter
from casadi_engine.discrepancy.beside_rivals import beside_rivals
from casadi_engine.discrepancy.exchange import (
    exchanged,
    in_its_parts,
    is_rounding,
    known_twins,
    late_otherwise,
    leaves_more,
    special_cases,
    weak_beside_colour,
)
from casadi_engine.discrepancy.exchanged_units import impossible, more_than_whole
from casadi_engine.discrepancy.families import BEYOND, chosen_of, families_of
from casadi_engine.discrepancy.fresh_misfit import SEEN
from casadi_engine.discrepancy.membership import simpler
from casadi_engine.discrepancy.pairs import price_of, together, tried_in_two, with_one_more
from casadi_engine.discrepancy.refit import Refitter, vanished
from casadi_engine.discrepancy.refits import FACTOR, Refits
from casadi_engine.discrepancy.repaired import Round
from casadi_engine.discrepancy.screening import Screened, coloured
from casadi_engine.discrepancy.start import Start
from casadi_engine.discrepancy.station import Station
from casadi_engine.discrepancy.tried import Key, Tried
from casadi_engine.discrepancy.ways import way
from casadi_engine.estimation import Fit

# Shares of the spare time behind a budget at which whole fits, and the search for the colour of the noise, have to end.
_FIT, _COLOUR = 0.35, 0.45
# Times the spare time that is kept before the end of the budget, for fresh data.
_KEPT = 1.0
# Share of the time that is left which sharper corners may take: without them there is an answer too.
_SHARP = 0.5
# Times as long as the search until then that sharp corners and what follows may last.
_LONGER = 5.0
# Share of the time that is left which is kept for a whole fit, at most.
_WHOLE = 0.25
# What a search that was ended in a round did not come to.
ANY = "any effect"
# Other structures that are gone on from where nothing helps beside the best one, and how much larger chi-squared is.
_OTHERS, _NEARLY = 2, 2.0
NO_FIT = "its fit of all data does not converge"
_NOTHING_LEFT = "its fit of all data leaves nothing of it"


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
    misfit: float = 1.0  # chi-squared per sample of fresh data, where more than 1 is no chance
    # the effects of a structure that fresh data would leave out of it in the end
    idle_on_fresh: Callable[[Key], Key] = field(default=lambda _: frozenset(), repr=False)
    stations: dict[Key, Station] = field(default_factory=dict, repr=False)
    _fits: dict[Key, tuple[Arrived, Fit | None]] = field(default_factory=dict, repr=False)
    # of stations that were made before their corners were sharpened: where their refits had arrived
    _wide: dict[Key, Arrived] = field(default_factory=dict, repr=False)
    _asked: set[tuple[Key, Key]] = field(default_factory=set, repr=False)
    null_time: float = 0.0  # seconds that the fit without effects took, about what one with them takes
    _begun: float = field(default_factory=time.perf_counter, repr=False)
    _left_out: tuple[tuple[str, float], ...] = ()
    _beside: str = ""

    def run(self, null_fit: Fit) -> None:
        """Add, drop and exchange effects until no change is worth it."""
        self.null_fit = null_fit
        first = self._timed("score", lambda: self._screened(null_fit))
        self.stations[frozenset()] = Station(null_fit, (), first)
        self.refits = Refits(self.refitter, null_fit, first.noise, cylinders=self.cylinders, tell=self.tell)
        self.refits.rounded.update(first.choice.rounded)
        here = self.refits.none(null_fit)
        with self.deadline.spared(-_KEPT):  # time for what judges the answer
            self._rounds(here)
            self._without_curves()
        self._most_probable_of_all()
        self._with_colour()

    def _rounds(self, here: Tried) -> None:
        """Rounds from a structure on, until no change is worth it or the time is over."""
        try:
            self._grown(here)
            self._from_others()
            self._timed("exchange", lambda: self._special_cases_of(self.pool[self.best]))
            self._timed(
                "exchange", lambda: known_twins(self.refits, self.best, self.null.screened, self.tell)
            )
            least = self.pool[self.best].log - math.log(FACTOR)
            near = [t for t in self.pool.values() if len(t.key) == len(self.best) > 0 and t.log > least]
            self._timed("refit", lambda: self.refits.exactly(near if len(near) > 1 else ()))
            self._most_probable_first()
            self._in_two()
        except TimeUp:
            if TIME_UP not in self.failed.values():
                self.failed[f"{ANY}{self._beside}"] = TIME_UP

    def _without_curves(self) -> None:
        """Go on without structures whose effects bend to something else: an event for what comes gradually, two laws
        that take each other back.

        They stay in the search until then: what another effect leaves comes gradually too.
        """
        curves = [one for one in self.pool.values() if one.is_curve]
        if not curves:
            return
        for one in curves:
            one.failed = True
        self.refits.named_alone = True
        if not self.pool[self.best].failed:
            return
        ready = [t for t in self.pool.values() if not t.failed and t.beyond > BEYOND]
        ready.sort(key=lambda one: self.price * len(one.effects) - one.log)
        self.best = frozenset()
        with suppress(TimeUp):
            self.best = next(one.key for one in ready if self.station_of(one) is not None)
            self._grown(self.pool[self.best])

    def _grown(self, here: Tried) -> None:
        """Let a structure grow effect by effect, until no change is worth it."""
        for _ in range(self.most - len(here.effects)):
            station = self.stations[here.key]
            if not self._asks(station.screened):
                break
            if not here.effects:
                station = self._by_windows(here) or station
                here = self.pool[here.key]
                if not self._asks(station.screened):
                    break
            self._beside = f" beside {here.label}" if here.effects else ""
            ask()
            made = self._round(here, station)
            # what fresh data say of a model that does not fit yet is no word on its effects
            while made is not None and here.effects and not leaves_more(self.refits, made):
                idle = self._timed("confirm", partial(self.idle_on_fresh, made.key))
                if not idle:
                    break
                self.prefer(made.key - idle, without=idle)
                here = self.pool[self.best]
                made = self._another(here) if here.key in self.stations else None
            if made is None:
                break
            here = made
            self.best = here.key

    def _from_others(self) -> None:
        """Go on from structures of as many effects that explain nearly as much, where the chosen one leaves more than
        noise and nothing beside it helps: effects that bend to one another's place leave none for a third."""
        best = self.pool[self.best]
        if not 2 <= len(best.effects) < self.most or not leaves_more(self.refits, best):
            return
        most = _NEARLY * best.arrived.cost
        near = [
            one
            for one in self.pool.values()
            if len(one.effects) == len(best.effects) and one is not best and one.arrived.cost < most
        ]
        for one in sorted(near, key=lambda t: t.arrived.cost)[:_OTHERS]:
            ask()
            station = None if one.failed else self.station_of(one)
            if station is None:
                continue
            kept, self.best = self.best, one.key
            self._grown(one)
            if self.pool[self.best].arrived.cost < best.arrived.cost:
                return
            self.best = kept

    def _most_probable_first(self) -> None:
        """Let a structure of as many effects that the last levels of the noise make more probable take the place of the
        chosen one: what is named first is to be what is most probable, or where that is not told the simplest."""
        for _ in range(AGAIN if self.best else 0):
            now = self.pool[self.best]
            alike = self._alike(now)
            top = max(alike, key=lambda one: one.log, default=now)
            told = top.log > now.log + 1
            top = top if told else simpler(now, alike, FACTOR)
            if late() or top is now:
                return
            if self.station_of(top) is None:
                self.failed.setdefault(top.label, NO_FIT)
                top.failed = True
            else:
                self.best = top.key
            if not told:
                return

    def _most_probable_of_all(self) -> None:
        """Let the structure that is far the most probable of all that were refitted take the place of the chosen one:
        any where the time was up in a round, and one of fewer effects, which rounds add up to pass by, at any time."""

        def log(one: Tried) -> float:
            return one.log - self.price * len(one.effects)

        now, any_size = self.pool[self.best], TIME_UP in self.failed.values()
        ready = [t for t in self.pool.values() if t.effects and t.beyond > BEYOND]
        ready = [t for t in ready if any_size or len(t.effects) < len(now.effects)]
        top = max(ready, key=log, default=now)
        enough = 1.0 if len(top.effects) == len(now.effects) else math.log(FACTOR)
        if log(top) > log(now) + enough and self.station_of(top) is not None:
            self.best = top.key

    def prefer(self, key: Key, *, without: Collection[tuple[str, str]]) -> None:
        """Let a structure that was refitted be the chosen one, or the simplest of as many effects as it that the data
        do not tell from the most probable; none that has effects more, and one of those that are left out."""
        for one in self.pool.values():
            one.failed |= len(one.key) > len(key) and not one.key.isdisjoint(without)
        if TIME_UP not in self.failed.values():
            known_twins(self.refits, key, self.null.screened, self.tell)
        self.refits.weigh()
        ready = self._alike(self.pool[key])
        top = max(ready, key=lambda one: one.log, default=self.pool[key])
        fitted = (one.key for one in (simpler(top, ready, FACTOR), top) if self.station_of(one) is not None)
        self.best = next(fitted, key)

    def special_cases_of(self, key: Key) -> list[Key]:
        """The structures that were refitted with the special case of one of the laws in its place."""
        found = []
        for one in self.pool[key].effects:
            limit = (one.candidate.source.effect.limit, one.candidate.port)
            case = self.pool.get(key - {one.candidate.key} | {limit})
            if case is not None and case.beyond > BEYOND:
                found.append(case.key)
        return found

    def _alike(self, one: Tried) -> list[Tried]:
        """The structures of as many effects as one that are findings."""
        return [t for t in self.pool.values() if len(t.effects) == len(one.effects) and t.beyond > BEYOND]

    def _in_two(self) -> None:
        """Let two effects take the place of one where that is more probable, and others in its class know of it."""
        now = self.pool[self.best]
        if not now.effects or len(now.effects) >= self.most or late():
            return
        screened = self.stations[frozenset()].screened
        made = self._timed("exchange", lambda: tried_in_two(
            self.refits, now, screened, families_of(screened), partial(chosen_of, screened), self.tell,
            self.stations.get(self.best),
        ))  # fmt: skip
        self.refits.weigh()
        ready = [one for one in made if one.beyond > BEYOND and one.log - self.price > now.log]
        for one in sorted(ready, key=lambda t: -t.log):
            if weak_beside_colour(self.refits, one):
                one.failed = True  # nor is it in the class of what stands
                continue
            if self.station_of(one) is not None:
                self.best = one.key
                # rivals of each of the two were not tried beside the other
                best = self._timed("exchange", lambda: self._exchanged(one, self.pool[frozenset()]))  # noqa: B023
                self.best = one.key if self.station_of(best) is None else best.key
            return

    @property
    def price(self) -> float:
        """What a further effect has to gain in log probability."""
        return price_of(families_of(self.stations[frozenset()].screened))

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
        station = self.stations[key]
        if station.screened.choice.waits:
            screened = self._timed("score", lambda: coloured(station.screened, station.fit))
            self.stations[key] = replace(station, screened=screened)
        return self.stations[key].screened

    def as_chosen(self, key: Key) -> Station:
        """A structure's station, scored in the colour of its noise where the chosen one's is: fresh data may prefer
        it."""
        if not self.chosen.screened.choice.waits:
            self._in_colour(key)
        return self.stations[key]

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
        return self.refits.pool if self.stations else {}

    @property
    def scored(self) -> bool:
        """True once the model without effects is scored: from then on there is an answer."""
        return frozenset() in self.pool

    @property
    def null(self) -> Station:
        """The model without effects."""
        return self.stations[frozenset()]

    @property
    def chosen(self) -> Station:
        """The model of the best structure so far."""
        return self.stations[self.best]

    @property
    def fit(self) -> Fit:
        """The fit of the best structure so far; before any is scored, of the model without effects."""
        return self.stations[self.best].fit if self.stations else self.null_fit

    # ---- one round

    def _asks(self, screened: Screened) -> bool:
        """True if there may be something that the library names."""
        if not screened.scores.testable.any():
            return False
        return bool(screened.significant) or bool(screened.noise.colour) or bool(screened.leftover.alarms)

    def _round(self, here: Tried, station: Station, known: tuple[Key, ...] = ()) -> Tried | None:
        """The structure that takes the place of ``here``; None where none does.

        known : structures that were found to be better before, by exchange too
        """
        with ending_before(self.null_time, _WHOLE):  # what a round finds is no answer without a whole fit
            tried = self._timed("refit", lambda: self._added(here, station))
            if here.effects:
                tried += self._timed("exchange", lambda: beside_rivals(self.refits, here, tried, self.tell))
        tried += [self.pool[key] for key in known if self.pool[key] not in tried]
        self._timed("evidence", self.refits.weigh)
        tried += self._timed("exchange", lambda: self._without_idle(tried))
        chosen = self._chosen_of(here, station, tried)
        if chosen is not None or self.refits.path.linear or not self._left_out or late():
            return chosen
        # one step is no word on them where what it was made from is no answer
        rest = self._timed("refit", lambda: self._added(here, station, again=True))
        self._timed("evidence", self.refits.weigh)
        return self._chosen_of(self.pool[here.key], station, rest) if rest else None

    def _another(self, here: Tried) -> Tried | None:
        """The structure that takes the place of ``here`` where what fresh data would leave out is no choice: one that
        closes a part of the gap which a person would see."""
        least = here.arrived.cost * (1 - SEEN) ** 2
        tried = [one for one in self.pool.values() if here.key < one.key and one.arrived.cost <= least]
        return self._chosen_of(here, self.stations[here.key], tried) if tried else None

    def _chosen_of(self, here: Tried, station: Station, tried: list[Tried]) -> Tried | None:
        """The most probable of the structures that were tried, fitted as ``here`` is; None where none is worth it."""
        screened = station.screened
        known = int(screened.scores.testable.sum())
        while True:
            tried = [self.pool.get(one.key, one) for one in tried]  # as refitted since, and failed
            best = self._most_probable(tried)
            gain = -math.inf if best is None else best.log - here.log
            if best is not None and not here.effects:
                gain = together(best, tried) - here.log
            white = not (screened.noise.colour or self.refits.levels.memory or screened.choice.rounded)
            calibrated = bool(screened.significant) and white
            # that anything is missing is told by all together; one more effect has to show it alone
            price = math.log(max(known, 1)) if here.effects else self.price
            sure = calibrated or gain > math.log(FACTOR) + price
            in_colour = gain > 0 and not here.effects
            if best is None or not (sure or (in_colour and self._scores_in_colour(here, best, tried))):
                self._told(here, tried, None)
                return None
            if is_rounding(self.refits, here, best):
                best.failed = True
                continue
            if weak_beside_colour(self.refits, best):
                more = self._timed("refit", lambda: self._with_one_more(best))  # noqa: B023
                best.failed = True
                if more is None:
                    continue
                tried.append(more)
                best = more
            best = self._timed("exchange", lambda: self._exchanged(best, here))  # noqa: B023
            best = late_otherwise(self.refits, best, self.null.screened, self.tell)
            # where that is not told, the simpler one is named in the end: a whole fit of the other is in a flat valley
            self._timed("exchange", lambda: self._special_cases_of(best))  # noqa: B023
            best = simpler(best, self._alike(best), FACTOR)
            if len(best.effects) < self.most:
                best = in_its_parts(self.refits, best, self.null.screened, self.price, self.tell)
            tried += [] if best in tried else [best]
            self._timed("exchange", lambda: self._again_without(best, here))  # noqa: B023
            here = self.pool[here.key]
            renewed = self._renewed(here)
            if renewed is not None:
                return self._round(self.pool[here.key], renewed, (best.key,) if best.effects else ())
            if self._timed("refit", lambda: self._sharpened(best)):  # noqa: B023
                here, tried = self._as_they_are(here, tried)
                tried += [one for one in self._alike(best) if one not in tried]
                continue
            if weak_beside_colour(self.refits, best):
                best.failed = True
                continue
            arrived = self.station_of(best)
            best = self.pool.get(best.key, best)  # with wide corners, where the time was up before
            if arrived is not None and not vanished(best.effects, arrived.fit):
                self.refits.settled()
                break
            if self.refits.blunted():
                here, tried = self._as_they_are(here, tried)
                continue
            self.failed.setdefault(best.label, NO_FIT if arrived is None else _NOTHING_LEFT)
            best.failed = True
            ask()
        self._told(here, tried, best)
        return best

    def _as_they_are(self, here: Tried, tried: Sequence[Tried]) -> tuple[Tried, list[Tried]]:
        """Structures as they are refitted now, after corners have changed."""
        return self.pool[here.key], [self.pool[one.key] for one in tried if one.key in self.pool]

    def _special_cases_of(self, best: Tried) -> None:
        """See ``special_cases``."""
        special_cases(self.refits, best.key, self.null.screened, self.tell)
        self.refits.weigh()

    def _renewed(self, here: Tried) -> Station | None:
        """The structure fitted and scored anew, where what was tried beside it found a better optimum of it: what a
        poor one leaves is no missing effect. None where there is none, or where that fit does not converge."""
        if here.key not in self.refits.improved:
            return None
        self.refits.improved.clear()
        made = self._fits.get(here.key)
        if made is not None and made[0] is self.pool[here.key].arrived:
            return None  # the station is that optimum's already
        before, found = self.stations.pop(here.key), None
        try:
            found = self.station_of(self.refits.pool[here.key])
        finally:  # whatever ends it: the answer so far is asked of the stations
            if found is None:
                self.stations[here.key] = before
        if found is not None:
            for one in self.pool.values():  # what was no answer beside a poor optimum is asked again
                one.failed = False
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

    def _with_one_more(self, one: Tried) -> Tried | None:
        """A structure that is no finding beside the colour it leaves, with the effect that takes this colour away; None
        where there is none. Of two that are missing, the one that is added first leaves what the other does."""
        if len(one.effects) >= self.most or late():
            return None
        screened = self.stations[frozenset()].screened
        families = families_of(screened)
        others = {key: own for key, own in families.items() if key not in one.key}
        chosen = partial(chosen_of, screened)
        made = with_one_more(self.refits, one, screened, others, chosen, self.tell, self.price)
        self.refits.weigh()
        ready = [t for t in made if t.beyond > BEYOND and t.log > one.log + self.price]
        best = max(ready, key=lambda t: t.log, default=None)
        return None if best is None or weak_beside_colour(self.refits, best) else best

    def _added(self, here: Tried, station: Station, *, again: bool = False) -> list[Tried]:
        """What was refitted with one effect more; again : those that were left out before."""
        if not again:
            self._additions = Additions(self.refits, here, station, self.failed, self.tell)
        tried = self._additions.rest() if again else self._additions.run()
        left = self._additions.left_out.items()
        self._left_out = tuple((f"{effect} at {port}", cost) for (effect, port), cost in left)
        return tried

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
        """See ``Refits.sharpened``; False once their share of the time is over, corners as they were then."""
        try:
            ask()
            self._kept_wide(best)
            with Deadline(_SHARP * self.deadline.left) as own:
                sharper = self.refits.sharpened(best)
                if sharper and own.over:
                    self.refits.blunted()
                return sharper and not own.over
        except TimeUp:
            self.refits.blunted()
            return False

    def _wide_again(self, key: Key) -> bool:
        """True if corners were taken back to those of the station that a structure has."""
        while key in self._wide and self.pool[key].arrived is not self._wide[key]:
            if not self.refits.blunted():
                return False
        return key in self._wide

    def _kept_wide(self, best: Tried) -> None:
        """Fit a structure whose corners may become sharper as it is, where time may not do for that: an answer."""
        so_far = time.perf_counter() - self._begun
        limited = self.deadline.left < _LONGER * so_far and best.key not in self.stations
        if limited and self.refits.may_sharpen(best) and self.station_of(best) is not None:
            self._wide[best.key] = best.arrived

    def _told(self, here: Tried, tried: Sequence[Tried], kept: Tried | None) -> None:
        order = sorted(tried, key=lambda one: -one.log)
        library = tuple((one.label, one.log - here.log) for one in order)
        refits = tuple((one.label, one.arrived.cost, one.arrived.settled) for one in order)
        gone = tuple(one.label for one in here.effects if kept and one.candidate.key not in kept.key)
        self.rounds.append(Round(library, refits, None if kept is None else kept.label, gone, self._left_out))

    def _most_probable(self, tried: Sequence[Tried]) -> Tried | None:
        found = [one for one in tried if one.beyond > BEYOND and math.isfinite(one.log)]
        return max(found, key=lambda one: one.log, default=None)

    def _exchanged(self, best: Tried, here: Tried) -> Tried:
        """The structure after its members were exchanged one by one, and each was left out, as far as time allows; or
        what is left of one that is more probable, without the members that do nothing there."""
        with suppress(TimeUp):
            best = exchanged(self.refits, best, here, self.null.screened, self.tell)
            alike = [one for one in self.pool.values() if len(one.effects) == len(best.effects)]
            made = [
                one for one in self._without_idle(alike) if not one.key <= here.key and one.beyond > BEYOND
            ]
            least = best.log - self.price
            best = max((one for one in made if one.log > least), key=lambda one: one.log, default=best)
        return best

    # ---- whole fits

    def _screened(self, fit: Fit) -> Screened:
        self.tell("scores of all effects at all ports")
        return self.screen(fit)

    def station_of(self, tried: Tried) -> Station | None:
        """The structure fitted as the null model is, and screened; None where that does not converge, or in time."""
        try:
            # with an answer at hand, the time that is kept for fresh data stays theirs
            with nullcontext() if tried.key in self._wide else self.deadline.spared(_FIT):
                return self._fitted(tried)
        except TimeUp:
            if self._wide_again(tried.key):
                self.failed[f"sharper corners of {tried.name}"] = TIME_UP
                return self.stations[tried.key]
            self.failed[tried.label] = TIME_UP
            return None

    def _fitted(self, tried: Tried) -> Station | None:
        wide = self._wide.get(tried.key, tried.arrived)
        if tried.key not in self.stations or wide is not tried.arrived:
            fit = self._whole(tried)
            if fit is None:
                return None
            screened = self._timed("score", lambda: self._screened(fit))
            self.refits.rounded.update(screened.choice.rounded)
            self.stations[tried.key] = Station(fit, tried.effects, screened)
            self._wide.pop(tried.key, None)
        return self.stations[tried.key]

    def _whole(self, tried: Tried) -> Fit | None:
        """The structure fitted as the null model is; None where that does not converge."""
        there, known = tried.arrived, self._fits.get(tried.key)
        if known is not None and known[0] is there:
            return known[1]
        self.tell(f"fit with {tried.label}")
        start = Start(there.values, there.initial, {}, there.settled, fineness=there.refit.fineness)
        fit = self._timed("fit", lambda: self.refitter(self.null_fit, tried.effects, start=start))
        if fit is not None and (
            not fit.converged
            or impossible(tried.effects, fit.values, self.refitter.model, self.refitter.data)
            or more_than_whole(tried.effects, fit.values, fit.stderr)
        ):
            fit = None  # the gain or delay was a possible one where the refit ended
        if fit is not None:
            # before, the scatter of assumed pressures had to stand for the effect
            own, options = self.refitter.noise, self.refitter.options
            fit, _ = self._timed(
                "fit", lambda: settle_scatter(fit, fit.parameters, noise=own, options=options)
            )
        self._fits[tried.key] = there, fit
        return fit

    def fit_of(self, tried: Tried) -> Fit | None:
        """The whole fit of a structure, which is not scored: enough to foretell fresh data."""
        if tried.key in self.stations:
            return self.stations[tried.key].fit
        try:
            with self.deadline.spared(_FIT):
                return self._whole(tried)
        except TimeUp:
            self.failed[tried.label] = TIME_UP
            return None

    def way(self, key: Key) -> list[Station] | None:
        """See ``ways.way``."""
        return way(self, key)

    def _timed(self, what, work):  # type: ignore[no-untyped-def]
        begun = time.perf_counter()
        made = work()
        self.timing[what] = self.timing.get(what, 0.0) + time.perf_counter() - begun
        return made
