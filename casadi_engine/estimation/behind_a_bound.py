"""Whether the data tell a parameter that rests on its bound from one that does not.

The errors of the others are those along the bound, to first order. Where a search ends on a bound in a valley that
bends, the likelihood is nearly as high elsewhere, and the others are elsewhere too. So the model is fitted once more
with that parameter held inside, from where its search began on towards the bound, until chi-squared is within the 95 %
region; and on from there, away from the bound, as far as that region goes. Where chi-squared is lower inside, the bound
was no optimum, and the search goes on from there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from casadi_engine.deadline import Deadline, TimeUp, late
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.followed import lost
from casadi_engine.parameters import Parameters

# Chi-squared by which a point of the 95 % region lies above the optimum; errors by which another estimate is elsewhere.
_WITHIN, _ELSEWHERE = 4.0, 2.0
# Share by which a region that is printed may be too short beside that with a parameter off its bound.
_TOO_SHORT = 1.25
# Parameters on a bound that are looked behind, and fits for each.
_MOST, _FITS = 2, 5
# Chi-squared by which a fit from inside has to be lower to take the place of one on a bound; so often.
_LOWER, _AGAIN = 0.1, 3
# Seconds of the processor for it: so many at least, and times those of the fit.
_SECONDS, _TIMES = 3.0, 1.0
# Share of the way that places away from the bound lie apart.
_ON = 0.125
# Power of the distance from the bound with which chi-squared rises, at least.
_FLATTEST = 0.5
# Share of a value within which a place is that of the bound.
_SAME = 1e-6
NOT_TOLD = "rests on its bound, and"
_NOT_LOOKED = (
    "the errors are those with {} on its bound; whether the data allow it elsewhere, with the others elsewhere too, "
    "was not seen, as that takes more than {:.0f} s: call ce.posterior(fit)"
)


def told_from_their_bounds(fit: Fit, parameters: Parameters, again: Callable[[dict[str, Any]], Fit]) -> Fit:
    """The fit, without the errors of what is elsewhere where a parameter leaves its bound.

    again(changes) : makes a fit with changed arguments
    """
    if lost(fit):  # where its bounds are is not what is wrong with it
        return fit
    seconds = _SECONDS + _TIMES * fit.timing.get("total", 0.0)
    for _ in range(_AGAIN):
        try:
            with Deadline(seconds, clock=time.process_time):
                found = _looked_behind(fit, parameters, again)
        except TimeUp:
            if late():
                raise
            held = _listed([name for name in fit.free if fit.estimates[name].at_bound])
            return replace(fit, messages=(*fit.messages, _NOT_LOOKED.format(held, seconds)))
        lower = found if found is not None and found.cost < fit.cost - _LOWER else None
        if lower is None:
            return fit if found is None else found
        fit = lower
    return fit


def _looked_behind(fit: Fit, parameters: Parameters, again: Callable[[dict[str, Any]], Fit]) -> Fit | None:
    """The fit as it is told from its bounds, or a lower one; None where nothing is said of them."""
    held = [name for name in fit.free if fit.estimates[name].at_bound and name in fit.start]
    if not fit.converged or fit.gain is not None:
        return None
    for name in held[:_MOST]:
        found = _behind(fit, name, parameters, again)
        if found is not None and found is not fit:
            return found
    return None


def _behind(
    fit: Fit, name: str, parameters: Parameters, again: Callable[[dict[str, Any]], Fit]
) -> Fit | None:
    """The fit without the errors of what is elsewhere at some place of one parameter that the data allow, or one from
    such a place that is lower."""
    bound, inside = fit.estimates[name].value, _first_inside(fit, name, parameters)
    if inside is None:
        return None
    by_logarithm = bound > 0 and inside > 0
    begin = math.log(inside / bound) if by_logarithm else inside - bound
    # what chi-squared counts in white noise is worth less in the noise that there is
    worth = max((1.0, *fit.own_noise.values())) ** 2
    near, far, risen, power, at = 0.0, 0.0, math.inf, 2.0, begin  # distances that the data allow, and do not
    for _ in range(_FITS):
        inside = bound * math.exp(at) if by_logarithm else bound + at
        other = _held_at(name, inside, parameters, again)
        rise = math.inf if other is None else _rise(fit, other) / worth
        if other is not None and rise < -_LOWER:
            lower = again({"parameters": parameters, "warm": other})
            return lower if lower.converged and _rise(fit, lower) < -_LOWER else None
        if other is not None and rise <= _WITHIN:
            found = _without_errors(fit, other, name, inside, rise)
            if found is not fit:
                return found
            near = at
            if not far:  # it goes on, away from the bound
                further = _further(bound, at, parameters[name], by_logarithm=by_logarithm)
                if further is None:
                    return None
                at = further
                continue
        else:
            if rise < risen < math.inf:
                power = min(max(math.log(risen / rise) / math.log(far / at), _FLATTEST), 2.0)
            far, risen = at, rise
        # by the power of the distance with which it fell, a quadratic at first; then half-way, by the logarithm
        share = min(0.5, (0.5 * _WITHIN / risen) ** (1 / power)) if risen < math.inf else 0.5
        at = math.copysign(math.sqrt(near * far), far) if near else share * far
    return None


def _further(bound: float, at: float, own: Any, *, by_logarithm: bool) -> float | None:
    """A place further from the bound: by a share of the way to the other one, or of the way so far; None from there."""
    other = own.max if at > 0 else own.min
    if not math.isfinite(other) or (by_logarithm and other <= 0):
        return (1 + _ON) * at
    end = math.log(other / bound) if by_logarithm else other - bound
    return None if abs(at) >= (1 - _SAME) * abs(end) else at + _ON * (end - at)


def _first_inside(fit: Fit, name: str, parameters: Parameters) -> float | None:
    """Where the search began, or the other bound if that is on the first; None where neither is inside."""
    value, start = fit.estimates[name].value, fit.start[name]
    if abs(start - value) > _SAME * abs(start):
        return start
    own = parameters[name]
    return next(
        (at for at in (own.min, own.max) if math.isfinite(at) and abs(at - value) > _SAME * abs(at)), None
    )


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


def _reaches(here: Any, there: Any, rise: float) -> bool:
    """True for an estimate whose 95 % region, with a parameter off its bound, reaches beyond the one that is printed;
    rise : chi-squared there, above the fit's."""
    own, other = _region(here), _region(there)
    if own is None:
        return False
    share = math.sqrt(max(1 - rise / _WITHIN, 0.0))
    low, high = (there.value + share * (end - there.value) for end in other or (there.value, there.value))
    return bool(
        here.value - low > _TOO_SHORT * (here.value - own[0])
        or high - here.value > _TOO_SHORT * (own[1] - here.value)
    )


def _region(one: Any) -> tuple[float, float] | None:
    """The 95 % region that is printed for an estimate; None without one."""
    interval = getattr(one, "interval", None)
    if interval is not None:
        return float(interval[0]), float(interval[1])
    error = one.stderr or one.quadratic
    return (one.value - _ELSEWHERE * error, one.value + _ELSEWHERE * error) if error else None


def _without_errors(fit: Fit, other: Fit, name: str, inside: float, rise: float) -> Fit:
    estimates: Mapping[str, Any] = fit.estimates
    moved = [
        one for one in fit.free
        if one != name and one in other.estimates and _reaches(estimates[one], other.estimates[one], rise)
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
        f"data do not tell {name} from {_listed(moved)}; fix {name} where it is known, or call ce.posterior(fit)"
    )
    initial = {
        record: {
            state: replace(one, stderr=None, interval=None, quadratic=one.stderr)
            if one.stderr and _reaches(one, other.initial[record][state], rise)
            else one
            for state, one in states.items()
        }
        for record, states in fit.initial.items()
    }
    return replace(fit, estimates={**estimates, **gone}, initial=initial, messages=(words, *fit.messages))


def _listed(names: Sequence[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
