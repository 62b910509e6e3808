"""A repair that was read back, in sentences and tables: what its page says without traces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from casadi_engine.discrepancy.wording import in_unit
from casadi_engine.estimation.summary import with_error
from casadi_engine.report.page import Section
from casadi_engine.report.tables import table

_VERDICTS = {
    "named": "Something is missing, and the data name it.",
    "class": "Something is missing; the data narrow it to a class of effects.",
    "unnamed": "Something is missing that no effect of the library names.",
    "nothing missing": "Nothing is missing that these data could show.",
}


def stored_verdict(result: Mapping[str, Any]) -> list[str]:
    """Sentences of the verdict, of each effect, and of what fresh data said."""
    lines = [_VERDICTS.get(result["verdict"], f"No answer: {result['status']}.")]
    for effect in result["effects"]:
        sizes = ", ".join(
            f"{name} = {with_error(one['value'], one['stderr'])}{in_unit(one['unit'])}"
            for name, one in effect["parameters"].items()
        )
        lines.append(f"{effect['sentence']}: {sizes}; {100 * effect['share_explained']:.3g} % of the gap.")
    if result["unknown"] is not None:
        lines.append(f"{result['unknown']['sentence']}.")
    if result["effects"]:
        said = {
            True: "Confirmed by fresh data.",
            False: "Contradicted by fresh data.",
            None: "Not confirmed by fresh data.",
        }
        lines.append(said[result["confirmed"]])
    if result.get("stopped"):
        missed = ", ".join(result["not_searched"]) or "further effects"
        lines.append(f"Stopped by {result['stopped']}; not searched: {missed}.")
    return lines


def stored_sections(result: Mapping[str, Any]) -> list[Section]:
    """The equations, the gap before and after, and what was not found."""
    sections = []
    if "summary" in result:
        sections.append(Section("printed", "As it was printed", preformatted=[result["summary"]]))
    if result["equation"] is not None:
        sections.append(Section("equation", "Equations", preformatted=[result["equation"]["text"]]))
    if result["gap"] is not None:
        sections.append(Section("gap", "The gap before and after", tables=[_gap_table(result["gap"])]))
    rows = [
        (
            f"{one['name']} at {one['at']}",
            "no plausible size" if one["testable"] and one.get("note") else _size(one["smallest_detectable"]),
            one["unit"],
            f"does the same here as {one['twin']}" if one.get("twin") else one.get("note", ""),
        )
        for one in result["not_found"]
    ]
    if rows:
        made = table(("effect", "smallest size found in 95 %", "unit", "note"), rows, right=(1,))
        sections.append(Section("not-found", "Not found", tables=[made]))
    return sections


def _gap_table(gap: Mapping[str, Any]) -> str:
    rows = []
    for name in ("estimation", "validation"):
        sides = gap[name]
        if sides is None:
            continue
        for output, before in sides["before"]["rmse"].items():
            rows.append((name, output, f"{before:.4g}", f"{sides['after']['rmse'][output]:.4g}"))
    return table(("data", "output", "rms before", "rms after"), rows, right=(2, 3))


def _size(value: float | None) -> str:
    return "not testable" if value is None else f"{value:.3g}"
