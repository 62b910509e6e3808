"""The search for missing effects: screen, refit the best, keep the best by the extended BIC, screen again."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import stats

from casadi_engine.discrepancy.assumed_pressure import SCATTER, settle_scatter
from casadi_engine.discrepancy.classes import clusters, confusable
from casadi_engine.discrepancy.long_run import long_run_noise
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.discrepancy.refit import Addition, Refitter, addition, freedom, merit, whitened_cost
from casadi_engine.discrepancy.repaired import Member, Round
from casadi_engine.discrepancy.screening import Screened, rescored, whitely
from casadi_engine.discrepancy.selection import (
    Proposal,
    Refit,
    Step,
    effective_samples,
    select,
    selection_frequency,
)
from casadi_engine.estimation import Fit

# Refits in a round: those whose predicted drop is at least this share of the best one's, and at most so many.
_SHARE, _MOST = 0.5, 5
# A member leaves the class when the lead beats it by so much, squared: see ``classes``.
_KEEP = 2.326**2
# Share of the library's false-alarm rate that is added for decisions with equal weights.
_ADDED = 0.1
_LONG = "the residual is coloured: a large effect was decided with equal weights and the colour that its refit leaves"


@dataclass(frozen=True, eq=False)
class Station:
    """A model on the way: its fit, its effects, what was screened against it, and how it was reached.

    lead : the candidate of the round before that was added last; members : its class; drop : of chi-squared by it;
    frequency : share of half-samples in which it scored best
    """

    fit: Fit
    effects: tuple[Addition, ...]
    screened: Screened
    lead: int | None = None
    members: tuple[Member, ...] = ()
    drop: float = 0.0
    frequency: float | None = None


@dataclass
class Search:
    """The rounds of the search, and what they found; ``stations`` begins with the null model."""

    refitter: Refitter
    screen: Callable[[Fit], Screened]
    most: int
    tell: Callable[[str], None]
    stations: list[Station] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    timing: dict[str, float] = field(default_factory=dict)
    _equal: bool = field(default=False, repr=False)
    _ended: bool = field(default=False, repr=False)
    # by identity, with what is identified, so that it stays alive
    _screens: dict[int, tuple[Fit, Screened]] = field(default_factory=dict, repr=False)
    _fits: dict[tuple[int, tuple[int, ...]], tuple[Fit, Fit]] = field(default_factory=dict, repr=False)

    def run(self, null_fit: Fit) -> None:
        """Add effects one by one until none is significant."""
        self.stations = [Station(null_fit, (), self._screen(null_fit, ()))]
        while (
            not self._ended
            and len(self.stations[-1].effects) < self.most
            and len(self.rounds) < 2 * self.most
        ):
            if not self._round():
                return

    def _screen(self, fit: Fit, effects: tuple[Addition, ...]) -> Screened:
        """The scores against a fit; those with white noise where the best of them stands by the colour it leaves.

        A large effect colours the residual of the model that lacks it, and counted as noise it hides itself. So where
        the noise is coloured the best candidates by white noise are proposed; the first is refitted; what its fit
        leaves is the noise, its colour counted along the proposals' directions, and that decides. The decision is at a
        small part of the false-alarm rate for all candidates together, which is added to the library's. A search that
        has decided so goes on so, or ends: weights by the colour may well drop what it found.
        """
        found = self._scored(fit)
        if found.noise.colour and not found.choice.scatter and len(effects) < self.most:
            decided = self._decided(fit, effects, found)
            self._ended = self._equal and decided is None
            self._equal = self._equal or decided is not None
            return decided or found
        return found

    def _decided(self, fit: Fit, effects: tuple[Addition, ...], found: Screened) -> Screened | None:
        """The scores with equal weights, if they decide."""
        begun = time.perf_counter()
        white = whitely(found, fit)
        picked = proposals(white)
        self._spent("score", begun)
        if not picked:
            return None
        begun = time.perf_counter()
        trial = self._refitted(fit, (*effects, _addition_of(white, picked[0])))
        self._spent("refit", begun)
        if not trial.converged:
            return None
        noise, count = long_run_noise(white, picked, null_model(trial), freedom(trial))
        if count < 1:
            return None
        decided = rescored(white, replace(white.choice, noise=noise, messages=(_LONG,)))
        tests = int(decided.scores.testable.sum())
        z = float(decided.scores.statistic[picked[0]])
        sure = 2 * tests * float(stats.t.sf(z, count)) <= _ADDED * decided.share
        return decided if sure and decided.significant else None

    def _scored(self, fit: Fit) -> Screened:
        """The scores of the library against a fit, once."""
        if id(fit) not in self._screens:
            begun = time.perf_counter()
            self.tell("scores of all effects at all ports")
            self._screens[id(fit)] = (fit, self.screen(fit))
            self._spent("score", begun)
        return self._screens[id(fit)][1]

    def _refitted(self, base: Fit, effects: Sequence[Addition]) -> Fit:
        """The fit with these effects from another fit, once for the same candidates."""
        key = (id(base), tuple(id(one.candidate) for one in effects))
        if key not in self._fits:
            self.tell(f"refit with {', '.join(one.label for one in effects) or 'no effects'}")
            self._fits[key] = (base, self.refitter(base, effects))
        return self._fits[key][1]

    def _spent(self, what: str, begun: float) -> None:
        self.timing[what] = self.timing.get(what, 0.0) + time.perf_counter() - begun

    def _round(self) -> bool:
        """One round; False if it ends the search."""
        here = self.stations[-1]
        screened = here.screened
        picked = proposals(screened)
        if not picked:
            return False
        begun = time.perf_counter()
        known = {one.label: one for one in here.effects}
        known |= {(one := _addition_of(screened, k)).label: one for k in picked}
        offers = [
            Proposal(screened.candidates[k].label, screened.pooled(k), float(screened.scores.drop[k]))
            for k in picked
        ]
        start = Refit(
            tuple(one.label for one in here.effects),
            whitened_cost(here.fit, screened.choice),
            freedom(here.fit),
            state=here.fit,
        )

        def refit(base: Refit[Fit], names: tuple[str, ...]) -> Refit[Fit]:
            assert base.state is not None
            fit = self._refitted(base.state, [known[name] for name in names])
            if not fit.converged or not _worth(base.state, fit, screened):
                return Refit(names, np.inf, freedom(fit), converged=False, state=fit)
            return Refit(names, whitened_cost(fit, screened.choice), freedom(fit), state=fit)

        selection = select(
            start,
            lambda fit: offers if fit is start else (),
            refit,
            alpha=screened.share,
            samples=_samples(screened),
            library=int(screened.scores.testable.sum()),
            clusters=_MOST,
            most=len(here.effects) + 1,
        )
        self._spent("refit", begun)
        step = selection.steps[0]
        self.rounds.append(_round_of(offers, step))
        if step.kept is None or step.kept.state is None:
            return False
        self._advance(here, step, picked, known)
        return True

    def _advance(
        self, here: Station, step: Step[Fit], picked: Sequence[int], known: Mapping[str, Addition]
    ) -> None:
        kept = step.kept
        assert kept is not None
        assert kept.state is not None
        screened = here.screened
        lead = next(k for k in picked if screened.candidates[k].label == kept.effects[-1])
        effects = tuple(known[name] for name in kept.effects)
        fit = self._settled(kept.state)
        after = self._screen(fit, effects)
        begun = time.perf_counter()
        # with the effect in the model its noise is known better: a large effect leaves more than one step explains
        choice = after.choice if screened.noise.colour or not after.noise.colour else screened.choice
        before = whitened_cost(here.fit, choice)
        gains: dict[int, float] = {}
        for one in (*step.tried, kept):
            if one.converged and one.state is not None:
                k = next(k for k in picked if screened.candidates[k].label == one.effects[-1])
                gains[k] = max(gains.get(k, 0.0), before - whitened_cost(one.state, choice))
        members, frequency = members_of(screened, lead, gains), _frequency(screened, lead)
        self._spent("certificate", begun)
        self.stations.append(Station(fit, effects, after, lead, members, gains[lead], frequency))

    def _settled(self, fit: Fit) -> Fit:
        """The fit at the scatter of assumed pressures that is likely now: before, that had to stand for the effect."""
        made, _ = settle_scatter(
            fit, fit.parameters, noise=self.refitter.noise, options=self.refitter.options
        )
        if made is not fit:
            pars = self.refitter.parameters.copy()
            pars[SCATTER].set(made.values[SCATTER])
            self.refitter = replace(self.refitter, parameters=pars)
        return made


def _addition_of(screened: Screened, k: int) -> Addition:
    """A candidate to be added, from its score."""
    scores = screened.scores
    return addition(screened.candidates[k], float(scores.amplitude[k]), float(scores.drop[k]))


def proposals(screened: Screened) -> list[int]:
    """The candidates worth a refit: significant, one of each effect at each port, none that is another one's row.

    Of several names of one row the one with the fewest nuisance parameters stands for all.
    """
    found: list[int] = []
    taken: set[tuple[str, str]] = set()
    rows = clusters(screened.scores)
    home = {k: number for number, row in enumerate(rows) for k in row}
    used: set[int] = set()
    drop = screened.scores.drop
    for first in screened.significant:
        alike = [k for k in rows[home[first]] if drop[k] > drop[first] - 0.5 * _KEEP]
        k = min(alike, key=lambda k: (_freed(screened, k), screened.candidates[k].key in taken, -drop[k]))
        key = screened.candidates[k].key
        if key in taken or home[k] in used or (found and drop[k] < _SHARE * drop[found[0]]):
            continue
        found.append(k)
        taken.add(key)
        used.add(home[k])
    return found[:_MOST]


def members_of(screened: Screened, lead: int, gains: Mapping[int, float]) -> tuple[Member, ...]:
    """The class of the lead: all effects that the data do not exclude beside it.

    gains : candidate -> drop of chi-squared of its refit. Candidates without a refit are taken to gain in the share in
    which the lead's refit differs from its prediction.
    """
    scores, drop = screened.scores, screened.scores.drop
    ratio = gains[lead] / drop[lead] if drop[lead] > 0 else 1.0
    # what no refit has shown, or whose refit failed, does not put the lead out of its own class
    gain = {k: min(float(ratio * drop[k]), gains[lead]) for k in range(len(drop))}
    for tried, value in gains.items():
        # an estimated nuisance fits some noise: one unit of chi-squared each
        own = value - _freed(screened, tried)
        for k, candidate in enumerate(screened.candidates):
            if candidate.key == screened.candidates[tried].key:
                gain[k] = own if k == tried else min(gain[k], own - 1e-9)
    gain[lead] = max(gain[lead], max(gain[k] for k in gains))
    found: list[Member] = []
    for member in confusable(scores, gain=gain):
        names = [k for k in member.names if k == lead or gain[lead] - gain[k] <= _KEEP]
        for k in names:
            candidate = screened.candidates[k]
            rho = float(scores.correlation[lead, k])
            found.append(Member(candidate.effect, candidate.port, rho, member.probability / len(names)))
    key = screened.candidates[lead].key
    found.sort(key=lambda m: ((m.name, m.at) != key, -m.probability))
    total = sum(m.probability for m in found)
    return tuple(Member(m.name, m.at, m.rho, m.probability / total) for m in found)


def _worth(base: Fit, fit: Fit, screened: Screened) -> bool:
    """False for an addition that coloured noise makes significant and that closes nothing of the gap itself: the plain
    sum of squares then falls by less than one more number is worth."""
    if not screened.noise.colour or len(fit.free) <= len(base.free):
        return True
    library = max(float(screened.scores.testable.sum()), 1.0)
    gained = (merit(base) - merit(fit)) / max(base.cost / base.n, 1.0)
    return gained > math.log(max(fit.n, 2)) + math.log(library)


def _freed(screened: Screened, k: int) -> int:
    """How many nuisance parameters of a candidate a refit estimates."""
    grids = screened.candidates[k].source.effect.nuisance.values()
    return sum(not grid.whole for grid in grids)


def _frequency(screened: Screened, lead: int) -> float | None:
    """How often the lead's effect scores best in half-samples, against the best point of every other effect."""
    best: dict[tuple[str, str], int] = {}
    for k in screened.order:
        best.setdefault(screened.candidates[k].key, k)
    found = selection_frequency(screened.compressed.only(list(best.values())), seed=screened.seed)
    return found.get(screened.candidates[lead].key, 0.0) if found else None


def _samples(screened: Screened) -> float:
    """The number of independent samples that the residuals are worth."""
    return sum(
        effective_samples(screened.noise.whiten(record, output, e[:, None])[:, 0])
        for record in screened.null.records
        for output, e in record.residual.items()
    )


def _round_of(offers: Sequence[Proposal], step: Step[Any]) -> Round:
    return Round(
        tuple((offer.name, offer.pooled) for offer in offers),
        tuple((one.effects[-1], one.cost, one.converged) for one in step.tried),
        None if step.kept is None else step.kept.effects[-1],
        step.dropped,
    )
