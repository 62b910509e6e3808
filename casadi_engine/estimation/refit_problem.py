"""The problem of a refit, set up once: over short windows first, then longer ones, then the whole record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import TimeUp, late
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.constraints import Priors
from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.estimation.integration import shorten_steps
from casadi_engine.estimation.levenberg_marquardt import minimise
from casadi_engine.estimation.options import initial_bounds, interval_length
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.refit_answer import Refit, Windowed, in_time
from casadi_engine.estimation.starts import chained_nodes, fitted_nodes, joined_nodes, nodes_from_measurement
from casadi_engine.estimation.windows import Place, Windows, simulated
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters, compile
from casadi_engine.parameters.compiled import ParameterMap
from casadi_engine.simulation.grid import lay_grid
from casadi_engine.simulation.null_path import NullPath, pieces_path, with_slope
from casadi_engine.simulation.propagator import fineness_of, switches_with_states
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator
from casadi_engine.simulation.shared_core import Cores

Array = NDArray[np.float64]

# Standard errors by which the end of a search may be off its optimum: a next step that promises less of chi-squared
# than their square ends it. Over a window a share of chi-squared, or half of one.
EXACT, _SHARE, _HALF = 0.01, 1e-3, 0.5
# Longest step of a logarithm, or of a number in units of its size; a number that starts at 0 has none.
_LONGEST = 1.5
# Gaps that count as none, by their effect on chi-squared as a share of that fall, and how often they are closed.
_CLOSED, _CLOSINGS = 1e-2, 6
# Evaluations over one horizon, in multiples of its steps, at which a search ends.
_ENOUGH = 3
# Rounds of shorter integration steps, each with a few steps from where the last one ended.
_SHORTENED = 4
TIME_UP = "the time was up"
# Growth of a window from one horizon to the next.
_GROWTH = 8


class RefitProblem:
    """What refits of one model have in common; arguments as those of ``refit``.

    felt : standard errors by which their ends may be off; twice as much by the integration
    """

    def __init__(
        self,
        model: Model,
        records: Sequence[Experiment],
        parameters: Parameters,
        *,
        levels: Mapping[str, float],
        interval: Any = "auto",
        felt: float = EXACT,
    ) -> None:
        self.model, self.felt = model, felt
        names = tuple(record.name for record in records)
        self.pmap: ParameterMap = compile(parameters, model.parameter_names, names)
        sigma = np.array([_level(levels, output.name) for output in model.outputs])
        self.coordinates, cores = Coordinates(self.pmap), Cores()
        local: dict[int, Any] = {}
        self.records: list[RecordTerm] = []
        for record in records:
            grid, physical = lay_grid(model, record), self.pmap.physical[record.name]
            own = local.setdefault(id(physical), self.coordinates.substitute(physical))
            length = interval_length(interval, grid, whole=switches_with_states(model))
            term = RecordTerm(
                model, record, self.coordinates.symbol, own,
                length=length, gain=None, method="exact", grid=grid, cores=cores,
            )  # fmt: skip
            term.set_sigma(sigma)
            self.records.append(term)
        self.count = sum(record.count for record in self.records)
        self.priors = Priors(self.pmap, self.coordinates)
        self.bounds = self.coordinates.of(self.pmap.lower), self.coordinates.of(self.pmap.upper)
        zero = (self.pmap.start == 0) & ~self.coordinates.log
        self._endless = np.where(zero, np.inf, 1.0)

    # ---- run

    def run(
        self,
        *,
        start: Mapping[str, float] | None = None,
        initial: Mapping[str, Mapping[str, Any]] | None = None,
        warm: Refit | None = None,
        horizons: Sequence[float | None] | None = None,
        most: int = 60,
        near: Sequence[Array] | None = None,
        after: Windowed | None = None,
    ) -> Refit:
        """The refit from a start; see ``refit``. near : states (M, n) of each record's intervals near those of the
        simulation from ``initial``; after : what it goes on from in place of a start"""
        self._check_constraints()
        if after is not None:
            start = {**after.values, **(start or {})}
            after = after if self._cut_alike(after) else self.windowed(start, most=most)
        z = self._values(start, warm)
        v = self.coordinates.of(z)
        self._steps = 0
        with np.errstate(all="ignore"):
            try:
                close = near if near is not None else [None] * len(self.records)
                nodes = (
                    [
                        self._nodes(record, v, z, initial, warm, own)
                        for record, own in zip(self.records, close, strict=True)
                    ]
                    if after is None
                    else list(after.nodes)
                )
                begun = None if after is None else list(after.begun)
                counts = self._counts(horizons)
                return self._searched(v, nodes, counts, most, warm, near=near is not None, states=begun)
            except (FloatingPointError, np.linalg.LinAlgError) as fault:
                if self.step_in_places():
                    return self.run(
                        start=start, initial=initial, warm=warm, horizons=horizons, most=most, near=near,
                        after=after,
                    )  # fmt: skip
                return self._failed(z, f"the model cannot be evaluated: {fault}")

    def windowed(
        self, start: Mapping[str, float] | None, after: Windowed | None = None, *, most: int = 60
    ) -> Windowed:
        """Where the search over windows ends, all horizons but the whole records; over the last of them alone after
        another one.

        Raises FloatingPointError, LinAlgError where the model cannot be evaluated."""
        self._check_constraints()
        if after is not None and not self._cut_alike(after):
            start, after = {**after.values, **(start or {})}, None
        z = self._values({**(after.values if after is not None else {}), **(start or {})}, None)
        v, ladder = self.coordinates.of(z), self._counts(None)[:-1]
        self._steps, begun = 0, after and list(after.begun)
        with np.errstate(all="ignore"):
            try:
                nodes = (
                    [self._nodes(r, v, z, None, None) for r in self.records]
                    if after is None
                    else [*after.nodes]
                )
                for counts in ladder if after is None else ladder[-1:]:
                    place, status = self._descended(counts, v, nodes, most, last=False)
                    v, nodes = place.v, list(place.nodes)
                    begun = begun or nodes
            except (FloatingPointError, np.linalg.LinAlgError):
                if self.step_in_places():
                    return self.windowed(start, after, most=most)
                raise
        values = dict(zip(self.pmap.free, self.coordinates.values(v).tolist(), strict=True))
        cost = 2 * place.squares.cost
        return Windowed(values, tuple(nodes), tuple(begun or nodes), cost, status == "converged")

    def step_in_places(self, *, anyway: bool = False) -> bool:
        """Take steps that are short where a corner is passed, in place of those of a linear core, which are alike
        everywhere and too long for a sharp one; False where all do. anyway : see ``RecordTerm.step_in_places``"""
        stepped = [record.step_in_places(anyway=anyway) for record in self.records]  # each of them
        return any(stepped)

    def _cut_alike(self, after: Windowed) -> bool:
        """True if a search over windows cut the records as they are cut here: another integrator may not."""
        return all(len(own) == record.plan.m for own, record in zip(after.nodes, self.records, strict=True))

    def _searched(
        self,
        v: Array,
        nodes: list[Array],
        ladder: list[list[int]],
        most: int,
        warm: Refit | None,
        *,
        near: bool,
        states: list[Array] | None = None,
    ) -> Refit:
        """The refit over horizons of so many intervals of each record.

        states : of the intervals over the first horizon, where that is done
        near : it begins near an optimum, so that steps are made there as short as they have to be: steps that are too
        long for a corner make chi-squared rough, and a search would only wander over that
        """
        for counts in ladder[:-1]:
            place, _ = self._descended(counts, v, nodes, most, last=False)
            v, nodes = place.v, list(place.nodes)
            states = states or nodes
        self._as_fine_as(warm)
        if near:
            self._shortened(ladder[-1], v, nodes)
        place, status = self._descended(ladder[-1], v, nodes, most, last=True)
        for _ in range(_SHORTENED):
            try:
                misfit = 2 * place.squares.cost / max(self.count, 1)
                if status != "converged" or not shorten_steps(
                    self.records, place.v, place.nodes, misfit, 2 * self.felt
                ):
                    break
                place, status = self._descended(ladder[-1], place.v, list(place.nodes), most, last=True)
            except TimeUp:  # what there is stays what it was
                status = TIME_UP
        return self._answer(place, states or list(place.nodes), status)

    def _shortened(self, counts: list[int], v: Array, nodes: list[Array]) -> None:
        """Give the integration steps as short as they have to be at a point."""
        for _ in range(_SHORTENED):
            windows = Windows(self.records, self.priors, counts, nodes)
            if windows(v) is None:
                return  # what is wrong is said where the search begins
            misfit = 2 * windows.best.squares.cost / max(self.count, 1)
            self._steps += windows.evaluations
            if not shorten_steps(self.records, v, list(windows.best.nodes), misfit, 2 * self.felt):
                return

    def _as_fine_as(self, warm: Refit | None) -> None:
        """Integrate as finely as a refit before did in the end, where the integrators are alike."""
        for record in self.records:
            record.as_fine_as(None if warm is None else warm.fineness.get(record.experiment.name))

    def _descended(
        self, counts: list[int], v: Array, nodes: list[Array], most: int, *, last: bool
    ) -> tuple[Place, str]:
        """Where the search over one horizon ends, and its status; over the last one gaps are closed."""
        windows = Windows(self.records, self.priors, counts, nodes)
        converged, (low, high) = False, self.bounds
        v = np.clip(v, low, high)
        if windows(v) is None:
            raise FloatingPointError("its states or slopes are not finite")
        for _ in range(_CLOSINGS if last else 1):
            before = windows.best.squares.cost
            unit = max(1.0, 2 * before / self.count)  # of chi-squared, where the model is wrong
            fall = 0.5 * self.felt**2 * unit if last else max(_HALF, _SHARE * before)
            try:
                found = minimise(
                    windows, v, low, high, fall=fall, steps=most, longest=self._longest,
                    anew=lambda at: windows.closed_at(at, _CLOSED * fall),  # noqa: B023
                )  # fmt: skip
                if found is None:
                    raise FloatingPointError("its states or slopes are not finite")
                v, converged = windows.best.v, found.converged
                if windows.evaluations > _ENOUGH * most:  # gaps that open again as often as they are closed
                    converged = False
                    break
                if not last:
                    break
                closed, after = self._closed(windows, fall), windows.best.squares.cost
                if after > 2 * max(
                    before, self.count
                ):  # no run follows these states: first order said too much
                    converged = False
                elif closed and before < 2 * max(after, self.count):
                    break
            except TimeUp:  # the best point so far
                converged = False
                break
        self._steps += windows.evaluations
        why = TIME_UP if late() else f"the {most} steps over a horizon ran out"
        return windows.best, "converged" if converged else why

    def _closed(self, windows: Windows, fall: float) -> bool:
        """Close the gaps; True if the cost is the one that the search ended at."""
        begun = windows.best.squares.cost
        for _ in range(_CLOSINGS):
            if windows.gaps <= _CLOSED * fall:
                break
            windows.closed()
        return abs(windows.best.squares.cost - begun) <= fall

    def _longest(self, v: Array) -> Array:
        size = np.where(self.coordinates.log, 1.0, np.maximum(1.0, np.abs(v)))
        return np.asarray(_LONGEST * size * self._endless)

    # ---- simulation alone

    def simulated(self, values: Mapping[str, float], initial: Mapping[str, Any]) -> list[Array]:
        """The states (M, n) of each record's intervals in a simulation from these values and initial states."""
        z = self._values(values, None)
        return [self._nodes(record, self.coordinates.of(z), z, initial, None) for record in self.records]

    def nodes_of(self, refit: Refit) -> list[Array]:
        """The states (M, n) of each record's intervals where a refit ended, which may have cut records otherwise."""
        same = all(len(own) == record.plan.m for own, record in zip(refit.nodes, self.records, strict=True))
        return list(refit.nodes) if same else self.simulated(refit.values, refit.initial)

    def cost_from(self, values: Mapping[str, float], nodes: Sequence[Array]) -> float:
        """Chi-squared without priors of the run at these values from the first of each record's states, by steps of
        the integration that move no estimate; nodes : (M, n), near that run."""
        v = self.coordinates.of(np.array([values[name] for name in self.pmap.free]))
        for _ in range(1 + _SHORTENED):
            try:
                residuals, nodes, _ = simulated(self.records, v, nodes)
            except FloatingPointError:
                if not self.step_in_places():
                    raise
                residuals, nodes, _ = simulated(self.records, v, nodes)
            if not shorten_steps(self.records, v, nodes):
                break
        return float(sum(np.sum(r**2) for r in residuals))

    def glance(self, values: Mapping[str, float], nodes: Sequence[Array]) -> float:
        """The same by the steps that there are."""
        v = self.coordinates.of(np.array([values[name] for name in self.pmap.free]))
        return float(sum(np.sum(r**2) for r in simulated(self.records, v, nodes)[0]))

    def glance_from(self, values: Mapping[str, float], initial: Mapping[str, Any]) -> float:
        """The same of a simulation from values, those of the set where they are left out, and initial states."""
        z = self._values(values, None)
        nodes = self.simulated(values, initial)
        return self.glance(dict(zip(self.pmap.free, z.tolist(), strict=True)), nodes)

    def paths(self, values: Mapping[str, float], nodes: Sequence[Array]) -> list[NullPath]:
        """The records' simulations at these values, likewise."""
        z = np.array([values[name] for name in self.pmap.free])
        points = simulated(self.records, self.coordinates.of(z), nodes)[2]
        return [
            self._path(record, point.path.x, z) for record, point in zip(self.records, points, strict=True)
        ]

    def measured_paths(self, start: Mapping[str, float]) -> list[NullPath]:
        """The same piece by piece, each shooting interval from the states that explain its own samples."""
        z, found = self._values(start, None), []
        v = self.coordinates.of(z)
        for record in self.records:
            nodes = self._nodes(record, v, z, None, None)
            values, length = self.pmap.unpack(z, record.experiment.name), record.plan.length
            path = None
            if record.linear:  # which steps by blocks of samples
                nodes = fitted_nodes(record, v, nodes)
                path = pieces_path(self.model, record.grid, values, nodes * record.scale, length)
            if path is None:
                path = self._path(record, record.outputs_at(v, nodes)[1].x, z)
            found.append(path)
        return found

    def _path(self, record: RecordTerm, states: Array, z: Array) -> NullPath:
        """From the scaled states of a record's intervals."""
        whole = states[: record.plan.length].transpose(1, 2, 0).reshape(record.n, -1)
        x = whole[:, : record.grid.samples] * record.scale[:, None]
        return with_slope(self.model, record.grid, x, self.pmap.unpack(z, record.experiment.name))

    # ---- where it starts

    def _check_constraints(self) -> None:
        labels = [one.label for one in self.pmap.constraints]
        labels += [one.label for one in self.pmap.frequency_constraints]
        if labels:
            raise EstimationError(
                "a refit keeps bounds, ties and priors alone",
                seen=", ".join(labels),
                allowed="a parameter set without constraints",
                cure="take estimate(), which keeps constraints",
            )

    def _values(self, start: Mapping[str, float] | None, warm: Refit | None) -> Array:
        known = {**(warm.values if warm is not None else {}), **(start or {})}
        z = np.array(
            [known.get(name, own) for name, own in zip(self.pmap.free, self.pmap.start, strict=True)]
        )
        return np.clip(z.astype(float), self.pmap.lower, self.pmap.upper)

    def _nodes(
        self,
        record: RecordTerm,
        v: Array,
        z: Array,
        initial: Any,
        warm: Refit | None,
        near: Array | None = None,
    ) -> Array:
        """The states (M, n) of a record's intervals at which the search begins, scaled."""
        name, states = record.experiment.name, [state.name for state in self.model.states]
        given = (initial or {}).get(name)
        before = None if warm is None else warm.records.get(name)
        count = record.plan.m
        if given is None and before is not None and len(before.states) == count:
            known = dict(zip(warm.initial[name], before.states.T, strict=True))  # type: ignore[union-attr]
            if all(state in known for state in states):
                return np.stack([known[state] for state in states], axis=1) / record.scale
        measured = nodes_from_measurement(record, self.pmap.unpack(z, name))
        if given is not None:
            first = initial_bounds(given, self.model, name, [name])[2] / record.scale
            first = np.where(np.isfinite(first), first, measured[0])
            if near is None or near.shape != measured.shape:
                return chained_nodes(record, v, first)
            return joined_nodes(record, v, np.concatenate([first[None], near[1:]]))
        if before is not None and len(before.states) == count:
            for state in known.keys() & set(states):  # the others are an effect's own
                measured[:, states.index(state)] = known[state] / record.scale[states.index(state)]
        elif isinstance(record.propagator, RungeKuttaPropagator):
            measured = fitted_nodes(record, v, measured)
        return measured

    def _counts(self, horizons: Sequence[float | None] | None) -> list[list[int]]:
        """Intervals of the windows of each record, for one horizon after the other."""
        if horizons is None:
            most, counts = max(record.plan.m for record in self.records), [2]
            while _GROWTH * counts[-1] < most // 2:
                counts.append(_GROWTH * counts[-1])
            return [[min(c, r.plan.m) for r in self.records] for c in counts] + [self._whole()]
        found = []
        for horizon in horizons:
            own = self._whole()
            if horizon is not None:
                own = [
                    int(np.clip(round(horizon / (r.grid.step * r.plan.length)), 1, r.plan.m))
                    for r in self.records
                ]
            found.append(own)
        return found or [self._whole()]

    def _whole(self) -> list[int]:
        return [record.plan.m for record in self.records]

    # ---- the answer

    def _answer(self, place: Place, states: list[Array], status: str) -> Refit:
        v, z = place.v, self.coordinates.values(place.v)
        slope = self.coordinates.slope(v)
        names = [state.name for state in self.model.states]
        cost, _, _, prior = self.priors.evaluate(v)
        initial, records = {}, {}
        for record, own, nodes, before in zip(self.records, place.records, place.nodes, states, strict=True):
            name = record.experiment.name
            begun = own.moved(nodes, np.zeros(len(record.active)))[0] * record.scale
            initial[name] = dict(zip(names, begun.tolist(), strict=True))
            records[name] = in_time(record, own.slopes, slope, before)
        return Refit(
            free=self.pmap.free,
            values=dict(zip(self.pmap.free, z.tolist(), strict=True)),
            initial=initial,
            cost=2 * place.squares.cost,
            prior_cost=2 * float(cost),
            prior_information=prior / np.outer(slope, slope),
            records=records,
            status=status,
            steps=self._steps,
            fineness={record.experiment.name: fineness_of(record.propagator) for record in self.records},
            nodes=place.nodes,
        )

    def _failed(self, z: Array, status: str) -> Refit:
        nz = len(z)
        values = dict(zip(self.pmap.free, z.tolist(), strict=True))
        return Refit(self.pmap.free, values, {}, np.inf, 0.0, np.zeros((nz, nz)), {}, status, self._steps)


def _level(levels: Mapping[str, float], output: str) -> float:
    found = levels.get(output)
    if isinstance(found, (int, float, np.floating)) and 0 < found < np.inf:
        return float(found)
    raise EstimationError(
        f"the noise level of {output} is not acceptable",
        seen=repr(found),
        allowed="a standard deviation > 0 in the unit of the output",
        cure=f"write levels={{{output!r}: 0.1}}, for instance",
    )
