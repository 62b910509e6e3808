"""The problem of a fit, laid out: records, coordinates, bounds and noise levels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EstimationError
from casadi_engine.estimation.constraints import ParameterConstraints, Priors
from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.estimation.innovations import SizedPriors, StableLoop
from casadi_engine.estimation.levels import NoiseLevels, check_noise, check_samples
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.options import initial_bounds, interval_length
from casadi_engine.estimation.predictor import Predictor
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.scales import sized
from casadi_engine.estimation.shooting import ShootingProblem
from casadi_engine.estimation.spectral_start import asked_in_full, complete
from casadi_engine.estimation.taken import are_few, taken
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters, compile
from casadi_engine.problem.noise import Noise
from casadi_engine.simulation.grid import Grid, lay_grid
from casadi_engine.simulation.propagator import switches_with_states
from casadi_engine.simulation.shared_core import Cores

Array = NDArray[np.float64]


class LaidProblem:
    """The terms of a fit's records, its parameters' coordinates, and the levels that weigh its residuals."""

    def __init__(
        self,
        model: Model,
        data: tuple[Experiment, ...],
        parameters: Parameters,
        noise: Noise | None,
        *,
        interval: Any,
        initial: Any,
        loss: Loss,
        ties: str,
        method: str,
        warm: Any,
    ) -> None:
        noise = check_noise(noise, model)
        self.model, self.data, self.noise, self.loss = model, data, noise, loss
        self.warm = _checked_warm(warm, parameters)
        names = tuple(record.name for record in data)
        self._grids = {record.name: lay_grid(model, record) for record in data}
        self.predictor = Predictor(noise, model, list(self._grids.values()), parameters)
        wanted = (*model.parameter_names, *self.predictor.names)
        whole = compile(parameters, wanted, names, ties=ties)  # type: ignore[arg-type]
        pmap, self._whole_tails = self.predictor.split(whole)
        self.pmap = sized(pmap, self.warm)
        self.parameters = parameters
        self._initial = [initial_bounds(initial, model, name, names) for name in names]
        self.cut, self._method = interval, method
        self._lay(noise, Coordinates(self.pmap))
        if self.problem.nv:
            check_samples(noise, self.records, self.free_count, len(self.pmap.priors))
        self._weigh(self.levels.first(self.warm))

    def _lay(self, noise: Noise, coordinates: Coordinates, larger: Array | None = None) -> None:
        """Set the problem up in these coordinates, the states' scales times ``larger`` (n,)."""
        scale = np.array([state.scale for state in self.model.states])
        self._scale = scale if larger is None else scale * larger
        self.coordinates = coordinates
        self._tails: dict[str, Any] = {}
        self.records, level = self._terms(self._grids, self._whole_tails, self.cut, self._method)
        if getattr(self.warm, "in_places", False):
            for record in self.records:
                record.step_in_places(anyway=True)
        for record in self.records:
            record.as_fine_as(getattr(self.warm, "fineness", {}).get(record.experiment.name))
        priors: Any = Priors(self.pmap, self.coordinates)
        if level is not None:
            self._check_loss()
            priors = SizedPriors(priors, self.records, level)
            noise = Noise(**dict(zip(self.predictor.outputs, level.tolist(), strict=True)))
        self.constraints = ParameterConstraints(self.model, self.pmap, self.coordinates, self._stable())
        self.problem = ShootingProblem(self.records, self.constraints, priors, self.loss, len(self.pmap.free))
        self._bounds()
        self.sigma = np.zeros(0)
        self.levels = NoiseLevels(noise, self.model, self.records)

    def _terms(
        self, grids: dict[str, Grid], tails: dict[str, Any], interval: Any, method: str
    ) -> tuple[list[RecordTerm], Array | None]:
        """The records' terms, and with noise covariances the levels (ny,) to which innovations are whitened."""
        made: dict[int, Any] = {}
        cores, records = Cores(), []
        level: Array | None = None
        outputs = tuple(out.name for out in self.model.outputs)
        linear = self.model.linear is not None and not self.model.has_slot_laws
        bins = linear and not self.pmap.constraints and asked_in_full(self) is None
        for record in self.data:
            grid, physical = grids[record.name], self.pmap.physical[record.name]
            local = made.setdefault(id(physical), self.coordinates.substitute(physical))
            own = self._tails[record.name] = self.coordinates.substitute(tails[record.name])
            if self.predictor.kind == "process" and level is None:
                start = self.coordinates.of(self.pmap.start)
                level = self.predictor.reference(own, local, self.coordinates.symbol, start, grid)
            term = RecordTerm(
                self.model,
                record,
                self.coordinates.symbol,
                local,
                length=interval_length(
                    interval,
                    grid,
                    whole=switches_with_states(self.model),
                    few=bins and grid.uniform and complete(grid, outputs),
                ),
                gain=self.predictor.plan(own, local, level),
                method=method,
                grid=grid,
                cores=cores,
                scale=self._scale,
            )
            records.append(term)
        return records, level

    def _check_loss(self) -> None:
        """Raise for a robust loss beside noise covariances."""
        if self.loss.robust:
            raise EstimationError(
                "a robust loss does not go with noise covariances: outliers would pass for process noise",
                seen="process= and a robust loss",
                allowed='loss="square" with process=',
                cure='take Noise(omega="innovations"), whose gain is free, or mask the outliers',
            )

    def plain_gain(self, record: RecordTerm) -> Any:
        """The gain of a record whose innovations stay in the outputs' units."""
        return self.predictor.plan(self._tails[record.experiment.name], record.symbols[1])

    def _stable(self) -> list[StableLoop]:
        """For an estimated gain, that every record's predictor forgets; once for records that share it."""
        if self.predictor.kind != "innovations":
            return []
        own = {tuple(r.active.tolist()): r for r in reversed(self.records)}
        size, every = len(self.pmap.free), self.predictor.every
        return [StableLoop(record, every, size, alone=len(own) == 1) for record in own.values()]

    # ---- bounds, noise

    def _bounds(self) -> None:
        pmap, problem = self.pmap, self.problem
        self.lower, self.upper = np.full(problem.size, -np.inf), np.full(problem.size, np.inf)
        nv = problem.nv
        self.lower[:nv], self.upper[:nv] = self.coordinates.of(pmap.lower), self.coordinates.of(pmap.upper)
        for lay, record, (low, high, _) in zip(problem.layouts, self.records, self._initial, strict=True):
            self.lower[lay.at : lay.at + lay.n] = low / record.scale
            self.upper[lay.at : lay.at + lay.n] = high / record.scale

    def _weigh(self, sigma: Array) -> None:
        """Weight all residuals by the levels (ny,)."""
        if np.array_equal(sigma, self.sigma):  # what was evaluated still holds
            return
        self.sigma = sigma
        for record in self.records:
            record.set_sigma(sigma)
        self.problem.forget()
        self._fraction: float | None = None

    def levels_at(self, x: Array) -> Array:
        """Noise levels (ny,) from the residuals at x; known ones as they are."""
        own = taken(self, x) if are_few(self) else None
        return self.levels.at(self.problem.at(x).records, self.sigma, self.loss, self.free_count, own)

    @property
    def free_count(self) -> int:
        """Number of free parameters and initial states, less the equalities between them."""
        fixed = sum(int((low == high).sum()) for low, high, _ in self._initial)
        fixed += int((self.constraints.lower == self.constraints.upper).sum())
        return self.problem.nv + sum(record.n for record in self.records) - fixed

    @property
    def lost(self) -> float:
        """Share of the samples that free parameters and initial states take."""
        return self.free_count / max(sum(record.count for record in self.records), 1)

    def _objective(self, x: Array) -> float:
        try:
            return self.problem.at(x).objective
        except (FloatingPointError, np.linalg.LinAlgError):
            return float("nan")

    def _in_places(self) -> bool:
        """Go on by steps that may be short in places and implicit, where laws were found too stiff for those of the
        linear core; False where none was, or none can."""
        changed = [record.stiff and record.step_in_places() for record in self.records]  # each of them
        if any(changed):
            self.problem.forget()
        return any(changed)

    def _lower(self, one: Array, other: Array) -> bool:
        """True if the objective is lower at one point than at another, or is none there."""
        before, after = self._objective(other), self._objective(one)
        return bool(after < before or (np.isfinite(after) and not np.isfinite(before)))


def _checked_warm(warm: Any, parameters: Parameters) -> Any:
    if warm is None:
        return None
    if isinstance(values := getattr(warm, "values", None), Mapping):
        if not values or not {name.split("@")[0] for name in values}.isdisjoint(parameters.names):
            return warm
        raise EstimationError(
            "warm is the result of another model: it has none of the parameters",
            seen=", ".join(map(str, values)) or "no parameter",
            allowed=", ".join(parameters.names),
            cure="give a fit of this model, or of one that shares parameters with it, or leave warm out",
        )
    raise EstimationError(
        "warm is not a result to start from",
        seen=repr(warm),
        allowed="a Fit, or a result loaded from a file",
        cure="give the fit itself: warm=fit",
    )
