"""The answer of the exact test on one screen: verdict, what is lost, why, and what would bring it back."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from casadi_engine.estimation.summary import COLUMNS, LINES, limited, short, wrapped
from casadi_engine.identifiability.remedies import Remedy
from casadi_engine.identifiability.symmetry import Symmetry

if TYPE_CHECKING:
    from casadi_engine.identifiability.settings import Setting
    from casadi_engine.identifiability.structural import Identifiability

_SYMMETRIES, _EXPERIMENTS, _REMEDIES, _COMBINATIONS = 4, 4, 6, 8


def summary(found: Identifiability, *, remedies: bool = True) -> str:
    """Return the answer as text of at most 45 lines and 100 columns, the verdict first."""
    lines = [*wrapped(f"Identifiability of {found.model.name}: {verdict(found)}", "  ")]
    lines = [*limited(lines, 5), ""]
    settings = found.question.settings
    for setting in settings[:_EXPERIMENTS]:
        lines += limited(wrapped(f"  {setting_words(setting, several=len(settings) > 1)}", "    "), 3)
    if len(settings) > _EXPERIMENTS:
        lines.append(f"  … and {len(settings) - _EXPERIMENTS} more experiments")
    lines += ["", *(f"  {line}" for line in numbers(found))]
    if found.combinations:
        told = [f"{text}: {'yes' if good else 'no'}" for text, good in found.combinations.items()]
        lines += limited(wrapped(f"  combinations       {'; '.join(told[:_COMBINATIONS])}", " " * 21), 4)
    if found.lost or found.lost_states:
        lines += ["", *_why(found)]
    if found.lost and remedies:
        lines += ["", "What would bring them back"]
        lines += [
            line
            for text in remedy_lines(found.remedies())
            for line in limited(wrapped(f"  {text}", "    "), 2)
        ]
    return "\n".join(
        [short(line, COLUMNS) for line in lines[: LINES - 2]] + ["", f"Next: {next_step(found)}"]
    )


# A rank is that of slopes, and slopes know nothing of what lies far off.
_LOCAL = (
    "local              around these values: others far off, as two rates exchanged, are not",
    "                   excluded; a fit looks for exchanges of parameters of one unit",
)


def verdict(found: Identifiability) -> str:
    """The verdict in one sentence."""
    count = len(found.free)
    if not count:
        return "no parameter is free; " + (
            "all initial states can be told"
            if not found.lost_states
            else "not all initial states can be told"
        )
    if found.passed:
        return (
            f"YES, all {count} free parameters can be told"
            if count > 1
            else f"YES, {found.free[0]} can be told"
        )
    words = "cannot be told" if found.final else f"is not seen in derivatives up to order {found.orders}"
    if len(found.lost) == count:
        what = f"none of the {count} free parameters" if count > 1 else found.free[0]
        words = words if count == 1 else words.replace("cannot", "can").replace("not ", "")
        return f"NO, {what} {words}"
    return (
        f"NO, {len(found.lost)} of {count} free parameters cannot be told by themselves: {', '.join(found.lost)}"
        + ("" if found.final else f" (not seen up to order {found.orders})")
    )


def setting_words(setting: Setting, *, several: bool = False) -> str:
    """What was assumed of one experiment, in words."""
    groups: dict[str, list[str]] = {}
    for name, one in setting.inputs.items():
        groups.setdefault(str(one), []).append(name)
    inputs = "; ".join(f"{', '.join(names)} {word}" for word, names in groups.items()) or "none"
    starts: dict[str, list[str]] = {}
    for name, known in setting.start.items():
        starts.setdefault(str(known), []).append(name)
    words = {"free": "free", "known": "known", "rest": "at rest (zero, known)"}
    start = "; ".join(
        (f"{', '.join(names)} " if len(starts) > 1 else "") + words.get(word, f"= {word}")
        for word, names in starts.items()
    )
    head = f"experiment {setting.name}: " if several else ""
    return f"{head}measured: {', '.join(setting.outputs)} · drives: {inputs} · start: {start}"


def numbers(found: Identifiability) -> list[str]:
    """The numbers behind the verdict, one line each."""
    states = len(found.question.initial)
    held = "final: no higher derivative adds to it" if found.final else f"looked at up to {found.orders}"
    came = f"the last of the rank came with order {found.order}; "
    return [
        f"rank               {found.rank} of {found.size} ({len(found.free)} parameters, {states} initial states)",
        f"directions         {found.directions} of {len(found.free)} independent combinations of the parameters",
        f"derivatives        {'' if found.question.arbitrary else came}{held}",
        f"chance of an error < {found.error_probability:.0e} in each of {found.seeds} drawings "
        f"({found.seconds:.2g} s of CPU time)",
        *(_LOCAL if found.passed and len(found.free) > 1 else ()),
    ]


def _why(found: Identifiability) -> list[str]:
    lines = ["Why: these changes leave no trace in what is measured"]
    for symmetry in found.symmetries[:_SYMMETRIES]:
        lines += limited(wrapped(f"  {symmetry_words(symmetry)}", "    "), 3)
    more = len(found.symmetries) - _SYMMETRIES
    if more > 0:
        lines.append(f"  … and {more} more scalings or shifts")
    if found.other_directions:
        count = found.other_directions
        shown = (
            "" if found.symmetries else ", which change several unknowns at once in proportions of their own"
        )
        lines += wrapped(
            f"  {count} {'further ' if found.symmetries else ''}direction{'s' * (count > 1)} that "
            f"{'are' if count > 1 else 'is'} neither scaling nor shift{shown}",
            "    ",
        )
    if found.lost_states:
        lines += limited(
            wrapped(f"  initial states that cannot be told: {', '.join(found.lost_states)}", "    "), 2
        )
    return lines


def symmetry_words(symmetry: Symmetry) -> str:
    """A symmetry as a line; a parameter that nothing shows by itself is said to be without effect."""
    if len(symmetry.names) == 1:
        return f"{symmetry.names[0]} by itself, to any value: it has no effect on what is measured"
    return f"{symmetry.kind}: {symmetry}"


def remedy_lines(remedies: Sequence[Remedy]) -> list[str]:
    """Remedies in words; single changes of one kind that restore the same share a line."""
    if not remedies:
        return ["no single change and no pair of changes of those tried restores any of them"]
    groups: dict[tuple[Any, ...], list[Remedy]] = {}
    for remedy in remedies:
        kinds = tuple(change.kind for change in remedy.changes)
        key = (kinds, remedy.lost) if len(kinds) == 1 else (remedy,)
        groups.setdefault(key, []).append(remedy)
    lines = []
    for group in list(groups.values())[:_REMEDIES]:
        first = group[0]
        if len(group) == 1:
            lines.append(str(first))
            continue
        words = "; or ".join(remedy.changes[0].sentence for remedy in group)
        end = str(first).removeprefix(first.changes[0].sentence)
        lines.append(f"{words}{end}")
    if not any(remedy.complete for remedy in remedies):
        lines.append("nothing tried restores all of them: one change or two are not enough")
    return lines


def next_step(found: Identifiability) -> str:
    """What to do next."""
    if found.lost and any(remedy.complete for remedy in found.remedies()):
        return "make one of these changes, and ask again"
    if found.lost:
        return "fix or tie more parameters, measure more, and ask again"
    return "structure allows it; whether the data do: ce.profile(fit), and the standard errors of a fit"


def html_summary(found: Identifiability) -> str:
    """The same as HTML for notebooks: the text, and a table of the parameters."""
    rows = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{'yes' if good else 'no'}</td></tr>"
        for name, good in found.identifiable.items()
    )
    return (
        f"<pre>{html.escape(summary(found))}</pre><table><thead><tr><th>unknown</th><th>can be told</th></tr></thead>"
        f"<tbody>{rows}</tbody></table>"
    )
