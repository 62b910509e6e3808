"""What is said of a fit: directions without data, priors and noise that contradict it, starts that rest at a wall."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.constraints import Priors
from casadi_engine.estimation.final_check import cure
from casadi_engine.estimation.fit import Optimum
from casadi_engine.estimation.predictor import output_stride
from casadi_engine.estimation.residual_noise import OwnNoise, quieter
from casadi_engine.estimation.search import AT_WALL, Attempt, Search
from casadi_engine.estimation.standard_errors import Uncertainty
from casadi_engine.estimation.varied_noise import Varied
from casadi_engine.simulation.error_estimate import ErrorEstimate

Array = NDArray[np.float64]

# What is said of errors that would have to count with a noise, and cannot.
UNTOLD = "no errors are given, as those of white noise are too small"
# What is said of residuals that are of different sizes.
UNEVEN_SIZE, UNEVEN_LEVEL = "the size of the residual of", "times as large as that of"
# How the words on constraints that hold estimates begin.
HELD = "held by constraints"
# Growth of the errors from which it is stated as a number.
_SEEN = 1.05
# Independent samples with fewer of which the colour of a residual is hardly known.
_EFFECTIVE = 20
# An integration error that may move an estimate by this share of its standard error is said.
_FELT = 0.1
# Standard errors between a prior and the data that chance brings once in sixteen thousand fits.
_CONTRADICTED = 4.0


def of_the_search(
    search: Search,
    best: Attempt,
    errors: Uncertainty,
    reason: str | None,
    optima: tuple[Optimum, ...],
    stopped: str,
    noise_words: Sequence[str],
) -> tuple[str, ...]:
    """What the search and its optimum ask to be known: why it is none, what no data determine, what holds it.

    reason : why the optimum is none; stopped : who ended the search before its end, if anyone
    """
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
        found.append(f"{HELD}: {', '.join(errors.acting)}; do they agree with the data?")
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


def against_priors(search: Search, errors: Uncertainty) -> tuple[str, ...]:
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


def of_quieter_outputs(search: Search, best: Attempt) -> list[str]:
    """Outputs whose residuals are far smaller than the level that was stated."""
    found = quieter(search, search.problem.at(best.solution.x).records)
    sigma = dict(zip(search.levels.outputs, map(float, search.sigma), strict=True))
    return [
        f"the residual of {name} is {size:.2g} times the stated noise level of {sigma[name]:.3g}: the level (its "
        "unit?) is too large, or neighbouring samples are not independent; the standard errors are those of that level"
        for name, size in found.items()
    ]


def errors_then(ratio: Array | None, effective: float, *, counted: bool = False) -> str:
    """What the residual's own noise does to the standard errors.

    ratio : (N,) by how much the errors are larger than those of white noise, None where they do not count with it
    effective : independent samples that the most coloured one is worth; counted : the errors were to count with it
    """
    if ratio is None:
        return UNTOLD if counted else "the standard errors are too small"
    most = float(ratio.max(initial=1.0))
    then = f"the standard errors count with that: they are up to {most:.2g} times those of white noise"
    if most < _SEEN:
        then = "the standard errors count with that, and are those of white noise here"
    if effective < _EFFECTIVE:
        few = f"the residual is worth about {max(round(effective), 1)} independent samples"
        then += f", and may still be too small, as {few}"
    return then


def of_the_noise(
    search: Search, noises: Sequence[OwnNoise], varied: Sequence[Varied], then: str
) -> list[str]:
    """Outputs whose residuals are larger than stated, not white, not of one size or not by themselves; then : what that
    does to the standard errors."""
    found = []
    # predictions from each sample to those next to it lead past the optima of whole records
    short = not all(record.linear for record in search.records)
    looks = 'approach="prediction" or starts=10 looks for one' if short else "starts=10 looks for one"
    for one in noises:
        key = f"{search.records[one.at].experiment.name}/{one.output}"
        if one.level is not None and one.others is not None and one.level > one.others:
            found.append(
                f"the residual of {key} is {one.level / one.others:.2g} {UNEVEN_LEVEL} {one.output} in the "
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
                f"something, or has a lower optimum ({looks}), and {then}; see validate"
            )
    for own in varied:
        keys = " and ".join(f"{search.records[own.at].experiment.name}/{name}" for name in own.outputs)
        how = "depends on what the sensor shows" if own.grows else "changes along the record"
        how += ", as a share of it" if own.of_share else ""
        if own.chance < 1:
            how = f"{how.replace('depends', 'may depend').replace('changes', 'may change')} ({100 * own.chance:.0f} %)"
        what = f"{UNEVEN_SIZE} {keys} {how}, and the fit weights all samples alike"
        if own.step:
            what = f"{keys} is read in steps of {own.step:.3g}: rounding is most of its noise and depends on the motion"
        if len(own.outputs) > 1:
            what = f"the residuals of {keys} are correlated ({own.share:.2f})"
        found.append(f"{what}; {then}")
    return list(dict.fromkeys(found))


def of_the_integration(integration: dict[str, ErrorEstimate], misfit: float) -> tuple[str, ...]:
    """What integration errors do to the estimates, where it is more than they are allowed to.

    misfit : chi-squared per sample; beside a residual that is no noise of the levels steps may be as much longer
    """
    most = _FELT * math.sqrt(max(misfit, 1.0))
    return tuple(
        f"the integration of {record} moves the estimates by up to {found.shift:.2g} standard errors, and shorter "
        "steps were not reached: the equations change too sharply; make them smoother"
        for record, found in integration.items()
        if found.shift is not None and found.shift > most
    )
