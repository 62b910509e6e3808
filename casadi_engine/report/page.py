"""report.html: one file that holds everything of a result and opens without a network."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import casadi_engine
from casadi_engine.errors import MissingDependencyError, OutputError
from casadi_engine.report.figures import figures
from casadi_engine.report.files import write_file
from casadi_engine.report.page_figures import PageFigures

# The figures of a page may take this many bytes of it; what is beyond is named, not drawn.
FIGURE_BYTES = 2_300_000
# What a page of this program has in its foot, whichever version wrote it.
_MARK = b"Written by casadi-engine "


@dataclass(frozen=True)
class Folded:
    """A text behind a title that opens it."""

    title: str
    text: str


@dataclass(frozen=True)
class Section:
    """One section of a page; tables and figures are HTML, everything else is text."""

    key: str
    title: str
    verdict: Sequence[str] = ()
    mood: str = "plain"
    lines: Sequence[str] = ()
    preformatted: Sequence[str] = ()
    folded: Sequence[Folded] = ()
    tables: Sequence[str] = ()
    wanted: Sequence[tuple[Any, str, str]] = ()  # (result, name of its figure, caption)
    figures: Sequence[str] = ()  # HTML


def report(
    result: Any, path: Any, *, validation: Any = None, arguments: Mapping[str, Any] | None = None
) -> Path:
    """Write a result as one self-contained report.html (at most 3 MB), atomically, and return its path.

    A browser draws lines from the numbers in the page and zooms into them; without scripts static figures are shown.

    result : a Fit, a Validation, a Simulated, a Repair, a Posterior, a Comparison, or a result that was loaded (what
    result.json holds: no traces)
    validation : the Validation of a Fit, for its section of residual tests
    arguments : what the command was given, for the section on how it was made

    Raises MissingDependencyError without jinja2, ResultError for another kind of result, OutputError when
    the file cannot be written (the old one stays), or is there already and no page of this program's.
    """
    template = _template()
    _refuse_others(path)
    from casadi_engine.report.sections import page_of

    title, subtitle, sections = page_of(result, validation, dict(arguments or {}))
    drawn = PageFigures(FIGURE_BYTES)
    done = [_with_figures(section, drawn) for section in sections]
    content = template.render(
        title=title,
        subtitle=subtitle,
        sections=done,
        css=_packaged("page.css"),
        script=_packaged("charts.js"),
        uplot=_packaged("uplot/uPlot.iife.min.js").partition("\n")[
            2
        ],  # without the address in its first line
        uplot_css=_packaged("uplot/uPlot.min.css"),
        uplot_licence=_packaged("uplot/LICENSE.txt"),
        **drawn.json(),
        footer=f"Written by casadi-engine {casadi_engine.__version__} on "
        f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC.",
    )
    return write_file(path, content.encode())


def _refuse_others(path: Any) -> None:
    """OutputError for a path that does not end as a page does, or under which there is another file."""
    if not isinstance(path, str | os.PathLike):
        return  # the writer says what is wrong
    there = Path(os.fsdecode(os.fspath(path)))
    if there.is_dir():
        return
    if there.suffix.lower() not in (".html", ".htm"):
        raise OutputError(
            "a report is a page for a browser",
            seen=str(there),
            allowed="a path that ends in .html",
            cure=f'write ce.report(result, "{there.with_suffix(".html")}")',
        )
    if there.is_file() and _MARK not in there.read_bytes():
        raise OutputError(
            f"a file of this name would be lost: {there}",
            seen="a file that is no report of this program",
            allowed="a new file, or an earlier report, which is replaced",
            cure="give another name, or move the file away",
        )


def _with_figures(section: Section, drawn: PageFigures) -> Section:
    made = [drawn.html(figures(result)[name](), caption) for result, name, caption in section.wanted]
    shown = [one for one in made if one is not None]
    lines = list(section.lines)
    if len(shown) < len(made):
        lines.append(
            f"{len(made) - len(shown)} figures are left out to keep this file small: "
            "ce.plot(result, what=...) draws them."
        )
    return replace(section, wanted=(), lines=lines, figures=shown)


@cache
def _packaged(name: str) -> str:
    return files("casadi_engine.report").joinpath(name).read_text(encoding="utf-8")


def _template() -> Any:
    try:
        import jinja2  # noqa: F401  asked for here, so that a missing one is said before the work
    except ImportError:
        raise MissingDependencyError(
            "report.html needs the package jinja2",
            seen="it is not installed",
            cure='pip install "casadi-engine[app]"',
        ) from None
    return _compiled()


@cache
def _compiled() -> Any:
    import jinja2

    environment = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(_packaged("page.html"))
