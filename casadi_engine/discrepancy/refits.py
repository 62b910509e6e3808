"""Every structure that was refitted, its evidence counted with one noise for all: the one that the best leaves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from casadi_engine.deadline import ask, late
from casadi_engine.discrepancy.arrived import Arrived
from casadi_engine.discrepancy.cancelling import work_against_each_other
from casadi_engine.discrepancy.compression import scatter_columns
from casadi_engine.discrepancy.evidence import (
    FACTOR,
    Columns,
    Digest,
    Levels,
    Prior,
    digest,
    evidence,
    innovations,
    levels_left,
)
from casadi_engine.discrepancy.exchanged_units import impossible, more_than_whole
from casadi_engine.discrepancy.full_stores import is_overfull
from casadi_engine.discrepancy.gradual import Gradual, in_place_of_event
from casadi_engine.discrepancy.late_samples import Samples, beyond, leaving_out
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.linearised import OneStep
from casadi_engine.discrepancy.noise_choice import scatter_of
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.path import FAILURES, Form, Path, form_of
from casadi_engine.discrepancy.priors import priors_of
from casadi_engine.discrepancy.refit import Addition, Refitter, numbers, parts_of
from casadi_engine.discrepancy.start import Start
from casadi_engine.discrepancy.tried import THERE, Counted, Key, Tried, key_of
from casadi_engine.discrepancy.whole_lags import at_whole_lags
from casadi_engine.errors import EstimationError
from casadi_engine.estimation import Fit
from casadi_engine.estimation.corner_widths import FELT, ROUNDED

# Share of what the best effect takes from chi-squared that another may still gain in further steps.
PART = 0.3
# Levels that fall by this share are new ones, at which refits go on.
_RELEVELLED = 0.7
# Chi-squared within which two ends are one valley, as refits are off by as much, and share of a value by which it is at
# another place there.
_VALLEY, _PLACE = 0.1, 0.1
# Log evidence by which an optimum of a structure is another one.
_BETTER = 1.0
# Rivals that are refitted with sharper corners; that are asked where these do not help the best one.
_RIVALS, _SHARP_RIVALS = 6, 3
# Times the chi-squared that the best structure leaves from which on another one is not refitted with sharper corners:
# what wide ones cost is left by both, but for the share that one more number may stand for, here 99 of 100.
_FAR = 100.0
# A refit with sharper corners may change chi-squared by so many times what one simulation foretells: 50 were seen.
_FORETOLD = 50.0


def _no_better(one: Arrived, known: Arrived) -> bool:
    """True for a refit that ended above a known one, or at its place; along a valley in which the data tell nothing
    another place may be more probable a priori."""
    if one.cost >= known.cost + _VALLEY:
        return True
    pairs = [(own, known.values.get(name, math.nan)) for name, own in one.values.items()]
    here = all(abs(own - there) <= _PLACE * max(abs(own), abs(there)) for own, there in pairs)
    return one.cost >= known.cost - 1e-6 and here


class Refits:
    """The pool of structures, and the refits that fill it.

    noise : of the model without effects; tell : takes what is being done, in words
    """

    def __init__(
        self,
        refitter: Refitter,
        null_fit: Fit,
        noise: NoiseModel,
        *,
        cylinders: object,
        tell: Callable[[str], None],
    ) -> None:
        self.refitter, self.null_fit, self.cylinders = refitter, null_fit, cylinders
        refitter.base = null_fit
        self.path = Path(refitter, dict(noise.sigma))
        self.levels = Levels(dict(noise.sigma), {}, max(noise.scatter.values(), default=0.0))
        self.pool: dict[Key, Tried] = {}
        # shares and pools before corners were sharpened, the last at the end
        self._wide: list[tuple[float, dict[Key, Tried]]] = []
        self._blunt = False
        # those that were refitted with the widths of their corners estimated
        self._rounded: set[Form] = set()
        # structures of which sharper corners left more, and the share and the end of the refit that left least
        self._turned: dict[Key, tuple[Tried, tuple[float, Arrived]]] = {}
        self.blur = 0.0  # chi-squared that corners as sharp as they are may be off by, as far as it is known
        self.rounded: dict[str, float] = {}  # see ``rounding``
        self.improved: set[Key] = (
            set()
        )  # structures of which a better optimum was found since this was last asked
        # structure -> what was asked, and one step of all candidates in the place of one of its effects
        self.steps: dict[Tried, tuple[tuple[object, ...], OneStep | None]] = {}
        self._own: dict[int, tuple[Digest, float]] = {}  # log evidence in their own noise
        self._pairs: dict[Any, tuple[Counted, Counted]] = {}  # see ``_pair``
        self.filters: dict[
            Key, Tried
        ] = {}  # structures with a lag that no sensor has, see ``more_than_whole``
        self.race: Any = None  # functions that were refitted, see ``law_race``
        self.named_alone = False  # no structure whose effects bend to something else is wanted any more
        self._fine: set[Key] = set()  # structures whose corners are as sharp as the data feel
        self._tell = tell
        # the last one with the share of its corners, as several parts ask for the same
        self._linear: tuple[Arrived, float, NullModel | None] | None = None

    def tried(
        self,
        effects: tuple[Addition, ...],
        start: Start | None,
        *,
        near: bool = False,
        most: float = math.inf,
    ) -> list[Tried]:
        """The structure in the pool, after another refit of it from a start; empty where none has arrived.

        near : an optimum is to be near, so that no short windows show the way; most : see ``Path.from_windows``
        """
        key, path = key_of(effects), self.path
        if key not in self.pool and any(
            getattr(e.candidate.source.effect, "retards", False) for e in effects
        ):
            with suppress(*FAILURES):
                effects = at_whole_lags(self.null_fit, self.refitter.extended(effects), effects)
        arrived = path.from_point(effects, start) if near else path.from_windows(effects, start, most)
        known = self.pool.get(key)
        if arrived is None or not math.isfinite(arrived.cost):
            return [] if known is None else [known]
        if known is not None and known.form == form_of(effects) and _no_better(arrived, known.arrived):
            return [known]
        made = self._counted(effects, arrived)
        if made is not None and (known is None or made.log > known.log or self._excused(known, made)):
            self.pool[key] = made
            if known is not None and made.log > known.log + _BETTER:
                self.improved.add(key)
        return [self.pool[key]] if key in self.pool else []

    def _counted(self, effects: tuple[Addition, ...], arrived: Arrived) -> Tried | None:
        """A refit with its evidence; None where a sensor would have a gain or a delay that none has."""
        if impossible(effects, arrived.values, self.refitter.model, self.refitter.data):
            return None
        if is_overfull(effects, arrived.initial):
            return None
        try:
            with np.errstate(all="ignore"):
                null = self.path.residuals(effects, arrived)
                priors = priors_of(null, self.path.parameters(effects), effects)
                choices = float(np.prod([one.choices for one in effects]))
                random, held = self.random(null), arrived.held
                made = digest(null, priors, random=random, held=held, choices=choices)
                found = evidence(made, self.levels)
                lost = beyond(null)
        except FAILURES:
            return None
        if not math.isfinite(found.log):
            return None
        courses, cancels = (
            self._courses(effects, arrived, priors, random),
            work_against_each_other(null, effects),
        )
        tried = Tried(effects, arrived, made, found, lambda: self.pool, courses=courses, cancels=cancels)
        tried.lost = lost
        self._hold_late([tried])
        tried.weigh(self.levels)
        if more_than_whole(effects, arrived.values, tried.evidence.error):
            self.filters[key_of(effects)] = tried
            return None
        tried.failed = self.named_alone and tried.is_curve
        tried.acts = self._acts(tried)
        return tried

    def _hold_late(self, every: Iterable[Tried]) -> None:
        """Say what structures with late sensors are held against: the most probable one without, whose samples they
        cannot tell of count as noise for both."""
        plain = [
            one for one in (*self.pool.values(), *self.filters.values()) if not one.lost and not one.failed
        ]
        best = max(plain, key=lambda one: one.log, default=None)
        for one in every:
            if one.lost and best is not None:
                with suppress(*FAILURES), np.errstate(all="ignore"):
                    one.beside = self._pair(best, one.lost)

    def _pair(self, one: Tried, lost: Samples) -> tuple[Counted, Counted]:
        """A structure by all samples, and without these."""
        key = id(one.digest), tuple((place, *own.tolist()) for place, own in lost.items())
        if key not in self._pairs:
            null = self.path.residuals(one.effects, one.arrived)
            priors = priors_of(null, self.path.parameters(one.effects), one.effects)
            less = leaving_out(null, lost)
            made = digest(less, priors, random=self.random(less), held=one.arrived.held)
            # the digest is kept, too, so that no other one takes its identity
            self._pairs[key] = (
                Counted(null, one.digest),
                Counted(less, replace(made, amplitudes=one.digest.amplitudes)),
            )
        return self._pairs[key]

    def _courses(
        self,
        effects: tuple[Addition, ...],
        arrived: Arrived,
        priors: dict[str, Prior],
        random: Columns | None,
    ) -> tuple[Gradual, ...]:
        """What the events of a structure are held against; none where that cannot be told."""
        events = [one for one in effects if one.moves]
        made: list[Gradual | None] = []
        with suppress(*FAILURES), np.errstate(all="ignore"):
            null = self.path.null_at(effects, arrived) if events else None
            made = [in_place_of_event(null, one, priors, arrived.held, random) for one in events if null]
        return tuple(one for one in made if one is not None)

    def _acts(self, tried: Tried) -> dict[str, float]:
        """See ``Tried.acts``; in the noise of the evidence."""
        found, arrived, alone = {}, tried.arrived, tried.evidence.alone
        for one in tried.effects:
            own = [n for n in arrived.values if n.partition("@")[0] == one.amplitude]
            there = max((abs(arrived.values[n]) / alone.get(n, math.inf) for n in own), default=0.0)
            if own and there < THERE:
                rise = self.path.cost_without(tried.effects, arrived, one.amplitude) - arrived.cost
                share = tried.evidence.cost / max(arrived.cost, 1e-300)
                found[one.amplitude] = math.sqrt(max(rise * share, 0.0)) if math.isfinite(rise) else 0.0
        return found

    def random(self, null: NullModel) -> dict[str, dict[str, Array]] | None:
        """Columns of the random amplitudes of combustions whose pressure was assumed."""
        scatter = scatter_of(null, self.refitter.data, self.cylinders) if self.cylinders is not None else ()
        return {r.name: scatter_columns(r, scatter) for r in null.records} if scatter else None

    @property
    def known(self) -> dict[str, float]:
        """The levels below which no model's noise is: those that were stated, and of rounding."""
        return {name: s for name, (s, own) in self.null_fit.noise.items() if not own} | self.rounded

    def _is_its_limit(self, one: Tried, added: Addition) -> bool:
        """True if a law of a structure rests at that bound of its own where it is a simpler one."""
        effect = added.candidate.source.effect
        name = f"{added.key}.{effect.limit_at}"
        if not one.arrived.rests(name):
            return False
        bounds = self.path.parameters(one.effects)[name]
        other = {"max": bounds.min, "min": bounds.max}.get(effect.limit_end, math.nan)
        values = [value for own, value in one.arrived.values.items() if own.partition("@")[0] == name]
        return not any(math.isclose(value, other, rel_tol=1e-6) for value in values)

    def weigh(self) -> None:
        """Count every structure's evidence with the noise that the most probable one leaves.

        A law that rests where it is a simpler one (friction that fades beyond all speeds is dry friction) is no rival
        of that: nothing of what it has more was estimated. Nor is one beside an effect that it is made of.
        """
        for key, one in self.pool.items():
            for added in one.effects:
                effect, (_, at) = added.candidate.source.effect, added.candidate.key
                simpler = key - {added.candidate.key} | {(effect.limit, at)} in self.pool
                one.failed |= any((name, at) in key for name in parts_of(added, one.arrived.values))
                one.failed |= bool(effect.limit_at) and simpler and self._is_its_limit(one, added)
        seen: set[Key] = set()
        while True:
            best = max(self.pool.values(), key=lambda one: one.log)
            if best.key in seen:
                if not self.levels.memory:
                    return
                ready = [one for one in self.pool.values() if not one.failed]
                closest = min(ready, key=lambda one: one.arrived.cost, default=best)
                if closest.key in seen or not self._excused(best, closest):
                    return
                best = closest
            seen.add(best.key)
            try:
                self.levels = self._left_by(best)[1]
            except FAILURES:
                return
            every = [*self.pool.values(), *self.filters.values()]
            # those that late ones are held against first
            for one in sorted(every, key=lambda one: bool(one.lost)):
                self._hold_late([one])
                one.weigh(self.levels)
                one.own = self._alone(one) if self.levels.memory else None
            for one in every:
                one.outdone = one.own is not None and self._is_outdone(one)

    def _is_outdone(self, one: Tried) -> bool:
        """See ``Tried.outdone``."""
        less = [t for t in self.pool.values() if t.arrived.cost < one.arrived.cost and not t.failed]
        least = one.evidence.log + math.log(FACTOR)
        return any(not t.key or (not t.key <= one.key and t.evidence.log > least) for t in less)

    def _left_by(self, tried: Tried) -> tuple[NullModel, Levels]:
        """The residuals of a structure, and the noise that it leaves."""
        with np.errstate(all="ignore"):
            null = self.path.residuals(tried.effects, tried.arrived)
            return null, levels_left(null, self.known, self.levels.scatter, self.random(null))

    def _excused(self, tried: Tried, closer: Tried) -> bool:
        """True if a structure is the more probable one only as its gap counts as coloured noise: each one held against
        the noise that it leaves itself, by the likelihood of its innovations, another that is closer to the data is."""
        if not self.levels.memory or closer.arrived.cost >= tried.arrived.cost:
            return False
        return self._alone(closer) > self._alone(tried)

    def _alone(self, tried: Tried) -> float:
        """The log evidence with the noise that the structure leaves, of its own level and colour."""
        log = self._in_own_noise(tried.digest, lambda: self._left_by(tried)[0])
        if tried.beside is not None:
            full, part = (self._in_own_noise(b.digest, lambda b=b: b.null) for b in tried.beside)  # type: ignore[misc]
            log = log + full - part if math.isfinite(full - part) else log
        return log

    def _in_own_noise(self, made: Digest, null: Callable[[], NullModel]) -> float:
        """Log evidence in noise of the level and colour that a model leaves; once for each."""
        known = self._own.get(id(made))
        if known is None or known[0] is not made:
            try:
                left = null()
                levels = levels_left(left, self.known, self.levels.scatter, self.random(left))
                found = evidence(made, levels)
                known = made, found.log + 0.5 * found.cost - innovations(left, levels)
            except FAILURES:
                known = made, -math.inf
            self._own[id(made)] = known
        return known[1]

    def relevel(self, tried: Sequence[Tried]) -> None:
        """Go on at the levels that the most probable one leaves, where they are lower."""
        best = max(tried, key=lambda one: one.log, default=None)
        if best is None:
            return
        self.weigh()
        levels = {n: min(s, self.levels.sigma.get(n, s)) for n, s in self.path.levels.items()}
        if all(levels[n] > _RELEVELLED * s for n, s in self.path.levels.items()):
            return
        self.path.relevel(levels)
        plain = Levels(levels, {}, self.levels.scatter)
        for one in self.pool.values():  # costs compare at the same levels alone
            one.arrived = replace(one.arrived, cost=one.cost_by(plain).cost)
        near = best.log - 0.5 * PART * max(self.pool[frozenset()].evidence.cost - best.evidence.cost, 0.0)
        for one in sorted(tried, key=lambda one: -one.log):
            if not late() and one.log > near - math.log(FACTOR * len(tried)):
                self._tell(f"go on with {one.label}")
                again = self.path.from_point(one.effects, one.arrived)
                made = None if again is None else self._counted(one.effects, again)
                if made is not None and made.log > one.log:
                    self.pool[one.key] = made

    def exactly(self, rivals: Sequence[Tried]) -> None:
        """Refit structures as exactly as whole fits are made: what tells one from the other is no rounding."""
        for one in rivals:
            ask()
            again = self.path.exactly(one.effects, one.arrived)
            made = None if again is None or not again.settled else self._counted(one.effects, again)
            if made is not None:
                self.pool[one.key] = made
        self.weigh()

    def sharpened(self, best: Tried) -> bool:
        """Refit the best structure and its rivals with corners so sharp that the data do not tell them from sharper
        ones; False where they are.

        Where sharper ones do not help it, and what it leaves is no noise, the law of a rival may be the sharp one.
        """
        if self._blunt or best.key in self._fine:
            return False
        lead, found = best, self._sharpest(best)
        if found is None:
            lead, found = self._sharp_rival(best)
        if found is None:
            return self._as_rounded()
        self._wide.append((self.refitter.share, dict(self.pool)))
        self.refitter.share = found[0]
        sharp = self._counted(lead.effects, found[1])
        if sharp is None:
            self.blunted()
            return False
        self.pool[lead.key] = sharp
        least = best.log - abs(sharp.log - best.log) - math.log(FACTOR * len(self.pool))
        alike = [one for one in self.pool.values() if len(one.effects) == len(best.effects)]
        simpler = self._simpler(lead)[:_SHARP_RIVALS]
        near = sorted(
            (one for one in alike if one is not sharp and one.log > least and one not in simpler),
            key=lambda one: -one.log,
        )
        parts = [one for one in self.pool.values() if one.effects and one.key < lead.key]
        for one in (*simpler, *near[:_RIVALS], *parts):
            if one.arrived.cost <= _FAR * lead.arrived.cost and not late():
                self._again_sharp(one)
        self._as_rounded()
        self.weigh()
        return True

    def _as_rounded(self) -> bool:
        """Refit those of which sharper corners left more with the widths of their corners estimated: such a law is
        rounded itself, as contacts are that give way before they slide. True if one is more probable so."""
        changed = False
        for one, (share, start) in self._turned.values():
            if late():
                break
            before, self.refitter.share = self.refitter.share, share
            corners = [own for own in one.effects if self.path.cornered([own])]
            found = {own.candidate.key: getattr(self.refitter.rounded(own), "width", None) for own in corners}
            self.refitter.share = before
            widest = {own.candidate.key: self.refitter.widest(own) for own in corners}
            widths = {key: width for key, width in found.items() if width is not None and width < widest[key]}
            effects = tuple(
                replace(own, width=widths.get(own.candidate.key, own.width)) for own in one.effects
            )
            known = self.pool.get(one.key)
            if known is None or form_of(effects) == one.form or form_of(effects) in self._rounded:
                continue
            self._rounded.add(form_of(effects))  # one whose fit of all data fails is not made so again
            self._tell(f"rounded corners: {one.label}")
            arrived = self.path.from_point(effects, start)
            if (
                arrived is None
                or not arrived.settled
                or any(arrived.rests(f"{own.key}.width") for own in effects)
            ):
                continue  # what is rounded over more of the motion is a law of its own
            made = self._counted(effects, arrived)
            if made is not None and made.log > known.log:
                self.pool[one.key] = made
                changed = True
        self._turned.clear()
        return changed

    def may_sharpen(self, one: Tried) -> bool:
        """True for a structure of whose corners it is not known whether sharper ones are felt."""
        return not self._blunt and one.key not in self._fine and self.path.cornered(one.effects)

    def _sharpest(self, one: Tried) -> tuple[float, Arrived] | None:
        """The share of corners that a structure's data feel, and where its refit with them arrived; None where they
        feel none that are sharper, or its law itself is no sharper."""
        worth = max(1.0 / max(self.levels.memory.values(), default=1.0), 1e-6)
        target = self.path.sharpness(one.effects, one.arrived, worth)
        self.blur = self.path.felt if self.path.felt > FELT else 0.0
        found, self.path.turned = None, None
        if target < self.refitter.share:
            found = self.path.sharpest(one.effects, one.arrived, target, worth)
        if self.path.turned is not None:
            self._turned[one.key] = one, self.path.turned
        worse = found is None or found[1].cost > one.arrived.cost + FELT
        if worse and self.levels.memory and self.path.cornered(one.effects):  # wider ones may leave less
            self._turned.setdefault(one.key, (one, (self.refitter.share, one.arrived)))
        if target >= self.refitter.share:
            return None
        if found is None or worse:
            self._fine.add(one.key)
            self.path.felt = math.nan if found is None else 0.0
            return None
        self._fine |= {one.key} if self.path.felt < FELT else set()
        self.blur = self.path.felt if self.path.felt > FELT else 0.0
        return found

    def _sharp_rival(self, best: Tried) -> tuple[Tried, tuple[float, Arrived] | None]:
        """The most probable rival that leaves less than the best structure once its corners are sharp, likewise; beside
        white noise of those with fewer numbers, which one more number may stand for a sharper corner of."""
        known = self.path.felt, self.path.moved, self.blur
        rivals = self._simpler(best)
        if self.levels.memory:
            rivals = [one for one in self._cornered(best) if len(one.effects) == len(best.effects)]
        for one in [one for one in rivals if one.key not in self._fine][:_SHARP_RIVALS]:
            if late():
                break
            found = self._sharpest(one)
            if found is None:
                continue
            if self.levels.memory:
                nearer = found[1].cost < best.arrived.cost - FELT
            else:  # it is one of its class then
                nearer = self._sharp_log(one, found) > best.log - math.log(FACTOR)
            if nearer:
                return one, found
        self.path.felt, self.path.moved, self.blur = known
        return best, None

    def _cornered(self, best: Tried) -> list[Tried]:
        """Rivals of a structure, of no more effects, whose laws have corners, the most probable first."""
        alike = [
            one for one in self.pool.values()
            if len(one.effects) <= len(best.effects) and not one.key <= best.key and one.log > -math.inf
            and self.path.cornered(one.effects)
        ]  # fmt: skip
        return sorted(alike, key=lambda one: -one.log)

    def _simpler(self, best: Tried) -> list[Tried]:
        """Those of fewer numbers."""
        return [one for one in self._cornered(best) if numbers(one.effects) < numbers(best.effects)]

    def _sharp_log(self, one: Tried, found: tuple[float, Arrived]) -> float:
        """The log evidence of a structure where its refit with corners of another share arrived."""
        before, self.refitter.share = self.refitter.share, found[0]
        try:
            made = self._counted(one.effects, found[1])
        finally:
            self.refitter.share = before
        return -math.inf if made is None else made.log

    def _again_sharp(self, tried: Tried) -> bool:
        """Refit with the corners as they are now; what a wide one gained is no evidence, so that the end counts even
        where it is less probable."""
        self._tell(f"sharper corners: {tried.label}")
        again = self.path.sharper(tried.effects, tried.arrived, self._wide[-1][0])
        if again is not None and self.path.turned is not None:
            self._turned[tried.key] = tried, self.path.turned
        made = None if again is None else self._counted(tried.effects, again)
        if made is not None:
            self.pool[tried.key] = made
        return made is not None

    def blunted(self) -> bool:
        """Take corners back to the widths before, for good: fits do not settle with sharper ones; False where there
        were none."""
        if not self._wide:
            return False
        (self.refitter.share, self.pool), self._blunt = self._wide.pop(), True
        self.path.felt = math.nan
        self.weigh()
        return True

    def settled(self) -> None:
        """A fit with corners as sharp as they are was reached: they are not taken back for what is added later."""
        self._wide.clear()

    def rounding_felt(self, effects: Sequence[Addition], *, ended: bool = False) -> float:
        """Chi-squared by which sharper corners of these effects may change it, nan where that is not known; 0 where the
        data do not feel it. ended : before all was done, so that what is known may be of another structure"""
        if (self.path.felt <= FELT and not ended) or not any(self.path.cornered([one]) for one in effects):
            return 0.0
        tried = self.pool.get(key_of(effects))
        known = math.nan if ended else self.path.felt
        if math.isnan(known) and tried is not None:
            known = self.path.felt_along(tried.effects, tried.arrived)
        return 0.0 if known <= FELT else known

    def may_be_rounding(self, effects: Sequence[Addition]) -> bool:
        """True where all that these effects leave may come of corners that are rounded: sharper ones are felt, and what
        one simulation foretells of them is no small share of it."""
        felt, tried = self.rounding_felt(effects), self.pool.get(key_of(effects))
        if felt == 0 or math.isnan(felt) or tried is None:
            return felt != 0
        count = self.path.samples
        left = (
            count
            * (1 - count / max(tried.arrived.cost, count))
            / max(self.levels.memory.values(), default=1.0)
        )
        return felt >= left / _FORETOLD

    def doubt(self, effects: Sequence[Addition]) -> list[str]:
        """That the data feel how the corners of these effects are rounded, where they do."""
        own = {one.key: self.refitter.rounded(one).width for one in effects if self.path.cornered([one])}
        names = ", ".join(f"{key} over {width:.2g}" for key, width in own.items())
        left = self.rounding_felt(effects)
        if left == 0:
            return []
        known = (
            f"sharper ones may change chi-squared by {left:.2g}; the standard errors count with what that moves"
            if math.isfinite(left)
            else "by how much sharper ones would change the estimates is not known"
        )
        return [f"{ROUNDED} ({names}), and no fit with sharper ones was reached: {known}"]

    def none(self, fit: Fit) -> Tried:
        """The null fit as a structure."""
        initial = {r: {n: e.value for n, e in own.items()} for r, own in fit.initial.items()}
        arrived = self.path.at(fit.values, initial)
        if not fit.converged:  # refitted as every other structure is, so that no effect gains by that alone
            start = Start(fit.values, initial)
            further = (
                self.path.from_point((), start),
                self.path.from_windows((), start),
                self.path.from_windows(()),
            )
            ends = [one for one in (arrived, *further) if one is not None]
            arrived = min(ends, key=lambda one: one.cost, default=None)
        made = None if arrived is None else self._counted((), arrived)
        if made is None:
            raise EstimationError(
                "the model without effects cannot be simulated at its own optimum",
                seen="residuals that are no numbers",
                allowed="a fit that can be simulated over the records",
                cure="give other start values, bounds, or a shorter record",
            )
        self.pool[frozenset()] = made
        return made

    def null(self, tried: Tried) -> NullModel | None:
        """The model of a structure, linearised where its refit ended; None where that fails."""
        now = tried.arrived, self.refitter.share
        if self._linear is None or self._linear[0] is not now[0] or self._linear[1] != now[1]:
            made: NullModel | None = None
            with suppress(*FAILURES), np.errstate(all="ignore"):
                made = self.path.null_at(tried.effects, tried.arrived)
            self._linear = *now, made
        return self._linear[2]
