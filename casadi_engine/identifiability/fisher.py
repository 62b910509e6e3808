"""fisher: what data, recorded or planned, can tell about the free parameters (Cramér-Rao)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EstimationError, ParameterError
from casadi_engine.estimation.constraints import ParameterConstraints, Priors
from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.estimation.fit import Direction, Estimate
from casadi_engine.estimation.moved_jumps import refuse_moved_jumps
from casadi_engine.estimation.uncertainty import in_words, invert
from casadi_engine.identifiability.operating import OperatingRecord, Sensitivity, planned
from casadi_engine.model import Model
from casadi_engine.parameters import ParameterMap, Parameters, compile, parse_expression
from casadi_engine.problem.noise import Noise

Array = NDArray[np.float64]

_HELD = 1e-12


@dataclass(frozen=True)
class SloppyDirection:
    """A combination of the free parameters and how well it is known.

    text : parameters and how they move together, largest first; weights : name -> share of the unit vector, in
    relative changes (absolute ones, in units of its start value, where a parameter may be zero)
    stderr : standard error along it, of the same relative size; inf if the data do not determine it
    """

    text: str
    weights: Mapping[str, float]
    stderr: float


@dataclass(frozen=True, eq=False)
class Information:
    """The Fisher information of records about the free parameters, and the errors that follow.

    free : names of the free parameters. z : (nz,) values at which it was evaluated
    matrix : (nz, nz) information of all records together in relative changes of the parameters (dv), initial
        states that are not known taken out, priors put in
    records : name -> (nz, nz) share of each record
    covariance : (nz, nz) of relative changes, ties and equality constraints obeyed (Cramér-Rao bound)
    errors : name -> Estimate of every parameter of the set: its value and expected standard error
    directions : eigen-directions, sloppiest first. undetermined : those without any information
    noise : output -> (sigma, whether it was taken from residuals). n : samples. duration : s, of all records
    """

    model: Model
    parameters: Parameters
    free: tuple[str, ...]
    z: Array
    matrix: Array
    records: Mapping[str, Array]
    covariance: Array
    errors: Mapping[str, Estimate]
    directions: tuple[SloppyDirection, ...]
    undetermined: tuple[Direction, ...]
    noise: Mapping[str, tuple[float, bool]]
    n: int
    duration: float
    _frame: Frame = field(repr=False)

    def __str__(self) -> str:
        from casadi_engine.identifiability.practical_summary import information_text

        return information_text(self)

    @property
    def relative(self) -> dict[str, float | None]:
        """Name -> expected standard error as a share of the value; None where there is none."""
        return {name: share(estimate) for name, estimate in self.errors.items()}

    def of(self, expression: str) -> Estimate:
        """Value and expected standard error of a combination of parameters: ``info.of("C2 + C3")``.

        Raises ExpressionError for text that is no expression of the parameters' names.
        """
        return self._frame.combination(expression, self.covariance, self.undetermined)


def share(estimate: Estimate) -> float | None:
    """Standard error as a share of the value."""
    if estimate.stderr is None or estimate.value == 0:
        return None
    return abs(estimate.stderr / estimate.value)


def fisher(
    model: Model, data: Any, *, parameters: Parameters | None = None, noise: Noise | None = None
) -> Information:
    """Fisher information of recorded or planned experiments about the free parameters, and the expected errors.

    The outputs' sensitivities are exact (CasADi derivatives of the discrete model), at the values of the set.

    model : the equations
    data : an Experiment or PlannedExperiment, several of them, or label -> one. Outputs that an experiment holds
        count where they were measured; a planned one without them counts at every point of the inputs' grid
    parameters : the set (default: the model's); free ones count, ties, priors and equality constraints are obeyed,
        inequalities and bounds are not
    noise : sigma of each output; "estimate" takes it from the residuals of measured outputs at these values

    Returns Information. Raises EstimationError for a noise level that is not known, ExperimentError,
    ParameterError, ConstraintError, SimulationError for input that cannot be used.
    Source: thesis section 2.3 (covariance of the estimate); Ljung, System Identification, chapter 7.

    >>> import numpy as np, casadi_engine as ce
    >>> t = np.arange(200) * 0.01
    >>> run_up = ce.Experiment.from_arrays("run_up", time=t, units={"T": "N m"}, T=np.full(200, 2.0))
    >>> info = fisher(ce.one_inertia(), run_up, noise=ce.Noise(omega=0.01))
    >>> sorted(name for name, error in info.relative.items() if error is not None and error < 1)
    ['C_eng']
    """
    plans = planned(data)
    frame = Frame(model, parameters, tuple(plan.name for plan in plans))
    refuse_moved_jumps(model, frame.parameters)
    found = [frame.linearise(plan) for plan in plans]
    levels = noise_levels(model, noise, [seen for _, seen in found])
    parts = {
        plan.name: frame.information(plan.known_start, seen, levels)
        for plan, (_, seen) in zip(plans, found, strict=True)
    }
    return frame.conclude(
        parts,
        levels,
        samples=sum(record.count for record, _ in found),
        duration=sum(record.duration for record, _ in found),
    )


class Frame:
    """The free parameters of a set, in the coordinates of relative changes, over named records."""

    def __init__(self, model: Model, parameters: Parameters | None, names: tuple[str, ...]) -> None:
        chosen = model.parameters() if parameters is None else parameters
        if not isinstance(chosen, Parameters):
            raise EstimationError(
                "the parameters are not a parameter set",
                seen=type(parameters).__name__,
                allowed="a Parameters object",
                cure="start from model.parameters() and set values by pars[name].set(value)",
            )
        self.model, self.parameters = model, chosen.copy()
        self.pmap: ParameterMap = compile(self.parameters, model.parameter_names, names)
        self.coordinates = Coordinates(self.pmap)
        if not self.pmap.free:
            raise ParameterError(
                "no parameter is free, so there is nothing to ask the data for",
                seen=", ".join(self.parameters) or "(no parameters)",
                allowed="a set with one free parameter or more",
                cure='free one: pars.free("name")',
            )
        self.v = self.coordinates.of(self.pmap.start)
        self._physical: dict[int, ca.SX] = {}
        priors = Priors(self.pmap, self.coordinates)
        self.prior: Array = priors.evaluate(self.v)[3]
        limits = ParameterConstraints(model, self.pmap, self.coordinates)
        rows = limits.evaluate(self.v)[1] if limits.count else np.zeros((0, len(self.v)))
        self.equalities: Array = rows[limits.lower == limits.upper]

    def linearise(self, plan: Any) -> tuple[OperatingRecord, Sensitivity]:
        """A record and its sensitivities at the values of the set."""
        physical = self.pmap.physical[plan.name]
        local = self._physical.setdefault(id(physical), self.coordinates.substitute(physical))
        record = OperatingRecord(self.model, plan, self.coordinates.symbol, local)
        return record, record.at(self.v)

    def information(
        self, known_start: bool, seen: Sensitivity, levels: Mapping[str, tuple[float, bool]]
    ) -> Array:
        """(nz, nz) information of one record."""
        sigma = np.array([levels[out.name][0] for out in self.model.outputs])
        known = np.full(len(self.model.states), known_start)
        rows = seen.without_start(1 / sigma[seen.column], known)
        return rows.T @ rows

    def conclude(
        self,
        parts: Mapping[str, Array],
        levels: Mapping[str, tuple[float, bool]],
        *,
        samples: int,
        duration: float,
    ) -> Information:
        """Errors from the information of some records."""
        matrix = self.prior + sum(parts.values(), np.zeros_like(self.prior))
        covariance = invert(matrix, np.zeros(len(self.v), dtype=bool), self.equalities)
        words = [Direction(*in_words(direction, list(self.pmap.free))) for direction in covariance.directions]
        lost = tuple(covariance.directions)
        z = self.coordinates.values(self.v)
        return Information(
            model=self.model,
            parameters=self.parameters,
            free=self.pmap.free,
            z=z,
            matrix=matrix,
            records=dict(parts),
            covariance=covariance.matrix,
            errors=self._errors(covariance.matrix, lost),
            directions=self._directions(covariance.matrix, lost),
            undetermined=tuple(words),
            noise=dict(levels),
            n=samples,
            duration=duration,
            _frame=self,
        )

    def _directions(self, covariance: Array, lost: tuple[Array, ...]) -> tuple[SloppyDirection, ...]:
        """Directions without information, then the eigenvectors of the covariance, largest error first."""
        names, found = list(self.pmap.free), []
        for direction in lost:
            found.append(SloppyDirection(*in_words(direction, names), float("inf")))
        values, vectors = np.linalg.eigh(covariance)
        for k in np.argsort(values)[::-1]:
            if values[k] > _HELD * max(values[-1], 0.0):
                found.append(SloppyDirection(*in_words(vectors[:, k], names), float(np.sqrt(values[k]))))
        return tuple(found)

    def _errors(self, covariance: Array, lost: tuple[Array, ...]) -> dict[str, Estimate]:
        values = self.pmap.values(self.coordinates.values(self.v))
        slopes = self._slopes(self.pmap.reported_expressions)
        errors = {}
        for (name, value), slope in zip(values.items(), slopes, strict=True):
            stderr, why = _error(slope, covariance, lost)
            unit = self.parameters[name.split("@")[0]].unit
            errors[name] = Estimate(value, stderr, unit, why=why, fixed=not slope.any())
        return errors

    def _slopes(self, expressions: ca.SX) -> Array:
        """(rows, nv) of expressions of z, to the coordinates v."""
        jacobian = ca.densify(ca.jacobian(expressions, self.pmap.z))
        z = self.coordinates.values(self.v)
        found = np.asarray(ca.Function("slope", [self.pmap.z], [jacobian])(z), dtype=float)
        return found.reshape(-1, len(z)) * self.coordinates.slope(self.v)

    def combination(
        self, expression: str, covariance: Array, undetermined: tuple[Direction, ...]
    ) -> Estimate:
        """A combination of parameters at the values of the set, with its error."""
        reported = self.pmap.reported
        symbols = {name: ca.SX.sym(name) for name in reported if "@" not in name}
        given = parse_expression(expression, symbols)
        chosen = [self.pmap.reported_expressions[k] for k, name in enumerate(reported) if "@" not in name]
        whole = ca.substitute(given, ca.vertcat(*symbols.values()), ca.vertcat(*chosen))
        value = float(ca.Function("value", [self.pmap.z], [whole])(self.coordinates.values(self.v)))
        lost = tuple(
            np.array([direction.weights.get(name, 0.0) for name in self.pmap.free])
            for direction in undetermined
        )
        stderr, why = _error(self._slopes(whole)[0], covariance, lost)
        return Estimate(value, stderr, "", why=why, fixed=why == "fixed")


def _error(slope: Array, covariance: Array, lost: tuple[Array, ...]) -> tuple[float | None, str | None]:
    """Standard error of a quantity with this slope (nv,), or why there is none."""
    if not slope.any():
        return None, "fixed"
    size = float(np.linalg.norm(slope))
    if any(abs(d @ slope) > 1e-6 * size * np.linalg.norm(d) for d in lost):
        return None, "the data do not determine it"
    variance = float(slope @ covariance @ slope)
    if variance <= _HELD * float(slope**2 @ np.diag(covariance)):
        return None, "held by equality constraints"
    return float(np.sqrt(variance)), None


def noise_levels(
    model: Model, noise: Noise | None, found: list[Sensitivity]
) -> dict[str, tuple[float, bool]]:
    """Output -> (sigma, whether it was taken from residuals), for every output of the model.

    Raises EstimationError for a level that is neither given nor to be had from measured samples, and for a gain.
    """
    noise = Noise() if noise is None else noise
    if not isinstance(noise, Noise):
        raise EstimationError(
            "the noise is not acceptable",
            seen=repr(noise),
            allowed="a Noise",
            cure="write noise=ce.Noise(omega=0.1), for instance",
        )
    if noise.gain is not None or getattr(noise, "process", None) or getattr(noise, "innovations", ()):
        raise EstimationError(
            "expected errors are those of output error, and the noise asks for a predictor",
            seen=repr(noise),
            allowed="a Noise with levels alone",
            cure="leave the gain and the process noise out; the errors of a predictor stand in its fit",
        )
    levels: dict[str, tuple[float, bool]] = {}
    for k, out in enumerate(model.outputs):
        level = noise.level(out.name)
        samples = sum(int((seen.column == k).sum()) for seen in found)
        if level != "estimate" or samples == 0:
            levels[out.name] = (float(level) if level != "estimate" else 1.0, False)
            continue
        rest = np.concatenate([seen.residual[seen.was_measured & (seen.column == k)] for seen in found])
        size = float(np.sqrt(np.mean(rest**2))) if len(rest) else 0.0
        if not size > 0:
            raise EstimationError(
                f"the noise level of {out.name} is not known, and no measured sample tells it",
                seen=f'{out.name}="estimate"',
                allowed="a standard deviation > 0 in the unit of the output",
                cure=f"write noise=ce.Noise({out.name}=0.1), for instance",
            )
        levels[out.name] = (size, True)
    return levels
