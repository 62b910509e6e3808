"""The numbers of a repair with errors that its likelihood bears out, as those of every fit.

Refits have the errors of the quadratic at their optimum, which is enough to compare structures by. What is printed goes
through the checks of ``estimate``: at the optimum, once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from casadi_engine.deadline import TimeUp
from casadi_engine.discrepancy.repaired import FoundEffect, Repair
from casadi_engine.discrepancy.start import Start
from casadi_engine.discrepancy.wording import ROUNDED
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Estimate, Fit, estimate
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise

# Rise or fall of chi-squared with which an optimum is still the same.
_SAME = 0.1
# Errors that are larger by this factor are said to be.
_SEEN = 1.1
# Processor time that intervals by profile may take [s]: they are the last step of much work.
FOR_INTERVALS = 20.0
# Words of a fit whose errors were not checked, as that took longer than it may.
_NOT_CHECKED = "were not checked away from it"
_ROUNDED = "the search was ended before corners were as sharp as the data feel them"
_OF_ROUNDING = (
    "what is still unexplained may come of rounded corners, as the search was ended before sharper ones"
)
_UNCHECKED = "the standard errors are those of the curvature at the optimum; they were not checked"


def with_checked_errors(
    repair: Repair, noise: Noise | None, options: Mapping[str, Any], *, in_places: bool
) -> Repair:
    """The same values with the errors that ``estimate`` prints for them, or a message that these were not checked.

    noise, options : of its fits; in_places : their laws are so sharp that steps are short in places alone
    """
    if not repair.effects:
        return _null_checked(repair, noise, options)
    unchecked = replace(repair, messages=(*repair.messages, _UNCHECKED))
    fit = repair.fit
    start = replace(Start.of(fit), in_places=in_places)
    own = {
        **options,
        "interval": fit.options.get("interval", "auto"),
        "progress": False,
        "errors": FOR_INTERVALS,
    }
    try:
        found = estimate(fit.model, fit.data, parameters=as_fitted(fit), noise=noise, warm=start, **own)
    except (CasadiEngineError, TimeUp):
        return unchecked
    if not found.converged or abs(found.cost - fit.cost) > _SAME:
        return unchecked
    estimates = {
        name: _with_error_of(one, found.estimates.get(name), _limits(fit, name))
        for name, one in fit.estimates.items()
    }
    checked = no_smaller_errors(replace(fit, estimates=estimates), found)
    effects = tuple(with_errors_of(one, checked) for one in repair.effects)
    said = (*repair.messages, *_doubts(estimates), *_larger(estimates, checked.estimates))
    return replace(repair, fit=checked, effects=effects, messages=said)


def _null_checked(repair: Repair, noise: Noise | None, options: Mapping[str, Any]) -> Repair:
    """The same with the checks of the fit without effects, where nothing is missing in it and there was no time for
    these before."""
    fit = repair.fit
    if repair.verdict != "nothing missing" or not any(_NOT_CHECKED in words for words in fit.messages):
        return repair
    own = {**options, "interval": fit.options.get("interval", "auto"), "progress": False}
    try:
        found = estimate(
            fit.model, fit.data, parameters=as_fitted(fit), noise=noise, warm=Start.of(fit), **own
        )
    except (CasadiEngineError, TimeUp):
        return repair
    if not found.converged or abs(found.cost - fit.cost) > _SAME:
        return repair
    said = tuple(words for words in repair.messages if _NOT_CHECKED not in words)
    return replace(repair, fit=found, null_fit=found, messages=said)


def with_errors_of_rounding(
    repair: Repair,
    felt: float,
    moved: Mapping[str, float] = MappingProxyType({}),
    *,
    ended: bool,
    all_of_it: bool = True,
) -> Repair:
    """The same with errors that count how corners are rounded: larger by what sharper ones may move the estimates;
    none where the search was ended before these were tried, as what they do is foretold from wider ones alone.

    felt : chi-squared by which sharper corners may change it, nan where that is not known, 0 where none is felt
    moved : parameter -> what sharper corners may move it by, where that is known
    all_of_it : what is left may come of rounded corners alone
    """
    if not repair.effects or felt == 0 or (math.isnan(felt) and not ended):
        return repair
    found = {}
    for name, one in repair.fit.estimates.items():
        error = one.stderr or one.quadratic
        factor = math.hypot(1, moved[name] / error) if error and name in moved else math.sqrt(1 + felt)
        if one.stderr is None:
            interval = None if ended else _stretched(one, factor, _limits(repair.fit, name))
            found[name] = replace(one, interval=interval)
        elif ended:
            found[name] = replace(one, stderr=None, why=_ROUNDED)
        else:
            found[name] = replace(one, stderr=factor * one.stderr)
    fit = replace(repair.fit, estimates=found)
    effects = tuple(with_errors_of(one, fit) for one in repair.effects)
    own = ended and all_of_it
    said = (_OF_ROUNDING,) if own and repair.unknown is not None else ()
    options = {**repair.options, ROUNDED: _OF_ROUNDING} if own else repair.options
    return replace(repair, fit=fit, effects=effects, options=options, messages=(*repair.messages, *said))


def is_of_rounding(repair: Repair) -> bool:
    """True where the search was ended before corners were sharp, and all that is unexplained may come of that."""
    return ROUNDED in repair.options


def as_fitted(fit: Fit) -> Parameters:
    """A fit's parameters to go on from, with the widths of its corners held."""
    pars = fit.parameters.copy()
    for one in fit.model.effects:  # corners are as sharp as the search found them felt
        if one.width and not pars[one.width].vary:
            pars.fix(one.width)
    return pars


def with_errors_of(effect: FoundEffect, fit: Fit) -> FoundEffect:
    """An effect with its estimates of another fit."""
    return replace(
        effect, parameters={name: fit.estimates.get(name, own) for name, own in effect.parameters.items()}
    )


def _limits(fit: Fit, name: str) -> tuple[float, float]:
    """The bounds of a parameter, of its value in one record too."""
    own = fit.parameters[name.partition("@")[0]]
    return own.min, own.max


def _with_error_of(one: Estimate, other: Estimate | None, limits: tuple[float, float]) -> Estimate:
    """An estimate that has an error, with what the checks made of it."""
    if other is None or one.stderr is None or other.quadratic is None:
        return one
    # coloured noise stretches what the likelihood of white noise gives
    ratio = max(one.stderr / other.quadratic, 1.0)
    return replace(
        one, stderr=None, why=other.why, interval=_stretched(other, ratio, limits), quadratic=one.stderr
    )


def _stretched(one: Estimate, ratio: float, limits: tuple[float, float]) -> tuple[float, float] | None:
    """The interval of an estimate, so many times as wide, within its bounds."""
    if one.interval is None:
        return None
    low, high = one.interval
    low, high = one.value - ratio * (one.value - low), one.value + ratio * (high - one.value)
    return max(low, limits[0]), min(high, limits[1])


def no_smaller_errors(fit: Fit, known: Fit) -> Fit:
    """A fit whose errors are no smaller than those of another one that knows as much, and the noise's colour."""
    found = {}
    for name, one in fit.estimates.items():
        other = known.estimates.get(name)
        own = one.stderr or one.quadratic
        then = None if other is None else other.stderr or other.quadratic
        if own is None or then is None or then <= own:
            found[name] = one
        elif one.stderr is not None:
            found[name] = replace(one, stderr=then)
        else:
            found[name] = replace(
                one, quadratic=then, interval=_stretched(one, then / own, _limits(fit, name))
            )
    return replace(fit, estimates=found)


def _larger(before: Mapping[str, Estimate], after: Mapping[str, Estimate]) -> list[str]:
    """That errors count with a residual that is coloured, or larger than the noise that structures were compared by."""
    pairs = [(one.stderr or one.quadratic, after[name]) for name, one in before.items()]
    ratios = [(own.stderr or own.quadratic or then) / then for then, own in pairs if then]
    most = max(ratios, default=1.0)
    if most < _SEEN:
        return []
    return [
        "the standard errors count with the residual of the repaired model as it is: they are up to "
        f"{most:.2g} times those of the noise that structures were compared by"
    ]


def _doubts(estimates: Mapping[str, Estimate]) -> list[str]:
    """What is said of estimates without a symmetric error."""
    doubted = [name for name, one in estimates.items() if one.quadratic is not None]
    if not doubted:
        return []
    open_ends = [name for name in doubted if estimates[name].interval is None]
    call = (
        f"; for {', '.join(open_ends)} call ce.profile(repair.fit), or ce.posterior(repair.fit)"
        if open_ends
        else ""
    )
    return [f"no symmetric error describes {', '.join(doubted)}: the likelihood is not quadratic there{call}"]
