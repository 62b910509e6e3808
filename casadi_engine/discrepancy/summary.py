"""A repair on one screen: the verdict, the effects found, the gap before and after, and what to do next."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from casadi_engine.discrepancy.assumed_pressure import is_carried
from casadi_engine.discrepancy.repaired import more_probable
from casadi_engine.discrepancy.verdict_words import headline, next_step, why_withdrawn
from casadi_engine.discrepancy.wording import (
    LISTED,
    acting_at,
    acts_as,
    clock,
    first_words,
    held_out,
    in_unit,
    right_value,
    si,
    told,
)
from casadi_engine.estimation.summary import count, number, with_error, wrapped
from casadi_engine.experiment.units import NOT_STATED

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import FoundEffect, NotFound, Repair, Side

LINES = 45
# Change of a level that is said.
_OTHER = 0.05
_SHIFTS, _TERMS, _NOTES = 6, 4, 3
# Lines of one equation that are shown; effects named of which nothing is excluded.
_LONG, _NAMED = 4, 3


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


def _tested(repair: Repair) -> list[str]:
    names = ", ".join(record.name for record in repair.data)
    fresh = ", ".join(record.name for record in repair.fresh)
    within = {record.name for record in repair.data}
    kind = f" ({held_out(repair)} held out)" if within.intersection(r.name for r in repair.fresh) else ""
    lines = [f"  data       {names}; fresh: {fresh or 'none'}{kind if fresh else ''}"]
    if repair.noise is not None:
        lines += wrapped(f"  noise      {'; '.join(_noise(repair))}", "             ")
    if repair.threshold is not None:
        rate = f"false alarms {100 * repair.alpha:.3g} % over all tests"
        limit = f", |z| > {repair.threshold:.2f}" if repair.candidates else ""
        seconds = repair.timing.get("total", math.nan)
        lines += [f"  tested     {repair.candidates} candidates, {rate}{limit}; {number(seconds, '.2g')} s"]
    return lines


def _noise(repair: Repair) -> list[str]:
    """The noise of each output: what was stated, and what counts where that is something else."""
    assert repair.noise is not None
    units = {out.name: si(out.unit) for out in repair.model.outputs}
    stated = {name: sigma for name, (sigma, free) in repair.null_fit.noise.items() if not free}
    coloured = {key.rpartition("/")[2] for key in repair.noise.colour}
    words = []
    for name, (sigma, free) in repair.noise.sigma.items():
        unit = units.get(name, "")
        own = [f"sigma {stated[name]:.4g}{unit} (stated)"] if name in stated else []
        if name in coloured:
            own.append(f"coloured, with innovations of sigma {sigma:.4g}{unit}")
        elif free or not own:
            own.append(f"sigma {sigma:.4g}{unit} (estimated)")
        words.append(f"{name} {', '.join(own)}")
    return words + [f"{kind} scatters by {100 * tau:.2g} %" for kind, tau in repair.noise.scatter.items()]


def _found(repair: Repair) -> list[str]:
    lines: list[str] = []
    for title, effects in (
        ("Found", repair.effects),
        (f"Withdrawn: {why_withdrawn(repair)}", repair.withdrawn),
    ):
        if effects:
            lines += [title]
        for one in effects:
            lines += _effect(one, repair)
    return lines


def _effect(one: FoundEffect, repair: Repair) -> list[str]:
    chance = "p < 1e-300" if one.p_value < 1e-300 else f"p = {one.p_value:.2g}"
    share = f"explains {100 * one.share_explained:.0f} % of the gap"
    lines = wrapped(f"  {one.sentence}: z = {one.z:.1f}, {chance}, {share}", "    ")
    lines += [
        f"    {name} = {told(e, in_unit(e.unit))}{acts_as(one, name, repair.model)}"
        for name, e in one.parameters.items()
    ]
    changed = right_value(one, repair)
    lines += [f"    {changed}"] if changed else []
    lines += [f"    {one.key}.{name} = {value:.6g} (held)" for name, value in one.constants.items()]
    if len(one.members) > 1:
        text = ", ".join(f"{m.label} ({100 * m.probability:.0f} %, {m.rho:+.3f})" for m in one.members[1:])
        own = f"{100 * one.members[0].probability:.0f} %"
        words = f"    probability {own}; not excluded in its place (probability, correlation with it): {text}"
        lines += wrapped(words, "      ")
    return lines


def _where(repair: Repair) -> list[str]:
    where = repair.where
    if where is None:
        return []
    words = [f"record {where.record} {clock(repair.model, *where.time)}"]
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
    if repair.effects and repair.unknown.odds is not None:
        head = "More probable in its place" if more_probable(repair.unknown) else "Not excluded"
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
    old, new = repair.null_fit, repair.fit
    names = [name for name in old.free if name in new.estimates and not is_carried(name)]
    size = {n: abs(new.values[n] - old.values[n]) / max(old.stderr.get(n) or math.inf, 1e-300) for n in names}
    lines = [f"{'Parameters':<20}{'without':>22}{'with':>22}"]
    for name in sorted(names, key=lambda n: -size[n])[:_SHIFTS]:
        before, after = old.estimates[name], new.estimates[name]
        lines.append(f"  {name:<18} {told(before):>21} {told(after):>21}{si(after.unit)}")
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
    """Sizes that would have been found; what these data say little of stands behind, in words. None along a model that
    lacks what was not named."""
    if repair.verdict == "unnamed":
        return []
    told = [one for one in repair.not_found if one.excluded and not one.twin]
    alike = [one for one in repair.not_found if one.excluded and one.twin]
    beyond = [one for one in repair.not_found if one.testable and not one.excluded]
    rest = sum(not one.testable for one in repair.not_found)
    shown = told[:LISTED]
    parts = [f"{one.name} at {one.at} {one.smallest_detectable:.2g}{si(one.unit)}" for one in shown]
    parts += [f"and {count(len(told) - LISTED)} more"] if len(told) > LISTED else []
    parts += [_not_told_apart(alike)] if alike else []
    parts += [f"no plausible size is excluded of {_listed(beyond)}"] if beyond else []
    parts += [f"{rest} not testable with these data"] if rest else []
    vague = " (some in units that were not stated)" if any(one.unit == NOT_STATED for one in shown) else ""
    words = f"Smallest detectable sizes (95 % power){vague}: {'; '.join(parts)}"
    return wrapped(words, "  ") if parts else []


def _not_told_apart(alike: list[NotFound]) -> str:
    """Effects that do the same in these data, in words and not by a size of each."""
    first = alike[0]
    size = f"{first.smallest_detectable:.2g}{si(first.unit)}"
    more = f", and {count(len(alike) - 1)} more that have such a rival" if len(alike) > 1 else ""
    return f"{first.name} at {first.at} not told from {first.twin} (one of the two from {size}){more}"


def _listed(some: list[NotFound]) -> str:
    names = [f"{one.name} at {one.at}" for one in some[:_NAMED]]
    more = [f"{count(len(some) - _NAMED)} more"] if len(some) > _NAMED else []
    return " and ".join(", ".join([*names, *more]).rsplit(", ", 1))


def _not_applicable(repair: Repair) -> list[str]:
    """Effects that a port lacks signals for; those that have no port of their kind are counted."""
    at_ports = [one for one in repair.not_applicable if one.at]
    rest = len(repair.not_applicable) - len(at_ports)
    parts = [str(one) for one in at_ports[:LISTED]]
    parts += [f"{count(len(at_ports) - LISTED)} more at other ports"] if len(at_ports) > LISTED else []
    parts += [f"{count(rest)} without a port of the right kind"] if rest else []
    return wrapped(f"Not applicable: {'; '.join(parts)}", "  ") if at_ports else []
