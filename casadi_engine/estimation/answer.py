"""From the best point of a search to the Fit: errors, traces, fit percentages and what to say about them."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EstimationError
from casadi_engine.estimation.constraints import Priors
from casadi_engine.estimation.doubt import as_able
from casadi_engine.estimation.doubted import judged
from casadi_engine.estimation.final_check import cure, printed_cost, relabelled, residual, response, verdict
from casadi_engine.estimation.fit import Fit, Innovations, Optimum, Trace
from casadi_engine.estimation.fit_percent import fit_measures
from casadi_engine.estimation.innovations import SizedPriors, loop_of
from casadi_engine.estimation.integration import integration_of
from casadi_engine.estimation.lower_optimum import Place
from casadi_engine.estimation.predictor import output_stride
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.residual_noise import OwnNoise, own_noise, quieter, taken_of, with_own_noise
from casadi_engine.estimation.search import AT_WALL, Attempt, Search
from casadi_engine.estimation.standard_errors import Uncertainty, uncertainty
from casadi_engine.estimation.varied_noise import Varied, varied_noise
from casadi_engine.simulation.error_estimate import ErrorEstimate
from casadi_engine.simulation.propagator import fineness_of

Array = NDArray[np.float64]

# What takes the place of errors where there are none.
_NO_ERRORS = "there are no standard errors, as this is no optimum"
# Growth of the errors from which it is stated as a number.
_SEEN = 1.05
# Independent samples with fewer of which the colour of a residual is hardly known.
_EFFECTIVE = 20
# An integration error that may move an estimate by this share of its standard error is said.
_FELT = 0.1
# Standard errors between a prior and the data that chance brings once in sixteen thousand fits.
_CONTRADICTED = 4.0


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
    except FloatingPointError as fault:
        raise _no_numbers(best, fault) from fault
    v = errors.v
    z = search.coordinates.values(v)
    traces, drives, percents, first, residuals = {}, {}, {}, {}, []
    integration = {} if stopped else _integration(search, errors.x)
    for record, lay in zip(search.records, problem.layouts, strict=True):
        name, nodes = record.experiment.name, lay.take(errors.x)
        try:
            traces[name], left = _traces(search, record, v, nodes)
        except FloatingPointError as fault:
            raise _no_numbers(best, fault) from fault
        residuals.append(left)
        percents[name] = {key: _percent(trace) for key, trace in traces[name].items()}
        first[name] = nodes[0] * record.scale
    status, reason = (best.solution.status, None) if stopped else verdict(search, best, errors, residuals)
    if status != best.solution.status:
        errors, optima = replace(errors, optimal=status == "converged"), relabelled(optima, status)
        best = replace(best, solution=replace(best.solution, status=status))
    noises, white = own_noise(search, best), errors
    noisy = {(one.at, one.output) for one in noises}
    points = search.problem.at(best.solution.x).records
    varied = varied_noise(search, points, noisy, taken_of(search, points, white))
    ratio, effective = np.ones(len(white.covariance.matrix)), math.inf
    if check is not None and not stopped:
        errors, ratio, effective = with_own_noise(search, best, white, noises, varied)
    found = judged(
        search,
        best,
        white,
        errors,
        optima,
        residuals,
        check=None if stopped else check,
        spent=timing.get("solve", 0.0),
    )
    cost = printed_cost(search, v, residuals)
    then = _then(ratio if errors is not white else None, effective) if errors.optimal else _NO_ERRORS
    noise_words = _noise_words(search, noises, varied, then)
    noise_words += _quieter_words(search, best)
    said = _messages(search, best, errors, reason, optima, stopped, noise_words) + _against_priors(
        search, white
    )
    for (
        record
    ) in search.records:  # last, for the drives of a long record take as much memory as what came before
        drives[record.experiment.name] = _drives(record, v)
    doubted = [name for name in pmap.free if found.estimates[name].quadratic]
    known = errors.optimal and set(doubted) <= set(search.model.parameter_names)
    predictor = _predictor(search, v, best.sigma, errors, known=known)
    # With noise covariances the search adds the likelihood of the innovations' size, zero at this fit from here on.
    size = problem.priors.size(v) if isinstance(problem.priors, SizedPriors) else 0.0
    able = partial(as_able, predicted=predictor is not None, robust=search.loss.robust)
    timing["covariance"] = time.perf_counter() - clock
    timing["total"] = time.perf_counter() - begun
    fitted = search.parameters.copy()
    _write_values(fitted, pmap.values(z))
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
        initial={
            record.experiment.name: {key: replace(one, time=record.grid.start) for key, one in states.items()}
            for record, states in zip(search.records, found.initial.values(), strict=True)
        },
        noise=_noise(search, best.sigma, pmap.values(z)),
        cost=(cost if np.isfinite(cost) else best.cost) - size,
        n=problem.samples,
        dof=float(problem.samples - errors.covariance.rank),
        iterations=best.iterations,
        nodes=sum(record.plan.m for record in search.records),
        optima=tuple(replace(optimum, cost=optimum.cost - size) for optimum in optima),
        traces=traces,
        drives=drives,
        fit_percent=percents,
        timing=timing,
        options=options,
        messages=tuple(map(able, found.said + said + _coarse(integration))),
        states_at_start=first,
        gain=None if predictor is None else predictor.gain,
        innovations=predictor,
        integration=integration,
        errors=errors.as_prior(),
        own_noise=_by_name(search, ratio),
        lower=None if found.lower is None else _place(search, found.lower),
        fineness={record.experiment.name: fineness_of(record.propagator) for record in search.records},
        followed=search.too_long(best.solution.x),
    )


def _no_numbers(best: Attempt, fault: FloatingPointError) -> EstimationError:
    return EstimationError(
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


def _coarse(integration: dict[str, ErrorEstimate]) -> tuple[str, ...]:
    """What integration errors do to the estimates, where it is more than they are allowed to."""
    return tuple(
        f"the integration of {record} moves the estimates by up to {found.shift:.2g} standard errors, and shorter "
        "steps were not reached: the equations change too sharply; make them smoother"
        for record, found in integration.items()
        if found.shift is not None and found.shift > _FELT
    )


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


def _messages(
    search: Search,
    best: Attempt,
    errors: Uncertainty,
    reason: str | None,
    optima: tuple[Optimum, ...],
    stopped: str,
    noise_words: Sequence[str],
) -> tuple[str, ...]:
    found = [] if reason is None else [cure(reason, search.too_long(best.solution.x))]
    if best.solution.status != "converged":
        found.append("this is not an optimum: the values have no standard errors")
    for direction in errors.directions:
        found.append(
            f"the data do not determine {direction.text}: fix one of these, tie it, give it a prior, "
            + (
                "or add a record that excites it"
                if search.model.inputs
                else "or add a record with another start"
            )
        )
    if errors.acting:
        found.append(f"held by constraints: {', '.join(errors.acting)}; do they agree with the data?")
    violated = search.constraints.violated(errors.v)
    if violated:
        found.append(f"not met: {', '.join(violated)}")
    found += _walls(search, best)
    found += _rates(search)
    found += noise_words
    if stopped:
        done = sum(optimum.starts for optimum in optima if optimum.status == "converged")
        what = f"the best of {done} optima so far" if done else "the best point so far, not an optimum"
        found.append(f"stopped by {stopped}: this is {what}")
    return tuple(found)


def _place(search: Search, x: Array) -> Place:
    """Variables (size,) as a place to begin at."""
    v, names = x[: search.problem.nv], [state.name for state in search.model.states]
    first = {
        record.experiment.name: dict(zip(names, (lay.take(x)[0] * record.scale).tolist(), strict=True))
        for record, lay in zip(search.records, search.problem.layouts, strict=True)
    }
    values = dict(zip(search.pmap.free, search.coordinates.values(v).tolist(), strict=True))
    return Place(values, first, search.levels.by_name(search.sigma))


def _against_priors(search: Search, errors: Uncertainty) -> tuple[str, ...]:
    """Priors that the data and all else that is known contradict, with white noise."""
    priors, nv = search.problem.priors, search.problem.nv
    if not isinstance(priors, Priors) or not priors.count or not errors.optimal:
        return ()
    apart = priors.apart(errors.v, errors.covariance.matrix[:nv, :nv])
    found = [
        f"the prior of {own.label} ({own.mean:.4g} ± {own.sigma:.2g}) and the data are {abs(far):.2g} standard errors "
        "apart: the prior is wrong, or the model is; the estimates and ± count with both"
        for own, far in zip(search.pmap.priors, apart.tolist(), strict=True)
        if abs(far) > _CONTRADICTED
    ]
    return tuple(found)


def _walls(search: Search, best: Attempt) -> list[str]:
    """First states that rest where the equations cease to have a value; not those of a start that ended elsewhere."""
    x, low, high = best.solution.x, search.lower, search.upper
    names = [
        f"{state.name} of {record.experiment.name}"
        for record, lay in zip(search.records, search.problem.layouts, strict=True)
        for k, state in enumerate(search.model.states)
        if (at := lay.at + k) in search.walls
        and min(x[at] - low[at], high[at] - x[at]) < AT_WALL * max(1.0, abs(x[at]))
    ]
    if not names:
        return []
    return [
        f"{', '.join(names)}: the first value rests where the equations cease to have one (a root or logarithm of what "
        "would be negative): the estimates count on it; write fmax(x, 0) there, or give initial={...} bounds"
    ]


def _rates(search: Search) -> list[str]:
    """One gain for records whose outputs were sampled at different rates suits none of them."""
    if search.predictor.kind not in ("stated", "innovations"):
        return []
    steps = {float(f"{r.grid.step * output_stride(r.grid):.3g}") for r in search.records}
    if len(steps) < 2:
        return []
    return [
        f"one gain corrects records that were sampled every {', '.join(f'{s:g}' for s in sorted(steps))} s: what suits "
        "one rate does not suit another; resample them alike, or fit them one by one"
    ]


def _by_name(search: Search, ratio: Array) -> dict[str, float]:
    """Free parameter, or record/state for an initial state -> its entry of (N,)."""
    states = [f"{r.experiment.name}/{s.name}" for r in search.records for s in search.model.states]
    return dict(zip([*search.pmap.free, *states], ratio.tolist(), strict=True))


def _louder_words(search: Search, noises: Sequence[OwnNoise], output: str) -> str:
    """By how much the residual of an output is larger than stated, and in which record most."""
    levels = {one.at: one.level for one in noises if one.output == output and one.level is not None}
    at, most = max(levels.items(), key=lambda one: one[1])
    much = f"{most:.3g} times"
    if len(set(levels.values())) > 1 or len(levels) < sum(
        output in r.observation.where for r in search.records
    ):
        much = f"up to {much} (in {search.records[at].experiment.name})"
    sigma = float(search.sigma[search.levels.outputs.index(output)])
    return (
        f"the residual of {output} is {much} the stated noise level of {sigma:.3g}: the level (its unit?) or the model "
        "is wrong, or the search ended at a local optimum (try starts=10); "
    )


def _quieter_words(search: Search, best: Attempt) -> list[str]:
    """Outputs whose residuals are far smaller than the level that was stated."""
    found = quieter(search, search.problem.at(best.solution.x).records)
    sigma = dict(zip(search.levels.outputs, map(float, search.sigma), strict=True))
    return [
        f"the residual of {name} is {size:.2g} times the stated noise level of {sigma[name]:.3g}: the level (its "
        "unit?) is too large, or neighbouring samples are not independent; the standard errors are those of that level"
        for name, size in found.items()
    ]


def _then(ratio: Array | None, effective: float) -> str:
    """What the residual's own noise does to the standard errors.

    ratio : (N,) by how much the errors are larger than those of white noise, None where they do not count with it
    effective : independent samples that the most coloured one is worth
    """
    if ratio is None:
        return "the standard errors are too small"
    most = float(ratio.max(initial=1.0))
    then = f"the standard errors count with that: they are up to {most:.2g} times those of white noise"
    if most < _SEEN:
        then = "the standard errors count with that, and are those of white noise here"
    if effective < _EFFECTIVE:
        few = f"the residual is worth about {max(round(effective), 1)} independent samples"
        then += f", and may still be too small, as {few}"
    return then


def _noise_words(
    search: Search, noises: Sequence[OwnNoise], varied: Sequence[Varied], then: str
) -> list[str]:
    """Outputs whose residuals are larger than stated, not white, not of one size or not by themselves; then : what that
    does to the standard errors."""
    found = []
    for one in noises:
        key = f"{search.records[one.at].experiment.name}/{one.output}"
        if one.level is not None and one.others is not None and one.level > one.others:
            found.append(
                f"the residual of {key} is {one.level / one.others:.2g} times as large as that of {one.output} in the "
                "other records, and one noise level is estimated for all: quieter records count for less than they are "
                f"worth, and {then.replace('white noise', 'one level')}"
            )
        elif one.level is not None and one.others is None:
            found.append(
                _louder_words(search, noises, one.output) + then.replace("white noise", "that level")
            )
        if one.neighbours is not None:
            found.append(
                f"the residual of {key} is not white (neighbours correlate by {one.neighbours:.2f}): the model lacks "
                f"something, and {then}; see validate"
            )
    for own in varied:
        keys = " and ".join(f"{search.records[own.at].experiment.name}/{name}" for name in own.outputs)
        how = "depends on what the sensor shows" if own.grows else "changes along the record"
        what = f"the size of the residual of {keys} {how}, and the fit weights all samples alike"
        if own.step:
            what = f"{keys} is read in steps of {own.step:.3g}: rounding is most of its noise and depends on the motion"
        if len(own.outputs) > 1:
            what = f"the residuals of {keys} are correlated ({own.share:.2f})"
        found.append(f"{what}; {then}")
    return list(dict.fromkeys(found))
