"""A second search where the first one ended in what hardly follows the data: over short pieces of them first."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from casadi_engine.deadline import Deadline, TimeUp, late
from casadi_engine.distributions import chi2_isf
from casadi_engine.errors import CasadiEngineError, NoValueError
from casadi_engine.estimation.answer_notes import HELD
from casadi_engine.estimation.faulty_samples import wild_samples
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.followed import OTHERS, lost
from casadi_engine.estimation.ipopt import BLOCKED, ONE_STEP
from casadi_engine.estimation.lower_optimum import merit

# Half of twice the log likelihood by which the second has to be better; seconds for it, and times those of the first.
LOWER, _SECONDS, _TIMES = 0.1, 2.0, 3.0
# Seconds that a fit that is lost is worth at least: it is no answer, and one that went astray at once was quick.
_WORTH = 20.0
# Starts of a fit that is lost, and of one of a predictor that is far from its start.
_STARTS, _SEVERAL = 8, 4
# Seconds of a fit that is followed by others unasked.
_QUICK = 5.0
# Standard errors within which another optimum is in the interval of this one.
_BEYOND = 2.0
# Chi-squared per sample, by levels that were stated, from which a quick fit is followed by others: another optimum is
# as likely as a model that is wrong.
_LOUD = 2.0
# Logarithm of the factor by which a parameter has left its start where another search is worth its time.
_WAY = 1.0
# A second search has intervals this many times shorter, of so many samples at least.
_SHORTER, _SHORTEST = 4, 2
# What the option says then.
BOTH = "direct, then prediction"


def is_elsewhere(fit: Fit) -> bool:
    """True for a fit of which a parameter is far from where its search began, or at a bound: it may have passed a lower
    optimum on its way."""
    for name in fit.free:
        value, start = fit.values[name], fit.start.get(name, 0.0)
        if fit.estimates[name].at_bound or (value * start > 0 and abs(math.log(value / start)) > _WAY):
            return True
    return False


Again = Callable[[dict[str, Any]], Fit]


def looked_at_twice(
    fit: Fit, again: Again, with_errors: Callable[[Fit, dict[str, Any]], Fit] | None = None
) -> Fit:
    """The fit, or a better one of another search: of a fit that is lost by predictions over short pieces first and then
    from other starts, of one that is far from its start over whole records, whose states leave fewer ways to an
    optimum, as of one that came to where the model has no value: there intervals may begin at states that no
    simulation passes.

    again(changes) : makes a fit with changed arguments, or from several starts; with_errors(fit, changes) : the same
    with its errors, which only one that is better is asked for; None where it has them
    """
    kept = with_errors or (lambda found, _: found)
    plain = fit.options.get("approach") == "direct" and fit.options.get("starts") == 1
    short = ONE_STEP in fit.status  # of an optimum; what ran out of iterations was to take no more
    if plain and any(words in fit.status for words in BLOCKED):
        found = _another(fit, again, kept, {"interval": "single", "warm": None}, _TIMES, {}, _WORTH)
        if found.converged:
            return found
        return _another(found, again, kept, {"starts": _STARTS}, _TIMES, {OTHERS: _STARTS}, _WORTH)
    if not plain or not (fit.converged or short):
        return fit
    if (
        fit.innovations is not None
    ):  # process noise takes what a model does not follow: one start tells little
        far = fit.converged and is_elsewhere(fit)
        return _another(fit, again, kept, {"starts": _SEVERAL}, _SEVERAL, {}) if far else fit
    if lost(fit) and wild_samples(fit) is not None:  # no other search follows what a sensor made up
        return fit
    if lost(fit):
        found = _another(fit, again, kept, {"approach": "prediction"}, _TIMES, {"approach": BOTH}, _WORTH)
        searched = {OTHERS: _STARTS}
        if not lost(found):
            return found
        return _another(found, again, kept, {"starts": _STARTS}, _TIMES, searched, _WORTH)
    if not fit.converged:
        return fit
    fit = over_shorter_pieces(over_whole_records(fit, again, kept), again, kept)
    return _from_other_starts(fit, again, kept)


def _from_other_starts(fit: Fit, again: Again, kept: Callable[[Fit, dict[str, Any]], Fit]) -> Fit:
    """The fit, or a better one from other starts, of one that went far or to a bound and leaves more than noise, or
    whose likelihood is no quadratic, as where it has further optima, if that is quick."""
    white = _is_white(fit)
    loud = fit.cost > _LOUD * fit.n  # beside levels that were stated
    held = any(words.startswith(HELD) for words in fit.messages)
    more = (not white and is_elsewhere(fit)) or ((loud or not white) and held) or loud
    asked = (more or _is_bent(fit)) and not fit.options.get("neighbours")
    if not (asked and fit.timing["total"] < _QUICK) or wild_samples(fit) is not None:
        return fit
    return _another(fit, again, kept, {"starts": _STARTS}, 1.0, {OTHERS: _STARTS}, rivals=True)


def _is_white(fit: Fit) -> bool:
    return not any("is not white" in words and words.startswith("the residual of") for words in fit.messages)


def has_rivals(fit: Fit) -> bool:
    """True if several starts of a fit found another optimum that the data hardly tell from it, with a parameter beyond
    its interval by the curvature."""
    limit = fit.cost + chi2_isf(0.05, max(len(fit.free), 1))  # of the 95 % region
    others = [one for one in fit.optima if one.status == "converged" and one.apart and one.cost <= limit]
    errors = {name: fit.estimates[name].stderr or fit.estimates[name].quadratic or 0.0 for name in fit.free}
    return fit.converged and any(
        abs(one.values[name] - fit.values[name]) > _BEYOND * error
        for one in others
        for name, error in errors.items()
    )


def _is_bent(fit: Fit) -> bool:
    """True where an estimate rests on a bound; or, of a fit that looked at no other start, has no symmetric error."""
    errors = [fit.estimates[name] for name in fit.free if name in fit.estimates]
    if any(one.at_bound for one in errors):
        return True
    looked = "frequency bins" in str(fit.options.get("searched on", ""))
    # or the other optimum is told
    looked = looked or any("explained as well with" in words for words in fit.messages)
    bent = any(one.stderr is None and one.interval is not None for one in errors)
    return not looked and (bent or bool(fit.doubted))


def or_whole(begun: Callable[[dict[str, Any]], Fit]) -> Fit:
    """The first fit of a model; over whole records, whose states it can reach, where its search ended at a point at
    which it has no value."""
    try:
        return begun({})
    except NoValueError as fault:
        try:
            return begun({"interval": "single", "warm": None})
        except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
            raise fault from None


def over_whole_records(
    fit: Fit, again: Again, kept: Callable[[Fit, dict[str, Any]], Fit] = lambda found, _: found
) -> Fit:
    """The fit, or a better one whose states leave fewer ways to an optimum, of one that is far from its start."""
    several = fit.options.get("interval") == "auto" and fit.model.linear is None and fit.nodes > len(fit.data)
    if several and is_elsewhere(fit):
        return _another(fit, again, kept, {"interval": "single", "warm": None}, 1.0, {})
    return fit


def over_shorter_pieces(
    fit: Fit, again: Again, kept: Callable[[Fit, dict[str, Any]], Fit] = lambda found, _: found
) -> Fit:
    """The fit, or a better one over shorter shooting intervals, of one that leaves more than noise: the more states
    of its own a search has along a record, the nearer to the data they begin, and the fewer optima are in its way."""
    several = fit.options.get("interval") == "auto" and fit.model.linear is None and fit.nodes > len(fit.data)
    samples = sum(max((len(one.time) for one in own.values()), default=0) for own in fit.traces.values())
    length = max(round(samples / fit.nodes / _SHORTER), _SHORTEST)
    if not several or _is_white(fit) or length * fit.nodes >= samples or wild_samples(fit) is not None:
        return fit
    return _another(fit, again, kept, {"interval": length, "warm": None}, 1.0, {})


def _another(
    fit: Fit,
    again: Again,
    kept: Callable[[Fit, dict[str, Any]], Fit],
    changes: dict[str, Any],
    times: float,
    said: dict[str, Any],
    least: float = _SECONDS,
    *,
    rivals: bool = False,
) -> Fit:
    """The fit, or that with changed arguments if it is better, in so many times what the fit took, and so many seconds
    at least; rivals : also if it is as good, and met others that the data hardly tell from it."""
    seconds = max(least, _SECONDS + times * fit.timing["total"])
    try:
        # of the processor, that the answer does not depend on what else the machine does
        with Deadline(seconds, clock=time.process_time), np.errstate(all="ignore"):  # starts may be anywhere
            found = again(changes)
    except TimeUp:
        if late():
            raise
        how = ", ".join(f"{name}={value!r}" for name, value in changes.items() if value is not None)
        words = f"a second search, {how}, was ended after {seconds:.0f} s: called by itself it may find a better one"
        return replace(fit, messages=(*fit.messages, words)) if lost(fit) else fit
    except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):  # there is a fit
        return fit
    better = found.converged and (not fit.converged or merit(found) < merit(fit) - LOWER)
    better = better or (rivals and has_rivals(found) and merit(found) < merit(fit) + LOWER)
    best = kept(found, changes) if better else fit
    return replace(best, options={**best.options, **said})
