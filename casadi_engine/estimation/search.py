"""The search for an optimum: the problem set up once, run from any start, noise levels settled on the way."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EstimationError
from casadi_engine.estimation.constraints import ParameterConstraints, Priors
from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.estimation.ipopt import Solution, Solver
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.options import initial_bounds, interval_length
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.shooting import ShootingProblem
from casadi_engine.estimation.starts import chained_nodes, nodes_from_measurement
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters, compile
from casadi_engine.problem.noise import Noise
from casadi_engine.simulation.grid import lay_grid

Array = NDArray[np.float64]

# Noise levels that are estimated beside priors, several outputs or a robust loss are settled by repeated fits.
_ROUNDS, _LEVEL = 12, 1e-6
# Share of its median absolute deviation that the standard deviation of a normal variable is.
_MAD = 1.4826


@dataclass
class Attempt:
    """The outcome of one start: v (nv,) scaled parameters, cost = chi-squared + priors at the noise levels found."""

    solution: Solution
    v: Array
    cost: float
    sigma: Array
    iterations: int
    start: Array


class Search:
    """A fit's problem and solver."""

    def __init__(
        self,
        model: Model,
        data: tuple[Experiment, ...],
        parameters: Parameters,
        noise: Noise,
        *,
        interval: Any,
        initial: Any,
        loss: Loss,
        ties: str,
        method: str,
        max_iterations: int,
        tolerance: float,
        warm: Any,
        progress: Callable[[int, float, float], Any] | None,
    ) -> None:
        self.model, self.data, self.noise, self.loss = model, data, noise, loss
        self.outputs = tuple(out.name for out in model.outputs)
        _check_noise(noise, self.outputs, model)
        self.warm, self._progress = _checked_warm(warm), progress
        names = tuple(record.name for record in data)
        self.pmap = compile(parameters, model.parameter_names, names, ties=ties)  # type: ignore[arg-type]
        self.parameters = parameters
        nv = len(self.pmap.free)
        self.coordinates = Coordinates(self.pmap)
        scale = np.array([state.scale for state in model.states])
        gain = None if noise.gain is None else noise.gain / scale[:, None]
        self.records: list[RecordTerm] = []
        made: dict[int, Any] = {}
        for record in data:
            physical = self.pmap.physical[record.name]
            local = made.setdefault(id(physical), self.coordinates.substitute(physical))
            grid = lay_grid(model, record)
            self.records.append(
                RecordTerm(
                    model,
                    record,
                    self.coordinates.symbol,
                    local,
                    length=interval_length(interval, grid),
                    gain=gain,
                    method=method,
                    grid=grid,
                )
            )
        self.constraints = ParameterConstraints(model, self.pmap, self.coordinates)
        self.problem = ShootingProblem(
            self.records, self.constraints, Priors(self.pmap, self.coordinates), loss, nv
        )
        self._initial = [initial_bounds(initial, model, name, names) for name in names]
        self._bounds()
        self.sigma = self._first_levels()
        self._weigh(self.sigma)
        self._fraction = _variation(self.records)
        self.solver = Solver(
            self.problem, max_iterations=max_iterations, tolerance=tolerance, progress=self._report
        )

    # ---- bounds, noise

    def _bounds(self) -> None:
        pmap, problem = self.pmap, self.problem
        self.lower, self.upper = np.full(problem.size, -np.inf), np.full(problem.size, np.inf)
        nv = problem.nv
        self.lower[:nv], self.upper[:nv] = self.coordinates.of(pmap.lower), self.coordinates.of(pmap.upper)
        for lay, record, (low, high, _) in zip(problem.layouts, self.records, self._initial, strict=True):
            self.lower[lay.at : lay.at + lay.n] = low / record.scale
            self.upper[lay.at : lay.at + lay.n] = high / record.scale

    def _first_levels(self) -> Array:
        """Known noise levels, and for the others the scatter between neighbouring samples."""
        levels = []
        for name in self.outputs:
            level = self.noise.level(name)
            if level != "estimate":
                levels.append(float(level))
                continue
            series = [r.grid.measured[name].values for r in self.records if name in r.grid.measured]
            steps = np.concatenate([np.diff(s, 2) for s in series]) if series else np.zeros(0)
            size = max((float(np.abs(s).max()) for s in series), default=1.0)
            scatter = float(np.sqrt(np.mean(steps**2) / 6)) if len(steps) else 0.0
            levels.append(max(scatter, 1e-9 * size, 1e-300))
        return np.array(levels)

    def _weigh(self, sigma: Array) -> None:
        self.sigma = sigma
        for record in self.records:
            record.set_sigma(sigma)
        self.problem.forget()

    @property
    def estimated(self) -> list[bool]:
        """Whether the noise level of each output is estimated."""
        return [self.noise.level(name) == "estimate" for name in self.outputs]

    def levels_at(self, x: Array) -> Array:
        """Noise levels (ny,) from the residuals at x; known ones as they are."""
        point = self.problem.at(x)
        found = self.sigma.copy()
        lost = max(0.0, float(self.free_count))
        total = self.problem.samples
        for k, wanted in enumerate(self.estimated):
            if not wanted:
                continue
            parts = [
                p.r[record.observation.valid & (record.observation.column == k)]
                for record, p in zip(self.records, point.records, strict=True)
            ]
            r = np.concatenate(parts)
            if not len(r):
                continue
            if self.loss.robust:
                found[k] *= _MAD * float(np.median(np.abs(r - np.median(r))))
            else:
                found[k] *= float(np.sqrt(np.sum(r**2) / (len(r) * max(1.0 - lost / total, 1e-9))))
        size = max(float(np.abs(r.observation.measured).max(initial=0.0)) for r in self.records)
        return np.maximum(found, max(1e-12 * size, 1e-300))

    @property
    def free_count(self) -> int:
        """Number of free parameters and initial states, less the equalities between them."""
        fixed = sum(int((low == high).sum()) for low, high, _ in self._initial)
        fixed += int((self.constraints.lower == self.constraints.upper).sum())
        return self.problem.nv + sum(record.n for record in self.records) - fixed

    # ---- run

    def _warm_values(self, z: Array) -> Array:
        """The free parameters of a warm start as far as it has them, moved into the bounds."""
        known = self.warm.values
        found = [known.get(name, value) for name, value in zip(self.pmap.free, z, strict=True)]
        values = np.array(found, dtype=float)
        return np.clip(np.where(np.isfinite(values), values, z), self.pmap.lower, self.pmap.upper)

    def _start(self, z: Array, *, first: bool) -> Array:
        x = np.zeros(self.problem.size)
        nv = self.problem.nv
        x[:nv] = self.coordinates.of(z)
        for record, lay, bounds in zip(self.records, self.problem.layouts, self._initial, strict=True):
            nodes = self._warm_nodes(record, x[:nv]) if first else None
            if nodes is None:
                nodes = nodes_from_measurement(record, self.pmap.unpack(z, record.experiment.name))
            low, high, given = (part / record.scale for part in bounds)
            nodes[0] = np.clip(np.where(np.isfinite(given), given, nodes[0]), low, high)
            x[lay.at : lay.at + nodes.size] = nodes.ravel()
        return x

    def _warm_nodes(self, record: RecordTerm, v: Array) -> Array | None:
        states = (
            getattr(self.warm, "initial", {}).get(record.experiment.name) if self.warm is not None else None
        )
        if not states:
            return None
        names = [state.name for state in self.model.states]
        if not all(name in states for name in names):
            return None
        # the states of a Fit are estimates, those of a stored result numbers
        first = np.array([float(getattr(states[name], "value", states[name])) for name in names])
        try:
            return chained_nodes(record, v, first / record.scale)
        except FloatingPointError:
            return None

    def _warm_levels(self) -> Array:
        """Noise levels to start from: those of a warm start, as far as they are not known."""
        levels, before = self._first_levels(), getattr(self.warm, "noise", {})
        for k, name in enumerate(self.outputs):
            found = before.get(name) if self.estimated[k] else None
            levels[k] = found[0] if isinstance(found, tuple) and found[0] > 0 else levels[k]
        return levels

    def run(self, z: Array, *, first: bool = True) -> Attempt:
        """Search from z : (nz,), in the parameters' units."""
        z = self._warm_values(z) if first and self.warm is not None else z
        x = self._start(z, first=first)
        self._weigh(self._warm_levels() if first else self._first_levels())
        if not np.isfinite(self._objective(x)):
            raise EstimationError(
                "the model cannot be evaluated at the start values",
                seen=", ".join(f"{n}={value:.6g}" for n, value in zip(self.pmap.free, z, strict=True)),
                allowed="values for which the equations give finite numbers",
                cure="change the start values or the bounds",
            )
        known = {record.experiment.name for record in self.records} <= set(getattr(self.warm, "initial", ()))
        near = first and known and bool(getattr(self.warm, "converged", False))
        solution = self.solver.solve(x, self.lower, self.upper, exact=near)
        iterations = solution.iterations
        alone = sum(self.estimated) == 1 == len(self.outputs)
        settle = any(self.estimated) and (not alone or self.problem.priors.count or self.loss.robust)
        for _ in range(_ROUNDS if settle else 0):
            if solution.status != "converged":
                break
            levels = self.levels_at(solution.x)
            change = np.abs(levels / self.sigma - 1).max()
            self._weigh(levels)
            if change < _LEVEL:
                break
            solution = self.solver.solve(solution.x, self.lower, self.upper, exact=True)
            iterations += solution.iterations
        if any(self.estimated):
            self._weigh(self.levels_at(solution.x))
        cost = 2 * self.problem.samples * self._objective(solution.x)
        return Attempt(solution, solution.x[: self.problem.nv], cost, self.sigma.copy(), iterations, z)

    def _objective(self, x: Array) -> float:
        try:
            return self.problem.at(x).objective
        except (FloatingPointError, np.linalg.LinAlgError):
            return float("nan")

    def _report(self, iteration: int, objective: float) -> bool:
        if self._progress is None:
            return False
        chi2 = 2 * objective
        fit_percent = 100 * (1 - np.sqrt(max(chi2, 0.0) / self._fraction))
        return bool(self._progress(iteration, chi2 * self.problem.samples, float(fit_percent)))

    def close(self) -> None:
        """End the progress display."""
        if hasattr(self._progress, "close"):
            self._progress.close()  # type: ignore[union-attr]


def _checked_warm(warm: Any) -> Any:
    if warm is None or isinstance(getattr(warm, "values", None), Mapping):
        return warm
    raise EstimationError(
        "warm is not a result to start from",
        seen=repr(warm),
        allowed="a Fit, or a result loaded from a file",
        cure="give the fit itself: warm=fit",
    )


def _variation(records: list[RecordTerm]) -> float:
    """Mean square of the weighted outputs about their means: what a fit of 0 % leaves."""
    total, count = 0.0, 0
    for record in records:
        for name, sample in record.grid.measured.items():
            where = record.observation.where[name]
            weight = record.weight.ravel()[where]
            total += float((((sample.values - sample.values.mean()) * weight) ** 2).sum())
            count += len(sample.values)
    return max(total / max(count, 1), 1e-300)


def _check_noise(noise: Noise, outputs: tuple[str, ...], model: Model) -> None:
    for name in noise.outputs:
        if name not in outputs:
            raise EstimationError(
                f"the model {model.name} has no such output",
                seen=f"noise of {name!r}",
                allowed=", ".join(outputs),
                cure="name the model's outputs",
            )
    shape = (len(model.states), len(outputs))
    if noise.gain is not None and noise.gain.shape != shape:
        raise EstimationError(
            "the gain has the wrong shape",
            seen=str(noise.gain.shape),
            allowed=f"{shape}: states {', '.join(s.name for s in model.states)} by outputs {', '.join(outputs)}",
            cure="give one row for each state and one column for each output",
        )
