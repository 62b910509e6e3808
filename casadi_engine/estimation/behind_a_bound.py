"""Whether the data tell a parameter that rests on its bound from one that does not.

The errors of the others are those along the bound, to first order. Where a search ends on a bound in a valley that
bends, the likelihood is nearly as high elsewhere, and the others are elsewhere too. So the model is fitted once more
with that parameter held where its search began, and half-way there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation.fit import Fit
from casadi_engine.parameters import Parameters

# Chi-squared by which a point of the 95 % region lies above the optimum; errors by which another estimate is elsewhere.
_WITHIN, _ELSEWHERE = 4.0, 2.0
# Parameters on a bound that are looked behind.
_MOST = 2
NOT_TOLD = "rests on its bound, and"


def told_from_their_bounds(fit: Fit, parameters: Parameters, again: Callable[[dict[str, Any]], Fit]) -> Fit:
    """The fit, without the errors of what is elsewhere where a parameter leaves its bound.

    again(changes) : makes a fit with changed arguments
    """
    held = [name for name in fit.free if fit.estimates[name].at_bound and name in fit.start]
    if not fit.converged or fit.gain is not None:
        return fit
    for name in held[:_MOST]:
        value, start = fit.estimates[name].value, fit.start[name]
        for inside in (start, 0.5 * (start + value)):
            if inside == value:
                break
            other = _held_at(name, inside, parameters, again)
            # what chi-squared counts in white noise is worth less in the noise that there is
            worth = max((1.0, *fit.own_noise.values())) ** 2
            rise = math.inf if other is None else _rise(fit, other) / worth
            if other is not None and rise <= _WITHIN:
                return _without_errors(fit, other, name, inside, rise)
    return fit


def _held_at(
    name: str, value: float, parameters: Parameters, again: Callable[[dict[str, Any]], Fit]
) -> Fit | None:
    pars = parameters.copy()
    try:
        pars.fix(name, value)
        other = again({"parameters": pars, "warm": None})
    except CasadiEngineError:  # it is tied to others, or the model has no value there
        return None
    return other if other.converged else None


def _rise(fit: Fit, other: Fit) -> float:
    """-2 log likelihood of another fit less that of one, the levels of the noise being those that either leaves."""
    counts = dict.fromkeys(fit.noise, 0)
    for traces in fit.traces.values():
        for output, trace in traces.items():
            counts[output] += int(trace.mask.sum())
    levels = (
        2 * count * math.log(other.noise[output][0] / fit.noise[output][0])
        for output, count in counts.items()
        if count
    )
    return float(other.cost - fit.cost + sum(levels))


def _without_errors(fit: Fit, other: Fit, name: str, inside: float, rise: float) -> Fit:
    estimates: Mapping[str, Any] = fit.estimates
    moved = [
        one for one in fit.free
        if one != name and (error := estimates[one].stderr or estimates[one].quadratic)
        and abs(other.values[one] - fit.values[one]) > _ELSEWHERE * error
    ]  # fmt: skip
    if not moved:
        return fit
    gone = {}
    for one in moved:
        error = estimates[one].stderr or estimates[one].quadratic
        gone[one] = replace(estimates[one], stderr=None, interval=None, quadratic=error)
    there = ", ".join(f"{one} = {other.values[one]:.4g}" for one in moved)
    words = (
        f"{name} {NOT_TOLD} with {name} = {inside:.4g} chi-squared is {max(rise, 0.0):.2g} higher and {there}: these "
        f"data do not tell {name} from {' and '.join(moved)}; fix {name} where it is known, or call ce.posterior(fit)"
    )
    return replace(fit, estimates={**estimates, **gone}, messages=(words, *fit.messages))
