"""The verdict of a repair in a few words, and what to do next: the first and the last line on the screen."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from casadi_engine.discrepancy.checked_errors import is_of_rounding
from casadi_engine.discrepancy.common_delay import common_delay, other_cause
from casadi_engine.discrepancy.evidence import FACTOR
from casadi_engine.discrepancy.fresh_misfit import (
    FRESH,
    HALF,
    fresh_doubt,
    fresh_misfit,
    how_far,
    is_far_beyond,
    is_louder,
    laws_were_cut,
)
from casadi_engine.discrepancy.repaired import (
    FAR_OFF,
    FRESH_DATA,
    SO_FAR,
    UNCONFIRMED,
    UNTOLD,
    UNTRIED,
    in_its_place,
    more_probable,
)
from casadi_engine.discrepancy.wording import (
    AT_FAULT,
    BOUNDS,
    HINT,
    SHARE_OVER,
    STARTS,
    UNRESOLVED,
    USER,
    acting_at,
    as_fitted,
    is_blind,
    is_early,
    is_untold,
    names_own_law,
    twins,
    what_acts,
)
from casadi_engine.distributions import p_words
from casadi_engine.estimation.answer_notes import UNEVEN_LEVEL, UNEVEN_SIZE
from casadi_engine.estimation.summary import count

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import NextExperiment, Repair

# Where the sentence on a law goes on to say how probable it is.
_ODDS = re.compile(r":? (?:far|[0-9.e+]+ times) more probable")
# Probability of a member below which the headline does not speak of it.
_HARDLY = 1e-4
# p-value over all tests from which on chance alone is no likely cause: one search in ten thousand.
_SURELY = 1e-4
# Right in 95 % of records.
ENOUGH = 3.3
# Fixed parameters that are named in one line.
_NAMED = 4
# Effects that were looked for, of which at least one in so many has to be excluded for the model to be relied on.
_FEW = 4


def headline(repair: Repair) -> str:
    """The verdict in a few words, and what fresh data say against it."""
    if repair.verdict is None:
        return f"no answer: {repair.status}"
    blind = is_blind(repair)
    if repair.verdict == "nothing missing":
        if blind:
            return "nothing was found, but no physical effect could be looked for"
        tried = " (of what was tried)" if repair.stopped else ""
        what = "no effect of the library" if may_hide(repair) else "nothing"
        maybe = _by_chance(repair)
        seen = "is sure to be missing" if maybe else "is missing that these data could show"
        said = f"{what} {seen}{tried}{maybe}{_on_fresh(repair)}"
        return said + ("; the residual is coloured, and others may hide in it" if may_hide(repair) else "")
    if repair.verdict == "unnamed":
        if _in_fresh_alone(repair):
            return "something is missing that the data of the search do not show: the fresh data do not fit"
        if repair.unknown is not None and repair.unknown.sentence.startswith(SO_FAR):
            return (
                f"something is missing, and the search ended too early for a name: {repair.unknown.sentence}"
            )
        unseen = blind and not names_own_law(repair)
        why = "no physical effect could be looked for" if unseen else "no effect of the library names it"
        unnamed = _law_alone(repair)
        if repair.stopped and not blind:
            ended = "the search ended before an effect of the library could name it"
            why = "no effect that was tried names it" if unnamed else ended
        noisy = uneven_noise(repair)
        seems = "may be" if noisy or (repair.stopped and _by_a_score_alone(repair)) else "is"
        return f"something {seems} missing, and {why}{unnamed}{_nearest(repair)}{noisy}"
    left = "not held against the fresh data, as the time was up" if FRESH_DATA in repair.not_searched else ""
    sure = {
        True: "confirmed on fresh data",
        False: "not confirmed by fresh data",
        None: left or "unconfirmed",
    }
    likely, several = _more_probable(repair), len(repair.effects) > 1
    rivals = [(one, m) for one in repair.effects for m in one.members[1:] if m.probability > _HARDLY]
    others = [
        f"{m.label} in place of {one.name} at {one.at}" if several else m.label
        for one, m in rivals
        if m.label not in likely
    ]
    doubt = f", or more probably {' or '.join(likely)}" if likely else ""
    if others:
        doubt += f", or {others[0] if len(others) == 1 else f'one of {count(len(others))} others'}"
    if other := other_cause(repair):
        doubt += f", or {other} by as much"
    if any(is_early(one) for one in repair.effects):
        doubt += ", or a memory that the model lacks (no sensor is early)"
    law = in_its_place(repair.unknown, repair.effects)
    first, else_wrong = law_leads(repair), _in_the_way(repair)
    if repair.unknown and not first and (law or repair.unknown.odds is not None):
        doubt += f", or {'rather ' if law else ''}a law that the library lacks"
    elif repair.unknown and not first and not is_of_rounding(repair):
        doubt += _and_more(repair)
    tried = " (of what was tried)" if repair.stopped or "left out" in repair.options else ""
    hidden = "; the residual is coloured, and more may hide in it" if _may_hide_more(repair) else ""
    fresh = f"{sure[repair.confirmed]}{_on_fresh(repair)}{hidden}"
    if first:
        names = " and ".join(f"{one.name} at {one.at}" for one in repair.effects)
        lead = (
            f"something is missing, and a law that the library lacks is far more probable{_law_alone(repair)}"
        )
        return f"{else_wrong}{lead}; the nearest of the library: {names}{tried}{doubt}, {fresh}"
    return f"{else_wrong}{_named(repair)}{tried}{doubt}, {fresh}"


def _in_the_way(repair: Repair) -> str:
    """What may be all that is wrong in place of what is named: beyond a bound, or from other first states, the model
    without effects does as well."""
    what = (
        "a bound" if BOUNDS in repair.options else "a given first state" if STARTS in repair.options else ""
    )
    return f"{what} may be all that is wrong, or " if what else ""


def uneven_noise(repair: Repair) -> str:
    """That white noise of different sizes may be all, where the fit without effects leaves such, and fresh data confirm
    nothing; "" of a residual that is not white, which what is missing makes uneven too."""
    told = repair.null_fit.messages
    if repair.confirmed or any("is not white" in words for words in told):
        return ""
    if not any(UNEVEN_SIZE in words or UNEVEN_LEVEL in words for words in told):
        return ""
    return "; or the noise is not of one size, as the residual is not, which all tests take it to be"


def law_leads(repair: Repair) -> bool:
    """True where a law of no name is far more probable than effects that act elsewhere: these are nearest then, and not
    what it is by another name."""
    unknown = repair.unknown
    if unknown is None or unknown.course is None or not more_probable(unknown):
        return False
    return all(unknown.port not in {one.at, *(m.at for m in one.members)} for one in repair.effects)


def _and_more(repair: Repair) -> str:
    """What is said of what is unexplained beside the effects of an answer."""
    # where an input is not read late off the record, a law holds its delay that is not exact where the input jumps
    read = {f"input_{name}" for name, _ in repair.fit.model.late}
    delay = next((one for one in repair.effects if one.name == "input_delay" and one.at not in read), None)
    if repair.stopped:
        said = ", and more that was not searched to the end"
    elif delay is not None:
        said = f", and more is left, which may be the approximation of the delay where {delay.at[6:]} jumps"
    else:
        said = ", and more that no effect of the library names"
    return said + (", or a law that the library lacks, which was not tried" if laws_were_cut(repair) else "")


def acts_where(repair: Repair) -> str:
    """What acts where the gap is, in words, as "a force at deck"; "" where that is not known, or the answer names what
    acts elsewhere: one direction that explains most is no finding beside it."""
    place = None if repair.where is None else repair.where.location
    if place is None:
        return ""
    named = {member.at for one in repair.effects for member in one.members} | {
        one.at for one in repair.effects
    }
    if repair.unknown is not None and repair.unknown.port is not None:
        named.add(repair.unknown.port)
    ends = {end for at in named for end in _ends(repair, at)}
    return "" if named and place not in named | ends else acting_at(repair.model, place)


def _ends(repair: Repair, at: str) -> tuple[str, ...]:
    """The ports at which what acts at a link or a path does."""
    return next((one.ends for one in repair.model.ports.unlisted if one.name == at), ())


def _may_hide_more(repair: Repair) -> bool:
    """True where what is named leaves coloured noise, and nothing else says that more may be missing."""
    return repair.unknown is None and repair.noise is not None and repair.noise.is_coloured


def _more_probable(repair: Repair) -> list[str]:
    """The most probable members, two at most of each class, where the one that leads, as its fit had ended, is excluded
    by them."""
    found = []
    same = bool(common_delay(repair))  # no data tell a late input from late sensors
    for one in repair.effects:
        if (
            same
            and one.name.startswith("sensor_")
            and one.members[1:2]
            and one.members[1].at.startswith("input_")
        ):
            continue
        if one.members and one.members[0].probability < 1 / FACTOR:
            rest = sorted(one.members[1:], key=lambda member: -member.probability)
            found += [member.label for member in rest[:2] if member.probability >= 1 / FACTOR]
    return found


def _law_alone(repair: Repair) -> str:
    """The law of no name that is far more probable than all else; "" without one."""
    unknown = repair.unknown
    if unknown is None or unknown.course is None or unknown.odds is None or unknown.odds < FACTOR:
        return ""
    doubt = next((f", but {one}" for one in (UNTRIED, FAR_OFF) if one in unknown.sentence), "")
    return f": {re.split(_ODDS, unknown.sentence)[0]}{doubt}"


def _by_chance(repair: Repair) -> str:
    """What may be missing all the same: effects beyond chance on the data of the search that fresh ones neither confirm
    nor refuse."""
    maybe = [
        one for one in repair.withdrawn if one.why_withdrawn == UNCONFIRMED and one.p_value < repair.alpha
    ]
    if not maybe:
        return ""
    one = min(maybe, key=lambda found: found.p_value)
    return (
        f"; {one.name} at {one.at} may be missing ({p_words(one.p_value)}), and fresh data do not confirm it"
    )


def _by_a_score_alone(repair: Repair) -> bool:
    """True where all that speaks for what is missing is tests that chance passes in one of so many searches: no refit
    has told, and no fresh data were asked."""
    unknown = repair.unknown
    tests = {} if unknown is None else unknown.tests
    found = (*repair.withdrawn, *repair.effects)
    return bool(tests) and not found and min(tests.values()) > _SURELY


def _nearest(repair: Repair) -> str:
    """What comes nearest of what was withdrawn, where it closes more than it leaves."""
    near, gaps = repair.nearest, repair.gaps
    sigma = None if repair.noise is None else {name: one for name, (one, _) in repair.noise.sigma.items()}
    closes = 0.0 if near is None or gaps is None else near.closes(gaps, sigma)
    if near is None or closes < HALF:
        return ""
    verb, which = ("is", "closes") if len(near.names) == 1 else ("are", "close")
    return (
        f"; nearest {verb} {' and '.join(near.names)}, which {which} {100 * closes:.0f} % of the squared gap"
    )


def _in_fresh_alone(repair: Repair) -> bool:
    """True if what is missing is seen in the fresh data alone."""
    return repair.unknown is not None and FRESH in repair.unknown.tests


def may_hide(repair: Repair) -> bool:
    """True if what was found to be no effect of the library is taken for coloured noise: it may be another effect."""
    return repair.verdict == "nothing missing" and repair.noise is not None and repair.noise.is_coloured


def _named(repair: Repair) -> str:
    """What is missing, and which stated values are wrong.

    Where a name is of another world, friction at what is no machine, it stands beside what it is.
    """
    missing, maybe, wrong = list[str](), list[str](), list[str]()
    for one in repair.effects:
        unsure = is_untold(one) or is_early(one)
        into = maybe if unsure else missing
        name = f"{one.name} at {one.at}"
        port = repair.model.ports[one.at] if one.at in repair.model.ports.names else None
        if port is not None and port.parameter:
            sentence = one.sentence.replace(" is wrong", " may be wrong") if unsure else one.sentence
            wrong.append(f"{sentence} ({name})")
        elif port is not None and port.slot is not None and not port.is_mechanical:
            into.append(f"{name} ({one.sentence})")
        else:
            into.append(name)
    verb = "is" if len(missing) == 1 else "are"
    parts = [f"{' and '.join(own)} {how} missing" for own, how in ((missing, verb), (maybe, "may be")) if own]
    return " and ".join([*parts, *wrong])


def _on_fresh(repair: Repair) -> str:
    """What the fresh data say against the model that is the answer."""
    after = None if repair.gaps is None else repair.gaps.validation_after
    if after is None:
        return ""
    found = how_far(repair)
    if fresh_misfit(repair) is not None:
        what = "which the repaired model does not fit" if repair.effects else "but fresh data do not fit"
        if is_louder(repair):
            what = "which are noisier" if repair.effects else "but fresh data are noisier"
            found = how_far(repair, within=True)
        elif is_of_rounding(repair):
            what = "which its corners, still rounded, do not follow"
        return f", {what}: {found}"
    if fresh_doubt(repair) is not None:
        lead = ":" if repair.effects and not repair.confirmed else ", but"
        return f"{lead} fresh data agree only within the errors of its parameters: {found}"
    if is_far_beyond(repair):
        return f", but the model does not describe the fresh data, and these records are too short to say why: {found}"
    return ""


def next_step(repair: Repair) -> str:
    """What to do with the answer, for the screen and for the page."""
    if repair.status == AT_FAULT:
        return "look at the data, as said above, and repair again"
    if repair.status == UNRESOLVED:
        return "give the model its laws with sharp=True, or records with more motion, and repair again"
    if BOUNDS in repair.options:
        return "look at the bounds first, as said above, and repair again with wider ones"
    if STARTS in repair.options:
        return "look at the initial states that were given, as said above, and repair again without initial="
    if HINT in repair.options:
        return "look at the data first, as said above"
    if repair.verdict == "unnamed" and uneven_noise(repair):
        return (
            "compare the residual, ce.plot(repair.null_fit), with what the sensor shows: where it grows with that, let "
            "the model and the data give the logarithm, of which the noise is of one size, and repair again"
        )
    if repair.status == "interrupted":
        return "run it again and let it end; repair.fit is the best model so far"
    if repair.verdict is None and (SHARE_OVER in repair.status or repair.status == UNTOLD):
        return "give it more time, budget=..., or start values that are nearer"
    if repair.verdict is None:
        return "fix the baseline fit first: other start values, wider bounds, or more starts"
    if repair.stopped:
        more = "let it end" if repair.stopped == USER else "give it more time, budget=..."
        return (
            f"{more}, or look for less: ce.repair(..., effects=[...]); what was not searched is not excluded"
        )
    if repair.next_experiment is not None:
        return _to_split(repair.next_experiment)
    apart = fresh_misfit(repair) is not None and not is_louder(repair)
    if apart or _in_fresh_alone(repair) or (_more_in_fresh(repair) and not _law_alone(repair)):
        return "look for what is missing in the fresh records: give them as data of the search"
    if repair.verdict == "nothing missing" and (fresh_doubt(repair) is not None or is_far_beyond(repair)):
        return "record more before you use the model, or give the fresh records as data too: its parameters are vague"
    if repair.verdict == "nothing missing":
        if _by_chance(repair):
            return "record more before you rely on it: what may be missing was not told from chance"
        if is_blind(repair):
            return "give the model its ports as said above, and repair again: no physical effect was tested"
        if not any(one.excluded for one in repair.not_found):
            return "record more before you rely on it: these data exclude no effect of any size"
        if _FEW * sum(one.excluded for one in repair.not_found) < len(repair.not_found):
            return "record more before you rely on it: these data exclude hardly any effect"
        if names := as_fitted(repair.fit):
            return f"fix one of {names}, or give it a prior: the sizes hold for their fitted values alone"
        listed = "use the model; larger effects than those listed are excluded"
        return f"{listed}{', others are not' if may_hide(repair) else ''}{_on_fixed(repair)}"
    if repair.verdict == "unnamed":
        return _without_name(repair)
    if law_leads(repair):
        return _without_name(repair)
    if repair.verdict == "class" and any(len(one.members) > 1 for one in repair.effects):
        return _of_class(repair)
    if in_its_place(repair.unknown, repair.effects):
        return _without_name(repair)
    if repair.unknown is not None and repair.unknown.odds is not None:
        return "record other motion, larger or slower, that tells what was found from a law that the library lacks"
    if repair.unknown is not None:
        return "look at the figures of the residuals after the repair: they hold more"
    if repair.confirmed is None:
        return _unconfirmed(repair)
    if repair.confirmed is False:
        return "test it on more fresh data before you use it: those that were given do not confirm it"
    if other_cause(repair):
        said = "decide by what you know of the system which of both is late: no record of this kind tells them apart"
        return f"{said}{_on_fixed(repair)}"
    return f"go on with repair.fit, the repaired model: print(repair.fit){_on_fixed(repair)}"


def _on_fixed(repair: Repair) -> str:
    """That estimates are right where the parameters that are fixed are: a wrong one that others make up for leaves no
    gap."""
    pars = repair.fit.parameters
    fixed = [name for name in pars if not pars[name].vary and pars[name].tie is None and "." not in name]
    more = f" and {len(fixed) - _NAMED} more" if len(fixed) > _NAMED else ""
    gains = [
        one.at.partition("_")[2]
        for one in repair.not_found
        if one.name in ("input_gain", "sensor_gain") and not one.testable
    ]
    counts = [f"what is fixed: {', '.join(fixed[:_NAMED])}{more}"] if fixed else []
    counts += [f"the gain of {' and of '.join(gains)}, which these data cannot determine"] if gains else []
    return f"; its values count on {', and on '.join(counts)}" if counts else ""


def _unconfirmed(repair: Repair) -> str:
    """What to do with an answer that fresh data neither confirm nor refuse."""
    given = given_fresh(repair)
    unjudged = bool(repair.stopped) or any("not judged" in words for words in repair.messages)
    if repair.fresh and unjudged:
        return "give it more time, budget=..., or shorter fresh records: the fresh data have not judged it"
    if given:
        names = ", ".join(given)
        return (
            f"test it on more fresh data: those that were given ({names}) neither confirm nor refuse it, as the notes "
            "say"
        )
    return "test it on data it has not seen: --validate FILE, or ce.repair(..., fresh=other_record)"


def given_fresh(repair: Repair) -> list[str]:
    """Names of the fresh records that the user gave; none where a part of the data was held out."""
    whole = repair.gaps is not None and repair.gaps.source == "records"
    own = set() if whole else {record.name for record in repair.data}
    return [record.name for record in repair.fresh if record.name not in own]


def _more_in_fresh(repair: Repair) -> bool:
    """True where nothing is named and the fresh records show twice as much of the gap, by its root mean square."""
    gaps = repair.gaps
    if repair.verdict != "unnamed" or gaps is None or gaps.validation_after is None:
        return False
    own, fresh = gaps.estimation_after.gap, gaps.validation_after.gap
    return fresh.chi2_per_sample > 4 * max(own.chi2_per_sample, 1.0)


def _to_split(made: NextExperiment) -> str:
    """The experiment that would tell the members of a class apart, or at least help."""
    names: Sequence[str] = made.splits or ("the class",)
    enough = made.expected_separation >= ENOUGH
    words = f"separation {made.expected_separation:.1f}, now {made.separation_now:.1f}; {ENOUGH} is enough"
    if enough:
        return f"to split {', '.join(names)}: {made.change} ({words})"
    return f"{made.change}: of what was tried by simulation it helps most, but does not split the class ({words})"


def _without_name(repair: Repair) -> str:
    if is_blind(repair) and not names_own_law(repair):
        return "give the model its ports as said above, and repair again"
    unknown = repair.unknown
    if unknown is None or unknown.course is None:
        curve = "the residuals and what they ask for at each port"
    else:
        curve = f"the curve of the unknown {what_acts(repair.model, str(unknown.port))[0]}"
    return f"look at {curve}, ce.report(repair, 'repair.html'), and write an effect of your own (ten lines, ce.Effect)"


def _of_class(repair: Repair) -> str:
    """What is left to do where no experiment that was tried splits a class."""
    one = next((e for e in repair.effects if len(e.members) > 1), None)
    if one is None:
        return "record data that tell the members of the class apart"
    lead, others = f"{one.name} at {one.at}", twins(one)
    tried = "no other input or sensor and no longer record that could be tried by simulation tells them apart"
    if any(words.startswith("next experiment: not looked for") for words in repair.messages):
        tried = "which other record tells them apart was not looked for, as the time was up"
    rival = one.members[1]
    # the same effect at two ports is left out by its port alone
    how = f'at="{one.at}"' if rival.name == one.name and not rival.more else f'without=["{rival.name}"]'
    choose = (
        f"decide by what you know of the system, and leave out what it cannot have: ce.repair(..., {how})"
    )
    if others:
        names = [lead, *(f"{m.name} at {m.at}" for m in others)]
        alike = f"{', '.join(names[:-1])} and {names[-1]} are one and the same in data of this kind"
        return f"{alike} (correlation 1 or -1), and {tried}: {choose}"
    return f"{tried}; a record of another kind may, or {choose}"
