"""A repair on one screen: the verdict, the effects found, the gap before and after, and what to do next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from casadi_engine.discrepancy.fresh_misfit import fresh_misfit
from casadi_engine.discrepancy.wording import (
    AT_FAULT,
    LISTED,
    USER,
    acting_at,
    first_words,
    held_out,
    in_unit,
    is_blind,
    si,
    twins,
)
from casadi_engine.estimation.summary import count, number, with_error, wrapped
from casadi_engine.experiment.units import NOT_STATED

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import FoundEffect, NextExperiment, Repair, Side

LINES = 45
# Right in 95 % of records.
ENOUGH = 3.3
# Share of halves from which a score is stable; change of a level that is said.
_OFTEN, _OTHER = 0.5, 0.05
_SHIFTS, _TERMS, _NOTES = 6, 4, 3
# Lines of one equation that are shown.
_LONG = 4


def summary(repair: Repair) -> str:
    """Return a repair as text of at most 45 lines and 100 columns, the next step last."""
    lines = wrapped(f"Repair of {repair.model.name}: {headline(repair)}", "  ")
    lines += [line for words in first_words(repair) for line in wrapped(words, "  ")]
    lines += _tested(repair)
    if repair.verdict is not None:
        lines += [*_found(repair), *_where(repair), *_unknown(repair), *_gap(repair)]
        lines += [*_shifts(repair), *_equation(repair), *_not_found(repair)]
        lines += _not_applicable(repair)
    notes = [line for note in repair.messages[:_NOTES] for line in wrapped(f"Note: {note}", "      ")]
    last = wrapped(f"Next: {next_step(repair)}", "      ")
    kept = lines[: LINES - len(last) - min(len(notes), 6)]
    return "\n".join(line.rstrip()[:100] for line in [*kept, *notes[:6], *last])


def headline(repair: Repair) -> str:
    """The verdict in a few words."""
    if repair.verdict is None:
        return f"no answer: {repair.status}"
    blind = is_blind(repair)
    if repair.verdict == "nothing missing":
        shown = "nothing is missing that these data could show"
        return "nothing was found, but no physical effect could be looked for" if blind else shown
    if repair.verdict == "unnamed":
        why = "no physical effect could be looked for" if blind else "no effect of the library names it"
        return f"something is missing, and {why}"
    names = " and ".join(f"{one.name} at {one.at}" for one in repair.effects)
    sure = {True: "confirmed on fresh data", False: "not confirmed by fresh data", None: "unconfirmed"}
    others = [f"{m.name} at {m.at}" for one in repair.effects for m in one.members[1:]]
    doubt = (
        f", or {others[0] if len(others) == 1 else f'one of {count(len(others))} others'}" if others else ""
    )
    gaps = repair.gaps
    misfit = ""
    if gaps is not None and gaps.validation_after is not None and fresh_misfit(repair) is not None:
        misfit = (
            f", which the repaired model does not fit: chi2/N {gaps.validation_after.gap.chi2_per_sample:.3g}"
        )
    verb = "is" if len(repair.effects) == 1 else "are"
    tried = " (of what was tried)" if repair.stopped else ""
    return f"{names} {verb} missing{tried}{doubt}, {sure[repair.confirmed]}{misfit}"


def _tested(repair: Repair) -> list[str]:
    names = ", ".join(record.name for record in repair.data)
    fresh = ", ".join(record.name for record in repair.fresh)
    within = {record.name for record in repair.data}
    kind = f" ({held_out(repair)} held out)" if within.intersection(r.name for r in repair.fresh) else ""
    lines = [f"  data       {names}; fresh: {fresh or 'none'}{kind if fresh else ''}"]
    if repair.noise is not None:
        units = {out.name: out.unit for out in repair.model.outputs}
        words = [
            f"{name} sigma {sigma:.4g}{si(units.get(name, '1'))} ({'estimated' if free else 'known'})"
            for name, (sigma, free) in repair.noise.sigma.items()
        ]
        words += ["coloured"] if repair.noise.colour else []
        words += [f"{kind} scatters by {100 * tau:.2g} %" for kind, tau in repair.noise.scatter.items()]
        lines += [f"  noise      {'; '.join(words)}"]
    if repair.threshold is not None:
        rate = f"false alarms {100 * repair.alpha:.3g} % over all tests"
        limit = f", |z| > {repair.threshold:.2f}" if repair.candidates else ""
        seconds = repair.timing.get("total", math.nan)
        lines += [f"  tested     {repair.candidates} candidates, {rate}{limit}; {number(seconds, '.2g')} s"]
    return lines


def _found(repair: Repair) -> list[str]:
    lines: list[str] = []
    for title, effects in (
        ("Found", repair.effects),
        ("Withdrawn: contradicted by fresh data", repair.withdrawn),
    ):
        if effects:
            lines += [title]
        for one in effects:
            lines += _effect(one)
    return lines


def _effect(one: FoundEffect) -> list[str]:
    chance = "p < 1e-300" if one.p_value < 1e-300 else f"p = {one.p_value:.2g}"
    share = f"explains {100 * one.share_explained:.0f} % of the gap"
    lines = wrapped(f"  {one.sentence}: z = {one.z:.1f}, {chance}, {share}{_stability(one)}", "    ")
    lines += [
        f"    {name} = {with_error(e.value, e.stderr)}{in_unit(e.unit)}" for name, e in one.parameters.items()
    ]
    lines += [f"    {one.key}.{name} = {value:.6g}" for name, value in one.constants.items()]
    if len(one.members) > 1:
        text = ", ".join(
            f"{m.name} at {m.at} ({100 * m.probability:.0f} %, {m.rho:+.3f})" for m in one.members[1:]
        )
        own = f"{100 * one.members[0].probability:.0f} %"
        words = f"    probability {own}; not excluded in its place (probability, correlation with it): {text}"
        lines += wrapped(words, "      ")
    return lines


def _stability(one: FoundEffect) -> str:
    """How often half of the data would choose it; of a class, whose members share the first place, nothing."""
    if one.selection_frequency is None or len(one.members) > 1:
        return ""
    share = f"{100 * one.selection_frequency:.0f} %"
    if one.selection_frequency < _OFTEN:
        return f"; its score is the best in {share} of random halves of the data only: the refits decided"
    return f", the best score in {share} of random halves of the data"


def _where(repair: Repair) -> list[str]:
    where = repair.where
    if where is None:
        return []
    first, last = where.time
    words = [
        f"record {where.record} "
        + (f"from {first:.4g} to {last:.4g} s" if first < last else f"at {first:.4g} s")
    ]
    words += [] if where.cycles is None else [f"cycles {', '.join(map(str, where.cycles[:8]))}"]
    if where.crank_angle is not None:
        low, high = (math.degrees(a) for a in where.crank_angle)
        words += [f"crank angle {low:.0f} to {high:.0f} deg"]
    words += [] if where.order is None else [f"order {where.order:g}"]
    words += (
        [] if where.location is None else [f"{acting_at(repair.model, where.location)} explains most of it"]
    )
    return wrapped(f"Gap widest in {'; '.join(words)}", "       ")


def _unknown(repair: Repair) -> list[str]:
    if repair.unknown is None:
        return []
    tests = ", ".join(f"{name} p = {p:.2g}" for name, p in list(repair.unknown.tests.items())[:3])
    head = "Still unexplained" if repair.effects else "Unexplained"
    return wrapped(f"{head}: {repair.unknown.sentence}" + (f" ({tests})" if tests else ""), "  ")


def _gap(repair: Repair) -> list[str]:
    gaps = repair.gaps
    if gaps is None:
        return []
    heads = ("sigma", "rmse", "after", "fit %", "after", "chi2/N", "after")
    lines = [f"{'Gap':<12}{'output':<12}" + "".join(f"{head:>10}" for head in heads)]
    lines += _gap_rows("found on", repair, gaps.estimation_before, gaps.estimation_after)
    if gaps.validation_before is not None and gaps.validation_after is not None:
        lines += _gap_rows("fresh", repair, gaps.validation_before, gaps.validation_after)
    lines += wrapped(f"  {noise_of_chi2(repair)}", "    ") if noise_of_chi2(repair) else []
    gain = gaps.gain_per_cycle
    if gain is not None and gain.mean is not None:
        turns = any(variable.name == "theta" for variable in repair.model.inputs)
        part = "cycle" if turns else "piece"
        size = with_error(gain.mean, gain.se)
        lines += [f"  fresh data: 2 ln(likelihood) changes by {size} per {part}, over {gain.cycles} {part}s"]
    return lines


def levels(repair: Repair) -> dict[str, float]:
    """output -> sigma of its noise: the stated one, else that which the search estimated."""
    found = {} if repair.noise is None else {name: sigma for name, (sigma, _) in repair.noise.sigma.items()}
    return found | {name: sigma for name, (sigma, free) in repair.null_fit.noise.items() if not free}


def noise_of_chi2(repair: Repair) -> str:
    """By which noise chi-squared counts, where that is not the sigma beside it."""
    noise = repair.noise
    if noise is None:
        return ""
    units = {out.name: out.unit for out in repair.model.outputs}
    other = {
        name: sigma
        for name, (sigma, _) in noise.sigma.items()
        if abs(sigma / levels(repair)[name] - 1) > _OTHER
    }
    said = [f"{sigma:.4g}{si(units.get(name, '1'))} for {name}" for name, sigma in other.items()]
    what = ["coloured noise as the search estimated it"] if noise.colour else []
    what += [f"sigma {', '.join(said)}, larger than stated"] if said and not noise.colour else []
    what += [f"sigma {', '.join(said)}"] if said and noise.colour else []
    what += ["the scatter of combustion"] if noise.scatter else []
    return f"chi2/N counts by {' and '.join(what)}: judge the gap by rmse beside sigma" if what else ""


def _gap_rows(title: str, repair: Repair, before: Side, after: Side) -> list[str]:
    lines, sigma = [], levels(repair)
    for k, output in enumerate(before.gap.rmse):
        old, new = before.gap, after.gap
        chi2 = f"{old.chi2_per_sample:>10.4g}{new.chi2_per_sample:>10.4g}" if k == 0 else ""
        lines.append(
            f"  {title if k == 0 else '':<10}{output:<12}{number(sigma.get(output), '.4g'):>10}"
            f"{old.rmse[output]:>10.4g}{new.rmse[output]:>10.4g}"
            f"{old.fit_percent[output]:>10.3f}{new.fit_percent[output]:>10.3f}{chi2}"
        )
    return lines


def _shifts(repair: Repair) -> list[str]:
    if not repair.effects:
        return []
    units = {name: e.unit for name, e in repair.fit.estimates.items()}
    predicted: dict[str, float] = {}
    for one in repair.effects:
        for name, value in one.predicted_shift.items():
            predicted[name] = predicted.get(name, 0.0) + value
    names = [n for n in predicted if n in repair.fit.estimates and n in repair.null_fit.estimates]
    size = {n: abs(predicted[n]) / max(repair.null_fit.stderr.get(n) or math.inf, 1e-300) for n in names}
    lines = [f"{'Parameters':<20}{'without':>22}{'with':>22}{'predicted shift':>18}"]
    for name in sorted(names, key=lambda n: -size[n])[:_SHIFTS]:
        old, new = repair.null_fit.estimates[name], repair.fit.estimates[name]
        lines.append(
            f"  {name:<18} {with_error(old.value, old.stderr):>21} {with_error(new.value, new.stderr):>21}"
            f"{predicted[name]:>+18.3g}{si(units[name])}"
        )
    return lines


def _equation(repair: Repair) -> list[str]:
    if repair.equation is None:
        return []
    lines = ["Equation"]
    for term in repair.equation.terms[:_TERMS]:
        shown = wrapped(f"  {term.strip()}", "      ")
        lines += shown[:_LONG] + (["      ..."] if len(shown) > _LONG else [])
    return lines


def _not_found(repair: Repair) -> list[str]:
    testable = [one for one in repair.not_found if one.testable]
    rest = len(repair.not_found) - len(testable)
    shown = testable[:LISTED]
    parts = [f"{one.name} at {one.at} {one.smallest_detectable:.2g}{si(one.unit)}" for one in shown]
    parts += [f"and {count(len(testable) - LISTED)} more"] if len(testable) > LISTED else []
    parts += [f"{rest} not testable with these data"] if rest else []
    vague = " (some in units that were not stated)" if any(one.unit == NOT_STATED for one in shown) else ""
    words = f"Smallest detectable sizes (95 % power){vague}: {'; '.join(parts)}"
    return wrapped(words, "  ") if parts else []


def _not_applicable(repair: Repair) -> list[str]:
    """Effects that a port lacks signals for; those that have no port of their kind are counted."""
    at_ports = [one for one in repair.not_applicable if one.at]
    rest = len(repair.not_applicable) - len(at_ports)
    parts = [str(one) for one in at_ports[:LISTED]]
    parts += [f"{count(len(at_ports) - LISTED)} more at other ports"] if len(at_ports) > LISTED else []
    parts += [f"{count(rest)} without a port of the right kind"] if rest else []
    return wrapped(f"Not applicable: {'; '.join(parts)}", "  ") if at_ports else []


def next_step(repair: Repair) -> str:
    """What to do with the answer, for the screen and for the page."""
    if repair.status == "interrupted":
        return "run it again and let it end; repair.fit is the best model so far"
    if repair.status == AT_FAULT:
        return "look at the data, as said above, and repair again"
    if repair.verdict is None:
        return "fix the baseline fit first: other start values, wider bounds, or more starts"
    if repair.stopped:
        more = "let it end" if repair.stopped == USER else "give it more time, budget=..."
        return (
            f"{more}, or look for less: ce.repair(..., effects=[...]); what was not searched is not excluded"
        )
    if repair.next_experiment is not None:
        return _to_split(repair.next_experiment)
    if fresh_misfit(repair) is not None:
        return "look for what is missing in the fresh records: give them as data of the search"
    if repair.verdict == "nothing missing":
        if is_blind(repair):
            return "give the model its ports as said above, and repair again: no physical effect was tested"
        return "use the model; larger effects than those listed are excluded"
    if repair.verdict == "unnamed":
        return _without_name(repair)
    if repair.verdict == "class":
        return _of_class(repair)
    if repair.unknown is not None:
        return "look at the figures of the residuals after the repair: they hold more"
    if repair.confirmed is None:
        return "test it on data it has not seen: --validate FILE, or ce.repair(..., fresh=other_record)"
    if repair.confirmed is False:
        return "test it on more fresh data before you use it: those that were given do not confirm it"
    return "go on with repair.fit, the repaired model: print(repair.fit)"


def _to_split(made: NextExperiment) -> str:
    """The experiment that would tell the members of a class apart, or at least help."""
    names: Sequence[str] = made.splits or ("the class",)
    enough = made.expected_separation >= ENOUGH
    words = f"separation {made.expected_separation:.1f}, now {made.separation_now:.1f}; {ENOUGH} is enough"
    if enough:
        return f"to split {', '.join(names)}: {made.change} ({words})"
    return f"{made.change}: of what was tried by simulation it helps most, but does not split the class ({words})"


def _without_name(repair: Repair) -> str:
    if is_blind(repair):
        return "give the model its ports as said above, and repair again"
    unknown = repair.unknown
    if unknown is None or unknown.course is None:
        curve = "the residuals and what they ask for at each port"
    else:
        known = unknown.port is not None and unknown.port in repair.model.ports.names
        curve = f"the curve of the unknown {repair.model.ports[str(unknown.port)].quantity if known else 'torque'}"
    return f"look at {curve}, ce.report(repair, 'repair.html'), and write an effect of your own (ten lines, ce.Effect)"


def _of_class(repair: Repair) -> str:
    """What is left to do where no experiment that was tried splits a class."""
    one = next((e for e in repair.effects if len(e.members) > 1), None)
    if one is None:
        return "record data that tell the members of the class apart"
    lead, others = f"{one.name} at {one.at}", twins(one)
    tried = "no other input or sensor and no longer record that could be tried by simulation tells them apart"
    choose = f'decide by what you know of the system: ce.repair(..., without=["{one.members[1].name}"])'
    if others:
        names = [lead, *(f"{m.name} at {m.at}" for m in others)]
        alike = f"{', '.join(names[:-1])} and {names[-1]} are one and the same in data of this kind"
        return f"{alike} (correlation 1 or -1), and {tried}: {choose}"
    return f"{tried}; a record of another kind may, or {choose}"
