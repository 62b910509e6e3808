"""A repair on one screen: the verdict, the effects found, the gap before and after, and what to do next."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from casadi_engine.discrepancy.assumed_pressure import is_carried
from casadi_engine.discrepancy.clocks import clock_of
from casadi_engine.discrepancy.one_screen import Lines, fitted, in_columns, listed, shortened
from casadi_engine.discrepancy.repaired import UNTRIED, more_probable
from casadi_engine.discrepancy.verdict_words import acts_where, headline, next_step
from casadi_engine.discrepancy.wording import (
    LISTED,
    acts_as,
    as_fitted,
    first_words,
    held_out,
    in_unit,
    of_either_sign,
    right_value,
    si,
    told,
    why_leads,
)
from casadi_engine.distributions import p_words
from casadi_engine.estimation.fit import Estimate
from casadi_engine.estimation.summary import count, number, short, with_error, wrapped
from casadi_engine.experiment.units import NOT_STATED

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import FoundEffect, NotFound, Repair, Side

LINES = 45
# Chi-squared per sample in coloured noise below which it says nothing; change of a level that is said.
_NO_CHI2 = 0.5
# A p-value, or a share of the gap, of an effect that does nothing by itself; probability of a lead that is not said.
_NONE, _HARDLY = 0.05, 0.01
_OTHER = 0.05
_SHIFTS, _TERMS, _NOTES = 6, 4, 3
# Lines of one equation that are shown; effects named of which nothing is excluded; columns of a parameter's and of an
# output's name.
_LONG, _NAMED, _WIDE, _OUTPUT = 4, 3, 20, 18
# Width of the first column of chi-squared where that is of all outputs.
_CHI2 = 12
# What gives way on a full screen, in this order: parts, and how many of their shorter forms are left to be told later.
_GIVES_WAY = (
    ("not applicable", 0), ("notes", 2), ("not found", 0), ("equation", 2), ("shifts", 2), ("found", 1), ("notes", 1),
    ("equation", 0), ("shifts", 0), ("tested", 0), ("gap", 0), ("found", 0), ("notes", 0),
)  # fmt: skip


def summary(repair: Repair) -> str:
    """Return a repair as text of at most 45 lines and 100 columns, the next step last.

    Where it is more, whole items are left out and counted; what no shorter form says less of stays, line by line.
    """
    head = wrapped(f"Repair of {repair.model.name}: {headline(repair)}", "  ")
    head += [line for words in first_words(repair) for line in wrapped(words, "  ")]
    parts = {"head": [head], "tested": _tested(repair)}
    if repair.verdict is not None:
        parts |= {
            "found": _found(repair), "where": [[*_where(repair), *_unknown(repair)]], "gap": _gap(repair),
            "shifts": _shifts(repair), "equation": _equation(repair), "not found": _not_found(repair),
            "not applicable": _not_applicable(repair),
        }  # fmt: skip
    parts["notes"] = _notes(repair)
    parts["next"] = [wrapped(f"Next: {next_step(repair)}", "      ")]
    parts = {name: [in_columns(form) for form in forms] for name, forms in parts.items()}
    order = [(name, left) for name, left in _GIVES_WAY if name in parts]
    return "\n".join(fitted(parts, order, LINES))


def _notes(repair: Repair) -> list[Lines]:
    """What the user should know, the first notes first."""

    def form(most: int) -> Lines:
        rest = len(repair.messages) - most
        more = [f"Note: {count(rest)} more in repair.messages"] if rest > 0 else []
        return [line for n in repair.messages[:most] for line in wrapped(f"Note: {n}", "      ")] + more

    return [form(k) for k in range(min(len(repair.messages), _NOTES), -1, -1)]


def _tested(repair: Repair) -> list[Lines]:
    """Data, noise and number of tests; fewer of many outputs."""
    noise = [] if repair.noise is None else _noise(repair)
    return shortened(lambda most: _tested_lines(repair, listed(noise, most)), len(noise), 6, 3, 1)


def _tested_lines(repair: Repair, noise: list[str]) -> Lines:
    names = ", ".join(record.name for record in repair.data)
    fresh = ", ".join(record.name for record in repair.fresh)
    within = {record.name for record in repair.data}
    own = within.intersection(record.name for record in repair.fresh)
    given = repair.gaps is not None and repair.gaps.source == "records"  # a later cut of the same record
    kind = f" ({held_out(repair)} held out)" if own and not given else ""
    lines = [f"  data       {names}; fresh: {fresh or 'none'}{kind if fresh else ''}"]
    lines += wrapped(f"  noise      {'; '.join(noise)}", "             ") if noise else []
    if repair.threshold is not None:
        rate = f"false alarms {100 * repair.alpha:.3g} % over all tests"
        limit = f", |z| > {repair.threshold:.2f}" if repair.candidates else ""
        seconds = repair.timing.get("total", math.nan)
        lines += [f"  tested     {repair.candidates} candidates, {rate}{limit}; {_seconds(seconds)} s"]
    return lines


def _seconds(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else number(value, ".2g")


def _noise(repair: Repair) -> list[str]:
    """The noise of each output: what was stated, and what counts where that is something else."""
    assert repair.noise is not None
    units = {out.name: si(out.unit) for out in repair.model.outputs}
    stated = {name: sigma for name, (sigma, free) in repair.null_fit.noise.items() if not free}
    coloured = {key.rpartition("/")[2] for key in repair.noise.colour}
    colour, words = "coloured" if repair.noise.is_coloured else "perhaps coloured", []
    for name, (sigma, free) in repair.noise.sigma.items():
        unit = units.get(name, "")
        own = [f"sigma {stated[name]:.4g}{unit} (stated)"] if name in stated else []
        if name in coloured:
            own.append(f"{colour}, with innovations of sigma {sigma:.4g}{unit}")
        elif free or not own:
            own.append(f"sigma {sigma:.4g}{unit} (estimated)")
        words.append(f"{name} {', '.join(own)}")
    return words + [f"{kind} scatters by {100 * tau:.2g} %" for kind, tau in repair.noise.scatter.items()]


def _found(repair: Repair) -> list[Lines]:
    """Effects found and withdrawn; fewer members of large classes."""
    classes = [len(one.members) - 1 for one in (*repair.effects, *repair.withdrawn)]
    return shortened(lambda most: _found_lines(repair, most), max(classes, default=0), 6, 3, 1)


def _found_lines(repair: Repair, most: int) -> Lines:
    lines: list[str] = []
    gone = dict.fromkeys(one.why_withdrawn for one in repair.withdrawn)
    titles = {f"Withdrawn: {why}": [e for e in repair.withdrawn if e.why_withdrawn == why] for why in gone}
    for title, effects in {"Found": repair.effects, **titles}.items():
        if effects:
            lines += [title]
        for one in effects:
            lines += _effect(one, repair, most)
    return lines


def _told_by(one: FoundEffect, *, nearest: bool = False) -> str:
    """How surely an effect is there: by its score beside the model without it, and by the share of the gap that closes
    with it. A score that says nothing of a large share is that of a law which bends the other way by one step.

    nearest : what it closes was said of all that come nearest, by another measure
    """
    chance = p_words(one.p_value)
    share = f"explains {100 * one.share_explained:.0f} % of the gap"
    if one.share_explained < 0.005:  # it rounds to 0 %
        share = "closes nothing of the gap by itself"
    if one.p_value > _NONE and one.share_explained < _NONE:
        return "beyond chance beside the others, and nothing without them"
    if one.p_value > _NONE:
        return f"{share}, by a refit: one step along the model without it shows nothing of that"
    return f"z = {one.z:.1f}, {chance}" if nearest else f"z = {one.z:.1f}, {chance}, {share}"


def _effect(one: FoundEffect, repair: Repair, most: int) -> Lines:
    near = () if repair.effects or repair.nearest is None else repair.nearest.names
    told_by = _told_by(one, nearest=f"{one.name} at {one.at}" in near)
    lines = wrapped(f"  {one.sentence}: {told_by}", "    ")
    for k, (name, found) in enumerate(one.parameters.items()):
        e, more = clock_of(repair.model).told(found, always=k > 0)
        more += of_either_sign(found) if k == 0 else ""
        lines.append(f"    {name} = {told(e, in_unit(e.unit))}{more}{acts_as(one, name, repair.model)}")
    changed = right_value(one, repair)
    lines += wrapped(f"    {changed}", "      ") if changed else []
    lines += [f"    {one.key}.{name} = {value:.6g} (held)" for name, value in one.constants.items()]
    if len(one.members) > 1:
        others = [f"{m.label} ({_percent(m.probability)}, {m.rho:+.3f})" for m in one.members[1:]]
        text = ", ".join(listed(others, most))
        own = one.members[0].probability
        which = (
            f"probability {_percent(own)}; not excluded in its place"
            if own >= _HARDLY
            else "more probable by their evidence"
        )
        words = f"    {which} (probability, correlation with it): {text}"
        lines += wrapped(f"{words}; {why_leads(one)}" if why_leads(one) else words, "      ")
    return lines


def _percent(share: float) -> str:
    """A probability beside others, which is neither 0 nor 1.

    >>> _percent(0.55), _percent(0.9992), _percent(0.0008)
    ('55 %', 'above 99 %', 'below 1 %')
    """
    if 0.005 <= share < 0.995:
        return f"{100 * share:.0f} %"
    return "above 99 %" if share > 0.5 else "below 1 %"


def _where(repair: Repair) -> list[str]:
    where = repair.where
    if where is None:
        return []
    words = [f"record {where.record} {clock_of(repair.model).span(*where.time)}"]
    words += [] if where.cycles is None else [f"cycles {', '.join(map(str, where.cycles[:8]))}"]
    if where.crank_angle is not None:
        low, high = (math.degrees(a) for a in where.crank_angle)
        words += [f"crank angle {low:.0f} to {high:.0f} deg"]
    words += [] if where.order is None else [f"order {where.order:g}"]
    acts = acts_where(repair)
    words += [f"{acts} explains most of it"] if acts else []
    return wrapped(f"Gap widest in {'; '.join(words)}", "       ")


def _unknown(repair: Repair) -> list[str]:
    if repair.unknown is None:
        return []
    tests = ", ".join(f"{name} {p_words(p)}" for name, p in list(repair.unknown.tests.items())[:3])
    head = "Still unexplained" if repair.effects else "Unexplained"
    if repair.effects and repair.unknown.odds is not None:
        head = "More probable in its place" if more_probable(repair.unknown) else "Not excluded"
    head += ", at first sight" if UNTRIED in repair.unknown.sentence else ""
    return wrapped(f"{head}: {repair.unknown.sentence}" + (f" ({tests})" if tests else ""), "  ")


def _gap(repair: Repair) -> list[Lines]:
    """The gap before and after; of many outputs the first ones."""
    outputs = 0 if repair.gaps is None else len(repair.gaps.estimation_before.gap.rmse)
    return shortened(lambda most: _gap_lines(repair, most), outputs, 6, 3, 1) if outputs else []


def _gap_lines(repair: Repair, most: int) -> Lines:
    gaps = repair.gaps
    assert gaps is not None
    # chi-squared is of all outputs, in the row of the first one
    several = len(gaps.estimation_before.gap.rmse) > 1
    heads = ("sigma", "rmse", "after", "fit %", "after", "chi2/N all" if several else "chi2/N", "after")
    room = _OUTPUT - 1 - (_CHI2 - 10) * several
    width = min(max([11, *(len(name) for name in gaps.estimation_before.gap.rmse)]), room) + 1
    lines = [
        f"{'Gap':<12}{'output':<{width}}"
        + "".join(f"{head:>{_CHI2 if 'all' in head else 10}}" for head in heads)
    ]
    lines += _gap_rows("found on", repair, gaps.estimation_before, gaps.estimation_after, most, width)
    if gaps.validation_before is not None and gaps.validation_after is not None:
        lines += _gap_rows("fresh", repair, gaps.validation_before, gaps.validation_after, most, width)
    rest = len(gaps.estimation_before.gap.rmse) - most
    lines += [f"  and {count(rest)} more outputs in repair.gaps"] if rest > 0 else []
    lines += wrapped(f"  {noise_of_chi2(repair)}", "    ") if noise_of_chi2(repair) else []
    lines += _nearest(repair, most)
    gain = gaps.gain_per_cycle
    if gain is not None and gain.mean is not None:
        turns = any(variable.name == "theta" for variable in repair.model.inputs)
        part = "cycle" if turns else "piece"
        size = with_error(gain.mean, gain.se)
        # beside a gap that is that of the model as it was given
        gone = "" if repair.effects else " with what was withdrawn"
        changes = f"2 ln(likelihood) changes by {size} per {part}{gone}, over {gain.cycles} {part}s"
        lines += [f"  fresh data: {changes}"]
    return lines


def _nearest(repair: Repair, most: int) -> list[str]:
    """The gap with what was withdrawn, of the first outputs."""
    near, gaps = repair.nearest, repair.gaps
    if near is None or gaps is None or repair.effects:
        return []
    sides = [("", gaps.estimation_before.gap, near.estimation)]
    if gaps.validation_before is not None and near.validation is not None:
        sides.append(("fresh: ", gaps.validation_before.gap, near.validation))
    told = [
        f"{title}{', '.join(f'{o} {old.rmse[o]:.4g} -> {new.rmse[o]:.4g}' for o in list(old.rmse)[:most])}"
        for title, old, new in sides
    ]
    words = f"rmse with {' and '.join(near.names)}: {'; '.join(told)} (repair.nearest)"
    return wrapped(f"  {words}", "    ")


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


def chi2_words(value: float, repair: Repair) -> str:
    """Chi-squared per sample; "-" where it is far less than 1 by coloured noise, which is then that of another gap."""
    coloured = repair.noise is not None and bool(repair.noise.colour)
    return "-" if coloured and value < _NO_CHI2 else f"{value:.4g}"


def _gap_rows(title: str, repair: Repair, before: Side, after: Side, most: int, width: int) -> Lines:
    lines, sigma = [], levels(repair)
    for k, output in enumerate(list(before.gap.rmse)[:most]):
        old, new = before.gap, after.gap
        first = _CHI2 if len(old.rmse) > 1 else 10
        both = "".join(
            f"{chi2_words(one.chi2_per_sample, repair):>{wide}}" for one, wide in ((old, first), (new, 10))
        )
        chi2 = both if k == 0 else ""
        lines.append(
            f"  {title if k == 0 else '':<10}{short(output, width - 1):<{width}}{number(sigma.get(output), '.4g'):>10}"
            f"{old.rmse[output]:>10.4g}{new.rmse[output]:>10.4g}"
            f"{old.fit_percent[output]:>10.3f}{new.fit_percent[output]:>10.3f}{chi2}"
        )
    return lines


def _shifts(repair: Repair) -> list[Lines]:
    """Parameters without the effects and with them, those that moved most first."""
    if not repair.effects:
        return []
    old, new = repair.null_fit, repair.fit
    names = [name for name in old.free if name in new.estimates and not is_carried(name)]
    size = {n: abs(new.values[n] - old.values[n]) / max(old.stderr.get(n) or math.inf, 1e-300) for n in names}
    lines = [f"{'Parameters':<{_WIDE}}{'without':>22}{'with':>22}"]
    for name in sorted(names, key=lambda n: -size[n]):
        before, after = old.estimates[name], new.estimates[name]
        lines.append(f"  {name:<{_WIDE - 2}} {told(before):>21} {told(after):>21}{si(after.unit)}")

    def form(most: int) -> Lines:
        rest = f"{count(len(names) - most)} more: print(repair.fit)" if len(names) > most else ""
        if most == 0:  # a head alone says nothing
            return [f"Parameters: {count(len(names))}, in print(repair.fit)"]
        return lines[: most + 1] + ([f"  and {rest}"] if rest else [])

    return [form(k) for k in range(min(len(names), _SHIFTS), -1, -1)] if names else []


def _equation(repair: Repair) -> list[Lines]:
    """Equations that the repair changed, each whole or by its name alone."""
    if repair.equation is None:
        return []
    shown = [wrapped(f"  {term.strip()}", "      ") for term in repair.equation.terms]
    shown = [
        lines
        if len(lines) <= _LONG
        else [f"  {lines[0].strip().partition(' = ')[0]} = (long: print(repair.equation.text))"]
        for lines in shown
    ]

    # equations run in seconds, whatever the unit of time in which values are told
    head = "Equation" if clock_of(repair.model).unit == "s" else "Equation, all times in s"

    def form(most: int) -> Lines:
        rest = len(shown) - most
        if most == 0:
            return ["Equation: print(repair.equation.text)"]
        more = [f"  and {count(rest)} more: print(repair.equation.text)"] if rest > 0 else []
        return [head, *(line for lines in shown[:most] for line in lines), *more]

    return [form(k) for k in range(min(len(shown), _TERMS), -1, -1)] if shown else []


def _not_found(repair: Repair) -> list[Lines]:
    """Sizes that would have been found; what these data say little of stands behind, in words. None along a model that
    lacks what was not named."""
    if repair.verdict == "unnamed" or repair.unknown is not None or not repair.not_found:
        return []
    told = [one for one in repair.not_found if one.excluded and not one.twin]
    forms = shortened(lambda most: _sizes(repair, told, most), min(len(told), LISTED), 3, 1)
    return [
        *forms,
        [f"Smallest detectable sizes (95 % power): {count(len(repair.not_found))} in repair.not_found"],
    ]


def _sizes(repair: Repair, told: list[NotFound], most: int) -> Lines:
    alike = [one for one in repair.not_found if one.excluded and one.twin]
    beyond = [one for one in repair.not_found if one.testable and not one.excluded]
    rest = [one for one in repair.not_found if not one.testable]
    sizes = [Estimate(one.smallest_detectable, None, one.unit) for one in told]
    sizes = [clock_of(repair.model).told(size, always=False)[0] for size in sizes]
    parts = [
        f"{one.name} at {one.at} {'a share of ' * (e.unit == '1')}{e.value:.2g}{si(e.unit)}"
        for one, e in zip(told, sizes, strict=True)
    ]
    parts = listed(parts, most)
    parts += [_not_told_apart(alike)] if alike else []
    parts += [f"no plausible size is excluded of {_listed(beyond)}"] if beyond else []
    parts += [f"not testable with these data: {_listed(rest)}"] if rest else []
    vague = (
        " (some in units that were not stated)" if any(one.unit == NOT_STATED for one in told[:most]) else ""
    )
    if told and (names := as_fitted(repair.fit)):
        vague += f" with {names} as fitted"
    return wrapped(f"Smallest detectable sizes (95 % power){vague}: {'; '.join(parts)}", "  ")


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


def _not_applicable(repair: Repair) -> list[Lines]:
    """Effects that a port lacks signals for; those that have no port of their kind are counted."""
    at_ports = [one for one in repair.not_applicable if one.at]
    rest = len(repair.not_applicable) - len(at_ports)

    def form(most: int) -> Lines:
        parts = listed([str(one) for one in at_ports], most, "more at other ports")
        parts += [f"{count(rest)} without a port of the right kind"] if rest else []
        return wrapped(f"Not applicable: {'; '.join(parts)}", "  ")

    last = [f"Not applicable: {count(len(repair.not_applicable))} in repair.not_applicable"]
    return [*shortened(form, min(len(at_ports), LISTED), 3, 1), last] if at_ports else []
