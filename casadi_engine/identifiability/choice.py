"""choose_experiments: which of the experiments that could be made tell the parameters best."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.blas_threads import one_blas_thread
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.fit import Estimate
from casadi_engine.estimation.options import whole
from casadi_engine.identifiability.fisher import Frame, Information, noise_levels, share
from casadi_engine.identifiability.operating import planned
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters, near_matches
from casadi_engine.problem.noise import Noise

Array = NDArray[np.float64]

# What is not determined counts as known to this relative error, so that sets which lose less rank first.
_LOST = 1e3
# Up to this many sets all are tried.
_ALL = 4000
_CRITERIA = ("A", "D", "E")


@dataclass(frozen=True)
class Candidate:
    """One experiment that could be made: what it would tell alone.

    errors : name -> Estimate with the expected standard error; value : of the criterion
    samples : number of them; duration : s
    """

    name: str
    errors: Mapping[str, Estimate]
    value: float
    samples: int
    duration: float

    @property
    def relative(self) -> dict[str, float | None]:
        """Name -> expected standard error as a share of the value."""
        return {name: share(one) for name, one in self.errors.items()}


@dataclass(frozen=True, eq=False)
class ExperimentChoice:
    """The best small set of experiments.

    criterion : "A", "D", "E" or name -> wanted relative error
    candidates : label -> Candidate. chosen : labels of the set, in the order of their worth
    information : of the set (with those already made): its ``errors`` are the expected ones
    value : of the criterion. A: root mean square of the relative errors; D: their geometric mean along the axes of
        the confidence ellipsoid; E: the largest of these; targets: the largest ratio of expected to wanted error
    by_size : value of the best set of 1, 2, ... experiments
    free : names of the free parameters
    met : whether all targets are met (None for A, D, E). tried : number of sets; every : whether those were all
    """

    criterion: str | Mapping[str, float]
    candidates: Mapping[str, Candidate]
    chosen: tuple[str, ...]
    information: Information
    value: float
    by_size: tuple[float, ...]
    met: bool | None
    tried: int
    every: bool
    free: tuple[str, ...]

    def __str__(self) -> str:
        from casadi_engine.identifiability.practical_summary import choice_text

        return choice_text(self)

    @property
    def errors(self) -> Mapping[str, Estimate]:
        """Name -> Estimate with the standard error that the chosen set is expected to give."""
        return self.information.errors

    @property
    def relative(self) -> dict[str, float | None]:
        """Name -> expected standard error of the chosen set as a share of the value."""
        return self.information.relative

    def length_for(self, name: str, error: float) -> float | None:
        """Seconds of data like the chosen set's that would give a parameter this relative error.

        Errors fall with the root of the length. None where the data do not determine the parameter.
        """
        now = self.information.relative.get(name)
        return None if now is None else self.information.duration * (now / error) ** 2


@one_blas_thread
def choose_experiments(
    model: Model,
    candidates: Any,
    *,
    parameters: Parameters | None = None,
    noise: Noise | None = None,
    criterion: str | Mapping[str, float] = "A",
    size: int = 3,
    repeats: bool = False,
    have: Any = None,
) -> ExperimentChoice:
    """Expected errors of every candidate experiment, and the set of at most ``size`` that tells most.

    The information of each candidate comes from exact sensitivities of the model at the values of the set, its
    unknown initial state taken out; sets are compared by sums of these matrices. All sets are tried where they are
    few, else sets are built one by one and improved by exchanges.

    model : with all outputs that any candidate measures
    candidates : PlannedExperiments (or Experiments), a sequence or label -> one; see ``identifiability.plan``
    parameters, noise : as in ``fisher``; sigma of every output that is only planned must be given
    criterion : "A", "D", "E" over all free parameters, or name -> wanted relative standard error: then the
        smallest set that meets them all
    size : experiments at most; repeats : whether one may be made several times; have : experiments already made

    Returns an ExperimentChoice. Raises EstimationError for unusable options, and what ``fisher`` raises.
    Source: Fedorov, Theory of Optimal Experiments, 1972 (exchange); Atkinson & Donev, Optimum Experimental Designs.

    >>> import numpy as np, casadi_engine as ce
    >>> t = np.arange(200) * 0.01
    >>> def run(torque):
    ...     return ce.Experiment.from_arrays("run", time=t, units={"T": "N m"}, T=torque)
    >>> candidates = {"constant": run(0 * t + 2), "steps": run(4.0 * (t % 1 < 0.5))}
    >>> choice = ce.choose_experiments(ce.one_inertia(), candidates, noise=ce.Noise(omega=0.01), size=1)
    >>> choice.chosen
    ('steps',)
    >>> {name: f"{100 * choice.relative[name]:.2g} %" for name in ("J_eng", "C_eng")}
    {'J_eng': '0.099 %', 'C_eng': '0.045 %'}
    """
    size = whole("size", size, 1)
    plans, made = planned(candidates), () if have is None else planned(have)
    names = [plan.name for plan in plans]
    twice = [plan.name for plan in made if plan.name in names]
    if twice:
        raise EstimationError(
            "an experiment already made has the name of a candidate",
            seen=", ".join(twice),
            allowed="different names",
            cure="give labels: have={label: experiment}",
        )
    frame = Frame(model, parameters, (*names, *(plan.name for plan in made)))
    found = {plan.name: (plan, *frame.linearise(plan)) for plan in (*plans, *made)}
    levels = noise_levels(model, noise, [seen for _, _, seen in found.values()])
    parts = {
        name: frame.information(plan.known_start, seen, levels) for name, (plan, _, seen) in found.items()
    }
    judge = _Judge(frame, criterion, parts, tuple(plan.name for plan in made))
    best, by_size, tried, every = _search(judge, names, size, repeats)
    alone = {}
    for name in names:
        record = found[name][1]
        own = frame.conclude({name: parts[name]}, levels, samples=record.count, duration=record.duration)
        alone[name] = Candidate(name, own.errors, judge.value((name,)), record.count, record.duration)
    used = [*judge.made, *best]
    whole_set = frame.conclude(
        {label: parts[name] for label, name in _labels(used)},
        levels,
        samples=sum(found[name][1].count for name in used),
        duration=sum(found[name][1].duration for name in used),
    )
    value = judge.value(best)
    met = value <= 1 if judge.targets else None
    chosen = _by_worth(judge, best)
    return ExperimentChoice(
        criterion, alone, chosen, whole_set, value, by_size, met, tried, every, frame.pmap.free
    )


class _Judge:
    """The criterion, as a function of the names of a set."""

    def __init__(
        self, frame: Frame, criterion: Any, parts: Mapping[str, Array], made: tuple[str, ...]
    ) -> None:
        self.frame, self.parts, self.made = frame, parts, made
        self.targets: dict[str, float] = {}
        self.criterion = criterion
        if isinstance(criterion, Mapping):
            self.targets = _checked_targets(criterion, frame)
            rows = [list(frame.pmap.reported).index(name) for name in self.targets]
            slopes = frame._slopes(frame.pmap.reported_expressions)[rows]
            values = frame.pmap.values(frame.coordinates.values(frame.v))
            sizes = np.array([abs(values[name]) * target for name, target in self.targets.items()])
            self._slopes: Array = slopes / sizes[:, None]
        elif criterion not in _CRITERIA:
            raise EstimationError(
                "the criterion is not known",
                seen=repr(criterion),
                allowed='"A", "D", "E", or name -> wanted relative standard error',
                cure='write criterion={"K_el": 0.05} for an error of 5 %, for instance',
            )
        base = frame.prior.copy()
        for name in made:
            base += parts[name]
        self._base: Array = base
        # a parameter of one record is in play only where its record is chosen
        self._owner = [name.split("@", 1)[1] if "@" in name else None for name in frame.pmap.free]

    def value(self, names: Sequence[str]) -> float:
        """The criterion of a set with those already made; small is good."""
        from scipy.linalg import null_space

        total = self._base + sum((self.parts[name] for name in names), np.zeros_like(self._base))
        there = {*names, *self.made}
        open_ = np.array([owner is None or owner in there for owner in self._owner])
        basis = np.eye(len(total))[:, open_]
        if len(self.frame.equalities):
            basis = basis @ null_space(self.frame.equalities[:, open_])
        inner = basis.T @ total @ basis + np.eye(basis.shape[1]) / _LOST**2
        spread = np.sqrt(np.diag(inner))
        values, vectors = np.linalg.eigh(inner / np.outer(spread, spread))
        # rounding may leave an eigenvalue below what the term for lost directions gives at least
        values = np.maximum(values, np.finfo(float).eps * values[-1])
        if self.criterion == "D":
            log = float(np.log(values).sum() + 2 * np.log(spread).sum())
            return math.exp(-0.5 * log / len(values))
        root = basis @ ((vectors / np.sqrt(values)) / spread[:, None])  # root root' = covariance
        if self.targets:
            return float(np.sqrt(((self._slopes @ root) ** 2).sum(axis=1)).max())
        if self.criterion == "A":
            return float(np.sqrt((root**2).sum() / max(int(open_.sum()), 1)))
        return float(np.linalg.norm(root, 2))


def _checked_targets(criterion: Mapping[str, Any], frame: Frame) -> dict[str, float]:
    known = frame.pmap.reported
    if not criterion:
        raise EstimationError(
            "the criterion names no parameter",
            seen="{}",
            allowed="name -> wanted relative standard error",
            cure='write criterion={"K_el": 0.05}, or "A" for all',
        )
    values = frame.pmap.values(frame.coordinates.values(frame.v))
    slopes = dict(zip(known, frame._slopes(frame.pmap.reported_expressions), strict=True))
    for name, target in criterion.items():
        if name not in known:
            raise EstimationError(
                "the criterion names a parameter that is not in the set",
                seen=repr(name),
                allowed=near_matches(name, known),
                cure="name parameters of the set",
            )
        number = isinstance(target, int | float) and not isinstance(target, bool)
        if not (number and 0 < target < math.inf):
            raise EstimationError(
                f"the wanted error of {name} is not acceptable",
                seen=repr(target),
                allowed="a relative standard error > 0, such as 0.05 for 5 %",
                cure="give a share of the value",
            )
        if not slopes[name].any() or values[name] == 0:
            raise EstimationError(
                f"{name} has no relative error to ask for",
                seen="fixed" if values[name] else "a value of 0",
                allowed="free or tied parameters that are not zero",
                cure="free it, or leave it out of the criterion",
            )
    return {name: float(target) for name, target in criterion.items()}


def _search(
    judge: _Judge, names: list[str], size: int, repeats: bool
) -> tuple[tuple[str, ...], tuple[float, ...], int, bool]:
    """The best set, the best value of each size, how many sets were tried, and whether all of them."""
    most = size if repeats else min(size, len(names))
    best: tuple[str, ...] = ()
    by_size: list[float] = []
    tried, every = 0, True
    for count in range(1, most + 1):
        combine = itertools.combinations_with_replacement if repeats else itertools.combinations
        sets = math.comb(len(names) + count - 1, count) if repeats else math.comb(len(names), count)
        if sets <= _ALL:
            scored: Iterable[tuple[float, tuple[str, ...]]] = (
                (judge.value(group), group) for group in combine(names, count)
            )
            value, group = min(scored, key=lambda pair: pair[0])
            tried += sets
        else:
            value, group, steps = _exchanged(judge, names, best, count, repeats)
            tried, every = tried + steps, False
        best = group
        by_size.append(value)
        if judge.targets and value <= 1:
            break
    return best, tuple(by_size), tried, every


def _exchanged(
    judge: _Judge, names: list[str], start: tuple[str, ...], count: int, repeats: bool
) -> tuple[float, tuple[str, ...], int]:
    """Add the best one to the last set, then exchange single ones as long as that improves it."""
    chosen, tried = list(start), 0

    def free(without: list[str]) -> list[str]:
        return names if repeats else [name for name in names if name not in without]

    while len(chosen) < count:
        options = [(judge.value((*chosen, name)), name) for name in free(chosen)]
        tried += len(options)
        chosen.append(min(options)[1])
    value = judge.value(chosen)
    better = True
    while better:
        better = False
        for k in range(count):
            rest = chosen[:k] + chosen[k + 1 :]
            options = [(judge.value((*rest, name)), name) for name in free(rest)]
            tried += len(options)
            found, name = min(options)
            if found < value * (1 - 1e-12):
                chosen[k], value, better = name, found, True
    return value, tuple(chosen), tried


def _by_worth(judge: _Judge, best: Sequence[str]) -> tuple[str, ...]:
    """The set in the order in which each next one helps most."""
    rest, ordered = list(best), list[str]()
    while rest:
        name = min(rest, key=lambda one: judge.value((*ordered, one)))
        rest.remove(name)
        ordered.append(name)
    return tuple(ordered)


def _labels(names: Sequence[str]) -> list[tuple[str, str]]:
    """(label, name), a repeated name with a number."""
    counts: dict[str, int] = {}
    found = []
    for name in names:
        counts[name] = counts.get(name, 0) + 1
        found.append((name if counts[name] == 1 else f"{name} (again, {counts[name]})", name))
    return found
