"""A repair of which the effects are no answer: what is left is the model without them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from casadi_engine.discrepancy.evidence import FACTOR
from casadi_engine.discrepancy.repaired import BEHIND_OTHERS, FoundEffect, Nearest, Repair, Unknown
from casadi_engine.discrepancy.wording import EARLY, is_early, is_untold


def withdrawn(repair: Repair, why: str, unknown: Unknown | None, *messages: str) -> Repair:
    """The repair without its effects: "unnamed" where something unknown is missing, else "nothing missing"."""
    gaps = repair.gaps
    if gaps is not None:
        gaps = replace(gaps, estimation_after=gaps.estimation_before, validation_after=gaps.validation_before)
    nearest = None
    if unknown is not None and gaps is not None and repair.gaps is not None and repair.effects:
        after = repair.gaps.validation_after
        names = tuple(f"{one.name} at {one.at}" for one in repair.effects)
        fresh = None if after is None else after.gap
        nearest = Nearest(names, repair.fit, repair.gaps.estimation_after.gap, fresh)
    gone = tuple(replace(one, why_withdrawn=why) for one in repair.effects)
    return replace(
        repair,
        verdict="nothing missing" if unknown is None else "unnamed",
        confirmed=None,
        fit=repair.null_fit,
        effects=(),
        withdrawn=(*gone, *repair.withdrawn),
        unknown=unknown,
        nearest=nearest,
        gaps=gaps,
        equation=None,
        next_experiment=None,
        messages=(*messages, *repair.messages),
    )


def held_to_rivals(repair: Repair) -> Repair:
    """The repair without effects that fresh data do not confirm and the data exclude beside what could not lead."""
    behind = None if repair.confirmed else far_less_probable(repair.effects)
    return repair if behind is None else withdrawn(repair, BEHIND_OTHERS, behind)


def held_to_sizes(repair: Repair) -> Repair:
    """The repair, confirmed by no fresh data where it does not tell the size of what it names, or names a sensor that
    would be early."""
    early = [one.at.partition("_")[2] for one in repair.effects if is_early(one)]
    if early and repair.confirmed:
        words = (
            f"the gap on fresh data is smaller with {' and '.join(early)} shown early, as no sensor does: that is no "
            f"confirmation; {EARLY}"
        )
        return replace(repair, confirmed=None, messages=(words, *repair.messages))
    untold = [f"{one.name} at {one.at}" for one in repair.effects if is_untold(one)]
    if not untold or not repair.confirmed:
        return repair
    words = (
        f"the gap on fresh data is smaller with {' and '.join(untold)}, whose size may be zero within its errors, "
        "is at a bound, or has no error and a shape at a bound: that is no confirmation"
    )
    return replace(repair, confirmed=None, messages=(words, *repair.messages))


def far_less_probable(found: Sequence[FoundEffect]) -> Unknown | None:
    """Why effects that nothing confirms are no answer: the data exclude one of them beside another in its place, which
    does not lead as its fit did not end; None where they exclude none."""
    for one in found:
        most = max(one.members, key=lambda member: member.probability)
        if one.members[0].probability * FACTOR < most.probability:
            words = (
                f"{most.name} at {most.at}{most.more} is far more probable than {one.name} at {one.at}, but no whole "
                "fit with it was reached, or fresh data do not stand by it"
            )
            return Unknown(words, {one.key: one.p_value})
    return None
