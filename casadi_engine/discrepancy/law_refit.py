"""An unknown law far from the model without it: a function of one signal at one port as a part of the equations.

Where a law is large, the model without it is far from the motion that was measured, and nothing that is linearised
along its simulation sees what is missing: the residual looks like coloured noise. Here the function stands in the
equations, its terms are parameters with a smooth prior, and the model is refitted from short windows, which follow the
measurement. Its evidence is held against that of the model without it, at the noise that the function leaves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from casadi_engine.deadline import Deadline, TimeUp, ask
from casadi_engine.discrepancy.evidence import (
    FACTOR,
    Digest,
    Levels,
    Prior,
    digest,
    evidence,
    foretold,
    levels_left,
)
from casadi_engine.discrepancy.law_rival import SIZES, TAKEN, of_size
from casadi_engine.discrepancy.law_setups import TERMS, Setup, setups_at, setups_elsewhere
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.priors import priors_of
from casadi_engine.discrepancy.random_families import Course, Family, course_of
from casadi_engine.discrepancy.refit_null import null_of_refit
from casadi_engine.discrepancy.refits import Refits, Tried
from casadi_engine.discrepancy.unknown_law import UnknownLaw, near_of
from casadi_engine.estimation.refit_answer import Refit
from casadi_engine.estimation.refit_problem import RefitProblem
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters

# Links between ports are looked at where they are no more than so many.
_LINKS = 6
# Steps over a horizon, and over one of the short ones.
_STEPS, _FEW = 30, 12
# Horizons over which every function is refitted; those go on to the whole record whose chi-squared over these is within
# such a factor of the least.
_SHORT, _NEAR = 3, 2.0
# So many of these at most, the best over short windows.
_FOLLOWED = 4
# A simulation that is off by this share of what an output varies by has slopes that are off as much: a law that is
# found along it leaves a hundredth of the squares that one along the motion itself would take.
_FAR = 0.1


def refitted_law(
    refits: Refits, tried: Tried, further: float, *, others: Sequence[Family] = ()
) -> UnknownLaw | None:
    """The most probable function in the place of a structure's effects, or of none, each refitted; None where none
    arrives.

    further : what a further effect has to gain in log probability; others : functions of what the signals of a port do
    not say, or of a parameter, that come first along the simulation
    """
    none = refits.pool[frozenset()]
    ports = refits.refitter.model.ports
    between = ports.links if len(ports.links) <= _LINKS else ()
    setups = [one for port in (*ports, *between) for one in setups_at(refits, none, port)]
    known = {(one.family.port, one.family.signal) for one in setups}
    further_ones = [one for one in others if (one.port, one.signal) not in known and not one.order]
    setups += [one for family in further_ones for one in setups_elsewhere(refits, none, family)]
    if not setups:
        return None
    asked = {(one.port, one.signal) for one in further_ones}
    begun: list[tuple[Setup, _Begun, bool]] = []
    for setup in setups:
        own = _begun(refits, none, setup.model, setup.parameters)
        if own is not None:
            begun.append((setup, own, (setup.family.port, setup.family.signal) in asked))
    begun.sort(key=lambda one: one[1].found.cost)
    most = min(_NEAR * begun[0][1].found.cost, _chance(refits, tried, len(setups))) if begun else 0.0
    near = [(setup, one) for setup, one, told in begun if not told and one.found.cost <= most]
    wanted = near[:_FOLLOWED] + [(setup, one) for setup, one, told in begun if told]
    each = [_followed(refits, tried, setup, one) for setup, one in wanted]
    found = [one for one in each if one is not None]
    best = _most_probable(found, none, tried) if found else None
    if best is None:
        return None
    price = (len(tried.effects) - 1) * max(further, 0.0)
    return replace(best, log=best.log - math.log(len(setups)) + price, price=price)


def is_far(null: NullModel) -> bool:
    """True if what the past of a residual foretells is so much of what an output varies by that slopes along the
    simulation are not those along the motion."""
    for record in null.records:
        for output, e in record.residual.items():
            off = math.sqrt(max(foretold(e), 0.0) / len(e))
            if off > _FAR * float(np.std(record.path.grid.measured[output].values)):
                return True
    return False


def _chance(refits: Refits, tried: Tried, many: int) -> float:
    """Chi-squared over the short windows below which a function leaves less than chance does of what the structure
    itself leaves there: a law that moves nothing over these is near enough to be seen along the simulation.

    many : functions that are looked at
    """
    model = refits.refitter.extended(tried.effects)
    parameters = refits.refitter.parameters_of(model, tried.effects).unconstrained()
    plain = _begun(refits, tried, model, parameters)
    if plain is None:
        return math.inf
    gained = TERMS + 2 * math.log(FACTOR * many)
    return plain.found.cost * math.exp(-gained / max(plain.problem.count, 1))


@dataclass(frozen=True, eq=False)
class _Begun:
    """A model that was refitted over short windows."""

    problem: RefitProblem
    found: Refit


def _begun(refits: Refits, tried: Tried, model: Model, parameters: Parameters) -> _Begun | None:
    """A model refitted over windows so short that the measurement leads, whatever the law; None where that fails."""
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
            short = _horizons(problem)[:_SHORT]
            with Deadline(work=refits.path.allowed(problem)):
                found = problem.run(start=tried.arrived.values, horizons=short, most=_FEW)
    except FAILURES:
        return None
    except TimeUp:
        ask()  # all of the time, or the work that it may cost
        return None
    return _Begun(problem, found) if found.initial and math.isfinite(found.cost) else None


@dataclass(frozen=True, eq=False)
class _Followed:
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


def _most_probable(followed: Sequence[_Followed], none: Tried, tried: Tried) -> UnknownLaw | None:
    """The most probable of some functions, all held against the noise that the one leaves which leaves least."""
    levels = min(followed, key=lambda one: one.left).levels
    found = [(one, *one.log(levels)) for one in followed]
    one, log, best = max(found, key=lambda own: own[1])
    if not math.isfinite(log):
        return None
    zero, named, law = (evidence(own, levels) for own in (none.digest, tried.digest, best))
    share = (zero.cost - named.cost) / (zero.cost - law.cost) if zero.cost > law.cost else 1.0
    course, alike = _course(best, one.null, one.setup, levels), len(tried.effects) > 1
    return UnknownLaw(course, log - named.log, share, alike, near_of(tried, one.setup.family.port))


def _followed(refits: Refits, tried: Tried, setup: Setup, one: _Begun) -> _Followed | None:
    """A function in the place of a structure's effects after windows that grow to the whole record; None where it does
    not arrive there, or leaves most of the colour."""
    ask()
    try:
        with np.errstate(all="ignore"):
            longer = _horizons(one.problem)[_SHORT:] or [None]
            with Deadline(work=refits.path.allowed(one.problem)):
                found = one.problem.run(warm=one.found, horizons=longer, most=_STEPS)
            if not found.initial or not math.isfinite(found.cost):
                return None
            null = null_of_refit(setup.model, setup.parameters, one.problem, found, refits.path.levels)
            if not _takes_the_colour(refits.path.residuals(tried.effects, tried.arrived), null):
                return None
            levels = levels_left(null, refits.known, refits.levels.scatter, None)
            return _Followed(setup, null, _counted(null, setup), levels)
    except FAILURES:
        return None
    except TimeUp:
        ask()
        return None


def _takes_the_colour(before: NullModel, after: NullModel) -> bool:
    """True if a function takes most of what the model without it leaves beyond white noise: what it leaves would
    else be the sensors' own colour, which any smooth function takes a little of."""
    taken = beyond = 0.0
    for record, left in zip(before.records, after.records, strict=True):
        for output, e in left.residual.items():
            whole, rest = float(record.residual[output] @ record.residual[output]), float(e @ e)
            white = max(rest - foretold(e), 1e-300)
            taken += (whole - rest) / white
            beyond += (whole - white) / white
    return taken >= TAKEN * beyond


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


def _course(made: Digest, null: NullModel, setup: Setup, levels: Levels) -> Course:
    """The course of the function where its refit ended, with its band."""
    rows = np.concatenate([*(part * levels.weight(output) for output, part in made.parts), made.prior])
    mine = [null.parameters.index(name) for name in setup.terms]
    inverse = np.linalg.pinv(rows[:, :-1])[: made.turn.shape[1]]
    root = made.turn[mine] @ inverse
    course = course_of(setup.family, null.values[mine] + root @ rows[:, -1], root)
    # a line is what the model's own parameters took or left, and no likeness, but where one of them follows it
    alike = course.looks_like
    if setup.family.port.startswith("parameter_"):
        return course
    return replace(course, looks_like={} if max(alike, key=alike.__getitem__) == "linear" else alike)
