"""Short refits: a few Gauss-Newton steps of the model with an effect, to tell which effects are worth a whole refit.

The score at the optimum without effects says what a small effect would do. A large one has moved that optimum far, to
bounds perhaps, and its slope there says little: then only a refit tells, from the parameters' own start values as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.null_model import NullModel, null_at
from casadi_engine.discrepancy.refit import Addition, Refitter
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation.descent import Descender, gap_of
from casadi_engine.estimation.loss import read_loss
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.shooting import Point
from casadi_engine.estimation.starts import chained_nodes
from casadi_engine.problem.noise import Noise

# A fall of chi-squared in one step below which a short refit has settled.
_SETTLED = 0.3
# Share of the diagonal added to the Gauss-Newton matrix in the first step, and by what it falls from step to step.
_DAMPING, _FALLS = 0.1, 0.6
# The share with which a short refit goes on.
_LATER = 1e-3
# After so many steps one that is so many times above the best gives up.
_GIVEN, _HOPELESS = 4, 30.0
# A gap of the continuity (of scaled states) that counts as closed.
_CLOSED = 1e-2
_TIGHT = 1e-6
# Times that a settled point's gaps are closed by simulation, and steps after each.
_CLOSINGS, _FEWER = 4, 3
# Samples of all records above which integration is limited to so many steps of them in all, and the share of an
# amplitude from which a search starts, again and again, where its own asks for more. (Shorter records take as many
# steps as any law asks for.)
_LONG, _STEPS = 4000, 1e5
_SMALLER, _TIMES = 0.125, 4


@dataclass(frozen=True, eq=False)
class Short:
    """Where a short refit ended: values and first states, as ``estimate(warm=...)`` reads them.

    cost : chi-squared with priors, simulated from the first states; settled : one more step would change it little
    bounds : the parameters at a bound; x : the point of the shooting problem, to go on from
    """

    values: Mapping[str, float]
    initial: Mapping[str, Mapping[str, float]]
    cost: float
    settled: bool
    bounds: tuple[str, ...]
    x: Array = field(repr=False)
    noise: Mapping[str, tuple[float, bool]] = field(default_factory=dict)
    converged: bool = True


class _GaussNewton(Descender):
    """The first phase of a search without its exact steps."""

    def _settled(self, history: list[float], point: Point) -> bool:
        del history, point
        return False


class ShortRefits:
    """Short refits of one set of records; a model with an effect is made once.

    levels : output -> standard deviation of the noise, held
    """

    def __init__(self, refitter: Refitter, levels: Mapping[str, float]) -> None:
        self.refitter = refitter
        self.levels: dict[str, Any] = dict(levels)
        self._made: dict[tuple[int, ...], Search | None] = {}
        self._kept: list[Addition] = []

    def __call__(
        self, effects: Sequence[Addition], warm: Any, steps: int, *, worst: float = np.inf
    ) -> Short | None:
        """At most ``steps`` steps with these effects.

        warm : a fit, a Start, or a Short with these very effects to go on from; None for the parameters' own values.
        Without initial states the measurement gives them. worst : chi-squared far above which a search gives up
        Returns None where the model fails.
        """
        try:
            with np.errstate(all="ignore"):
                search = self._search(effects)
                if search is None:
                    return None
                return _descended(search, warm, steps, worst, effects[-1].amplitude if effects else None)
        except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
            return None

    def first_states(self, effects: Sequence[Addition]) -> dict[str, Array]:
        """record -> (n,) first states that the measurement gives at the parameters' own values."""
        search = self._search(effects)
        assert search is not None
        search.warm = None
        x = search._start(search.pmap.start, first=True)
        return {
            record.experiment.name: x[lay.at : lay.at + lay.n] * record.scale
            for record, lay in zip(search.records, search.problem.layouts, strict=True)
        }

    def null_at(self, effects: Sequence[Addition], short: Short) -> NullModel:
        """The model with these effects where a short refit of them ended."""
        search = self._search(effects)
        assert search is not None
        names = [state.name for state in search.model.states]
        first = {record: np.array([own[n] for n in names]) for record, own in short.initial.items()}
        z = np.array([short.values[name] for name in search.pmap.free])
        return null_at(search.model, search.data, search.parameters, z, first)

    def _search(self, effects: Sequence[Addition]) -> Search | None:
        key = tuple(id(one.candidate) for one in effects)
        if key not in self._made:
            self._kept += effects  # alive, so that no other candidate takes its identity
            self._made[key] = None
            self._made[key] = self._problem(effects)
        return self._made[key]

    def _problem(self, effects: Sequence[Addition]) -> Search:
        refitter = self.refitter
        model = refitter.extended(effects)
        options = dict(refitter.options)
        search = Search(
            model,
            refitter.data,
            refitter._parameters(model, effects),
            Noise(**self.levels),
            interval=options.get("interval", "auto"),
            initial=options.get("initial"),
            loss=read_loss("square"),
            ties="substitute",
            method=options.get("method", "exact"),
            max_iterations=1,
            tolerance=1e-6,
            warm=None,
            progress=None,
        )
        if self.long:
            for record in search.records:
                record.limit_steps(max(1, int(_STEPS / self.samples)))
        return search

    @property
    def samples(self) -> int:
        """Samples of all records together, each by its longest channel."""
        return sum(max(len(record[name].time) for name in record.names) for record in self.refitter.data)

    @property
    def long(self) -> bool:
        """True for records so long that what promises little is not followed to its end; records of a lower rate count
        as those they were made of."""
        factors = [1 if one.decimation is None else one.decimation.factor for one in self.refitter.data]
        return self.samples * min(factors) > _LONG


def _first(search: Search, warm: Any, amplitude: str | None) -> Array:
    """The point (size,) that a search starts from: with a smaller amplitude where its own takes too many steps."""
    z = search.pmap.start if warm is None else search._warm_values(search.pmap.start)
    x = search._start(z, first=True)
    if amplitude not in search.pmap.free or not any(record.limited for record in search.records):
        return x
    at = search.pmap.free.index(amplitude)
    for _ in range(_TIMES):
        try:
            search.problem.exact = False
            search.problem.at(x)
        except FloatingPointError:
            z = z.copy()
            z[at] *= _SMALLER
            x = search._start(z, first=True)
        else:
            break
    return x


def _descended(search: Search, warm: Any, steps: int, worst: float, amplitude: str | None = None) -> Short:
    search.warm = warm
    problem = search.problem
    x = warm.x if isinstance(warm, Short) else None
    if x is None:
        x = _first(search, warm, amplitude)
    problem.damping = _LATER if isinstance(warm, Short) else _DAMPING / _FALLS
    unit, last = 2 * problem.samples, np.inf
    settled, done = False, 0

    def watch(point: Point) -> bool:
        nonlocal last, settled, done
        cost = unit * point.objective
        closed = gap_of(point, problem.user.count) < _CLOSED
        settled = closed and abs(last - cost) < _SETTLED
        last = cost if closed else np.inf
        problem.damping *= _FALLS
        done += 1
        return settled or (done > _GIVEN and cost > _HOPELESS * worst)

    if problem.user.count:  # constraints beside bounds are the solver's
        x = search.solver.solve(x, search.lower, search.upper).x
    else:
        x = _GaussNewton(problem, search.lower, search.upper).run(x, watch, steps).x
        if settled:
            x, settled = _closed(search, x)
    return _ended(search, x, settled)


def _closed(search: Search, x: Array) -> tuple[Array, bool]:
    """A settled point without gaps, and whether it is still settled.

    Small gaps add up where the states hardly forget: along a valley the cost at the nodes has settled long before that
    of a simulation. From the simulated nodes a few steps more reach it.
    """
    problem = search.problem
    problem.exact = False
    unit = 2 * problem.samples
    for _ in range(_CLOSINGS):
        point = problem.at(x)
        if gap_of(point, problem.user.count) <= _TIGHT:
            return x, True
        simulated = _simulated(search, x)
        if unit * (problem.at(simulated).objective - point.objective) < _SETTLED:
            return simulated, True
        problem.damping = _LATER
        x = _GaussNewton(problem, search.lower, search.upper).run(simulated, lambda _: False, _FEWER).x
        problem.exact = False
    return x, False


def _simulated(search: Search, x: Array) -> Array:
    """The point with its nodes simulated from the first states."""
    problem = search.problem
    closed = x.copy()
    for record, lay in zip(search.records, problem.layouts, strict=True):
        first = x[lay.at : lay.at + lay.n]
        closed[lay.at : lay.at + lay.m * lay.n] = chained_nodes(record, x[: problem.nv], first).ravel()
    return closed


def _ended(search: Search, x: Array, settled: bool) -> Short:
    """The point with its gaps closed by simulation where they are not."""
    problem = search.problem
    problem.exact = False
    v, closed = x[: problem.nv], x
    if gap_of(problem.at(x), problem.user.count) > _TIGHT:
        closed = _simulated(search, x)
    cost = float(2 * problem.samples * problem.at(closed).objective)
    states = [state.name for state in search.model.states]
    initial = {
        record.experiment.name: dict(
            zip(states, (x[lay.at : lay.at + lay.n] * record.scale).tolist(), strict=True)
        )
        for record, lay in zip(search.records, problem.layouts, strict=True)
    }
    problem.forget()  # a point of a long record is large, and there are many problems
    names, edge = search.pmap.free, ((x <= search.lower) | (x >= search.upper))[: problem.nv]
    return Short(
        dict(zip(names, search.coordinates.values(v).tolist(), strict=True)),
        initial,
        cost if np.isfinite(cost) else np.inf,
        settled,
        tuple(name for name, at in zip(names, edge, strict=True) if at),
        x,
        search.levels.by_name(search.sigma),
    )
