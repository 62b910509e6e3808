"""Every structure that was refitted, its evidence counted with one noise for all: the one that the best leaves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from casadi_engine.deadline import ask, late
from casadi_engine.discrepancy.cancelling import work_against_each_other
from casadi_engine.discrepancy.compression import scatter_columns
from casadi_engine.discrepancy.evidence import (
    FACTOR,
    Columns,
    Digest,
    Evidence,
    Levels,
    Prior,
    digest,
    evidence,
    innovations,
    levels_left,
)
from casadi_engine.discrepancy.exchanged_units import impossible, more_than_whole
from casadi_engine.discrepancy.gradual import Gradual, in_place_of_event
from casadi_engine.discrepancy.late_samples import Samples, beyond, leaving_out
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.linearised import OneStep
from casadi_engine.discrepancy.noise_choice import scatter_of
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.path import FAILURES, Arrived, Path, form_of
from casadi_engine.discrepancy.priors import priors_of
from casadi_engine.discrepancy.refit import Addition, Refitter, parts_of
from casadi_engine.discrepancy.start import Start
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
# Standard errors, all else known, from which an amplitude is there at all, however much a refit with it gained.
_THERE = 1.0
# So many times the standard errors by the slopes: a drop of chi-squared four times what these promise.
_ELSEWHERE = 2.0

Key = frozenset[tuple[str, str]]


@dataclass(frozen=True, eq=False)
class Counted:
    """Residuals and slopes of a structure where its refit ended, and what its evidence is counted from."""

    null: NullModel
    digest: Digest


@dataclass(eq=False)
class Tried:
    """A structure that was refitted: its effects, where that ended, and its evidence with the noise of all.

    pool : all structures at the time it is asked; own : log evidence in noise of the level and colour that it leaves
    itself, where what the best leaves is coloured; failed : its whole fit did not converge; fresh : log probability of
    fresh data beside that by the structure which foretells them best, where they were asked; acts : amplitude -> the
    root of what chi-squared rises by where it is put to zero, of those whose slopes say that they are nothing: of an
    overflow that is as fast as it likes the slope is nearly none; courses : what its events are held against;
    is_gradual : one of them is far less probable than something that comes gradually; cancels : effects at one port
    work against each other; outdone : the model without effects leaves less, or another structure that is far more
    probable by the samples: a wrong way is smooth, and foretells itself; lost : the samples that late sensors cannot
    tell of; beside : what the most probable structure without them is by all samples, and by those that this one can
    tell of
    """

    effects: tuple[Addition, ...]
    arrived: Arrived
    digest: Digest
    evidence: Evidence
    pool: Callable[[], dict[Key, Tried]]
    own: float | None = None
    failed: bool = False
    fresh: float = 0.0
    acts: dict[str, float] = field(default_factory=dict)
    courses: tuple[Gradual, ...] = ()
    is_gradual: bool = False
    cancels: bool = False
    lost: Samples = field(default_factory=dict)
    beside: tuple[Counted, Counted] | None = None
    outdone: bool = False

    @property
    def is_curve(self) -> bool:
        """True where effects bend to something that has no name of theirs."""
        return self.is_gradual or self.cancels

    @property
    def key(self) -> Key:
        """Effects and ports."""
        return key_of(self.effects)

    @property
    def form(self) -> frozenset[tuple[str, str, bool]]:
        """``form_of`` the effects."""
        return form_of(self.effects)

    def newest(self, here: Tried) -> Addition:
        """The effect that another structure lacks."""
        return next(one for one in self.effects if one.candidate.key not in here.key)

    @property
    def label(self) -> str:
        """The effects' labels."""
        return " + ".join(one.label for one in self.effects) or "no effects"

    @property
    def log(self) -> float:
        """The log evidence, of fresh data too where they were asked.

        Beside coloured noise two likelihoods see what the other does not: that of samples which are worth fewer
        independent ones, slow effects; and that of the innovations, fast ones. Whichever says more, over what the model
        without effects leaves, counts.
        """
        return -math.inf if self.failed else self.counted + self.fresh

    def weigh(self, levels: Levels) -> None:
        """Count the evidence with this noise."""
        self.evidence = self.cost_by(levels)
        odds = [one.log(levels) - self.evidence.log for one in self.courses if self._is_told(one, levels)]
        self.is_gradual = max(odds, default=-math.inf) > math.log(FACTOR)

    def cost_by(self, levels: Levels) -> Evidence:
        """The evidence with this noise. What a late sensor cannot tell of it does not explain: it gains as much over
        the best structure without one as by the samples that both tell of."""
        made = evidence(self.digest, levels)
        if self.beside is None:
            return made
        full, part = (evidence(one.digest, levels) for one in self.beside)
        return replace(made, log=made.log + full.log - part.log, cost=made.cost + full.cost - part.cost)

    def _is_told(self, course: Gradual, levels: Levels) -> bool:
        """True if the slopes along a structure say what it is without an event; see ``law_rival.is_told``."""
        without = self.pool().get(self.key - {course.event})
        return without is None or course.is_told(levels, self.evidence.cost, without.evidence.cost)

    @property
    def counted(self) -> float:
        """The log evidence of the records alone."""
        none = self.pool().get(frozenset())
        if self.own is None or none is None or none.own is None or self.outdone:
            return self.evidence.log
        return max(self.evidence.log, none.evidence.log + self.own - none.own)

    @property
    def name(self) -> str:
        """The effects and their ports."""
        return " + ".join(one.name for one in self.effects) or "no effects"

    @property
    def beyond(self) -> float:
        """The least certain amplitude in its standard errors."""
        return min(map(self.certainty, self.effects), default=math.inf)

    def certainty(self, one: Addition) -> float:
        """The amplitude of an effect in its standard errors, the largest where records have their own; or the root of
        what chi-squared falls by with it, where that is far larger: the optimum without it is elsewhere then, or it is
        known but for a factor that it shares with others, and its error by the slopes says nothing of that."""
        values = self.arrived.values
        own = [n for n in values if n.partition("@")[0] == one.amplitude]
        size = max((abs(values[n]) / self.evidence.error.get(n, math.inf) for n in own), default=math.inf)
        without, alone = self.pool().get(self.key - {one.candidate.key}), self.evidence.alone
        there = max((abs(values[n]) / alone.get(n, math.inf) for n in own), default=0.0)
        there = max(there, self.acts.get(one.amplitude, 0.0))
        if without is None or not math.isfinite(size) or there < _THERE:
            return size
        gain = 2 * (self.counted - without.counted) if self.own is not None else 0.0
        drop = math.sqrt(max(without.evidence.cost - self.evidence.cost, gain, 0.0))
        return drop if drop > _ELSEWHERE * size else size


def _no_better(one: Arrived, known: Arrived) -> bool:
    """True for a refit that ended above a known one, or at its place; along a valley in which the data tell nothing
    another place may be more probable a priori."""
    if one.cost >= known.cost + _VALLEY:
        return True
    pairs = [(own, known.values.get(name, math.nan)) for name, own in one.values.items()]
    here = all(abs(own - there) <= _PLACE * max(abs(own), abs(there)) for own, there in pairs)
    return one.cost >= known.cost - 1e-6 and here


def key_of(effects: Sequence[Addition]) -> Key:
    """Effects and ports, in no order."""
    return frozenset(one.candidate.key for one in effects)


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
            if own and there < _THERE:
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
        if found is None and self.levels.memory:
            lead, found = self._sharp_rival(best)
        if found is None:
            return False
        self._wide.append((self.refitter.share, dict(self.pool)))
        self.refitter.share = found[0]
        sharp = self._counted(lead.effects, found[1])
        if sharp is None:
            self.blunted()
            return False
        self.pool[lead.key] = sharp
        least = best.log - abs(sharp.log - best.log) - math.log(FACTOR * len(self.pool))
        alike = [one for one in self.pool.values() if len(one.effects) == len(best.effects)]
        near = sorted(
            (one for one in alike if one.log > least and one is not sharp), key=lambda one: -one.log
        )
        parts = [one for one in self.pool.values() if one.effects and one.key < lead.key]
        for one in (*near[:_RIVALS], *parts):
            if not late():
                self._again_sharp(one)
        self.weigh()
        return True

    def may_sharpen(self, one: Tried) -> bool:
        """True for a structure of whose corners it is not known whether sharper ones are felt."""
        return not self._blunt and one.key not in self._fine and self.path.cornered(one.effects)

    def _sharpest(self, one: Tried) -> tuple[float, Arrived] | None:
        """The share of corners that a structure's data feel, and where its refit with them arrived; None where they
        feel none that are sharper, or its law itself is no sharper."""
        worth = max(1.0 / max(self.levels.memory.values(), default=1.0), 1e-6)
        target = self.path.sharpness(one.effects, one.arrived, worth)
        self.blur = self.path.felt if self.path.felt > FELT else 0.0
        if target >= self.refitter.share:
            return None
        found = self.path.sharpest(one.effects, one.arrived, target, worth)
        if found is None or found[1].cost > one.arrived.cost + FELT:
            self._fine.add(one.key)
            self.path.felt = math.nan if found is None else 0.0
            return None
        self._fine |= {one.key} if self.path.felt < FELT else set()
        self.blur = self.path.felt if self.path.felt > FELT else 0.0
        return found

    def _sharp_rival(self, best: Tried) -> tuple[Tried, tuple[float, Arrived] | None]:
        """The most probable rival that leaves less than the best structure once its corners are sharp, likewise."""
        known = self.path.felt, self.path.moved, self.blur
        alike = [
            one for one in self.pool.values()
            if len(one.effects) == len(best.effects) and one is not best and one.log > -math.inf
            and one.key not in self._fine and self.path.cornered(one.effects)
        ]  # fmt: skip
        for one in sorted(alike, key=lambda one: -one.log)[:_SHARP_RIVALS]:
            if late():
                break
            found = self._sharpest(one)
            if found is not None and found[1].cost < best.arrived.cost - FELT:
                return one, found
        self.path.felt, self.path.moved, self.blur = known
        return best, None

    def _again_sharp(self, tried: Tried) -> bool:
        """Refit with the corners as they are now; what a wide one gained is no evidence, so that the end counts even
        where it is less probable."""
        self._tell(f"sharper corners: {tried.label}")
        again = self.path.sharper(tried.effects, tried.arrived, self._wide[-1][0])
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

    def rounding_felt(self, effects: Sequence[Addition]) -> float:
        """Chi-squared by which sharper corners of these effects may change it, nan where that is not known; 0 where the
        data do not feel it."""
        if self.path.felt <= FELT or not any(self.path.cornered([one]) for one in effects):
            return 0.0
        tried = self.pool.get(key_of(effects))
        known = self.path.felt
        if math.isnan(known) and tried is not None:
            known = self.path.felt_along(tried.effects, tried.arrived)
        return 0.0 if known <= FELT else known

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
