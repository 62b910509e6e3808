"""Trials: a short refit of every effect at every port, from several starts, where something is missing.

The scores at the optimum without effects propose what a small effect would do. A large one has moved the parameters
far, and what it would explain is seen from elsewhere: from the parameters' own start values, and from the optimum of
the best effect so far, whose parameters are near the true ones if it is only alike. At each of these points all
candidates are linearised with all parameters free (a Gauss-Newton step of every extended model at once), which chooses
their nuisance values and amplitudes; short refits do the rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from casadi_engine.discrepancy.chi_squared import chi_squared
from casadi_engine.discrepancy.compression import candidate_columns, compress
from casadi_engine.discrepancy.linear_algebra import Array, basis, without
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel, null_at
from casadi_engine.discrepancy.quick_refit import Short, ShortRefits
from casadi_engine.discrepancy.refit import Addition, addition
from casadi_engine.discrepancy.score import scores_of
from casadi_engine.discrepancy.screening import Screened
from casadi_engine.discrepancy.start import Start
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Fit

# Steps of a short refit, and of one that goes on.
_STEPS, _MORE = 8, 16
# Amplitude from which a candidate starts that has the forbidden sign, in its standard errors.
_SMALL = 3.0
# Short refits that have not settled go on, the best first, at most so many.
_UNSETTLED = 6
# Chi-squared this many standard deviations above the number of samples is not noise alone: then the optimum without
# effects is no place to look from, and the parameters' own values are tried too.
_UNUSUAL = 3.0
# From the optimum without effects those are tried whose predicted drop is at least this share of the best one's.
_PART = 0.25
# Where the best trial explains everything so many are tried from the parameters' own values.
_FEW = 8
# Least share of what the best explains that its slope must take away, for what others promise in its place to count.
_BENT = 0.8
# With long records so many rivals in a row that gain no more than was promised, but for this share of what they are
# behind, show that promises are kept: those that promise less are not tried.
_BEYOND = 0.1
# Times that the best trial may change while its rivals are tried in its place.
_AGAIN = 3
# A trial that ended so far above what was promised beside the best one may have ended elsewhere.
_SURE = 3.0
# How far above the best trial a linearised candidate may foresee its chi-squared to be tried from there: of what the
# best explains, and at least.
_SHARE, _NEAR = 0.1, 30.0
# The same share with long records where the best explains everything: a linearisation that is so far off is rare, and a
# trial is dear.
_SURER = 0.02


@dataclass(frozen=True, eq=False)
class Trial:
    """The best short refit of an effect at a port; candidate : its number among those screened."""

    candidate: int
    added: Addition
    short: Short

    @property
    def cost(self) -> float:
        """Chi-squared with priors, white noise."""
        return self.short.cost


@dataclass(frozen=True, eq=False)
class Foreseen:
    """What a linearisation promises: chi-squared (k,) with each candidate, its amplitude (k,); none : without any."""

    cost: Array
    amplitude: Array
    none: float


@dataclass(frozen=True, eq=False)
class Trials:
    """The trials of one round: (effect, port) -> Trial; base : chi-squared without any of them, at the same levels.

    foreseen : (effect, port) -> the least chi-squared that a linearisation beside the best trial promises
    """

    best: Mapping[tuple[str, str], Trial]
    base: float
    foreseen: Mapping[tuple[str, str], float] = field(default_factory=dict)

    @property
    def order(self) -> list[Trial]:
        """By rising chi-squared."""
        return sorted(self.best.values(), key=lambda one: one.cost)

    def sure(self, one: Trial) -> bool:
        """True if a trial came to an end, and to no worse a one than was promised."""
        promised = self.foreseen.get(one.added.candidate.key, math.inf)
        return one.short.settled and one.cost <= promised + _SURE

    def least(self, one: Trial) -> float:
        """The least chi-squared that an effect may have for all that is known: its trial's, or what was promised."""
        return (
            one.cost
            if self.sure(one)
            else min(one.cost, self.foreseen.get(one.added.candidate.key, math.inf))
        )


def make_trials(screened: Screened, fit: Fit, effects: Sequence[Addition], shorts: ShortRefits) -> Trials:
    """Short refits of every testable effect at every port beside ``effects``, which the fit has.

    screened : scores against the fit
    """
    base = chi_squared(screened.null, shorts.levels)
    made = _Maker(screened, fit, tuple(effects), shorts, base)
    scores = screened.scores
    here = Foreseen(base - scores.drop, scores.amplitude, base)
    # with long records what explains everything is soon found from where parameters are not at bounds, and its rivals
    # from there: an optimum at bounds is then no place to start from
    ahead = shorts.long and driven(fit)
    if ahead:
        made.from_own_values()
    if not (ahead and made.explained):
        made.try_all(here, fit, most=base - _PART * float(scores.drop.max(initial=0.0)))
    if not ahead and (driven(fit) or not made.explained):
        made.from_own_values()
    made.go_on()
    made.beside_best()
    return Trials(made.best, base, made.promised)


def trials_beside(
    known: Trials,
    screened: Screened,
    fit: Fit,
    effects: Sequence[Addition],
    shorts: ShortRefits,
    point: Fit,
    added: Sequence[Addition],
) -> Trials:
    """The trials of a fit, and those in the place of several effects more; point : the fit with these, ``added``."""
    made = _Maker(screened, fit, tuple(effects), shorts, known.base)
    made.best, made.promised = dict(known.best), dict(known.foreseen)
    first = {r: np.array([state.value for state in own.values()]) for r, own in point.initial.items()}
    null = null_at(point.model, point.data, point.parameters, point.z, first)
    made.beside(null, point.values, added, chi_squared(null, shorts.levels))
    return Trials(made.best, known.base, made.promised)


def driven(fit: Fit) -> bool:
    """True if an estimate is at a bound."""
    return any(fit.estimates[name].at_bound is not False for name in fit.free)


class _Maker:
    """The trials so far."""

    def __init__(
        self, screened: Screened, fit: Fit, effects: tuple[Addition, ...], shorts: ShortRefits, base: float
    ) -> None:
        self.screened, self.fit, self.effects, self.shorts = screened, fit, effects, shorts
        self.best: dict[tuple[str, str], Trial] = {}
        self.promised: dict[tuple[str, str], float] = {}
        self.base = base
        self.families: dict[tuple[str, str], list[int]] = {}
        for k in screened.order:
            self.families.setdefault(screened.candidates[k].key, []).append(k)

    def own_values(self) -> Array:
        """(nz,) the parameters' own values, the earlier effects' as they were found."""
        own = self.shorts.refitter.parameters
        free, values = self.fit.free, self.fit.values
        return np.array([float(own[n].value) if n in own else values[n] for n in free])

    @property
    def explained(self) -> bool:
        """True if the best trial leaves no more than noise."""
        count = self.screened.null.count
        least = min((one.cost for one in self.best.values()), default=math.inf)
        return least <= count + _UNUSUAL * math.sqrt(2 * count)

    def from_own_values(self) -> None:
        """Short refits from the parameters' own values: of few effects where one explains everything already."""
        start = self.foreseen(self.own_values(), self.shorts.first_states(self.effects))
        if start is not None:
            self.try_all(start, None, few=_FEW if self.explained else None)

    def try_all(self, seen: Foreseen, warm: Any, *, most: float = np.inf, few: int | None = None) -> None:
        """A short refit of every effect at every port that promises chi-squared up to ``most``, from the point at which
        ``seen`` was linearised; few : of so many that promise most.

        With long records the few are enough as soon as one explains everything: rivals are tried in its place."""
        best = {key: min(members, key=lambda k: seen.cost[k]) for key, members in self.families.items()}
        order = sorted(best.items(), key=lambda pair: seen.cost[pair[1]])[:few]
        for number, (key, k) in enumerate(order):
            if seen.cost[k] > most or (self.shorts.long and number >= _FEW and self.explained):
                return
            self._try(key, self._added(k, seen), warm, _STEPS)

    def _added(self, k: int, seen: Foreseen) -> tuple[int, Addition]:
        scores, candidate = self.screened.scores, self.screened.candidates[k]
        size = float(seen.amplitude[k])
        if size * candidate.side < 0 or size == 0:
            size = _SMALL * float(scores.error[k]) * (candidate.side or 1)
        return k, addition(candidate, size, float(scores.drop[k]))

    def _try(self, key: tuple[str, str], chosen: tuple[int, Addition], warm: Any, steps: int) -> None:
        k, added = chosen
        short = self.shorts((*self.effects, added), warm, steps, worst=self.base)
        if short is not None and (key not in self.best or short.cost < self.best[key].cost):
            self.best[key] = Trial(k, added, short)

    def go_on(self) -> None:
        """More steps for the best that have not settled."""
        order = sorted(self.best.values(), key=lambda t: t.cost)
        far = self.base
        if self.explained:
            far = order[0].cost + _PART * (self.base - order[0].cost)
        waiting = [t for t in order if not t.short.settled and t.cost < far]
        for trial in waiting[:_UNSETTLED]:
            key = trial.added.candidate.key
            short = self.shorts((*self.effects, trial.added), trial.short, _MORE)
            if short is not None and (short.cost <= trial.cost or short.settled):
                self.best[key] = replace(trial, short=min(short, trial.short, key=lambda s: s.cost))

    def beside_best(self) -> None:
        """Those that could explain as much as the best, from its parameters; again where that finds a better one."""
        for _ in range(_AGAIN):
            best = min(self.best.values(), key=lambda t: t.cost, default=None)
            if best is None:
                return
            try:
                null = self.shorts.null_at((*self.effects, best.added), best.short)
            except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
                return
            self.beside(null, best.short.values, [best.added], best.cost)
            if min(one.cost for one in self.best.values()) > best.cost - _SURE:
                return

    def beside(
        self,
        null: NullModel,
        values: Mapping[str, float],
        added: Sequence[Addition],
        cost: float,
    ) -> None:
        """Those that could explain as much as the effects ``added``, from the parameters found with these.

        null : the model with them, linearised; values : its parameters; cost : its chi-squared
        """
        done = added[0].candidate.key if len(added) == 1 else None
        self.promised.clear()
        rest, least = self._in_place_of(null, added), cost + _BENT * (self.base - cost)
        bends = rest is not None and self._none(rest) < least
        seen = None if rest is None or bends else self._linearised(rest)
        if seen is None:
            # a law that bends: its slope takes away less than it explains, and promises all others too much
            z = np.array([values.get(n, v) for n, v in zip(self.fit.free, self.fit.z, strict=True)])
            seen = self.foreseen(z, {record.name: record.path.x[:, 0] for record in null.records})
            if seen is None and rest is not None and bends:
                seen = self._linearised(rest)
        if seen is None:
            return
        warm = Start({name: values[name] for name in self.fit.free if name in values})
        if seen.none < least:
            self._unsettled_from(seen, warm, done)
            return
        quick = self.shorts.long and self.explained
        close = cost + max(_NEAR, (_SURER if quick else _SHARE) * (self.base - cost))
        best = {key: min(members, key=lambda k: seen.cost[k]) for key, members in self.families.items()}
        self.promised |= {key: float(seen.cost[k]) for key, k in best.items()}
        kept = 0
        for key, k in sorted(best.items(), key=lambda pair: seen.cost[pair[1]]):
            promised, known = float(seen.cost[k]), self.best.get(key)
            if promised > close or (quick and kept >= _FEW and promised > cost + _NEAR):
                return
            if key == done:
                continue
            if known is None or known.cost >= promised + _SURE or not known.short.settled:
                self._try(key, self._added(k, seen), warm, _STEPS + _MORE)
                known = self.best.get(key)
            # a promise that was kept: no more was gained than a small part of the way to the best
            exact = known is not None and known.cost >= promised - max(_SURE, _BEYOND * (promised - cost))
            kept = kept + 1 if exact else 0

    def _unsettled_from(self, seen: Foreseen, warm: Start, done: tuple[str, str] | None) -> None:
        """Where a linearisation promises all too much, no promise counts: those are tried from there whose trials have
        not come to an end, the most promising first."""
        best = {key: min(members, key=lambda k: seen.cost[k]) for key, members in self.families.items()}
        waiting = [
            (key, k)
            for key, k in sorted(best.items(), key=lambda pair: seen.cost[pair[1]])
            if key != done and not (key in self.best and self.best[key].short.settled)
        ]
        for key, k in waiting[:_UNSETTLED]:
            self._try(key, self._added(k, seen), warm, _STEPS + _MORE)
        self._siblings()

    def _siblings(self) -> None:
        """The effects that explain as much as the best at one port are tried at their other ports from there."""
        least = min(one.cost for one in self.best.values())
        for key, members in self.families.items():
            known = self.best.get(key)
            others = [
                one for one in self.best.values()
                if one.added.candidate.effect == key[0] and one.cost <= least + _NEAR
            ]  # fmt: skip
            if not others or (known is not None and known.cost <= least + _NEAR):
                continue
            one = min(others, key=lambda t: t.cost)
            nuisance = one.added.candidate.nuisance
            k = next((k for k in members if self.screened.candidates[k].nuisance == nuisance), members[0])
            alike = math.copysign(1.0, float(self.screened.scores.correlation[k, one.candidate]))
            size = alike * one.short.values[one.added.amplitude]
            made = addition(self.screened.candidates[k], size, float(self.screened.scores.drop[k]))
            values = {name: one.short.values[name] for name in self.fit.free if name in one.short.values}
            own = f"{one.added.key}."
            values |= {
                f"{made.key}.{name.removeprefix(own)}": value
                for name, value in one.short.values.items()
                if name.startswith(own) and name != one.added.amplitude
            }
            self._try(key, (k, made), Start(values), _STEPS + _MORE)

    def foreseen(self, z: Array, first: Mapping[str, Array]) -> Foreseen | None:
        """All candidates linearised at z : (nz,) and first states record -> (n,), without them there."""
        try:
            with np.errstate(all="ignore"):
                null = null_at(self.fit.model, self.fit.data, self.fit.parameters, z, first)
        except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
            return None
        return self._linearised(null)

    def _in_place_of(self, null: NullModel, added: Sequence[Addition]) -> NullModel | None:
        """The model linearised where the added effects are, without them: each candidate is to take their place.

        What the added amplitudes do to the outputs is to be explained along with the residual, by the others' slopes.
        """
        size = np.diag(null.turn)
        plain = null.turn.shape == (len(null.values),) * 2 and np.array_equal(null.turn, np.diag(size))
        if not plain or len(null.model.states) != len(self.fit.model.states):
            return None
        stems, amplitudes = tuple(f"{one.key}." for one in added), {one.amplitude for one in added}
        names = [name.partition("@")[0] for name in null.parameters]
        gone = [k for k, name in enumerate(names) if name.startswith(stems)]
        # a nuisance value moves nothing once its effect is gone; an amplitude goes to zero
        zero = [k for k in gone if names[k] in amplitudes]
        records = []
        for record in null.records:
            slopes, residual = {}, {}
            for output, own in record.slopes.items():
                residual[output] = record.residual[output] + own[:, zero] @ (null.values[zero] / size[zero])
                slopes[output] = np.delete(own, gone, axis=1)
            records.append(replace(record, slopes=slopes, residual=residual))
        return replace(
            null,
            turn=np.delete(null.turn, gone, axis=1),
            prior=np.delete(null.prior, gone, axis=1),
            records=tuple(records),
        )

    def _none(self, null: NullModel) -> float:
        """Chi-squared that is left without any candidate."""
        reduced = compress(null, (), NoiseModel(self.shorts.levels)).reduced()
        n = reduced.parameters
        return float((without(basis(reduced.rows[:, :n]), reduced.rows[:, n:]) ** 2).sum())

    def _linearised(self, null: NullModel) -> Foreseen | None:
        """All candidates linearised along a model; None where that fails."""
        try:
            with np.errstate(all="ignore"):
                columns = {r.name: candidate_columns(r, self.screened.candidates) for r in null.records}
        except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
            return None
        if not all(np.isfinite(part).all() for own in columns.values() for part in own.values()):
            return None
        noise = NoiseModel(self.shorts.levels)
        reduced = compress(null, self.screened.candidates, noise, columns=columns).reduced()
        scores = scores_of(reduced, self.screened.candidates, null.turn)
        n = reduced.parameters
        left = without(basis(reduced.rows[:, :n]), reduced.rows[:, -1:])
        none = float((left**2).sum())
        return Foreseen(none - scores.drop, scores.amplitude, none)
