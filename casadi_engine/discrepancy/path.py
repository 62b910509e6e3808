"""The one path of refits: every candidate's complete model, from short windows to the whole record.

Long simulations of a wrong model have many optima; over short windows, whose first states are free, an added torque is
nearly linear and there are few. A refit therefore starts in windows (``estimation.pieces``), goes on to longer ones and
ends in a multiple-shooting problem whose gaps close; it is also started from the best point that is known, where the
new amplitude is what one step predicts. The better end counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from casadi_engine.discrepancy.from_search import null_of_search
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.null_model import NullModel, null_at
from casadi_engine.discrepancy.refit import Addition, Refitter
from casadi_engine.discrepancy.start import Start
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation.loss import read_loss
from casadi_engine.estimation.pieces import approach
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.starts import chained_nodes, nodes_from_measurement
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise

# A fall of chi-squared in one step below which a refit has arrived.
_ARRIVED = 0.1
# Steps of one start, and rounds in which gaps that add up are closed by simulation, with steps after each.
_STEPS, _CLOSINGS, _MORE = 40, 4, 3
# Share of the diagonal added to the Gauss-Newton matrix at first, and from a point that is near.
_DAMPING, _NEAR = 0.1, 1e-3
# A gap of the continuity (of scaled states) that counts as closed, and as none.
_CLOSED, _TIGHT = 1e-2, 1e-6
# Samples of all records above which integration is limited to so many steps in all; share of an amplitude from which a
# search starts, again and again, where its own asks for more.
_LONG, _INTEGRATION = 4000, 1e5
_SMALLER, _TIMES = 0.125, 4

FAILURES = (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError)


@dataclass(frozen=True, eq=False)
class Arrived:
    """Where a refit ended: values and first states, as ``estimate(warm=...)`` reads them.

    cost : chi-squared with priors at the levels of the path, simulated from the first states
    settled : one more step would change it little; held : parameters at a bound
    """

    values: Mapping[str, float]
    initial: Mapping[str, Mapping[str, float]]
    cost: float
    settled: bool
    held: frozenset[str] = frozenset()
    noise: Mapping[str, tuple[float, bool]] = field(default_factory=dict)
    converged: bool = True
    x: Array = field(default_factory=lambda: np.zeros(0), repr=False)


class Path:
    """Refits of one set of records at held noise levels; a model with its effects is set up once.

    levels : output -> standard deviation of the noise
    """

    def __init__(self, refitter: Refitter, levels: Mapping[str, float]) -> None:
        self.refitter, self.levels = refitter, dict(levels)
        self._made: dict[tuple[int, ...], Search | None] = {}
        self._kept: list[Addition] = []

    def from_point(self, effects: Sequence[Addition], start: Start | Arrived | None) -> Arrived | None:
        """The end of a refit from a point, None for the parameters' own values; None where the model fails."""
        return self._ended(effects, lambda search: _first(search, start, effects))

    def from_windows(self, effects: Sequence[Addition], start: Start | None = None) -> Arrived | None:
        """The end of a refit that begins in short windows, at the values of a start or the parameters' own."""
        return self._ended(effects, lambda search: _by_windows(search, start))

    def linear(self, effects: Sequence[Addition]) -> bool:
        """True if the equations with these effects are linear in the states: then windows have nothing to tell."""
        search = self._search(effects)
        return search is not None and all(record.linear for record in search.records)

    def residuals(self, effects: Sequence[Addition], arrived: Arrived) -> NullModel:
        """Residuals and slopes where a refit of these effects ended, as its own integrator has them."""
        search = self._search(effects)
        assert search is not None
        try:
            return null_of_search(search, arrived.x)
        finally:
            search.problem.forget()  # a point of a long record is large, and there are many problems

    def null_at(self, effects: Sequence[Addition], arrived: Arrived) -> NullModel:
        """The model with these effects, linearised where a refit of them ended."""
        search = self._search(effects)
        assert search is not None
        names = [state.name for state in search.model.states]
        first = {record: np.array([own[n] for n in names]) for record, own in arrived.initial.items()}
        z = np.array([arrived.values[name] for name in search.pmap.free])
        return null_at(search.model, search.data, search.parameters, z, first)

    def at(self, values: Mapping[str, float], initial: Mapping[str, Mapping[str, float]]) -> Arrived:
        """The model without effects at known parameters and first states."""
        search = self._search(())
        assert search is not None
        return _arrived(search, _first(search, Start(values, initial), ()), True)

    def first_states(self) -> dict[str, Array]:
        """record -> (n,) first states that the measurement gives at the parameters' own values."""
        search = self._search(())
        assert search is not None
        search.warm = None
        x = search._start(search.pmap.start, first=True)
        return {
            record.experiment.name: x[lay.at : lay.at + lay.n] * record.scale
            for record, lay in zip(search.records, search.problem.layouts, strict=True)
        }

    def parameters(self, effects: Sequence[Addition]) -> Any:
        """The parameters of the model with these effects."""
        search = self._search(effects)
        assert search is not None
        return search.parameters

    def relevel(self, levels: Mapping[str, float]) -> None:
        """Weigh all further refits by other levels."""
        self.levels = dict(levels)
        for search in self._made.values():
            if search is not None:
                search._weigh(np.array([levels[out.name] for out in search.model.outputs]))

    # ---- inside

    def _ended(self, effects: Sequence[Addition], begin: Callable[[Search], Array]) -> Arrived | None:
        try:
            with np.errstate(all="ignore"):
                search = self._search(effects)
                if search is None:
                    return None
                x = begin(search)
                x, settled = _descended(search, x)
                return _arrived(search, x, settled)
        except FAILURES:
            return None

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
        pars = refitter.parameters_of(model, effects)
        search = set_up(model, refitter.data, pars, self.levels, refitter.options)
        count = sum(max(len(one[name].time) for name in one.names) for one in refitter.data)
        if count > _LONG:
            for record in search.records:
                record.limit_steps(max(1, int(_INTEGRATION / count)))
        return search


def set_up(
    model: Model,
    data: Sequence[Experiment],
    parameters: Parameters,
    levels: Mapping[str, float],
    options: Mapping[str, Any],
) -> Search:
    """The problem of one model at held noise levels; options : of ``estimate``."""
    return Search(
        model,
        tuple(data),
        parameters,
        Noise(**levels),
        interval=options.get("interval", "auto"),
        initial=options.get("initial"),
        loss=read_loss("square"),
        ties="substitute",
        method=options.get("method", "exact"),
        max_iterations=200,
        tolerance=1e-6,
        warm=None,
        progress=None,
    )


def settled(search: Search) -> Start | None:
    """Where a refit from the measured states ends; None where the model fails."""
    try:
        with np.errstate(all="ignore"):
            found = _arrived(search, *_descended(search, search._start(search.pmap.start, first=True)))
    except FAILURES:
        return None
    return Start(found.values, found.initial, found.noise, found.settled)


def _first(search: Search, start: Any, effects: Sequence[Addition]) -> Array:
    """The point (size,) that a search starts from: with a smaller amplitude where its own takes too many steps."""
    search.warm = start
    z = search.pmap.start if start is None else search._warm_values(search.pmap.start)
    x = search._start(z, first=True)
    amplitude = effects[-1].amplitude if effects else None
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


def _by_windows(search: Search, start: Start | None) -> Array:
    """The point (size,) that predictions over short windows, and then longer ones, lead to."""
    search.warm = start
    z = search.pmap.start if start is None else search._warm_values(search.pmap.start)
    nv = search.problem.nv
    v = approach(
        search.records,
        [search.coordinates.of(z)],
        lambda record: nodes_from_measurement(record, search.pmap.unpack(z, record.experiment.name)),
        coordinates=search.coordinates,
        bounds=(search.lower[:nv], search.upper[:nv]),
        sigma=search.sigma,
    )
    found = np.clip(search.coordinates.values(v), search.pmap.lower, search.pmap.upper)
    search.warm = None
    return search._start(found if np.isfinite(found).all() else z, first=False)


def _descended(search: Search, x: Array) -> tuple[Array, bool]:
    """Where Gauss-Newton steps from a point end, and whether they have settled there with their gaps closed."""
    problem = search.problem
    if problem.user.count:
        # constraints beside bounds have multipliers, which Gauss-Newton steps alone do not settle
        found = search.solver.solve(x, search.lower, search.upper)
        return found.x, found.status == "converged"
    settling = _Settling(2 * problem.samples, _STEPS)
    x = search.solver.gauss_newton(x, search.lower, search.upper, damping=_DAMPING, stop=settling)
    if not settling.settled:
        return x, False
    for _ in range(_CLOSINGS):
        point = problem.at(x)
        if point.gap <= _TIGHT:
            return x, True
        simulated = _simulated(search, x)
        if 2 * problem.samples * (problem.at(simulated).objective - point.objective) < _ARRIVED:
            return simulated, True
        few = _Settling(2 * problem.samples, _MORE)
        x = search.solver.gauss_newton(simulated, search.lower, search.upper, damping=_NEAR, stop=few)
    return x, False


class _Settling:
    """What stops a run: one more step changes chi-squared by little, or there were too many."""

    def __init__(self, unit: float, most: int) -> None:
        self.unit, self.most, self.last, self.done, self.settled = unit, most, np.inf, 0, False

    def __call__(self, objective: float, gap: float) -> bool:
        cost = self.unit * objective
        self.settled = gap < _CLOSED and abs(self.last - cost) < _ARRIVED
        self.last = cost if gap < _CLOSED else np.inf
        self.done += 1
        return self.settled or self.done > self.most


def _simulated(search: Search, x: Array) -> Array:
    """The point with its nodes simulated from the first states."""
    closed = x.copy()
    for record, lay in zip(search.records, search.problem.layouts, strict=True):
        first = x[lay.at : lay.at + lay.n]
        closed[lay.at : lay.at + lay.m * lay.n] = chained_nodes(record, x[: search.problem.nv], first).ravel()
    return closed


def _arrived(search: Search, x: Array, settled: bool) -> Arrived:
    """The point with its gaps closed by simulation where they are not."""
    problem = search.problem
    nv, closed = problem.nv, x
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
    span = np.maximum(np.abs(x[:nv]), 1e-12)
    low = x[:nv] - search.lower[:nv] <= 1e-8 * span
    high = search.upper[:nv] - x[:nv] <= 1e-8 * span
    held = frozenset(name for name, at in zip(search.pmap.free, low | high, strict=True) if at)
    return Arrived(
        dict(zip(search.pmap.free, search.coordinates.values(x[:nv]).tolist(), strict=True)),
        initial,
        cost if np.isfinite(cost) else np.inf,
        settled,
        held,
        search.levels.by_name(search.sigma),
        x=closed,
    )
