"""One set of parameters for the data of the search and the fresh ones, where nothing else seems to describe both.

Errors of parameters are a step of first order. Where a short record hardly tells a parameter, such a step says little
of what other values do; a fit of all records together says it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.discrepancy.checked_errors import as_fitted
from casadi_engine.discrepancy.fresh_misfit import fresh_misfit
from casadi_engine.distributions import chi2_sf
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Trace, estimate
from casadi_engine.problem.noise import Noise

if TYPE_CHECKING:
    from casadi_engine.discrepancy.refit import Addition, Refitter
    from casadi_engine.discrepancy.repaired import Repair

# Starts of the fit where nothing was found: the data of the search may have led astray.
_STARTS = 4
# Squares that are higher by no more than this share of them are as high.
_SAME = 1e-3


def asks_for_one(repair: Repair, effects: Sequence[Addition]) -> bool:
    """True where fresh data are not described, and a fit of all records can be made.

    effects : of the answer; an event that may be at another time there, or not at all, has no parameters for both
    """
    names = [record.name for record in (*repair.data, *repair.fresh)]
    able = len(set(names)) == len(names) and not any(one.placed for one in effects)
    return (
        able and repair.verdict in ("nothing missing", "named", "class") and fresh_misfit(repair) is not None
    )


def with_joint_fit(repair: Repair, refitter: Refitter) -> Repair:
    """The repair with what parameters that describe all records leave of the fresh ones, in place of a step of them.

    How far they move is held against the data of the search: by twice their log likelihood that it costs, chi-squared
    with one degree of freedom for every free parameter.
    """
    gaps, noise = repair.gaps, repair.noise
    after = None if gaps is None else gaps.validation_after
    if gaps is None or after is None or noise is None:
        return repair
    levels = {name: level for name, (level, _) in noise.sigma.items()}
    found_some = bool(repair.effects)
    given = {r: {n: e.value for n, e in own.items() if e.fixed} for r, own in repair.fit.initial.items()}
    try:
        with np.errstate(all="ignore"):
            both = estimate(
                repair.fit.model, (*repair.data, *repair.fresh),
                parameters=as_fitted(repair.fit) if found_some else refitter.parameters,
                noise=Noise(**dict[str, Any](levels)), starts=1 if found_some else _STARTS, progress=False,
                errors="quadratic", interval=refitter.interval,
                initial={r: own for r, own in given.items() if own} or None,
            )  # fmt: skip
    except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
        return repair
    fresh = [record.name for record in repair.fresh]
    searched = [record.name for record in repair.data]
    found, known = _squares(both.traces, fresh, levels), _squares(after.traces, fresh, levels)
    first, then = (_total(_squares(one.traces, searched, levels)) for one in (repair.fit, both))
    # the parameters of the search describe all records so well: what is worse than they are is no optimum
    if not then + _total(found) <= (1 + _SAME) * (first + _total(known)):
        return repair
    left = {}
    for output, own in found.items():
        before = (after.gap.rmse[output] / levels[output]) ** 2
        left[output] = min(1.0, float(own.mean()) / before) if before > 0 else 1.0
    every = np.concatenate([*found.values()])
    # a louder noise there moves the parameters further
    unit = max(gaps.estimation_after.gap.chi2_per_sample, float(every.mean()), 1e-300)
    chance = float(chi2_sf(max(then - first, 0.0) / unit, max(len(both.free), 1)))
    side = replace(after, within_errors=float(every.mean()), parameters_p=chance, left=left, jointly=True)
    return replace(repair, gaps=replace(gaps, validation_after=side))


def _squares(
    traces: Mapping[str, Mapping[str, Trace]], records: list[str], levels: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """output -> squared residuals over the noise's level, of some records."""
    found: dict[str, list[np.ndarray]] = {}
    for name in records:
        for output, trace in traces[name].items():
            if output in levels:
                own = trace.residual[np.isfinite(trace.residual)]
                found.setdefault(output, []).append((own / levels[output]) ** 2)
    return {output: np.concatenate(parts) for output, parts in found.items()}


def _total(squares: Mapping[str, np.ndarray]) -> float:
    return float(sum(own.sum() for own in squares.values()))
