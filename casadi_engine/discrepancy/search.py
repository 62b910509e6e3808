"""The search for missing effects: screen, refit the best, keep the best by the extended BIC, screen again."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from casadi_engine.discrepancy.assumed_pressure import SCATTER, settle_scatter
from casadi_engine.discrepancy.chi_squared import chi_squared
from casadi_engine.discrepancy.long_run import long_run_noise
from casadi_engine.discrepancy.members import KEEP, members_of
from casadi_engine.discrepancy.noise_choice import NoiseChoice, noise_left
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel, null_model
from casadi_engine.discrepancy.proposals import freed, proposals
from casadi_engine.discrepancy.quick_refit import ShortRefits
from casadi_engine.discrepancy.refit import Addition, Refitter, freedom, merit, whitened_cost
from casadi_engine.discrepancy.repaired import Member, Round
from casadi_engine.discrepancy.screening import Screened, coloured, rescored, whitely
from casadi_engine.discrepancy.selection import (
    Proposal,
    Refit,
    Step,
    effective_samples,
    select,
    selection_frequency,
)
from casadi_engine.discrepancy.trials import Trial, Trials, make_trials, trials_beside
from casadi_engine.distributions import chi2_isf, chi2_sf, normal_sf, t_sf
from casadi_engine.estimation import Fit

__all__ = ["Search", "Station", "members_of", "proposals"]

# Whole refits in a round: of the best trials, so far above the best one at most and so many.
_NEAR, _MOST = 12.0, 3
# Effects whose trial failed though a linearisation beside the best one promises as much: refitted, at most so many.
_DOUBTFUL = 3
# A simpler effect leaves at most this share of what its refinement takes away, to come before it.
_SHAPE = 0.03
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
    _shorts: ShortRefits | None = field(default=None, repr=False)
    _trials: dict[int, tuple[Fit, Trials]] = field(default_factory=dict, repr=False)
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
        has decided so goes on so, or ends: weights by the colour may well drop what it found. On a long record the
        colour waits for that refit: where it leaves white noise, none is needed.
        """
        found = self._scored(fit)
        if found.choice.waits:
            explained = self._explained(fit, effects, found) if len(effects) < self.most else None
            if explained is not None:
                return explained
            begun = time.perf_counter()
            self.tell("the colour of the noise")
            found = coloured(found, fit)
            self._screens[id(fit)] = (fit, found)
            self._spent("score", begun)
        if found.noise.colour and not found.choice.scatter and len(effects) < self.most:
            decided = self._decided(fit, effects, found)
            self._ended = self._equal and decided is None
            self._equal = self._equal or decided is not None
            return decided or found
        return found

    def _explained(self, fit: Fit, effects: tuple[Addition, ...], white: Screened) -> Screened | None:
        """The scores with white noise, if the refit of the best effect leaves white noise: at that level they decide,
        as in ``_decided``."""
        found = self._best_refitted(fit, effects, white)
        if found is None:
            return None
        _, trial = found
        noise = noise_left(null_model(trial), trial.noise, freedom(trial))
        if noise is None:
            return None
        choice = replace(white.choice, noise=noise, messages=(), waits=False)
        count = min(noise.freedom.values(), default=np.inf)
        return _sure(rescored(white, choice), proposals(white)[0], count)

    def _decided(self, fit: Fit, effects: tuple[Addition, ...], found: Screened) -> Screened | None:
        """The scores with equal weights, if they decide."""
        begun = time.perf_counter()
        white = whitely(found, fit)
        self._spent("score", begun)
        refitted = self._best_refitted(fit, effects, white)
        if refitted is None:
            return None
        best, trial = refitted
        picked = proposals(white)
        picked = [*picked, *({best.candidate} - set(picked))]
        noise, count = long_run_noise(white, picked, null_model(trial), freedom(trial))
        if count < 1:
            return None
        return _sure(rescored(white, replace(white.choice, noise=noise, messages=(_LONG,))), picked[0], count)

    def plainly(self, station: Station) -> Station:
        """The station with the scores that hold when no further effect is added: not those with equal weights, whose
        noise was that of a decision for one."""
        if _LONG not in station.screened.choice.messages:
            return station
        return replace(station, screened=self._scored(station.fit))

    def _best_refitted(
        self, fit: Fit, effects: tuple[Addition, ...], white: Screened
    ) -> tuple[Trial, Fit] | None:
        """The best trial beside a fit, and its whole refit; None where nothing is proposed, or it does not converge."""
        if not proposals(white):
            return None
        tried = self._tried(white, fit, effects)
        if not tried.best:
            return None
        best = _leads(tried, white)[0]
        begun = time.perf_counter()
        trial = self._refitted(fit, (*effects, best.added), start=best.short)
        self._spent("refit", begun)
        return (best, trial) if trial.converged else None

    def _scored(self, fit: Fit) -> Screened:
        """The scores of the library against a fit, once."""
        if id(fit) not in self._screens:
            begun = time.perf_counter()
            self.tell("scores of all effects at all ports")
            self._screens[id(fit)] = (fit, self.screen(fit))
            self._spent("score", begun)
        return self._screens[id(fit)][1]

    def _refitted(self, base: Fit, effects: Sequence[Addition], *, start: Any = None) -> Fit:
        """The fit with these effects from another fit, once for the same candidates."""
        key = (id(base), tuple(id(one.candidate) for one in effects))
        if key not in self._fits:
            self.tell(f"refit with {', '.join(one.label for one in effects) or 'no effects'}")
            self._fits[key] = (base, self.refitter(base, effects, start=start))
        return self._fits[key][1]

    def _tried(self, screened: Screened, fit: Fit, effects: tuple[Addition, ...]) -> Trials:
        """Short refits of every effect at every port beside a fit, once."""
        if id(fit) not in self._trials:
            begun = time.perf_counter()
            self.tell("short refits of all effects at all ports")
            if self._shorts is None:
                self._shorts = ShortRefits(self.refitter, _levels(screened, fit))
            self._trials[id(fit)] = (fit, make_trials(screened, fit, effects, self._shorts))
            self._spent("trials", begun)
        return self._trials[id(fit)][1]

    def _spent(self, what: str, begun: float) -> None:
        self.timing[what] = self.timing.get(what, 0.0) + time.perf_counter() - begun

    def _round(self) -> bool:
        """One round; False if it ends the search."""
        here = self.stations[-1]
        screened = here.screened
        picked = proposals(screened)
        if not picked:
            return False
        tried = self._tried(screened, here.fit, here.effects)
        begun = time.perf_counter()
        leads = _leads(tried, screened)
        leads += _doubtful(tried, leads)
        known = {one.label: one for one in here.effects} | {one.added.label: one.added for one in leads}
        starts = {(*(e.label for e in here.effects), one.added.label): one.short for one in leads}
        offers = [
            Proposal(one.added.label, min(screened.pooled(k), _pooled(one, tried, screened)), one.added.drop)
            for one in leads
            for k in [one.candidate]
        ]
        start = Refit(
            tuple(one.label for one in here.effects),
            whitened_cost(here.fit, screened.choice),
            freedom(here.fit),
            state=here.fit,
        )

        def refit(base: Refit[Fit], names: tuple[str, ...]) -> Refit[Fit]:
            assert base.state is not None
            fit = self._refitted(base.state, [known[name] for name in names], start=starts.get(names))
            if not fit.converged or not _worth(base.state, fit, screened):
                return Refit(names, np.inf, freedom(fit), converged=False, state=fit)
            return Refit(names, whitened_cost(fit, screened.choice), freedom(fit), state=fit)

        selection = select(
            start,
            lambda fit: offers if fit is start else (),
            refit,
            alpha=screened.share,
            samples=self._worth_samples(here, leads[0], starts),
            library=int(screened.scores.testable.sum()),
            clusters=len(offers),
            most=len(here.effects) + 1,
        )
        self._spent("refit", begun)
        step = selection.steps[0]
        self.rounds.append(_round_of(offers, step))
        if step.kept is None or step.kept.state is None:
            return False
        kept, fit = step.kept, step.kept.state
        number = {one.added.label: one.candidate for one in tried.best.values()}
        refits = {number[o.effects[-1]]: o.state for o in step.tried if o.converged and o.state is not None}
        effects = tuple(known[name] for name in kept.effects)
        made = self._station(here, fit, effects, number[kept.effects[-1]], refits, tried)
        made = self._by_its_limit(here, made, refits, tried) or made
        if not self._swapped(made):
            self.stations.append(made)
        return True

    def _worth_samples(self, here: Station, first: Trial, starts: Mapping[tuple[str, ...], Any]) -> float:
        """How many independent samples the data are worth: by what the first lead leaves where it leaves less colour,
        as a large effect is no noise."""
        screened, effects = here.screened, (*here.effects, first.added)
        fit = self._refitted(here.fit, effects, start=starts.get(tuple(one.label for one in effects)))
        before = _samples(screened.null, screened.noise)
        return max(before, _samples(null_model(fit), screened.noise)) if fit.converged else before

    def _station(
        self,
        here: Station,
        fit: Fit,
        effects: tuple[Addition, ...],
        lead: int,
        refits: Mapping[int, Fit],
        tried: Trials,
    ) -> Station:
        """A fit with effects, its lead among those screened against ``here``, and the class; refits : of rivals."""
        screened = here.screened
        fit = self._settled(fit)
        after = self._screen(fit, effects)
        begun = time.perf_counter()
        choice = _better_known(screened, after)
        before = whitened_cost(here.fit, choice)
        gains = {k: before - whitened_cost(one, choice) for k, one in refits.items()}
        gains[lead] = max(gains.get(lead, -np.inf), before - whitened_cost(fit, choice))
        gains = _by_trials(tried, screened, lead, gains) | gains
        members, frequency = members_of(screened, lead, gains), _frequency(screened, lead)
        self._spent("certificate", begun)
        return Station(fit, effects, after, lead, members, gains[lead], frequency)

    def _by_its_limit(
        self, here: Station, made: Station, refits: Mapping[int, Fit], tried: Trials
    ) -> Station | None:
        """The station with the simpler effect that the lead becomes at an end of its grid, if the data do not tell
        them apart; or if it takes away nearly all of what the lead does, and the lead leaves what is no noise.

        What the lead's shape is better by may then be of what is missing still: by the principle of marginality (Nelder
        1977) it has to stand as an effect of its own, beside the simpler one and against all others.
        """
        screened = here.screened
        assert made.lead is not None
        one = screened.candidates[made.lead]
        key = (one.source.effect.limit, one.port)
        trial, alike = tried.best.get(key), any((m.name, m.at) == key for m in made.members)
        if trial is None or not (alike or made.screened.leftover.alarms):
            return None
        begun = time.perf_counter()
        effects = (*here.effects, trial.added)
        fit = self._refitted(here.fit, effects, start=trial.short)
        choice = _better_known(screened, made.screened)
        left = whitened_cost(fit, choice) - whitened_cost(made.fit, choice)
        self._spent("refit", begun)
        if not fit.converged or (left > _SHAPE * made.drop and not alike):
            return None
        self.rounds.append(
            Round((), ((trial.added.label, fit.cost, True),), trial.added.label, (made.effects[-1].label,))
        )
        simpler = self._station(here, fit, effects, trial.candidate, {**refits, trial.candidate: fit}, tried)
        # halves that score the refinement best speak for the shape that both share
        return replace(simpler, frequency=made.frequency)

    def _settled(self, fit: Fit) -> Fit:
        """The fit at the scatter of assumed pressures that is likely now: before, that had to stand for the effect."""
        made, _ = settle_scatter(
            fit, fit.parameters, noise=self.refitter.noise, options=self.refitter.options
        )
        if made is not fit:
            pars = self.refitter.parameters.copy()
            pars[SCATTER].set(made.values[SCATTER])
            self.refitter = replace(self.refitter, parameters=pars)
            self._shorts = None  # they hold the old ones
        return made

    def _swapped(self, pair: Station) -> bool:
        """True if one other effect does as well as the last two, which it then replaces.

        Two wrong effects may stand for a right one that was not seen before: it is looked for from the parameters that
        are found with both.
        """
        if len(self.stations) < 2 or self._shorts is None:
            return False
        here, base = self.stations[-1], self.stations[-2]
        if len(pair.effects) != len(base.effects) + 2:
            return False
        begun = time.perf_counter()
        known = self._tried(base.screened, base.fit, base.effects)
        tried = trials_beside(
            known, base.screened, base.fit, base.effects, self._shorts, pair.fit, pair.effects[-2:]
        )
        cost = chi_squared(pair.screened.null, self._shorts.levels)
        others = [one for one in tried.order if one.candidate != here.lead]
        one = others[0] if others else None
        found = None
        if one is not None and one.cost - cost < self._price(pair, base, one):
            effects = (*base.effects, one.added)
            fit = self._refitted(base.fit, effects, start=one.short)
            choice = pair.screened.choice
            rise = whitened_cost(fit, choice) - whitened_cost(pair.fit, choice) if fit.converged else np.inf
            if rise < self._price(pair, base, one):
                found = (fit, effects)
        self._spent("refit", begun)
        if found is None or one is None:
            return False
        made = self._station(base, *found, one.candidate, {one.candidate: found[0]}, tried)
        dropped = tuple(e.label for e in pair.effects[-2:])
        self.rounds.append(Round((), ((one.added.label, found[0].cost, True),), one.added.label, dropped))
        self.stations[-1:] = [made]
        return True

    @staticmethod
    def _price(pair: Station, base: Station, one: Trial) -> float:
        """The rise of chi-squared at which one effect more is worth keeping."""
        more = freedom(pair.fit) - freedom(base.fit) - 1 - freed(base.screened, one.candidate)
        return float(chi2_isf(base.screened.share, max(more, 1)))


def _better_known(before: Screened, after: Screened) -> NoiseChoice:
    """The noise of gains: with the effect in the model it is known better, as a large one leaves more than one step
    explains; but for a colour that only the model with it shows."""
    return after.choice if before.noise.colour or not after.noise.colour else before.choice


def _sure(decided: Screened, first: int, count: float) -> Screened | None:
    """The scores, if the best one is beyond chance for all candidates together at a small part of the library's rate.

    first : the best candidate's number; count : degrees of freedom of the level
    """
    tests = int(decided.scores.testable.sum())
    z = float(decided.scores.statistic[first])
    p = float(t_sf(z, count)) if math.isfinite(count) else float(normal_sf(z))
    return decided if 2 * tests * p <= _ADDED * decided.share and decided.significant else None


def _levels(screened: Screened, fit: Fit) -> dict[str, float]:
    """White levels for short refits: those of the tests where they are white."""
    white = whitely(screened, fit) if screened.noise.colour else screened
    return dict(white.noise.sigma)


def _leads(tried: Trials, screened: Screened) -> list[Trial]:
    """The trials worth a whole refit, the best first: chi-squared and what its nuisance parameters cost."""
    price = math.log(max(_samples(screened.null, screened.noise), 2.0))
    order = sorted(tried.best.values(), key=lambda one: one.cost + price * freed(screened, one.candidate))
    least = order[0].cost if order else 0.0
    return [one for one in order if one.cost <= least + _NEAR][:_MOST] or order[:1]


def _doubtful(tried: Trials, leads: Sequence[Trial]) -> list[Trial]:
    """Further effects that may well be the missing one for all that is known: their trials did not come to an end,
    or not to what the linearisation beside the best one promises, which is about as much as that brings."""
    limit = min((one.cost for one in leads), default=0.0) + 2 * KEEP
    waiting = [one for one in tried.best.values() if one not in leads and not tried.sure(one)]
    waiting.sort(key=tried.least)
    return [one for one in waiting if tried.least(one) <= limit][:_DOUBTFUL]


def _pooled(one: Trial, tried: Trials, screened: Screened) -> float:
    """The p-value of a trial's drop of chi-squared, pooled over the library."""
    drop = max(tried.base - one.cost, 0.0)
    return screened.law.pooled(float(chi2_sf(drop, 1 + freed(screened, one.candidate))))


def _by_trials(tried: Trials, screened: Screened, lead: int, gains: Mapping[int, float]) -> dict[int, float]:
    """The gains of all trials on the scale of the lead's refit; what may gain as much for all that is known does."""
    best = next(one for one in tried.best.values() if one.candidate == lead)
    drop = tried.base - best.cost
    scale = min(gains[lead] / drop, 1.0) if drop > 0 else 1.0
    found = {}
    for one in tried.best.values():
        found[one.candidate] = gains[lead] - scale * (tried.least(one) - best.cost)
    for k in screened.order:  # never tried, since little was promised
        key = screened.candidates[k].key
        if key in tried.foreseen and key not in tried.best:
            found[k] = gains[lead] - scale * (tried.foreseen[key] - best.cost)
    return found


def _worth(base: Fit, fit: Fit, screened: Screened) -> bool:
    """False for an addition that coloured noise makes significant and that closes nothing of the gap itself: the plain
    sum of squares then falls by less than one more number is worth."""
    if not screened.noise.colour or len(fit.free) <= len(base.free):
        return True
    library = max(float(screened.scores.testable.sum()), 1.0)
    gained = (merit(base) - merit(fit)) / max(base.cost / base.n, 1.0)
    return gained > math.log(max(fit.n, 2)) + math.log(library)


def _frequency(screened: Screened, lead: int) -> float | None:
    """How often the lead's effect scores best in half-samples, against the best point of every other effect."""
    best: dict[tuple[str, str], int] = {}
    for k in screened.order:
        best.setdefault(screened.candidates[k].key, k)
    found = selection_frequency(screened.compressed.only(list(best.values())), seed=screened.seed)
    return found.get(screened.candidates[lead].key, 0.0) if found else None


def _samples(null: NullModel, noise: NoiseModel) -> float:
    """The number of independent samples that the residuals are worth."""
    return sum(
        effective_samples(noise.whiten(record, output, e[:, None])[:, 0])
        for record in null.records
        for output, e in record.residual.items()
    )


def _round_of(offers: Sequence[Proposal], step: Step[Any]) -> Round:
    return Round(
        tuple((offer.name, offer.pooled) for offer in offers),
        tuple((one.effects[-1], one.cost, one.converged) for one in step.tried),
        None if step.kept is None else step.kept.effects[-1],
        step.dropped,
    )
