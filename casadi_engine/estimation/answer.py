"""From the best point of a search to the Fit: errors, traces, fit percentages and what to say about them."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import NoValueError
from casadi_engine.estimation.answer_notes import (
    against_priors,
    errors_then,
    of_quieter_outputs,
    of_the_integration,
    of_the_noise,
    of_the_search,
)
from casadi_engine.estimation.doubt import as_able
from casadi_engine.estimation.doubted import judged
from casadi_engine.estimation.final_check import printed_cost, relabelled, residual, response, verdict
from casadi_engine.estimation.fit import Estimate, Fit, Innovations, Optimum, Trace
from casadi_engine.estimation.fit_percent import fit_measures
from casadi_engine.estimation.innovations import SizedPriors, loop_of
from casadi_engine.estimation.integration import integration_of
from casadi_engine.estimation.lower_optimum import Place
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.residual_noise import own_noise, taken_of, with_own_noise
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.standard_errors import Uncertainty, uncertainty
from casadi_engine.estimation.varied_noise import varied_noise
from casadi_engine.simulation.error_estimate import ErrorEstimate
from casadi_engine.simulation.propagator import fineness_of

Array = NDArray[np.float64]

# What takes the place of errors where there are none.
_NO_ERRORS = "there are no standard errors, as this is no optimum"
# Growth of the errors by noise that may not be of one size, which no test tells, from which on that is said.
_UNTOLD = 1.2


def make_fit(
    search: Search,
    best: Attempt,
    optima: tuple[Optimum, ...],
    options: dict[str, Any],
    timing: dict[str, float],
    begun: float,
    *,
    stopped: str = "",
    check: float | None = None,
) -> Fit:
    """The Fit at the best attempt.

    stopped : who ended the search before its end, if anyone; check : seconds that intervals may take where its standard
    errors do not describe the likelihood, None not to ask whether they do
    """
    clock = time.perf_counter()
    search._weigh(best.sigma)
    problem, pmap = search.problem, search.pmap
    try:
        errors = uncertainty(search, best)
        courses = [_course(search, k, errors) for k in range(len(search.records))]
    except FloatingPointError as fault:
        raise _no_numbers(best, fault) from fault
    v, names = errors.v, [record.experiment.name for record in search.records]
    residuals = [one.left for one in courses]
    integration = {} if stopped else _integration(search, errors.x)
    status, reason = (best.solution.status, None) if stopped else verdict(search, best, errors, residuals)
    if status != best.solution.status:
        errors, optima = replace(errors, optimal=status == "converged"), relabelled(optima, status)
        best = replace(best, solution=replace(best.solution, status=status))
    white, counted = errors, check is not None and not stopped
    errors, ratio, noise_notes = _with_noise(search, best, white, counted=counted)
    found = judged(
        search,
        best,
        white,
        errors,
        optima,
        residuals,
        check=None if stopped else check,
        spent=timing.get("solve", 0.0),
    ).as_told(noise_notes)
    notes = (
        *found.said,
        *of_the_search(search, best, errors, reason, optima, stopped, noise_notes),
        *against_priors(search, white),
        *of_the_integration(integration, best.cost / max(search.problem.samples, 1)),
    )
    doubted = [name for name in pmap.free if found.estimates[name].quadratic]
    known = errors.optimal and set(doubted) <= set(search.model.parameter_names)
    predictor = _predictor(search, v, best.sigma, errors, known=known)
    cost = printed_cost(search, v, residuals)
    # With noise covariances the search adds the likelihood of the innovations' size, zero at this fit from here on.
    size = problem.priors.size(v) if isinstance(problem.priors, SizedPriors) else 0.0
    z = search.coordinates.values(v)
    fitted = search.parameters.copy()
    _write_values(fitted, pmap.values(z))
    # last, for the drives of a long record take as much memory as what came before
    drives = {name: _drives(record, v) for name, record in zip(names, search.records, strict=True)}
    timing["covariance"] = time.perf_counter() - clock
    timing["total"] = time.perf_counter() - begun
    return Fit(
        model=search.model,
        parameters=fitted.frozen(),
        data=search.data,
        status="interrupted" if stopped else best.solution.status,
        estimates=found.estimates,
        start=dict(zip(pmap.free, search.begins.tolist(), strict=True)),
        free=pmap.free,
        z=z,
        covariance=errors.of_parameters(),
        undetermined=errors.directions,
        initial=_first_states(search, found.initial.values()),
        noise=_noise(search, best.sigma, pmap.values(z)),
        cost=(cost if np.isfinite(cost) else best.cost) - size,
        n=problem.samples,
        dof=float(problem.samples - errors.covariance.rank),
        iterations=best.iterations,
        nodes=sum(record.plan.m for record in search.records),
        optima=tuple(replace(optimum, cost=optimum.cost - size) for optimum in optima),
        traces={name: one.traces for name, one in zip(names, courses, strict=True)},
        drives=drives,
        fit_percent={name: one.percents for name, one in zip(names, courses, strict=True)},
        timing=timing,
        options=options,
        messages=tuple(
            as_able(note, predicted=predictor is not None, robust=search.loss.robust) for note in notes
        ),
        states_at_start={name: one.first for name, one in zip(names, courses, strict=True)},
        gain=None if predictor is None else predictor.gain,
        innovations=predictor,
        integration=integration,
        errors=errors.as_prior(),
        own_noise=_by_name(search, ratio),
        lower=None if found.lower is None else _place(search, found.lower),
        fineness={record.experiment.name: fineness_of(record.propagator) for record in search.records},
        followed=search.too_long(best.solution.x),
    )


@dataclass(frozen=True)
class _Course:
    """A record at the optimum: first states (n,), traces, fit percentages, the residual (K, M) that is minimised."""

    first: Array
    traces: dict[str, Trace]
    percents: dict[str, dict[str, float | None]]
    left: Array


def _course(search: Search, number: int, errors: Uncertainty) -> _Course:
    record = search.records[number]
    nodes = search.problem.layouts[number].take(errors.x)
    traces, left = _traces(search, record, errors.v, nodes)
    percents = {key: _percent(trace) for key, trace in traces.items()}
    return _Course(nodes[0] * record.scale, traces, percents, left)


def _with_noise(
    search: Search, best: Attempt, white: Uncertainty, *, counted: bool
) -> tuple[Uncertainty, Array, list[str]]:
    """The errors with the noise that the residuals show, by how much each grew (N,), and what is said of that noise.

    counted : let the errors count with it; else it is only said
    """
    noises = own_noise(search, best)
    noisy = {(one.at, one.output) for one in noises}
    points = search.problem.at(best.solution.x).records
    varied = varied_noise(search, points, noisy, taken_of(search, points, white))
    errors, ratio, effective = white, np.ones(len(white.covariance.matrix)), math.inf
    if counted:
        errors, ratio, effective = with_own_noise(search, best, white, noises, varied)
    known = ratio if errors is not white else None
    then = errors_then(known, effective, counted=counted) if errors.optimal else _NO_ERRORS
    felt = float(ratio.max(initial=1.0)) > _UNTOLD
    varied = tuple(one for one in varied if felt or one.chance == 1)
    notes = of_the_noise(search, noises, varied, then) + of_quieter_outputs(search, best)
    return errors, ratio, notes


def _first_states(search: Search, states: Iterable[dict[str, Estimate]]) -> dict[str, dict[str, Estimate]]:
    """Record -> its first states, at the time at which it begins."""
    return {
        record.experiment.name: {key: replace(one, time=record.grid.start) for key, one in own.items()}
        for record, own in zip(search.records, states, strict=True)
    }


def _no_numbers(best: Attempt, fault: FloatingPointError) -> NoValueError:
    return NoValueError(
        "the model cannot be evaluated where the search ended",
        seen=f"{best.solution.status}; {fault}",
        allowed="values at which the equations give finite numbers",
        cure="give other start values, or bounds that keep the parameters and initial states away from there",
    )


def _noise(search: Search, sigma: Array, values: dict[str, float]) -> dict[str, tuple[float, bool]]:
    """Output -> (level, whether it was estimated); with noise covariances that of the measurement alone."""
    if search.predictor.kind != "process":
        return search.levels.by_name(sigma)
    start = dict(zip(search.predictor.outputs, search.predictor.start.measurement.tolist(), strict=True))
    own = {name: values.get(f"noise.{name}") for name in start}
    return {name: (start[name], False) if own[name] is None else (own[name], True) for name in start}  # type: ignore[misc]


def _predictor(
    search: Search, v: Array, sigma: Array, errors: Uncertainty, *, known: bool
) -> Innovations | None:
    """The predictor at the optimum, that of the first record where records differ; known : its gain has errors."""
    if search.predictor.kind == "none":
        return None
    covariance = errors.covariance.matrix[: len(v), : len(v)]
    if not known:
        covariance = np.full_like(covariance, np.nan)
    gain, kalman, stderr, levels, radius = loop_of(search.records[0], v, covariance, search.predictor.every)
    outputs = search.predictor.outputs
    return Innovations(
        search.predictor.kind,
        search.predictor.states,
        outputs,
        gain,
        kalman,
        stderr,
        dict(zip(outputs, (sigma if levels is None else levels).tolist(), strict=True)),
        radius,
        search.predictor.every,
    )


def _traces(search: Search, record: RecordTerm, v: Array, nodes: Array) -> tuple[dict[str, Trace], Array]:
    """Measured, simulated and, with a gain, predicted outputs at the measured times; and the weighted residual (K, M)
    that the fit minimises, of the same trajectory."""
    simulated, start = response(record, v, nodes), nodes[0]
    left = residual(record, simulated[0])
    predicted = None
    if search.noise.predicts:
        predicted = simulated
        if search.predictor.kind == "process":  # the search has whitened innovations
            predicted = response(record.again(gain=search.plain_gain(record)), v, start)
        simulated = response(record.again(gain=None), v, start)
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
        measured = channel.values if counts.all() else np.where(counts, channel.values, np.nan)
        found[name] = Trace(channel.time, measured, counts, rows[0], rows[1] if len(rows) > 1 else None)
    return found, left


def _integration(search: Search, x: Array) -> dict[str, ErrorEstimate]:
    """Record -> its integration error, where it is integrated at all."""
    nodes = [lay.take(x) for lay in search.problem.layouts]
    try:
        return integration_of(search.records, x[: search.problem.nv], nodes)
    except FloatingPointError:
        return {}


def _filled(size: int, index: NDArray[np.intp], values: Array) -> Array:
    if len(index) == size:
        return values
    row = np.full(size, np.nan)
    row[index] = values
    return row


def _drives(record: RecordTerm, v: Array) -> dict[str, Array]:
    """Drive -> (2, N) its times and values: views of one array, which hold the times once."""
    table = record.drives_at(v)
    table.setflags(write=False)
    return {variable.name: table[:: k + 1][:2] for k, variable in enumerate(record.model.drives)}


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


def _place(search: Search, x: Array) -> Place:
    """Variables (size,) as a place to begin at."""
    v, names = x[: search.problem.nv], [state.name for state in search.model.states]
    first = {
        record.experiment.name: dict(zip(names, (lay.take(x)[0] * record.scale).tolist(), strict=True))
        for record, lay in zip(search.records, search.problem.layouts, strict=True)
    }
    values = dict(zip(search.pmap.free, search.coordinates.values(v).tolist(), strict=True))
    return Place(values, first, search.levels.by_name(search.sigma))


def _by_name(search: Search, ratio: Array) -> dict[str, float]:
    """Free parameter, or record/state for an initial state -> its entry of (N,)."""
    states = [f"{r.experiment.name}/{s.name}" for r in search.records for s in search.model.states]
    return dict(zip([*search.pmap.free, *states], ratio.tolist(), strict=True))
