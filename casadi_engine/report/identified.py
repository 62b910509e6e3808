"""The result of ``identify``: the structural answer, and what the records add to it, as data and as a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from casadi_engine.estimation.fit import Fit
from casadi_engine.experiment import Experiment
from casadi_engine.identifiability.fisher import Information
from casadi_engine.identifiability.profile import Profile
from casadi_engine.identifiability.structural import Identifiability
from casadi_engine.identifiability.summary import (
    next_step,
    numbers,
    remedy_lines,
    setting_words,
    symmetry_words,
    verdict,
)
from casadi_engine.report import identifiability_figures  # noqa: F401  registers the figures of a profile
from casadi_engine.report.page import Section
from casadi_engine.report.result_file import content, describe, parameters_of, plain_parameters
from casadi_engine.report.sections import Page, _data, _how, _model, page_of
from casadi_engine.report.tables import table


@dataclass(frozen=True, eq=False)
class Identified:
    """What `identify` found.

    structural : the exact answer. data : the records that were looked at, if any
    information, fit, profile : what they tell at the present values, and at the fit; None where not made
    notes : sentences on what was left out
    """

    structural: Identifiability
    data: tuple[Experiment, ...] = ()
    information: Information | None = None
    fit: Fit | None = None
    profile: Profile | None = None
    notes: tuple[str, ...] = ()


@content.register
def _(result: Identified) -> dict[str, Any]:
    found = result.structural
    why = "the question is about the equations; see the key profiles for what records tell"
    return {
        "status": "answered",
        "timing": {"structural": found.seconds},
        "inputs": describe(result.data, found.model),
        "noise": {},
        "cost": None,
        "n": None,
        "why": {"cost": why, "n": why},
        "parameters": plain_parameters(found.parameters) if result.fit is None else parameters_of(result.fit),
        **found.to_dict(),
        "expected_errors": _expected(result.information),
        "profiles": _profiles(result.profile),
        "notes": list(result.notes),
    }


def _expected(information: Information | None) -> dict[str, Any] | None:
    if information is None:
        return None
    made: dict[str, Any] = {}
    for name, estimate in information.errors.items():
        if estimate.fixed:
            continue
        made[name] = {"value": estimate.value, "stderr": estimate.stderr, "unit": estimate.unit}
        if estimate.stderr is None:
            made[name]["why"] = {"stderr": estimate.why or "not known"}
    return made


def _profiles(profile: Profile | None) -> dict[str, Any] | None:
    if profile is None:
        return None
    made: dict[str, Any] = {}
    for name, (low, high) in profile.intervals.items():
        why = {end: "no end was found" for end, value in (("low", low), ("high", high)) if value is None}
        made[name] = {"low": low, "high": high} | ({"why": why} if why else {})
    return made


@page_of.register
def _(result: Identified, _validation: Any, arguments: Mapping[str, Any]) -> Page:
    found = result.structural
    several = len(found.question.settings) > 1
    lines = [f"{verdict(found)}.", *result.notes, f"Next: {next_step(found)}."]
    sections = [
        Section("verdict", "Verdict", lines, "good" if found.passed else "poor"),
        Section(
            "asked",
            "What was asked",
            lines=[setting_words(setting, several=several) for setting in found.question.settings],
        ),
        _answer(found),
    ]
    if found.lost:
        sections.append(
            Section("remedies", "What would bring them back", lines=remedy_lines(found.remedies()))
        )
    if result.information is not None:
        sections.append(_errors(result.information))
    if result.profile is not None:
        wanted = [(result.profile, "overview", "Profile likelihood of each free parameter, and its interval")]
        sections.append(Section("profiles", "Profiles", preformatted=[str(result.profile)], wanted=wanted))
    sections += [_model(found.model), _data(result.data), _how(arguments, {}, {"structural": found.seconds})]
    return f"Identifiability of {found.model.name}", found.model.description, sections


def _answer(found: Identifiability) -> Section:
    kinds = dict.fromkeys(found.free, "parameter") | dict.fromkeys(found.question.initial, "initial state")
    rows = [(name, kinds[name], "yes" if good else "no") for name, good in found.identifiable.items()]
    rows += [(text, "combination", "yes" if good else "no") for text, good in found.combinations.items()]
    lines = [symmetry_words(symmetry) for symmetry in found.symmetries]
    if found.other_directions:
        lines.append(f"{found.other_directions} invisible directions that are neither scaling nor shift")
    return Section(
        "structure",
        "Structure",
        preformatted=["\n".join(numbers(found))],
        lines=lines,
        tables=[table(("unknown", "kind", "can be told"), rows)],
    )


def _errors(information: Information) -> Section:
    return Section(
        "errors",
        "Expected errors from the records, at the present values",
        preformatted=[str(information)],
        wanted=[(information, "overview", "Expected standard errors (Cramér-Rao bound)")],
    )
