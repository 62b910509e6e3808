"""One more effect beside a structure: every one that may turn out the best is refitted.

They come in the order of what one step says of them. Once one of them is refitted, a step from there, in its place,
tells what the others can come to: those that stay far above it, by more than chance and what it leaves unexplained, are
not refitted any more. Where the equations are linear, one step leaves out what explains far less, too.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from casadi_engine.deadline import Deadline, TimeUp, ask, late
from casadi_engine.deadline import left as time_left
from casadi_engine.discrepancy.event_times import located
from casadi_engine.discrepancy.exchanged_units import LATE
from casadi_engine.discrepancy.families import chosen_of, costs_of, families_of
from casadi_engine.discrepancy.in_place import (
    at_another_time,
    chance,
    instead,
    rival,
    start_without,
    step_in_place,
)
from casadi_engine.discrepancy.law_refit import is_far, leading
from casadi_engine.discrepancy.law_step import in_place_of_function
from casadi_engine.discrepancy.linearised import OneStep, one_step
from casadi_engine.discrepancy.null_model import null_at
from casadi_engine.discrepancy.path import FAILURES, form_of
from casadi_engine.discrepancy.refit import Addition, addition
from casadi_engine.discrepancy.refits import FACTOR, PART, Refits
from casadi_engine.discrepancy.score import score
from casadi_engine.discrepancy.start import Start
from casadi_engine.discrepancy.station import Station
from casadi_engine.discrepancy.tried import Tried
from casadi_engine.discrepancy.unknown_law import depends_on, moving

# Why a refit was not tried.
TIME_UP = "the time was up"
# What the time did not allow where every effect was refitted once.
_OTHER_STARTS = "other starts of these effects"
# Times that a better one is looked from.
AGAIN = 3
# A refit has arrived if chi-squared is no higher than without its effect, but for rounded corners; share of the
# one-step amplitude from which it is tried again.
_NESTED, _SMALL = 1.0, 0.02
# Log likelihood that a further effect has to promise to be refitted.
_NOTHING = 1.0
# Effects that do most by one step along the model without any, which are refitted where they may be a rival by that.
_FOREMOST = 4
# Seconds of refits from which functions of no name are asked to show the way, where nothing has come near the motion:
# as long as the refits have taken, and again when these have taken as long again.
_WORTH = 2.0
# Times as long that refits from the parameters' own values may take where nothing leaves noise, and what part of the
# time that is left.
_LONGER, _OF_LEFT = 8.0, 0.25
# Of what one step foretells that an effect leaves, the part below which its refit shows that one step tells nothing.
_FORETOLD = 0.5

Family = tuple[str, str]


@dataclass
class Additions:
    """The refits of one round.

    here, station : the structure, and its fit and scores; failed : takes what has no answer, and why; tell : takes what
    is being done, in words; done : the effects that were refitted; left_out : chi-squared by one step of those that
    stay far above the best one, or over windows; forms : of each effect, as it was refitted
    """

    refits: Refits
    here: Tried
    station: Station
    failed: dict[str, str]
    tell: Callable[[str], None]
    done: list[Family] = field(default_factory=list)
    left_out: dict[Family, float] = field(default_factory=dict)
    forms: dict[Family, list[Addition]] = field(default_factory=dict)
    # what was refitted and led nowhere, though it explained most
    refused: set[Family] = field(default_factory=set)

    def run(self) -> list[Tried]:
        """The structures with one effect more, as far as the time allows."""
        self.screened = self.station.screened
        self.families = families_of(self.screened)
        here, known = self.here, score(self.screened.choice.white or self.screened.compressed)
        none = here.arrived.cost
        self.at_here = OneStep(none - known.drop, known.amplitude, known.error, none)
        self.lead = self.at_here
        self.start: Start | None = Start(here.arrived.values, here.arrived.initial)
        order = left = self._ordered()
        best: Tried | None = None
        begun, raced = time.perf_counter(), 0.0
        try:
            while left:
                ask()
                spare = time.perf_counter() - begun - 2 * raced
                if spare > _WORTH:
                    clock = time.perf_counter()
                    left, done = self._in_turn(left, best, spare)
                    raced = math.inf if done else raced + time.perf_counter() - clock
                left = self._special_case_first(left)
                key = left[0]
                self.tell(f"refit {len(self.done) + 1} of {len(self.done) + len(left)}: {key[0]} at {key[1]}")
                self.done.append(key)
                self._try(self._in_time(chosen_of(self.screened, self.lead, self.families[key])), self.start)
                left, found = left[1:], self._best()
                if found is not None and (best is None or found.arrived.cost < best.arrived.cost - _NESTED):
                    best = found
                    left = self._left(best, [k for k in order if k not in self.done]) if left else []
            if not here.effects:
                self._from_own_values(begun)
                best = self._best()
            if best is not None and self._open():
                self._elsewhere(best)
                self.refits.relevel(self._tried())
                self._around()
        except TimeUp:  # the best of those that were tried
            names = [f"{key[0]} at {key[1]}" for key in left if key not in self.done]
            self.failed |= dict.fromkeys(names or [_OTHER_STARTS], TIME_UP)
        return self._tried()

    def rest(self) -> list[Tried]:
        """The structures of those effects that were left out as one that was refitted explained more, where that is no
        answer after all."""
        left = sorted(self.left_out, key=lambda key: self.left_out[key])
        self.refused, self.left_out, first = set(self.done), {}, len(self.done)
        self.lead, self.start = self.at_here, Start(self.here.arrived.values, self.here.arrived.initial)
        best: Tried | None = None
        try:
            while left:
                ask()
                key = left.pop(0)
                self.tell(f"refit of what was left out: {key[0]} at {key[1]}")
                self.done.append(key)
                self._try(self._in_time(chosen_of(self.screened, self.lead, self.families[key])), self.start)
                found = self._best()
                if found is not None and (best is None or found.arrived.cost < best.arrived.cost - _NESTED):
                    best = found
                    left = self._left(best, left) if left else []
        except TimeUp:
            self.failed |= dict.fromkeys((f"{key[0]} at {key[1]}" for key in left), TIME_UP)
        return [one for one in map(self._known, self.done[first:]) if one is not None]

    # ---- what is refitted

    def _ordered(self) -> list[Family]:
        """The effects that are worth a refit, in the order of these."""
        none, cost = self.at_here.none, costs_of(self.screened, self.at_here, self.families)
        if self.here.effects:
            # beside what was found the model is near the truth, and one step tells what has nothing to give
            least = none - 2 * _NOTHING * max(self.refits.levels.memory.values(), default=1.0)
            self.families = {key: own for key, own in self.families.items() if cost[key] < least}
        if not self.families:
            return []
        here = self.here.arrived
        if self.refits.path.linear and (here.held or not here.settled):
            own = self._own_step(k for members in self.families.values() for k in members)
            if own is not None and own.cost.min() < PART * self.at_here.cost.min():
                # what the fit without the effect made of the parameters is further off than their own values
                self.lead, self.start = own, None
                cost = costs_of(self.screened, own, self.families)
        order = sorted(self.families, key=lambda key: cost[key])
        # of those that may do as well as the best one, first each effect where it does best, and what has no values to
        # be looked for on a grid
        most = rival(self.refits, cost[order[0]], none, self.screened)
        first = {key[0]: key for key in reversed(order)}
        effects = {one.key: one.source.effect for one in self.screened.candidates}
        return sorted(
            order, key=lambda key: (cost[key] > most, first[key[0]] != key, len(effects[key].nuisance))
        )

    def _special_case_first(self, left: list[Family]) -> list[Family]:
        """The special case of the first of them comes before it: what has a number more always does more by one step,
        and where the time is up after it, it would stand for what is simpler."""
        port = left[0][1]
        effect = self.screened.candidates[self.families[left[0]][0]].source.effect
        simple = (effect.limit, port)
        # at a bound of its shape it says itself that it is that one
        ahead = simple in left and not effect.limit_at
        return [simple, *(key for key in left if key != simple)] if ahead else left

    def _in_turn(self, rest: list[Family], best: Tried | None, seconds: float) -> tuple[list[Family], bool]:
        """See ``_led``; and whether these seconds were enough for it."""
        try:
            with Deadline(seconds):
                return self._led(rest, best), True
        except TimeUp:
            if late():
                raise
            return rest, False

    def _led(self, rest: list[Family], best: Tried | None) -> list[Family]:
        """Those of the rest behind the laws of the signals at the ports where a function serves best, where nothing
        comes near the motion: along a simulation that is far from it one step tells nothing."""
        if self.here.effects or not rest:
            return rest
        if best is not None and not is_far(self.refits.path.residuals(best.effects, best.arrived)):
            return rest
        self.tell("which functions at which ports follow the motion")
        candidates, first = self.screened.candidates, list[Family]()
        functions = leading(self.refits)
        for port, signal in functions:
            for key, members in self.families.items():
                if key[1] == port and key not in self.done and depends_on(candidates[members[0]], signal):
                    first.append(key)
        found = in_place_of_function(self.refits, functions, self.screened, self.families)
        if found is None:
            return [*dict.fromkeys(first), *(key for key in rest if key not in first)]
        # along the motion that is measured one step tells what the function stands for
        self.lead, self.start, least = found
        cost = costs_of(self.screened, self.lead, self.families)
        most = rival(self.refits, least, self.lead.none, self.screened)
        every = [*rest, *(key for key in dict.fromkeys(first) if key not in rest)]
        nearest = min(every, key=cost.__getitem__)
        kept = [key for key in every if key in first or key == nearest or cost[key] < most]
        self.left_out |= {key: cost[key] for key in every if key not in kept}
        return sorted(kept, key=cost.__getitem__)

    def _in_time(self, one: Addition) -> Addition:
        """An event at its best time, which a swing of what it excites tells better than the grid of times."""
        with np.errstate(all="ignore"):
            found = located(self.refits, one, self.screened.null)
        return one if found is None else found[0]

    def _left(self, best: Tried, rest: list[Family]) -> list[Family]:
        """Those of the rest that are worth a refit, after the best one so far has arrived."""
        self.refits.weigh()
        linear, step = self.refits.path.linear, self._in_place_of(best)
        if step is None:
            return rest
        if linear:
            self.lead, self.start = step, start_without(best.arrived, best.newest(self.here))
        left = self._promising(best, step, rest, clearly=not linear)
        # a delay and a lag of one channel are far from one another by a step, and not by their refits, and what is late
        # behind an input is late in a sensor; so are two laws of one signal at one port
        effect, port = best.newest(self.here).candidate.key
        alone = costs_of(self.screened, self.at_here, self.families)
        most = self.here.arrived.cost - PART * (self.here.arrived.cost - best.arrived.cost)
        late_too = [k for k in rest if effect in LATE and k[0] in LATE and k in alone]
        late_too = [k for k in late_too if k[1] == port or alone[k] < most]
        moved = moving(best.newest(self.here).candidate)
        laws = [k for k in rest if moved and k[1] == port and k not in left and alone.get(k, math.inf) < most]
        laws = [k for k in laws if self._moving(k) == moved]
        # where a refit left far less than one step had foretold of it, one step tells nothing of its like elsewhere
        if best.arrived.cost < _FORETOLD * alone.get((effect, port), 0.0):
            left += [k for k in rest if k[0] == effect and k not in left]
        for key in dict.fromkeys([*late_too, *laws]):
            self.tell(f"refit in its place: {key[0]} at {key[1]}")
            one = chosen_of(self.screened, step, self.families[key])
            self._try(one, start_without(best.arrived, best.newest(self.here)), near=True)
        left += [k for k in self._foremost(best, step, rest) if k not in left and k not in self.forms]
        cost = costs_of(self.screened, step, self.families)
        self.left_out |= {key: cost[key] for key in rest if key not in left}
        # which of the laws of that signal there it is makes the name: these come next
        return sorted(left, key=lambda k: k[1] != port or not moved or self._moving(k) != moved)

    def _foremost(self, best: Tried, step: OneStep, rest: Sequence[Family]) -> list[Family]:
        """Of the effects that do most by one step along the model without any those that may be a rival by that: where
        the best one so far is a wrong name, its parameters may be far from those beside the right one, and a step in
        its place tells nothing of that."""
        if self.here.effects:
            return []
        cost = costs_of(self.screened, self.at_here, self.families)
        none = min(self.here.arrived.cost, step.none)
        most = rival(self.refits, best.arrived.cost, none, self.screened)
        first = sorted(cost, key=cost.__getitem__)[:_FOREMOST]
        return [key for key in first if key in rest and cost[key] < most]

    def _moving(self, key: Family) -> set[str]:
        """See ``unknown_law.moving``."""
        return moving(self.screened.candidates[self.families[key][0]])

    def _promising(
        self, best: Tried, step: OneStep, keys: Sequence[Family], *, clearly: bool = False
    ) -> list[Family]:
        """The effects that may come down to the best one so far, or to what it leaves unexplained, if a refit leaves at
        least ``PART`` of the gap that one step foretells.

        step : in its place; clearly : leave out only those that one step in its place clearly tells apart
        """
        cost, least, levels = (
            costs_of(self.screened, step, self.families),
            best.arrived.cost,
            self.refits.levels,
        )
        if levels.memory:
            here = costs_of(self.screened, self.at_here, self.families)
            cost = {key: min(own, here[key]) for key, own in cost.items()}
        share = min(1.0, max(levels.sigma.get(n, own) / own for n, own in self.refits.path.levels.items()))
        most = least + share**2 * (chance(self.refits, self.screened) + levels.foretold) / PART
        if not clearly:
            most = min(most, rival(self.refits, least, min(self.here.arrived.cost, step.none), self.screened))
        return [key for key in keys if cost[key] < most]

    def _in_place_of(self, best: Tried) -> OneStep | None:
        return step_in_place(self.refits, best, best.newest(self.here), self.screened, self.families)

    def _open(self) -> bool:
        """True if an effect may yet be worth it: nothing is missing beside what was found where neither scores, nor one
        step, nor any refit says so."""
        screened, memory = self.screened, max(self.refits.levels.memory.values(), default=1.0)
        if not self.here.effects or (screened.significant and not screened.noise.colour and memory == 1.0):
            return True
        self.refits.weigh()
        promise = 0.5 * (self.at_here.none - float(self.at_here.cost.min())) / memory
        gain = max((one.log - self.here.log for one in self._tried()), default=0.0)
        return max(promise, gain) > math.log(FACTOR * len(self.families))

    # ---- other starts

    def _from_own_values(self, begun: float) -> None:
        """Refits of what was left out from the parameters' own values, where the past of what the best one leaves
        foretells more of it than chance: a fit that lacks an effect may end where no step tells anything of it, and
        windows may lead there too, where few states are measured. They take as long again as those that one step
        promised, and longer while the best of them leaves more than noise.

        begun : when the first of those began
        """
        self.refits.weigh()
        if self._tried() and self.refits.levels.foretold <= chance(self.refits, self.screened):
            return
        candidates = self.screened.candidates
        step = self._own_step(range(len(candidates)))
        if step is None:
            return
        again = {key for own in self.screened.second_names.values() for key in own}
        for k in np.flatnonzero(np.isfinite(step.error)):
            if (key := candidates[k].key) not in again and int(k) not in self.families.get(key, ()):
                self.families[key] = [*self.families.get(key, ()), int(k)]
        cost = costs_of(self.screened, step, self.families)
        # what has no values to be looked for on a grid is told sooner
        grids = {one.key: bool(one.source.effect.nuisance) for one in candidates}
        left = sorted(self.families, key=lambda key: (grids[key], cost[key]))
        spent, best = time.perf_counter() - begun, self._best()
        self.lead, self.start = step, None
        left = self._led(left, best)
        if best is not None:  # which may be the right one, and have ended where the fit without it led
            first = best.newest(self.here).candidate.key
            left = [first, *(key for key in left if key != first)]
        now = time.perf_counter()
        last, latest = now + spent, now + min(_LONGER * spent, _OF_LEFT * time_left())
        while left and time.perf_counter() < latest:
            if time.perf_counter() > last and not self._is_coloured():
                break
            ask()
            key = left.pop(0)
            self.tell(f"refit from other values: {key[0]} at {key[1]}")
            one = chosen_of(self.screened, self.lead, self.families[key])
            self._try(one, self.start, near=True)
            if key not in self.done:
                self.done.append(key)
                self._try(one, self.start)
            found = self._best()
            if found is not None and (best is None or found.arrived.cost < best.arrived.cost - _NESTED):
                best, left = found, self._left(found, left)

    def _is_coloured(self) -> bool:
        """True where the past of what the best structure leaves foretells more of it than chance."""
        self.refits.weigh()
        return self.refits.levels.foretold > chance(self.refits, self.screened)

    def _elsewhere(self, best: Tried) -> None:
        """Refits from other starts, once every effect has an answer."""
        self.refits.weigh()
        step = self._in_place_of(best)
        lead = best.newest(self.here).candidate.key
        ended = [key for key in self.done if not self._beyond(key)]
        near = [*(ended if step is None else self._promising(best, step, ended))]
        near += [] if lead in near else [lead]
        own = (
            self._own_step(k for key in near for k in self.families[key]) if self.start is not None else None
        )
        for key in self.done:
            ask()
            if own is not None and key in near:
                one = chosen_of(self.screened, own, self.families[key])
                # windows, whose first states are free, tell little of what happens in one of them
                self._try(one, None, near=one.moves)
            if key in near:
                self._at_other_times(key)
            if key in near or self.refits.levels.memory:
                self._arrive(key)

    def _at_other_times(self, key: Family) -> None:
        """Refits of an event from a better time, once more where that finds one."""
        for _ in range(AGAIN):
            known = self._known(key)
            last = None if known is None else known.newest(self.here)
            if known is None or last is None or not last.moves:
                return
            for one in at_another_time(self.refits, known, last, self.screened, self.families):
                ask()
                self.tell(f"refit {one.label} at another time")
                self._try(one, start_without(known.arrived, last), near=True)
            if self._known(key) is known:
                return

    def _arrive(self, key: Family) -> None:
        """Another refit of an effect that has not come below the model without it, of which that is a special case,
        from a small amplitude; it has no answer if that fails too."""
        known, none = self._known(key), self.here.arrived
        if known is None and self._beyond(key):
            return
        if known is None or known.arrived.cost > none.cost + _NESTED:
            one = chosen_of(self.screened, self.at_here, self.families[key])
            self._try(replace(one, start=_SMALL * one.start), Start(none.values, none.initial), near=True)
            known = self._known(key)
        if known is None or known.arrived.cost > none.cost + _NESTED:
            self.failed[f"{key[0]} at {key[1]}"] = TIME_UP if late() else "no refit of it arrives"

    def _around(self) -> None:
        """Refits from the parameters of the most probable one, in its place; again where that finds a better one."""
        for _ in range(AGAIN):
            best = max(self._of_families(), key=lambda one: one.log, default=None)
            if best is None or late():
                return
            last = best.newest(self.here)
            for one in instead(self.refits, best, last, self.screened, self.families):
                ask()
                self.tell(f"refit {one.label} from the parameters of {last.label}")
                self._try(one, start_without(best.arrived, last), near=one.moves)
            self._containing()
            if max(one.log for one in self._of_families()) <= best.log:
                return

    def _containing(self) -> None:
        """Refits of effects that ended above a special case of theirs, from where that ended."""
        candidates = self.screened.candidates
        for key, members in self.families.items():
            limit = (candidates[members[0]].source.effect.limit, key[1])
            known, simple = self._known(key), self._known(limit)
            if simple is None or (known is not None and known.arrived.cost <= simple.arrived.cost + _NESTED):
                continue
            if limit not in self.families:
                continue
            case = next(one for one in simple.effects if one.candidate.key == limit)
            alike = np.abs(self.screened.scores.correlation[self.families[limit][0], members])
            candidate = candidates[members[int(np.argmax(alike))]]
            size = next(v for n, v in simple.arrived.values.items() if n.partition("@")[0] == case.amplitude)
            self._try(addition(candidate, size), start_without(simple.arrived, case))

    # ---- refits

    def _try(self, one: Addition, start: Start | None, *, near: bool = False) -> None:
        """A refit; not to its end where windows, whose first states are free, leave more than a rival may."""
        most = self._most()
        for form in one.forms:
            self.forms.setdefault(one.candidate.key, []).append(form)
            effects = (*self.here.effects, form)
            self.refits.tried(effects, start, near=near, most=most)
            bound = self.refits.path.bounds.get(form_of(effects), 0.0)
            if bound > most:
                self.left_out[one.candidate.key] = bound

    def _beyond(self, key: Family) -> bool:
        """True if what windows leave with an effect is more than a rival may leave, in whatever form it was tried."""
        forms = [form_of((*self.here.effects, one)) for one in self.forms.get(key, ())]
        bounds = [self.refits.path.bounds[form] for form in forms if form in self.refits.path.bounds]
        return bool(bounds) and min(bounds) > self._most()

    def _most(self) -> float:
        """Chi-squared beyond which an effect is less probable than the best one so far, more than chance makes it; what
        that one leaves is noise."""
        best = self._best()
        if best is None:
            return math.inf
        least, count = best.arrived.cost, self.screened.null.count
        return least + chance(self.refits, self.screened) * max(1.0, least / max(count, 1))

    def _known(self, key: Family) -> Tried | None:
        return self.refits.pool.get(self.here.key | {key})

    def _best(self) -> Tried | None:
        """The structure that was refitted here which leaves least."""
        ready = (
            one for key in self.done if key not in self.refused and (one := self._known(key)) is not None
        )
        return min(ready, key=lambda one: one.arrived.cost, default=None)

    def _tried(self) -> list[Tried]:
        """The structures of the effects that were refitted here, in the order of their refits."""
        return [one for one in map(self._known, self.done) if one is not None]

    def _of_families(self) -> list[Tried]:
        """The structures of all effects that can be tested, wherever they were refitted."""
        return [one for one in map(self._known, self.families) if one is not None]

    def _own_step(self, members: Iterable[int]) -> OneStep | None:
        """One step of some candidates from the parameters' own values, the effects so far as they were found."""
        refits, fit = self.refits, self.station.fit
        own = refits.refitter.parameters
        z = np.array([float(own[n].value) if n in own else fit.values[n] for n in fit.free])
        try:
            with np.errstate(all="ignore"):
                null = null_at(fit.model, fit.data, fit.parameters, z, refits.path.first_states(fit.model))
        except (*FAILURES, KeyError):
            return None
        return one_step(null, self.screened.candidates, refits.path.levels, sorted(members))
