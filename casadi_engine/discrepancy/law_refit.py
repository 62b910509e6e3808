"""An unknown law far from the model without it: a function of one signal at one port as a part of the equations.

Where a law is large, the model without it is far from the motion that was measured, and nothing that is linearised
along its simulation sees what is missing: the residual looks like coloured noise. Here the function stands in the
equations, its terms are parameters with a smooth prior, and the model is refitted from short windows, which follow the
measurement. Its evidence is held against that of the model without it, at the noise that the function leaves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import casadi as ca
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
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.priors import priors_of
from casadi_engine.discrepancy.random_families import Course, Family, course_of, smooth_family, terms_at
from casadi_engine.discrepancy.refit_null import null_of_refit
from casadi_engine.discrepancy.refits import Refits, Tried
from casadi_engine.discrepancy.unknown_law import UnknownLaw, near_of
from casadi_engine.effects import Amplitude, Effect, Grid
from casadi_engine.estimation.refit_answer import Refit
from casadi_engine.estimation.refit_problem import RefitProblem
from casadi_engine.model import Model, Port
from casadi_engine.parameters import Parameters
from casadi_engine.simulation.null_path import NullPath

# Kinds of ports at which something acts, or that may act otherwise than they say.
_KINDS = ("inertia", "coupling", "internal", "input")
# Steps over a horizon, and over one of the short ones.
_STEPS, _FEW = 30, 12
# Horizons over which every function is refitted; those go on to the whole record whose chi-squared over these is within
# such a factor of the least.
_SHORT, _NEAR = 3, 2.0
# A simulation that is off by this share of what an output varies by has slopes that are off as much: a law that is
# found along it leaves a hundredth of the squares that one along the motion itself would take.
_FAR = 0.1
# Terms of a function.
_TERMS = 20
# Factor of all terms, which is one: they are what is estimated.
_WHOLE = "whole"


class _Function(Effect):
    """A smooth function of a signal: cosines over the range that the records visit."""

    def __init__(self, port: Port, family: Family) -> None:
        self.name = f"function_of_{family.signal}"  # type: ignore[misc]
        self.attaches = (port.kind,)  # type: ignore[misc]
        self.amplitude = Amplitude(_WHOLE, unit=None)  # type: ignore[misc]
        self.nuisance: Mapping[str, Grid] = MappingProxyType(  # type: ignore[misc]
            {f"c{k}": Grid() for k in range(len(family.variances))}
        )
        self._family = family

    def law(self, port: Any, p: Any, math: Any) -> Any:
        del math
        terms = terms_at(self._family, getattr(port, self._family.signal))
        return p.whole * sum((getattr(p, f"c{k}") * term for k, term in enumerate(terms)), 0.0)


@dataclass(frozen=True, eq=False)
class _Setup:
    """A model with a function: its parameters, the names of the terms, and their prior standard deviations."""

    family: Family
    model: Model
    parameters: Parameters
    terms: tuple[str, ...]
    deviations: Array


def refitted_law(refits: Refits, tried: Tried, further: float) -> UnknownLaw | None:
    """The most probable function in the place of a structure's effects, or of none, each refitted; None where none
    arrives.

    further : what a further effect has to gain in log probability
    """
    none = refits.pool[frozenset()]
    setups = [one for port in refits.refitter.model.ports for one in _setups(refits, none, port)]
    if not setups:
        return None
    begun = [(setup, _begun(refits, none, setup.model, setup.parameters)) for setup in setups]
    least = min((one.found.cost for _, one in begun if one is not None), default=math.inf)
    most = min(_NEAR * least, _chance(refits, tried, len(setups)))
    found = []
    for setup, one in begun:
        if one is None or one.found.cost > most:
            continue
        made = _followed(refits, none, tried, setup, one)
        found += [] if made is None else [made]
    if not found:
        return None
    best = max(found, key=lambda one: one.log)
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
    memory = max(refits.levels.memory.values(), default=1.0)  # samples that are worth one independent one
    gained = (_TERMS + 2 * math.log(FACTOR * many)) * memory
    return plain.found.cost * math.exp(-gained / max(plain.problem.count, 1))


def _setups(refits: Refits, tried: Tried, port: Port) -> list[_Setup]:
    """A function of every signal of a port at which something acts, over the range that the records visit.

    Its prior is as large as all that moves the states there, or as an input itself.
    """
    if port.kind not in _KINDS or (port.slot is None and port.kind != "input") or not port.signals:
        return []
    if port.kind == "input":
        values = _as_read(refits, port)
        if not _moves(values):
            return []
        family = smooth_family(port.name, next(iter(port.signals)), values, terms=_TERMS)
        size = float(np.std(values))
        return [_attached(refits, tried, family, size)]
    first = smooth_family(port.name, next(iter(port.signals)), np.array([0.0, 1.0]), terms=_TERMS)
    probe = _attached(refits, tried, first, 1.0)
    problem = RefitProblem(probe.model, refits.refitter.data, probe.parameters, levels=refits.path.levels)
    try:
        with np.errstate(all="ignore"):
            paths = problem.measured_paths(tried.arrived.values)
            size = _size(probe, paths)
            visited = {name: _along(paths, own) for name, own in port.signals.items()}
    except FAILURES:
        return []
    found = []
    for name, values in visited.items():
        if _moves(values) and math.isfinite(size):
            found.append(_attached(refits, tried, smooth_family(port.name, name, values, terms=_TERMS), size))
    return found


def _moves(values: Array) -> bool:
    return bool(np.ptp(values) > 1e-9 * max(float(np.abs(values).max()), 1e-300))


def _as_read(refits: Refits, port: Port) -> Array:
    """What an input says in all records."""
    name = port.name.removeprefix("input_")
    return np.concatenate([np.asarray(record[name].values, dtype=float) for record in refits.refitter.data])


def _attached(refits: Refits, tried: Tried, family: Family, size: float) -> _Setup:
    """The model with a function of such a size."""
    model = refits.refitter.extended(tried.effects)
    effect = _Function(model.ports[family.port], family)
    wider = model.with_effect(effect, at=family.port)
    terms = tuple(f"{family.port}.{effect.name}.c{k}" for k in range(len(family.variances)))
    parameters = refits.refitter.parameters_of(model, tried.effects).unconstrained().extended(wider)
    parameters.fix(f"{family.port}.{effect.name}.{_WHOLE}", 1.0)
    deviations = size * np.sqrt(family.variances)
    for name, deviation in zip(terms, deviations, strict=True):
        parameters[name].set(0.0, min=None, max=None, prior=(0.0, float(deviation)))
    return _Setup(family, wider, parameters, terms, deviations)


def _size(probe: _Setup, paths: Sequence[NullPath]) -> float:
    """The amplitude at which what acts at a port moves some state as much as all does; inf where it moves none."""
    model = probe.model
    symbol = model.p[list(model.parameter_names).index(probe.terms[0])]
    pushes = ca.densify(ca.jacobian(model.closed_ode, symbol))
    size = math.inf
    for k in range(len(model.states)):
        gain = float(np.sqrt(np.mean(_along(paths, pushes[k]) ** 2)))
        moved = float(np.std(np.concatenate([path.slope[k] for path in paths])))
        if gain > 0 and moved > 0:
            size = min(size, moved / gain)
    return size


def _along(paths: Sequence[NullPath], expression: ca.SX) -> Array:
    """An expression along all records."""
    found = [path.function([expression])(*path.at_samples().arguments)[0][0] for path in paths]
    return np.concatenate(
        [np.broadcast_to(own, path.grid.time.shape) for own, path in zip(found, paths, strict=True)]
    )


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


def _followed(refits: Refits, none: Tried, tried: Tried, setup: _Setup, one: _Begun) -> UnknownLaw | None:
    """A function in the place of a structure's effects, its evidence averaged over its size, after windows that grow to
    the whole record; None where it does not arrive there."""
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
            made = _counted(null, setup)
            logs = [evidence(of_size(made, setup.terms, share), levels).log for share in SIZES]
            log = float(np.logaddexp.reduce(logs)) - math.log(len(SIZES))
            best = of_size(made, setup.terms, SIZES[int(np.argmax(logs))])
            zero, named, law = (evidence(own, levels) for own in (none.digest, tried.digest, best))
            share = (zero.cost - named.cost) / (zero.cost - law.cost) if zero.cost > law.cost else 1.0
            course = _course(best, null, setup, levels)
            alike = len(tried.effects) > 1
            return (
                UnknownLaw(course, log - named.log, share, alike, near_of(tried, setup.family.port))
                if math.isfinite(log)
                else None
            )
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


def _counted(null: NullModel, setup: _Setup) -> Digest:
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


def _course(made: Digest, null: NullModel, setup: _Setup, levels: Levels) -> Course:
    """The course of the function where its refit ended, with its band."""
    rows = np.concatenate([*(part * levels.weight(output) for output, part in made.parts), made.prior])
    mine = [null.parameters.index(name) for name in setup.terms]
    inverse = np.linalg.pinv(rows[:, :-1])[: made.turn.shape[1]]
    root = made.turn[mine] @ inverse
    course = course_of(setup.family, null.values[mine] + root @ rows[:, -1], root)
    # a line is what the model's own parameters took or left, and no likeness
    alike = course.looks_like
    return replace(course, looks_like={} if max(alike, key=alike.__getitem__) == "linear" else alike)
