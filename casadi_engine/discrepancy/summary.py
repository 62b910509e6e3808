"""A repair on one screen: the verdict, the effects found, the gap before and after, and what to do next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from casadi_engine.discrepancy.fresh_misfit import fresh_misfit
from casadi_engine.estimation.summary import count, number, with_error, wrapped

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import FoundEffect, Repair, Side

LINES = 45
_SHIFTS, _MISSED, _TERMS, _NOTES = 6, 6, 4, 3


def summary(repair: Repair) -> str:
    """Return a repair as text of at most 45 lines and 100 columns, the next step last."""
    lines = [*wrapped(f"Repair of {repair.model.name}: {headline(repair)}", "  "), *_tested(repair)]
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
    if repair.verdict == "nothing missing":
        return "nothing is missing that these data could show"
    if repair.verdict == "unnamed":
        return "something is missing, and no effect of the library names it"
    names = " and ".join(f"{one.name} at {one.at}" for one in repair.effects)
    sure = {True: "confirmed on fresh data", False: "not confirmed by fresh data", None: "unconfirmed"}
    doubt = " (or what its class holds)" if repair.verdict == "class" else ""
    gaps = repair.gaps
    misfit = ""
    if gaps is not None and gaps.validation_after is not None and fresh_misfit(repair) is not None:
        misfit = (
            f", which the repaired model does not fit: chi2/N {gaps.validation_after.gap.chi2_per_sample:.3g}"
        )
    verb = "is" if len(repair.effects) == 1 else "are"
    return f"{names} {verb} missing{doubt}, {sure[repair.confirmed]}{misfit}"


def _tested(repair: Repair) -> list[str]:
    names = ", ".join(record.name for record in repair.data)
    fresh = ", ".join(record.name for record in repair.fresh)
    kind = " (cycles held out)" if repair.gaps is not None and repair.gaps.source == "cycles" else ""
    lines = [f"  data       {names}; fresh: {fresh or 'none'}{kind if fresh else ''}"]
    if repair.noise is not None:
        units = {out.name: out.unit for out in repair.model.outputs}
        words = [
            f"{name} sigma {sigma:.4g} {units.get(name, '')} ({'estimated' if free else 'known'})"
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
    for title, effects in (("Found", repair.effects), ("Withdrawn: fresh data refuse it", repair.withdrawn)):
        if effects:
            lines += [title]
        for one in effects:
            lines += _effect(one)
    return lines


def _effect(one: FoundEffect) -> list[str]:
    often = (
        ""
        if one.selection_frequency is None
        else f", first in {100 * one.selection_frequency:.0f} % of halves"
    )
    chance = "p < 1e-300" if one.p_value < 1e-300 else f"p = {one.p_value:.2g}"
    share = f"explains {100 * one.share_explained:.0f} % of the gap"
    lines = wrapped(f"  {one.sentence}: z = {one.z:.1f}, {chance}, {share}{often}", "    ")
    lines += [f"    {name} = {with_error(e.value, e.stderr)} {e.unit}" for name, e in one.parameters.items()]
    lines += [f"    {one.key}.{name} = {value:.6g}" for name, value in one.constants.items()]
    if len(one.members) > 1:
        text = ", ".join(
            f"{m.name} at {m.at} ({100 * m.probability:.0f} %, rho {m.rho:.3f})" for m in one.members
        )
        lines += wrapped(f"    class: {text}", "      ")
    return lines


def _where(repair: Repair) -> list[str]:
    where = repair.where
    if where is None:
        return []
    words = [] if where.location is None else [f"a torque at {where.location} explains most"]
    words += [f"record {where.record} from {where.time[0]:.3f} to {where.time[1]:.3f} s"]
    words += [] if where.cycles is None else [f"cycles {', '.join(map(str, where.cycles[:8]))}"]
    if where.crank_angle is not None:
        low, high = (math.degrees(a) for a in where.crank_angle)
        words += [f"crank angle {low:.0f} to {high:.0f} deg"]
    words += [] if where.order is None else [f"order {where.order:g}"]
    return wrapped(f"Where  {'; '.join(words)}", "       ")


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
    lines = [
        f"{'Gap':<12}{'output':<14}{'rmse':>11}{'after':>11}{'fit %':>10}{'after':>10}{'chi2/N':>10}{'after':>10}"
    ]
    lines += _gap_rows("found on", gaps.estimation_before, gaps.estimation_after)
    if gaps.validation_before is not None and gaps.validation_after is not None:
        lines += _gap_rows("fresh", gaps.validation_before, gaps.validation_after)
    gain = gaps.gain_per_cycle
    if gain is not None and gain.mean is not None:
        turns = any(variable.name == "theta" for variable in repair.model.inputs)
        part = "cycle" if turns else "piece"
        size = with_error(gain.mean, gain.se)
        lines += [f"  twice the gain of log likelihood per fresh {part} {size} over {gain.cycles} {part}s"]
    return lines


def _gap_rows(title: str, before: Side, after: Side) -> list[str]:
    lines = []
    for k, output in enumerate(before.gap.rmse):
        old, new = before.gap, after.gap
        chi2 = f"{old.chi2_per_sample:>10.4g}{new.chi2_per_sample:>10.4g}" if k == 0 else ""
        lines.append(
            f"  {title if k == 0 else '':<10}{output:<14}{old.rmse[output]:>11.4g}{new.rmse[output]:>11.4g}"
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
            f"{predicted[name]:>+18.3g} {units[name]}"
        )
    return lines


def _equation(repair: Repair) -> list[str]:
    if repair.equation is None:
        return []
    lines = ["Equation"]
    for term in repair.equation.terms[:_TERMS]:
        lines += wrapped(f"  {term.strip()}", "      ")[:2]
    return lines


def _not_found(repair: Repair) -> list[str]:
    testable = [one for one in repair.not_found if one.testable]
    rest = len(repair.not_found) - len(testable)
    parts = [f"{one.name} at {one.at} {one.smallest_detectable:.2g} {one.unit}" for one in testable[:_MISSED]]
    if not parts and not rest:
        return []
    more = len(testable) - len(parts)
    text = "; ".join(parts) + (f"; and {count(more)} more" if more > 0 else "")
    text += f"; {rest} not testable with these data" if rest else ""
    return wrapped(f"Would have been found from a size of (95 %): {text}", "  ")


def _not_applicable(repair: Repair) -> list[str]:
    """Effects that a port lacks signals for; those that have no port of their kind are counted."""
    at_ports = [one for one in repair.not_applicable if one.at]
    rest = len(repair.not_applicable) - len(at_ports)
    parts = [str(one) for one in at_ports[:_MISSED]]
    parts += [f"{count(len(at_ports) - _MISSED)} more at other ports"] if len(at_ports) > _MISSED else []
    parts += [f"{count(rest)} without a port of the right kind"] if rest else []
    return wrapped(f"Not applicable: {'; '.join(parts)}", "  ") if at_ports else []


def next_step(repair: Repair) -> str:
    """What to do with the answer, for the screen and for the page."""
    if repair.status == "interrupted":
        return "run it again and let it end; repair.fit is the best model so far"
    if repair.verdict is None:
        return "mend the fit without effects first: other start values, wider bounds, or more starts"
    if repair.next_experiment is not None:
        made = repair.next_experiment
        names: Sequence[str] = made.splits or ("the class",)
        return (
            f"to split {', '.join(names)}: {made.change} (separation {made.expected_separation:.1f}, now "
            f"{made.separation_now:.1f}; 3.3 is enough)"
        )
    if fresh_misfit(repair) is not None:
        return "look for what is missing in the fresh records: give them as data of the search"
    if repair.verdict == "nothing missing":
        return "use the model; larger effects than those listed are excluded"
    if repair.verdict == "unnamed":
        return (
            "look at the curve of the unknown torque, ce.report(repair, 'repair.html'), and write an effect of your "
            "own (ten lines, ce.Effect)"
        )
    if repair.verdict == "class":
        return "record data that tell the members of the class apart, or fix by knowledge which one it is"
    if repair.unknown is not None:
        return "look at the figures of the residuals after the repair: they hold more"
    if repair.confirmed is None:
        return "test it on data it has not seen: --validate FILE, or ce.repair(..., fresh=other_record)"
    if repair.confirmed is False:
        return "test it on more fresh data before you use it: those that were given do not confirm it"
    return "go on with repair.fit, the repaired model: print(repair.fit)"
