"""report.html of a repair: one page that an engineer hands to a colleague, the verdict and the gap on top."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping
from typing import Any

from casadi_engine.discrepancy.clocks import clock_of
from casadi_engine.discrepancy.repaired import NotFound, Repair
from casadi_engine.discrepancy.wording import held_out, in_unit, is_blind, twins
from casadi_engine.estimation.summary import number, with_error
from casadi_engine.report import tables
from casadi_engine.report.figures import figures
from casadi_engine.report.page import Folded, Section
from casadi_engine.report.repaired_gap import pairs
from casadi_engine.report.repaired_latent import acting
from casadi_engine.report.repaired_tables import (
    class_table,
    gap_table,
    p_text,
    parameter_table,
    whiteness_table,
)
from casadi_engine.report.repaired_words import mood, verdict_lines
from casadi_engine.report.sections import DRAWN, Page, _data, _how, _model, page_of
from casadi_engine.report.tables import as_html, table, text


@page_of.register
def _(result: Repair, _validation: Any, arguments: Mapping[str, Any]) -> Page:
    sections = [_verdict(result)]
    if result.gaps is None:
        fit = result.null_fit
        sections += [_failed(result), _model(fit.model)]
    else:
        if result.effects:
            sections += [_equation(result), _effects(result)]
        if result.unknown is not None:
            sections.append(_unknown(result))
        sections += [
            _certificate(result),
            _parameters(result),
            _where(result),
            _scores(result),
            _not_found(result),
        ]
        if not result.effects:
            sections.append(_model(result.model))
    sections += [_data((*result.data, *result.fresh)), _how(arguments, result.options, result.timing)]
    return f"Repair of {result.model.name}", result.null_fit.model.description, sections


@text.register
def _(result: Repair) -> str:
    return str(result)


@as_html.register
def _(result: Repair) -> str:
    parts = [f"<p><b>{html.escape(verdict_lines(result)[0])}</b></p>"]
    if result.gaps is not None:
        parts += [gap_table(result), parameter_table(result)]
    return "".join(parts)


# ---- sections


def _verdict(result: Repair) -> Section:
    wanted = []
    if result.gaps is not None:
        caption = "The gap between measurement and simulation"
        turns = any("theta" in one for one in result.data)
        kinds = "mean of the cycles; its engine orders" if turns else "mean over time; its course"
        caption += f" before and after the repair, {kinds}; its spread; and the law found"
        if not result.effects:
            caption = caption.replace(" before and after the repair", "").replace(
                "the law found", "the scores"
            )
        wanted.append((result, "overview", caption))
    return Section("verdict", "Verdict", verdict_lines(result), mood(result), wanted=wanted)


def _failed(result: Repair) -> Section:
    fit = result.null_fit
    known = figures(fit)
    wanted = [(fit, "overview", "The fit without effects, where it stopped")] if "overview" in known else []
    return Section(
        "fit",
        "The fit without effects",
        preformatted=[str(fit)],
        tables=[tables.parameter_table(fit)],
        wanted=wanted,
    )


def _equation(result: Repair) -> Section:
    found = result.equation
    if found is None:
        return Section("equation", "The equations with the new term")
    return Section(
        "equation",
        "The equations with the new term",
        lines=["What the repair changed:"],
        preformatted=["\n".join(found.terms)] if found.terms else [],
        folded=[Folded("All equations", found.text), Folded("The equations in LaTeX", found.latex)],
    )


def _effects(result: Repair) -> Section:
    rows, lines = [], []
    for one in result.effects:
        lines.append(f"{one.sentence} ({one.name} at {one.at})")
        if twins(one):
            names = " and ".join(f"{m.name} at {m.at}" for m in twins(one))
            lines.append(f"Data of this kind cannot tell it from {names}, however many: correlation 1 or -1.")
        alone = one.selection_frequency is not None and len(one.members) == 1
        frequency = (
            f"{100 * one.selection_frequency:.0f} %" if alone and one.selection_frequency is not None else "-"
        )
        said = (f"{one.z:.1f}", p_text(one.p_value), f"{100 * one.share_explained:.3g} %", frequency)
        for k, (name, found) in enumerate(one.parameters.items()):
            estimate, more = clock_of(result.model).told(found, always=k > 0)
            size = f"{with_error(estimate.value, estimate.stderr)}{in_unit(estimate.unit)}{more}"
            rows.append((name, size, *said))
            said = ("", "", "", "")
    header = ("parameter", "value ± standard error", "z", "p, whole library", "of the gap", "stability")
    words = "Effects found; stability: share of random halves of the data in which the score is the best"
    made = [table(header, rows, right=(2, 3, 4, 5), caption=words)]
    made += [class_table(one) for one in result.effects if len(one.members) > 1]
    return Section("effects", "The effects", lines=lines, tables=made, wanted=_latent_wanted(result))


def _latent_wanted(result: Repair) -> list[tuple[Any, str, str]]:
    known = figures(result)
    ports = list(dict.fromkeys(one.at for one in result.effects if f"latent {one.at}" in known))
    if not ports and result.latent:
        ports = [result.latent[0].port]
    caption = (
        "{acts} of unknown course at {port}, as the data ask for it before the repair, and the law that was named. "
        "Parts linear in the signals belong to the old parameters and are set so that they agree with the law"
    )
    return [
        (
            result,
            f"latent {port}",
            caption.format(port=port, acts=acting(result, port, unit=False).capitalize()),
        )
        for port in ports
    ]


def _unknown(result: Repair) -> Section:
    unknown = result.unknown
    assert unknown is not None
    rows = [(name, p_text(p)) for name, p in unknown.tests.items()]
    wanted = (
        []
        if unknown.course is None
        else [(result, "unknown", f"The unknown {_acts(result)} that explains most of it")]
    )
    if not result.effects:
        wanted += _latent_wanted(result)
    made = [table(("rejected residual test", "p"), rows, right=(1,))] if rows else []
    blind = is_blind(result)
    title = "What is not explained" if blind else "What no effect of the library explains"
    line = f"{unknown.sentence}."
    return Section("unknown", title, [line], "poor", tables=made, wanted=wanted)


def _acts(result: Repair) -> str:
    """What acts at the port of what is unknown."""
    port = None if result.unknown is None else result.unknown.port
    return "torque" if port is None else acting(result, port, unit=False)


def _certificate(result: Repair) -> Section:
    gaps = result.gaps
    assert gaps is not None
    made = [gap_table(result), whiteness_table(result)]
    gain = gaps.gain_per_cycle
    if gain is not None:
        rows = [(number(gain.mean, ".4g"), number(gain.se, ".3g"), str(gain.cycles), _yes(result.confirmed))]
        part = "cycle" if any(one.name == "theta" for one in result.model.inputs) else "piece"
        header = ("mean", "standard error", f"{part}s", "confirmed (mean > 2 s.e.)")
        gone = "" if result.effects else ", with what was withdrawn"
        caption = f"Fall of chi-squared per {part} of data not used{gone}"
        made.append(table(header, rows, right=(0, 1, 2), caption=caption))
    what = {
        "records": "Fresh records: the parameters are kept, only initial states are found.",
        "cycles": "No fresh record was given: each record kept {held} for confirmation.",
        None: "No fresh data: the repair is not confirmed.",
    }
    every = pairs(result)
    wanted = [
        (
            result,
            f"{'fresh gap' if one.fresh else 'gap'} {one.record} {one.output}",
            f"{one.title}: residual over time with the band of the noise, its mean"
            + (" cycle, its orders" if one.theta is not None else " in pieces of the record"),
        )
        for one in every[:DRAWN]
    ]
    lines = [what[gaps.source].format(held=held_out(result))]
    if len(every) > DRAWN:
        lines.append(f"{len(every) - DRAWN} more outputs are in the tables, but not drawn here.")
    return Section(
        "certificate", "Certificate: the gap before and after", lines=lines, tables=made, wanted=wanted
    )


def _parameters(result: Repair) -> Section:
    known = figures(result)
    wanted = [
        (
            result,
            f"shift {one.key}",
            f"Old parameters when {one.name} at {one.at} was added",
        )
        for one in result.effects
        if one.found_shift and f"shift {one.key}" in known
    ]
    made = [parameter_table(result), tables.initial_table(result.fit)]
    return Section(
        "parameters", "Parameters before and after", tables=[one for one in made if one], wanted=wanted
    )


def _where(result: Repair) -> Section:
    place = result.where
    rows = []
    if place is not None:
        rows = [("record", place.record), ("time", clock_of(result.model).span(*place.time))]
        if place.cycles:
            rows.append(("engine cycles", ", ".join(map(str, place.cycles))))
        if place.crank_angle is not None:
            first, last = (math.degrees(angle) for angle in place.crank_angle)
            rows.append(("crank angle", f"{first:.0f} to {last:.0f} deg of 720"))
        if place.order is not None:
            rows.append(("engine order", f"{place.order:g} per revolution"))
        rows += [
            (f"share of the gap in {name}", f"{100 * value:.3g} %") for name, value in place.excess.items()
        ]
    made = [table(("the gap before the repair", "where"), rows)] if rows else []
    if result.latent:
        gains = [
            (
                f"{acting(result, one.port, unit=False)} at {one.port}",
                f"{one.gain:.4g}",
                _size_of(result, one.port, one.level),
            )
            for one in result.latent
        ]
        header = ("of unknown course", "gain of 2 log likelihood", "its size")
        caption = "Where in the system (a screen: with few sensors any place explains much; the claim is the score's)"
        made.append(table(header, gains, right=(1, 2), caption=caption))
    lines = [] if rows else ["No part of the data stands out of the noise."]
    return Section("where", "Where the gap sits", lines=lines, tables=made)


def _scores(result: Repair) -> Section:
    known = figures(result)
    wanted = [
        (result, name, caption)
        for name, caption in (
            (
                "scores",
                "Score of every effect at every port, all parameters free, and the threshold of the whole library",
            ),
            ("classes", "How alike the leading effects look in these data"),
        )
        if name in known
    ]
    line = (
        f"{result.candidates} candidates at α = {result.alpha:g} over all of them together: threshold "
        f"|z| = {number(result.threshold, '.3g')}."
    )
    lines = [line]
    if result.rounds:
        kept = [one.kept for one in result.rounds if one.kept]
        lines.append(f"Rounds of the search: {len(result.rounds)}; kept: {', '.join(kept) or 'nothing'}.")
    return Section("scores", "What was looked for", lines=lines, wanted=wanted)


def _said_of(one: NotFound) -> str:
    """Why a size is not said, or not the whole story."""
    if not one.testable:
        return f"not testable: {one.note or 'the free parameters explain all that it does'}; it may be there"
    if one.note:
        return f"no plausible size is excluded: {one.note} ({one.smallest_detectable:.3g}) to be found"
    return (
        f"does the same here as {one.twin}: one of the two would be found, not told apart" if one.twin else ""
    )


def _not_found(result: Repair) -> Section:
    rows = [
        (
            f"{one.name} at {one.at}",
            f"{one.smallest_detectable:.3g}"
            if one.excluded and math.isfinite(one.smallest_detectable)
            else "-",
            in_unit(one.unit).strip(),
            _said_of(one),
        )
        for one in result.not_found
    ]
    made = (
        [table(("effect", "smallest size found in 95 %", "unit", "note"), rows, right=(1,))] if rows else []
    )
    left_out = [(one.effect, one.at or "-", one.why) for one in result.not_applicable]
    made += [table(("not applicable: effect", "port", "why"), left_out)] if left_out else []
    line = "Not found is not absent: an effect below its smallest detectable size may well be there."
    if result.verdict == "unnamed":
        line = "The model lacks what was not named: sizes along it are a guide, and exclude nothing."
    split = result.next_experiment
    lines = [line] if rows else ["Every effect that was looked for was found, or nothing was looked for."]
    if split is not None:
        lines.append(
            f"Next experiment: {split.change}; expected separation {split.expected_separation:.2g}, now "
            f"{split.separation_now:.2g} (3.3 is right in 95 %)."
        )
    return Section("not-found", "Not found, and how small it would have to be", lines=lines, tables=made)


def _size_of(result: Repair, port: str, level: float) -> str:
    """A size with the unit of what acts at a port."""
    return f"{level:.3g}" + acting(result, port).removeprefix(acting(result, port, unit=False)).translate(
        _BARE
    )


_BARE = str.maketrans("", "", "[]")


def _yes(answer: bool | None) -> str:
    return "not known" if answer is None else "yes" if answer else "no"
