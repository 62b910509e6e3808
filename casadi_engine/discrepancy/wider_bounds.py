"""A bound or a first state that is wrong looks like physics that the model lacks: what the model would be without the
bounds that it rests on, and from first states that are found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from casadi_engine.discrepancy.evidence import FACTOR
from casadi_engine.discrepancy.misread import followed
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.refit import freedom, merit
from casadi_engine.discrepancy.repaired import Repair
from casadi_engine.discrepancy.wording import BOUNDS, STARTS, si
from casadi_engine.estimation import Fit, estimate
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise

# A bound moves out by this factor: what has a sign keeps it, and what is zero or infinite beyond is near enough.
_WIDER = 1e3
# Part of what the effects close that the wider bound has to close for the bound to be the likelier cause; of what is
# left of an output where no effect is known.
_AS_MUCH, _HALF = 0.9, 0.5


def with_wider_bounds(
    repair: Repair, parameters: Parameters, noise: Noise | None, options: Mapping[str, Any]
) -> Repair:
    """The same, and at the top that the bounds on which parameters rest may be all that is wrong, where a fit without
    them closes as much of the gap as the answer does."""
    null = repair.null_fit
    if repair.verdict in (None, "nothing missing"):
        return repair
    wide, moved = _wider(null, parameters)
    if not moved:
        return repair
    found = _without_any(repair, wide, {**options, "noise": noise})
    if found is None:
        return repair
    rests = " and ".join(
        f"{name} rests on its bound of {bound:.5g}{_unit(null, name)}" for name, bound in moved.items()
    )
    values = " and ".join(f"{name} = {found.values[name]:.5g}{_unit(null, name)}" for name in moved)
    follows = f"the model without any effect follows {_shares(found, null)}"
    words = f"{rests}: with {values} {follows}. Look whether the bound is right"
    return hedged(repair, BOUNDS, words)


def with_free_starts(
    repair: Repair, parameters: Parameters, noise: Noise | None, options: Mapping[str, Any]
) -> Repair:
    """The same, and at the top that the first states which were given may be all that is wrong, where a fit that finds
    them closes as much of the gap as the answer does."""
    if repair.verdict in (None, "nothing missing") or not options.get("initial"):
        return repair
    found = _without_any(repair, parameters, {**options, "noise": noise, "initial": None})
    if found is None:
        return repair
    record, own = next(iter(found.initial.items()))
    values = ", ".join(f"{name} = {one.value:.4g}{si(one.unit)}" for name, one in own.items())
    words = (
        f"The initial states were given: with {values} in {record} the model without any effect follows "
        f"{_shares(found, repair.null_fit)}. Look whether they are right"
    )
    return hedged(repair, STARTS, words)


def hedged(repair: Repair, what: str, words: str) -> Repair:
    """The same with such words; what it names is one of two causes then."""
    verdict = "class" if repair.verdict == "named" else repair.verdict
    return replace(repair, verdict=verdict, options={**repair.options, what: words})


def _without_any(repair: Repair, parameters: Parameters, options: Mapping[str, Any]) -> Fit | None:
    """The fit without effects under other conditions; None where it does not arrive, or does less than the answer."""
    how = {**options, "parameters": parameters, "progress": False, "errors": "quadratic"}
    try:
        found = estimate(repair.null_fit.model, repair.data, **how)
    except FAILURES:
        return None
    return found if found.converged and _as_good(found, repair) else None


def _shares(found: Fit, before: Fit) -> str:
    """How much of the outputs a fit follows, in place of how much."""
    return " and ".join(
        f"{share:.3g} % of {name} in place of {then:.3g} %"
        for (name, share), then in zip(followed(found).items(), followed(before).values(), strict=True)
    )


def _unit(fit: Fit, name: str) -> str:
    return si(fit.estimates[name].unit)


def _wider(fit: Fit, parameters: Parameters) -> tuple[Parameters, dict[str, float]]:
    """The parameters with bounds far out of those on which estimates rest, and these bounds; not where the bound is
    zero, which is a sign."""
    wide, moved = parameters.copy(), {}
    for name, one in fit.estimates.items():
        if not one.at_bound or name not in parameters.names or parameters[name].tie is not None:
            continue
        own = parameters[name]
        bound = own.min if one.at_bound == "min" else own.max
        if not bound:
            continue
        out = (bound > 0) == (one.at_bound == "max")
        wide[name].set(**{one.at_bound: bound * _WIDER if out else bound / _WIDER})
        moved[name] = bound
    return wide, moved


def _as_good(found: Fit, repair: Repair) -> bool:
    before, after = merit(repair.null_fit), merit(found)
    if repair.effects:
        theirs = merit(repair.fit)
        more = (freedom(repair.fit) - freedom(found)) * math.log(found.n)
        if repair.confirmed and after - theirs > more + 2 * math.log(FACTOR):
            return False  # what fresh data confirm is that much more probable
        return before - after >= _AS_MUCH * (before - theirs)
    then, now = followed(repair.null_fit), followed(found)
    return any((1 - now[name] / 100) <= _HALF * (1 - share / 100) for name, share in then.items())
