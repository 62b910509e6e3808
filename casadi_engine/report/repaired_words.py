"""A repair in sentences, for the top of its page."""

from __future__ import annotations

import math
from collections.abc import Collection

from casadi_engine.discrepancy.clocks import clock_of
from casadi_engine.discrepancy.confirmation import share_closed
from casadi_engine.discrepancy.fresh_misfit import fresh_doubt, fresh_misfit
from casadi_engine.discrepancy.repaired import FoundEffect, Repair
from casadi_engine.discrepancy.verdict_words import acts_where, given_fresh, may_hide, next_step
from casadi_engine.discrepancy.wording import (
    first_words,
    in_unit,
    is_blind,
    names_own_law,
    right_value,
    why_leads,
)
from casadi_engine.estimation.summary import number, with_error
from casadi_engine.report.panels import half_width

# A parameter is named at the top if it moved by so many of its standard errors.
_MOVED = 3.0


def verdict_lines(repair: Repair) -> list[str]:
    """The verdict, what fresh data say, by how much the gap shrank, what the old parameters hid, and what to do."""
    lines = [_verdict(repair), *(f"{words}." for words in first_words(repair))]
    lines += [_class(one) for one in repair.effects if len(one.members) > 1]
    if repair.effects and repair.unknown is not None:
        beside = "The residuals still hold more" if repair.unknown.odds is None else "In its place"
        lines.append(f"{beside}: {repair.unknown.sentence}.")
    lines += [f"{_where(repair)}." if _where(repair) else ""]
    lines += [_confirmed(repair)]
    lines += [gap_sentence(repair)]
    moved = moved_parameters(repair)
    if moved:
        lines.append(f"Without it the model had these wrong: {moved}.")
    lines += [
        f"Found first and withdrawn, {one.why_withdrawn}: {one.name} at {one.at}." for one in repair.withdrawn
    ]
    lines += [_sentence(text, _names(repair)) for text in repair.messages]
    lines.append(f"Next: {next_step(repair)}.")
    return [line for line in lines if line]


def mood(repair: Repair) -> str:
    """Colour of the verdict: good where the answer stands, poor where something is open."""
    if repair.verdict == "nothing missing":
        return "good" if fresh_misfit(repair) is None and fresh_doubt(repair) is None else "poor"
    return "good" if repair.verdict == "named" and repair.confirmed is not False else "poor"


def _verdict(repair: Repair) -> str:
    if repair.verdict is None:
        return f"No answer: {repair.status}."
    if repair.verdict == "nothing missing":
        coloured = may_hide(repair)
        left = "what an autoregression of the coloured noise leaves is" if coloured else "the residuals are"
        what = "No effect of the library is missing" if coloured else "Nothing is missing"
        if is_blind(repair):
            return "Nothing was found, but no physical effect could be looked for."
        return (
            f"{what} that these data can show: {repair.candidates} candidates at α = {repair.alpha:g}, "
            f"and {left} white{'; others may hide in it' if coloured else ''}."
        )
    if repair.verdict == "unnamed":
        words = repair.unknown.sentence if repair.unknown is not None else "the residuals are not noise"
        if is_blind(repair) and not names_own_law(repair):
            return f"Something is missing, and no physical effect could be looked for: {words}."
        return f"Something is missing that no effect of the library names: {words}."
    return f"Something is missing: {' and '.join(effect_words(one, repair) for one in repair.effects)}."


def effect_words(effect: FoundEffect, repair: Repair) -> str:
    """An effect with its size: ``dry friction at coupling (coulomb_friction at coupling), torque 8.05 ± 0.07 N m``.

    What an effect calls its torque is called by what acts at the port; of a wrong value the right one stands there.
    """
    model = repair.model
    name = next(iter(effect.parameters)).rpartition(".")[2]
    known = model.ports[effect.at] if effect.at in model.ports.names else None
    name = known.quantity if known is not None and name == "torque" else name
    found, _ = clock_of(model).told(effect.amplitude, always=False)
    size = f"{name} {with_error(found.value, found.stderr)}{in_unit(found.unit)}"
    changed = right_value(effect, repair)
    return f"{effect.sentence} ({effect.name} at {effect.at}), {changed or size}"


def _class(effect: FoundEffect) -> str:
    others = ", ".join(f"{one.label} ({100 * one.probability:.2g} %)" for one in effect.members)
    why = why_leads(effect)
    others += f"; {why}" if why else ""
    return f"These data do not tell apart {len(effect.members)} effects that explain it as well: {others}."


def _names(repair: Repair) -> set[str]:
    """What the model calls something: no word of a sentence."""
    model = repair.fit.model
    variables = (*model.states, *model.inputs, *model.outputs)
    return {*model.parameter_names, *(one.name for one in variables)}


def _sentence(text: str, names: Collection[str] = ()) -> str:
    """A note as a sentence; names : words that stay as they are.

    >>> _sentence("a note"), _sentence("J_eng went to a bound"), _sentence("c may go", {"c"})
    ('A note.', 'J_eng went to a bound.', 'c may go.')
    """
    first, _, rest = text.partition(" ")
    plain = first.isalpha() and first.islower() and first not in names
    return f"{first.capitalize() if plain else first} {rest}".strip().rstrip(".") + "."


def _where(repair: Repair) -> str:
    place = repair.where
    if place is None:
        return ""
    words = [f"in {place.record} {clock_of(repair.model).span(*place.time)}"]
    if place.cycles:
        words.append(f"cycle{'s' if len(place.cycles) > 1 else ''} {_numbers(place.cycles)}")
    if place.crank_angle is not None:
        first, last = (math.degrees(angle) for angle in place.crank_angle)
        words.append(f"crank angles {first:.0f} to {last:.0f} deg")
    if place.order is not None:
        words.append(f"engine order {place.order:g}")
    acts = acts_where(repair)
    at = f"; {acts} explains most of it" if acts else ""
    return f"The gap is widest {', '.join(words)}{at}"


def _numbers(values: tuple[int, ...]) -> str:
    """Cycle numbers, consecutive ones as a range: ``2, 5 to 8``.

    >>> _numbers((2, 5, 6, 7, 8)), _numbers((1,)), _numbers((1, 2))
    ('2, 5 to 8', '1', '1, 2')
    """
    runs: list[list[int]] = []
    for value in sorted(values):
        if runs and value == runs[-1][-1] + 1:
            runs[-1].append(value)
        else:
            runs.append([value])
    words = [f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs]
    return ", ".join(words)


def _confirmed(repair: Repair) -> str:
    gaps = repair.gaps
    if not repair.effects or gaps is None:
        return ""
    gain = gaps.gain_per_cycle
    if repair.confirmed is None and (gain is None or gain.why or gain.mean is None):
        why = "there are no fresh data" if gain is None or gain.why is None else gain.why
        if gain is None and given_fresh(repair):
            why = f"the fresh data that were given ({', '.join(given_fresh(repair))}) were not judged"
        return f"Not confirmed: {why}."
    part = "cycle" if any(one.name == "theta" for one in repair.model.inputs) else "piece"
    kind = "fresh records" if gaps.source == "records" else f"{part}s that were held out"
    size = ""
    if gain is not None and gain.mean is not None and gain.se is not None:
        size = f", gain of chi-squared {gain.mean:.3g} ± {gain.se:.2g} per {part} over {gain.cycles} {part}s"
    if repair.confirmed is None:
        return f"Neither confirmed nor refused by {kind}{size}, as said below."
    word = "Confirmed" if repair.confirmed else "Not confirmed"
    if not repair.confirmed and gain is not None and gain.refused:
        word = "Contradicted"
    return f"{word} by {kind}{size}."


def gap_sentence(repair: Repair) -> str:
    """How far the rms gap fell, on the data of the search and on fresh ones, and to what share of the noise."""
    gaps = repair.gaps
    if gaps is None:
        return ""
    units = {variable.name: variable.unit for variable in repair.model.outputs}
    parts = []
    for name, before, after in (
        ("data of the search", gaps.estimation_before, gaps.estimation_after),
        ("fresh data", gaps.validation_before, gaps.validation_after),
    ):
        if before is None or after is None:
            continue
        for output, old in before.gap.rmse.items():
            new, unit = after.gap.rmse[output], units.get(output, "1")
            if repair.effects:
                parts.append(f"{output} {old:.4g} to {new:.4g} {unit} on {name}")
            else:
                parts.append(f"{output} {new:.4g} {unit} on {name}")
    first, then = gaps.estimation_before.gap, gaps.estimation_after.gap
    noise = repair.noise
    sigma = {} if noise is None else {name: level for name, (level, _) in noise.sigma.items()}
    share = share_closed(first, then, sigma, coloured=noise is not None and bool(noise.colour))
    closed = f"; {100 * share:.3g} % of the gap above the noise is closed" if repair.effects else ""
    return f"Rms gap: {', '.join(parts)}{closed}." if parts else ""


def moved_parameters(repair: Repair) -> str:
    """Old parameters that adding the effects moved by several standard errors, the largest share first."""
    found = []
    for name in repair.null_fit.free:
        old, new = repair.null_fit.estimates.get(name), repair.fit.estimates.get(name)
        error = None if new is None else half_width(new)
        if not repair.effects or old is None or new is None or error is None:
            continue
        change = new.value - old.value
        if abs(change) > _MOVED * error / 1.96:
            share = abs(change) / (abs(new.value) or 1.0)
            found.append(
                (
                    share,
                    f"{name} {number(old.value, '.4g')}, now {with_error(new.value, new.stderr)}{in_unit(new.unit)}",
                )
            )
    found.sort(key=lambda pair: -pair[0])
    return "; ".join(text for _, text in found[:4])
