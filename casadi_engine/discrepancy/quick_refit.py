"""Short refits: a few Gauss-Newton steps of the model with an effect, to tell which effects are worth a whole refit.

The score at the optimum without effects says what a small effect would do. A large one has moved that optimum far, to
bounds perhaps, and its slope there says little: then only a refit tells, from the parameters' own start values as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.null_model import NullModel, null_at
from casadi_engine.discrepancy.refit import Addition, Refitter
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation.loss import read_loss
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.starts import chained_nodes
from casadi_engine.problem.noise import Noise

# A fall of chi-squared in one step below which a short refit has settled.
_SETTLED = 0.3
# Share of the diagonal added to the Gauss-Newton matrix in the first step, and where a short refit goes on.
_DAMPING, _LATER = 0.1, 1e-3
# After so many steps one that is so many times above the best gives up.
_GIVEN, _HOPELESS = 4, 30.0
# A gap of the continuity (of scaled states) that counts as closed.
_CLOSED = 1e-2
_TIGHT = 1e-6
# Times that a settled point's gaps are closed by simulation, and steps after each.
_CLOSINGS, _FEWER = 4, 3
# Iterations of a short refit at most, whatever is asked for.
_MOST = 200
# Samples of all records above which integration is limited to so many steps of them in all, and the share of an
# amplitude from which a search starts, again and again, where its own asks for more. (Shorter records take as many
# steps as any law asks for.)
_LONG, _STEPS = 4000, 1e5
_SMALLER, _TIMES = 0.125, 4


@dataclass(frozen=True, eq=False)
class Short:
    """Where a short refit ended: values and first states, as ``estimate(warm=...)`` reads them.

    cost : chi-squared with priors, simulated from the first states; settled : one more step would change it little
    x : the point of the shooting problem, to go on from
    """

    values: Mapping[str, float]
    initial: Mapping[str, Mapping[str, float]]
    cost: float
    settled: bool
    x: Array = field(repr=False)
    noise: Mapping[str, tuple[float, bool]] = field(default_factory=dict)
    converged: bool = True


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
            max_iterations=_MOST,
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
    unit, last = 2 * problem.samples, np.inf
    settled, done = False, 0

    def stop(objective: float, gap: float) -> bool:
        nonlocal last, settled, done
        cost = unit * objective
        settled = gap < _CLOSED and abs(last - cost) < _SETTLED
        last = cost if gap < _CLOSED else np.inf
        done += 1
        return settled or done > steps or (done > _GIVEN and cost > _HOPELESS * worst)

    if (
        problem.user.count
    ):  # constraints beside bounds have multipliers, which Gauss-Newton steps alone do not settle
        x = search.solver.solve(x, search.lower, search.upper).x
    else:
        damping = _LATER if isinstance(warm, Short) else _DAMPING
        x = search.solver.gauss_newton(x, search.lower, search.upper, damping=damping, stop=stop)
        if settled:
            x, settled = _closed(search, x)
    return _ended(search, x, settled)


def _closed(search: Search, x: Array) -> tuple[Array, bool]:
    """A settled point without gaps, and whether it is still settled.

    Small gaps add up where the states hardly forget: along a valley the cost at the nodes has settled long before that
    of a simulation. From the simulated nodes a few steps more reach it.
    """
    problem = search.problem
    unit = 2 * problem.samples
    for _ in range(_CLOSINGS):
        point = problem.at(x)
        if point.gap <= _TIGHT:
            return x, True
        simulated = _simulated(search, x)
        if unit * (problem.at(simulated).objective - point.objective) < _SETTLED:
            return simulated, True
        x = search.solver.gauss_newton(
            simulated, search.lower, search.upper, damping=_LATER, stop=_after(_FEWER)
        )
    return x, False


def _after(steps: int) -> Callable[[float, float], bool]:
    """What stops a run after so many steps."""
    left = iter(range(steps))
    return lambda *_: next(left, None) is None


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
    v, closed = x[: problem.nv], x
    if problem.at(x).gap > _TIGHT:
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
    return Short(
        dict(zip(search.pmap.free, search.coordinates.values(v).tolist(), strict=True)),
        initial,
        cost if np.isfinite(cost) else np.inf,
        settled,
        x,
        search.levels.by_name(search.sigma),
    )
