"""Functions of one signal that stand in the equations, refitted each once: over windows so short that the measurement
leads, and the best of them over windows that grow to the whole record.

Some need a hundred times the work of others, as what they stand for moves nothing over short windows, or makes the
equations stiff: where one explains more than chance, that is enough to show the way, and the rest waits for the answer.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace

import numpy as np

from casadi_engine.deadline import Deadline, TimeUp, ask
from casadi_engine.discrepancy.evidence import (
    FACTOR,
    Digest,
    Levels,
    Prior,
    digest,
    evidence,
    levels_left,
)
from casadi_engine.discrepancy.law_rival import SIZES, of_size
from casadi_engine.discrepancy.law_setups import TERMS, Setup, setups_at, setups_elsewhere
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.priors import priors_of
from casadi_engine.discrepancy.random_families import LINKS, Family
from casadi_engine.discrepancy.refit_null import null_of_refit
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.tried import Key, Tried
from casadi_engine.estimation.refit_answer import Refit
from casadi_engine.estimation.refit_problem import TIME_UP, RefitProblem
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters

# Steps over a horizon, and over one of the short ones.
_STEPS, _FEW = 30, 12
# Horizons over which every function is refitted.
_SHORT = 3
# Shares of the work that a refit may cost, the second where with the first no function is better than chance, or all
# are to have it.
_SHARES = 1 / 8, 1.0
# A function follows the motion whose residual over short windows is no larger than so many times the noise.
_FOLLOWS = 2.0
# Costs that are one but for rounding: of the same function at a port that knows its signal by another name.
_SAME = 1e-6


@dataclass(frozen=True, eq=False)
class Begun:
    """A function that was refitted over short windows; elsewhere : its port does not know its signal."""

    setup: Setup
    problem: RefitProblem
    found: Refit
    elsewhere: bool = False

    @property
    def at(self) -> tuple[str, str]:
        """Its port and its signal."""
        return self.setup.at

    @property
    def follows(self) -> bool:
        """True where it leaves little more than the noise over short windows."""
        return self.found.cost <= _FOLLOWS**2 * self.problem.count

    def is_again(self, others: Sequence[Begun]) -> bool:
        """True if one of the others is the same function."""
        own = self.found.cost
        return any(abs(own - one.found.cost) <= _SAME * own for one in others)


@dataclass(frozen=True, eq=False)
class Whole:
    """A function whose refit arrived on the whole record, and what its evidence is counted from."""

    setup: Setup
    found: Refit
    null: NullModel
    made: Digest


@dataclass(frozen=True, eq=False)
class Followed:
    """A function whose refit arrived on the whole record: what its evidence is counted from, the noise it leaves."""

    setup: Setup
    null: NullModel
    made: Digest
    levels: Levels

    @property
    def left(self) -> float:
        """How much it leaves: the logarithm of the residual's size, over all samples."""
        squares: dict[str, float] = {}
        counts: dict[str, int] = {}
        for record in self.null.records:
            for output, e in record.residual.items():
                squares[output] = squares.get(output, 0.0) + float(e @ e)
                counts[output] = counts.get(output, 0) + len(e)
        return sum(0.5 * n * math.log(max(squares[output] / n, 1e-300)) for output, n in counts.items() if n)

    def log(self, levels: Levels) -> tuple[float, Digest]:
        """Log evidence averaged over the function's size, and what it is counted from at the size that serves best."""
        logs = [evidence(of_size(self.made, self.setup.terms, share), levels).log for share in SIZES]
        best = of_size(self.made, self.setup.terms, SIZES[int(np.argmax(logs))])
        return float(np.logaddexp.reduce(logs)) - math.log(len(SIZES)), best


@dataclass
class Race:
    """What was refitted so far: functions over short windows and on the whole record, and those that failed there; and
    what models without a function leave over short windows."""

    setups: list[Setup] | None = None
    begun: dict[tuple[str, str], Begun] = field(default_factory=dict)
    elsewhere: dict[tuple[str, str], list[Setup]] = field(default_factory=dict)
    whole: dict[tuple[str, str], Whole | None] = field(default_factory=dict)
    failed: set[tuple[str, str]] = field(default_factory=set)
    share: float = 0.0  # of the work that each may cost, so far
    plain: dict[Key, tuple[float, int]] = field(default_factory=dict)
    wide: Refits | None = None  # with fresh data too, see ``law_on_fresh``

    @classmethod
    def of(cls, refits: Refits) -> Race:
        """That of some refits."""
        refits.race = refits.race or cls()
        race: Race = refits.race
        return race


def raced(
    refits: Refits, others: Sequence[Family] = (), *, thorough: bool = False
) -> tuple[list[Begun], int]:
    """The functions over short windows, the one that leaves least first, and among how many they are.

    others : of what the signals of their port do not say; thorough : give each all of its work, as far as the time
    allows, where one is better than chance too
    """
    race, none = Race.of(refits), refits.pool[frozenset()]
    if race.setups is None:
        ports = refits.refitter.model.ports
        between = ports.links if len(ports.links) <= LINKS else ()
        race.setups = [one for port in (*ports, *between) for one in setups_at(refits, none, port)]
    own = {one.at: one for one in race.setups}
    far = [one for one in others if (one.port, one.signal) not in own]
    further = {made.at: made for one in far for made in _elsewhere(refits, none, one)}
    every = further | own
    good = chance(refits, none, len(every)) if every else 0.0
    first, whole = _SHARES
    if race.share < whole:
        race.share = max(race.share, first)
        _through(refits, none, every, further, first)
    lost = min((race.begun[at].found.cost for at in every if at in race.begun), default=math.inf) > good
    if lost or thorough:
        race.share = whole
        with nullcontext() if lost else suppress(TimeUp):
            _through(refits, none, every, further, whole)
    found = [race.begun[at] for at in every if at in race.begun]
    return sorted(found, key=lambda one: one.found.cost), len(every)


def _elsewhere(refits: Refits, none: Tried, family: Family) -> list[Setup]:
    """See ``setups_elsewhere``; each is made once."""
    race, at = Race.of(refits), (family.port, family.signal)
    if at not in race.elsewhere:
        race.elsewhere[at] = setups_elsewhere(refits, none, family)
    return race.elsewhere[at]


def _through(
    refits: Refits,
    none: Tried,
    setups: Mapping[tuple[str, str], Setup],
    further: Container[tuple[str, str]],
    share: float,
) -> None:
    """Refit functions over short windows that were not yet, with a share of the work that each may cost."""
    race = Race.of(refits)
    for at, setup in setups.items():
        if at in race.begun or at in race.failed:
            continue
        try:
            found = short(refits, none, setup.model, setup.parameters, share)
        except TimeUp:
            ask()  # all of the time, or the work that this one may have so far
            if share >= 1:
                race.failed.add(at)
            continue
        if found is None:
            race.failed.add(at)
        else:
            race.begun[at] = Begun(setup, *found, elsewhere=at in further)


def chance(refits: Refits, tried: Tried, many: int) -> float:
    """Chi-squared over the short windows below which a function leaves less than chance does of what the structure
    itself leaves there: a law that moves nothing over these is near enough to be seen along the simulation.

    many : functions that are looked at
    """
    cost, count = plain(refits, tried)
    return cost * math.exp(-(TERMS + 2 * math.log(FACTOR * many)) / count)


def tells(refits: Refits, tried: Tried) -> bool:
    """True if a structure itself leaves more than noise over the short windows, so that they tell functions apart."""
    cost, count = plain(refits, tried)
    return cost > _FOLLOWS**2 * count


def plain(refits: Refits, tried: Tried) -> tuple[float, int]:
    """Chi-squared that a structure leaves over the short windows, inf where it has no refit there, and its samples."""
    known = Race.of(refits).plain
    if tried.key not in known:
        model = refits.refitter.extended(tried.effects)
        parameters = refits.refitter.parameters_of(model, tried.effects).unconstrained()
        try:
            found = short(refits, tried, model, parameters)
        except TimeUp:
            ask()
            found = None
        known[tried.key] = (math.inf, 1) if found is None else (found[1].cost, max(found[0].count, 1))
    return known[tried.key]


def short(
    refits: Refits, tried: Tried, model: Model, parameters: Parameters, share: float = 1.0
) -> tuple[RefitProblem, Refit] | None:
    """A model refitted over windows so short that the measurement leads, whatever the law; None where that fails.

    share : of the work that it may cost. TimeUp where that is not enough.
    """
    ask()
    refitter = refits.refitter
    try:
        with np.errstate(all="ignore"):
            problem = RefitProblem(
                model,
                refitter.data,
                parameters,
                levels=refits.path.levels,
                interval=refitter.interval,
            )
            horizons = _horizons(problem)[:_SHORT]
            with Deadline(work=share * refits.path.allowed(problem)):
                found = problem.run(start=tried.arrived.values, horizons=horizons, most=_FEW)
    except FAILURES:
        return None
    if share < 1 and found.status == TIME_UP:
        raise TimeUp
    return (problem, found) if found.initial and math.isfinite(found.cost) else None


def followed(refits: Refits, one: Begun) -> Followed | None:
    """A function after windows that grow to the whole record; None where it does not arrive there."""
    whole = Race.of(refits).whole
    if one.at not in whole:
        whole[one.at] = _followed(refits, one)
    found = whole[one.at]
    if found is None:
        return None
    levels = levels_left(found.null, refits.known, refits.levels.scatter, None)
    return Followed(found.setup, found.null, found.made, levels)


def _followed(refits: Refits, one: Begun) -> Whole | None:
    ask()
    try:
        with np.errstate(all="ignore"):
            longer = _horizons(one.problem)[_SHORT:] or [None]
            with Deadline(work=refits.path.allowed(one.problem)):
                found = one.problem.run(warm=one.found, horizons=longer, most=_STEPS)
            if not found.initial or not math.isfinite(found.cost):
                return None
            null = null_of_refit(
                one.setup.model, one.setup.parameters, one.problem, found, refits.path.levels
            )
            return Whole(one.setup, found, null, _counted(null, one.setup))
    except FAILURES:
        return None
    except TimeUp:
        ask()
        return None


def _horizons(problem: RefitProblem) -> list[float | None]:
    """Windows from one interval on that double, and the whole record: a law far from the motion so far leads astray
    over windows that grow faster."""
    lengths = [(record.grid.step * record.plan.length, record.plan.m) for record in problem.records]
    shortest, most = min(length for length, _ in lengths), max(m for _, m in lengths)
    return [*(shortest * 2.0**k for k in range(math.ceil(math.log2(max(most, 2))))), None]


def _counted(null: NullModel, setup: Setup) -> Digest:
    """What the evidence is counted from, with the function's prior at its largest."""
    mine = [null.parameters.index(name) for name in setup.terms]
    prior = null.prior
    if len(prior):  # those of the terms are counted by size
        moved = np.abs(prior[:, :-1] @ null.turn[mine].T).max(axis=1, initial=0.0)
        prior = prior[moved == 0]
    priors = priors_of(null, setup.parameters, ())
    priors |= {n: Prior(float(d)) for n, d in zip(setup.terms, setup.deviations, strict=True)}
    made = digest(replace(null, prior=prior), priors)
    rows = made.prior.copy()
    rows[mine, -1] = -null.values[mine] / setup.deviations  # around zero, not around what was found
    return replace(made, prior=rows)
