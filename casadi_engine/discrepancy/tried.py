"""A structure that was refitted, and how probable it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from casadi_engine.discrepancy.arrived import Arrived
from casadi_engine.discrepancy.evidence import FACTOR, Digest, Evidence, Levels, evidence
from casadi_engine.discrepancy.gradual import Gradual
from casadi_engine.discrepancy.late_samples import Samples
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.path import Form, form_of
from casadi_engine.discrepancy.refit import Addition

# Standard errors, all else known, from which an amplitude is there at all, however much a refit with it gained.
THERE = 1.0
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
    def form(self) -> Form:
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
        if without is None or not math.isfinite(size) or there < THERE:
            return size
        gain = 2 * (self.counted - without.counted) if self.own is not None else 0.0
        drop = math.sqrt(max(without.evidence.cost - self.evidence.cost, gain, 0.0))
        return drop if drop > _ELSEWHERE * size else size


def key_of(effects: Sequence[Addition]) -> Key:
    """Effects and ports, in no order."""
    return frozenset(one.candidate.key for one in effects)
