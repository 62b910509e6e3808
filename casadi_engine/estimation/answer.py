"""From the best point of a search to the Fit: errors, traces, fit percentages and what to say about them."""

from __future__ import annotations

import time
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.fit import AtBound, Direction, Estimate, Fit, Optimum, Trace
from casadi_engine.estimation.fit_percent import fit_measures
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.starts import chained_nodes
from casadi_engine.estimation.uncertainty import Covariance, chained_information, in_words, invert

Array = NDArray[np.float64]

# An entry this close to its bound (in scaled units) is at the bound.
_AT_BOUND = 1e-7
# A constraint is active when it is met within this share of its magnitude.
_ACTIVE = 1e-6


def make_fit(
    search: Search,
    best: Attempt,
    optima: tuple[Optimum, ...],
    options: dict[str, Any],
    timing: dict[str, float],
    begun: float,
) -> Fit:
    """The Fit at the best attempt."""
    clock = time.perf_counter()
    search._weigh(best.sigma)
    problem, pmap = search.problem, search.pmap
    x, information = _information(search, best)
    bound = _at_bounds(search, best, x, information)
    x = _snapped(search, x, bound)
    v = x[: problem.nv]
    covariance = _covariance(search, v, bound, information)
    z, slope = search.coordinates.values(v), search.coordinates.slope(v)
    estimates = _estimates(search, z, slope, covariance, bound)
    directions = tuple(Direction(*in_words(d, _names(search))) for d in covariance.directions)
    traces, drives, percents, first = {}, {}, {}, {}
    initial: dict[str, dict[str, Estimate]] = {}
    at = problem.nv
    for record, lay, limits in zip(search.records, problem.layouts, search._initial, strict=True):
        name = record.experiment.name
        start = lay.take(x)[0]
        traces[name] = _traces(search, record, v, start)
        drives[name] = _drives(record, v)
        percents[name] = {key: _percent(trace) for key, trace in traces[name].items()}
        initial[name] = _initial_states(search, record, start, limits, covariance, bound, at)
        first[name] = start * record.scale
        at += record.n
    lost = search.free_count - int(sum(b is not False for b in bound[: problem.nv]))
    timing["covariance"] = time.perf_counter() - clock
    timing["total"] = time.perf_counter() - begun
    fitted = search.parameters.copy()
    _write_values(fitted, pmap.values(z))
    return Fit(
        model=search.model,
        parameters=fitted.frozen(),
        data=search.data,
        status=best.solution.status,
        estimates=estimates,
        start=dict(zip(pmap.free, pmap.start.tolist(), strict=True)),
        free=pmap.free,
        z=z,
        covariance=_parameter_covariance(covariance, slope, bound),
        undetermined=directions,
        initial=initial,
        noise={
            name: (float(sigma), estimated)
            for name, sigma, estimated in zip(search.outputs, best.sigma, search.estimated, strict=True)
        },
        cost=best.cost,
        n=problem.samples,
        dof=float(problem.samples - lost),
        iterations=best.iterations,
        nodes=sum(record.plan.m for record in search.records),
        optima=optima,
        traces=traces,
        drives=drives,
        fit_percent=percents,
        timing=timing,
        options=options,
        messages=_messages(search, best, v, directions),
        states_at_start=first,
        gain=search.noise.gain,
    )


def _information(search: Search, best: Attempt) -> tuple[Array, Array]:
    """The point with its nodes, and the information matrix over [v; initial states]."""
    problem, x = search.problem, best.solution.x
    point = problem.at(x)
    size = problem.nv + sum(record.n for record in search.records)
    information = np.zeros((size, size))
    information[: problem.nv, : problem.nv] = problem.priors.evaluate(x[: problem.nv])[3]
    at = problem.nv
    for record, found in zip(search.records, point.records, strict=True):
        # Huber's information is that of least squares times the efficiency of the clipped residuals.
        blocks = record.gauss_newton(found, Loss())
        own = chained_information(record, found, blocks) * _efficiency(
            search.loss, found.r[record.observation.valid]
        )
        where = np.concatenate([record.active, np.arange(at, at + record.n)])
        information[np.ix_(where, where)] += own
        at += record.n
    return x, information


def _efficiency(loss: Loss, r: Array) -> float:
    """(mean rho'')^2 / mean rho'^2: 1 for least squares with unit residuals (Huber 1981, section 7.6)."""
    if not loss.robust:
        return 1.0
    curvature, slope = loss.curvature(r), loss.slope(r)
    return float(np.mean(curvature) ** 2 / np.mean(slope**2)) if curvature is not None else 1.0


def _at_bounds(search: Search, best: Attempt, x: Array, information: Array) -> list[AtBound]:
    """For v and the initial states: False, "min" or "max".

    An interior-point method stops a little inside: an entry is at its bound too when the slope that is left there
    would carry it beyond.
    """
    problem, found = search.problem, []
    entries = list(range(problem.nv))
    for lay in problem.layouts:
        entries += range(lay.at, lay.at + lay.n)
    for k, entry in enumerate(entries):
        low, high = x[entry] - search.lower[entry], search.upper[entry] - x[entry]
        slope = best.solution.lam_x[entry] * problem.samples
        step = abs(slope) / information[k, k] if information[k, k] > 0 else np.inf * abs(slope)
        near = min(low, high)
        side: AtBound = "min" if low <= high else "max"
        toward = slope < 0 if side == "min" else slope > 0
        fixed = search.lower[entry] == search.upper[entry]
        active = near < _AT_BOUND or (near < 1e-2 and toward and step > 3 * near)
        found.append(side if np.isfinite(near) and (active or fixed) else False)
    return found


def _snapped(search: Search, x: Array, bound: list[AtBound]) -> Array:
    x = x.copy()
    for k in range(search.problem.nv):
        if bound[k] is not False:
            x[k] = search.lower[k] if bound[k] == "min" else search.upper[k]
    return x


def _covariance(search: Search, v: Array, bound: list[AtBound], information: Array) -> Covariance:
    user, size = search.constraints, len(information)
    closed = np.array([b is not False for b in bound], dtype=bool)
    rows = np.zeros((0, size))
    if user.count:
        value, jacobian = user.evaluate(v)
        active = (value - user.lower < _ACTIVE) | (user.upper - value < _ACTIVE)
        rows = np.zeros((int(active.sum()), size))
        rows[:, : search.problem.nv] = jacobian[active]
    return invert(information, closed, rows)


def _parameter_covariance(covariance: Covariance, scale: Array, bound: list[AtBound]) -> Array:
    nv = len(scale)
    matrix = covariance.matrix[:nv, :nv] * np.outer(scale, scale)
    unknown = ~covariance.open[:nv] & np.array([b is False for b in bound[:nv]], dtype=bool)
    for direction in covariance.directions:
        unknown |= np.abs(direction[:nv]) >= 1e-6
    matrix[unknown, :] = np.nan
    matrix[:, unknown] = np.nan
    return matrix


def _names(search: Search) -> list[str]:
    names = list(search.pmap.free)
    for record in search.records:
        at = f" at the start of {record.experiment.name}" if len(search.records) > 1 else " at the start"
        names += [state.name + at for state in search.model.states]
    return names


def _estimates(
    search: Search, z: Array, scale: Array, covariance: Covariance, bound: list[AtBound]
) -> dict[str, Estimate]:
    """Every reported parameter with its error, propagated through ties to first order."""
    pmap, nv = search.pmap, search.problem.nv
    values = pmap.values(z)
    function = ca.Function("j", [pmap.z], [ca.densify(ca.jacobian(pmap.reported_expressions, pmap.z))])
    slopes = np.asarray(function(z), dtype=float).reshape(len(values), nv) * scale
    matrix = covariance.matrix[:nv, :nv]
    found = {}
    for (name, value), slope in zip(values.items(), slopes, strict=True):
        plain = name.split("@")[0]
        parameter = search.parameters[plain]
        side: AtBound = bound[pmap.free.index(name)] if name in pmap.free else False
        error, why = None, None
        lost = [d for d in covariance.directions if abs(d[:nv] @ slope) > 1e-6 * np.linalg.norm(slope)]
        if not slope.any():
            why = "fixed"
        elif side is not False and name in pmap.free:
            why = f"at its {'lower' if side == 'min' else 'upper'} bound: there is no symmetric error"
        elif lost:
            why = "the data do not determine it"
        else:
            variance = float(slope @ matrix @ slope)
            if variance > 0:
                error = float(np.sqrt(variance))
            else:
                why = "held by active bounds or constraints"
        found[name] = Estimate(value, error, parameter.unit, side, why, fixed=not slope.any())
    return found


def _initial_states(
    search: Search,
    record: RecordTerm,
    start: Array,
    limits: tuple[Array, Array, Array],
    covariance: Covariance,
    bound: list[AtBound],
    at: int,
) -> dict[str, Estimate]:
    found = {}
    for k, state in enumerate(search.model.states):
        fixed = bool(limits[0][k] == limits[1][k])
        side = bound[at + k]
        error, why = None, None
        if fixed:
            why = "fixed"
        elif side is not False:
            why = "at its bound: there is no symmetric error"
        elif not covariance.open[at + k]:
            why = "the data do not determine it"
        else:
            error = float(np.sqrt(covariance.matrix[at + k, at + k]) * record.scale[k])
        found[state.name] = Estimate(
            float(start[k] * record.scale[k]), error, state.unit, False if fixed else side, why, fixed
        )
    return found


def _traces(search: Search, record: RecordTerm, v: Array, start: Array) -> dict[str, Trace]:
    """Measured, simulated and, with a gain, predicted outputs at the measured times."""
    simulated = _response(record, v, start)
    predicted = None
    if search.noise.gain is not None:
        predicted = simulated
        plain = RecordTerm(
            search.model, record.experiment, *record.symbols,
            length=None, gain=None, method=record.method, grid=record.grid,
        )  # fmt: skip
        simulated = _response(plain, v, start)
    found = {}
    for name, sample in record.grid.measured.items():
        channel = record.experiment[name]
        size, counts = len(channel.time), np.zeros(len(channel.time), dtype=bool)
        counts[sample.index] = record.observation.series(record.observation.valid, name)
        rows = [
            _filled(size, sample.index, part[1].series(part[0], name))
            for part in (simulated, predicted)
            if part
        ]
        measured = np.where(counts, channel.values, np.nan)
        found[name] = Trace(channel.time, measured, counts, rows[0], rows[1] if len(rows) > 1 else None)
    return found


def _response(record: RecordTerm, v: Array, start: Array) -> tuple[Array, Any]:
    """Outputs (K, M) of the trajectory from ``start``, and the observation that lays them out."""
    path = record.propagator.propagate(v[record.active], chained_nodes(record, v, start), 0)
    return record.observation.observe(path.y)[0], record.observation


def _filled(size: int, index: NDArray[np.intp], values: Array) -> Array:
    row = np.full(size, np.nan)
    row[index] = values
    return row


def _drives(record: RecordTerm, v: Array) -> dict[str, Array]:
    samples = record.propagator.drives_at(v[record.active])
    return {
        variable.name: np.array([record.grid.time, values])
        for variable, values in zip(record.model.drives, samples, strict=True)
    }


def _percent(trace: Trace) -> dict[str, float | None]:
    simulated = fit_measures(trace.measured, trace.simulated, mask=trace.mask).fit_percent
    if trace.predicted is None:
        return {"simulation": simulated, "prediction": None}
    return {
        "simulation": simulated,
        "prediction": fit_measures(trace.measured, trace.predicted, mask=trace.mask).fit_percent,
    }


def _write_values(parameters: Any, values: dict[str, float]) -> None:
    """Put the estimates into a parameter set; one that varies by record takes the mean of its records."""
    for name in parameters.names:
        parameter = parameters[name]
        if parameter.tie is not None or not parameter.vary:
            continue
        own = [value for key, value in values.items() if key == name or key.startswith(name + "@")]
        parameter.set(float(np.clip(np.mean(own), parameter.min, parameter.max)))


def _messages(search: Search, best: Attempt, v: Array, directions: tuple[Direction, ...]) -> tuple[str, ...]:
    found = []
    for direction in directions:
        found.append(
            f"the data do not determine {direction.text}: fix one of these, tie it, give it a prior, "
            "or add a record that excites it"
        )
    violated = search.constraints.violated(v)
    if violated:
        found.append(f"not met: {', '.join(violated)}")
    if best.solution.status == "interrupted":
        found.append("stopped by the user: this is the best point so far, not an optimum")
    return tuple(found)
