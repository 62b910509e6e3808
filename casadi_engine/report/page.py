"""report.html: one file that holds everything of a result and opens without a network."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import casadi_engine
from casadi_engine.errors import MissingDependencyError
from casadi_engine.report.figures import drawn, figures, styled
from casadi_engine.report.files import write_file

# The figures of a page may take this many bytes of it; what is beyond is named, not drawn.
FIGURE_BYTES = 2_300_000
# A vector figure larger than this is stored as pixels.
VECTOR_BYTES = 250_000


@dataclass(frozen=True)
class Picture:
    """One figure of a page: a data URL, its caption, and whether it is shown at its own size."""

    source: str
    caption: str
    small: bool = False


@dataclass(frozen=True)
class Folded:
    """A text behind a title that opens it."""

    title: str
    text: str


@dataclass(frozen=True)
class Section:
    """One section of a page; tables are HTML, everything else is text."""

    key: str
    title: str
    verdict: Sequence[str] = ()
    mood: str = "plain"
    lines: Sequence[str] = ()
    preformatted: Sequence[str] = ()
    folded: Sequence[Folded] = ()
    tables: Sequence[str] = ()
    wanted: Sequence[tuple[Any, str, str]] = ()  # (result, name of its figure, caption)
    pictures: Sequence[Picture] = field(default=())


def report(
    result: Any, path: Any, *, validation: Any = None, arguments: Mapping[str, Any] | None = None
) -> Path:
    """Write a result as one self-contained report.html (at most 3 MB), atomically, and return its path.

    result : a Fit, a Validation, a Simulated, a Repair, or a result that was loaded (what result.json holds: no traces)
    validation : the Validation of a Fit, for its section of residual tests
    arguments : what the command was given, for the section on how it was made

    Raises MissingDependencyError without jinja2, ResultError for another kind of result, OutputError when
    the file cannot be written (the old one stays).
    """
    template = _template()
    from casadi_engine.report.sections import page_of

    title, subtitle, sections = page_of(result, validation, dict(arguments or {}))
    budget = _Budget(FIGURE_BYTES)
    done = [_with_pictures(section, budget) for section in sections]
    content = template.render(
        title=title,
        subtitle=subtitle,
        sections=done,
        css=_packaged("page.css"),
        footer=f"Written by casadi-engine {casadi_engine.__version__} on "
        f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC.",
    )
    return write_file(path, content.encode())


class _Budget:
    """What the figures of a page may still take."""

    def __init__(self, left: int):
        self.left = left

    def take(self, source: str) -> bool:
        if len(source) > self.left:
            return False
        self.left -= len(source)
        return True


def _with_pictures(section: Section, budget: _Budget) -> Section:
    pictures, lines = [], list(section.lines)
    missing = 0
    for result, name, caption in section.wanted:
        picture = None if missing else _picture(result, name, caption)
        if picture is not None and budget.take(picture.source):
            pictures.append(picture)
        else:
            missing += 1
    if missing:
        lines.append(
            f"{missing} figures are left out to keep this file small: ce.plot(result, what=...) draws them."
        )
    return Section(
        **{**{key: getattr(section, key) for key in section.__dataclass_fields__}, "wanted": ()}
        | {"pictures": pictures, "lines": lines}
    )


def _picture(result: Any, name: str, caption: str) -> Picture:
    with styled():
        figure = figures(result)[name]()
    content, kind = drawn(figure, "svg"), "svg+xml"
    if len(content) > VECTOR_BYTES:
        content, kind = drawn(figure, "png", dpi=120), "png"
    source = f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
    return Picture(source, caption, small=figure.get_figwidth() < 9)


@cache
def _packaged(name: str) -> str:
    return files("casadi_engine.report").joinpath(name).read_text(encoding="utf-8")


def _template() -> Any:
    try:
        import jinja2
    except ImportError:
        raise MissingDependencyError(
            "report.html needs the package jinja2",
            seen="it is not installed",
            cure='pip install "casadi-engine[app]"',
        ) from None
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(_packaged("page.html"))
