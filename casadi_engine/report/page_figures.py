"""Sketches as the figures of a page: static pictures, and beside them the numbers that a browser draws and zooms."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

from casadi_engine.report.charts import Numbers, as_json, chart
from casadi_engine.report.colours import css
from casadi_engine.report.sketch import Mark, Panel, Sketch
from casadi_engine.report.svg import svg

# Pixels across a page, and between two panels; narrower sketches are as wide as so many pixels an inch.
PAGE, GAP, INCH = 960, 14, 106
FULL = 9.0


class PageFigures:
    """The figures of one page, and how many bytes they may still take."""

    def __init__(self, left: int):
        self.left = left
        self.numbers = Numbers()
        self.charts: list[dict[str, Any]] = []

    def html(self, sketch: Sketch, caption: str) -> str | None:
        """The HTML of a figure; None if the page has no more room for it."""
        if not self.left:
            return None
        width = PAGE if sketch.width >= FULL else round(INCH * sketch.width)
        before = len(self.charts), len(self.numbers.entries)
        columns = _shares(sketch.across, sketch.grid[1])
        notes: dict[str, None] = {}
        made = [self._panel(sketch, panel, width, notes) for panel in sketch.panels]
        words = "; ".join([caption, *([sketch.foot] if sketch.foot else []), *notes])
        template = " ".join(f"minmax(0,{share:g}fr)" for share in columns)
        figure = (
            f'<figure><div class="panels" style="grid-template-columns:{template};max-width:{width}px">{"".join(made)}'
            f"</div><figcaption>{html.escape(words)}</figcaption></figure>"
        )
        size = len(figure) + sum(len(str(one)) for one in self.numbers.entries[before[1] :])
        if size > self.left:
            del self.charts[before[0] :], self.numbers.entries[before[1] :]
            self.left = 0  # what comes later is left out too: figures are dropped from the end of a page
            return None
        self.left -= size
        return figure

    def json(self) -> dict[str, str]:
        """The numbers and the charts, as they stand in script elements; empty without charts."""
        if not self.charts:
            return {"numbers": "", "charts": ""}
        return {"numbers": as_json(self.numbers.entries), "charts": as_json(self.charts)}

    def _panel(self, sketch: Sketch, panel: Panel, width: int, notes: dict[str, None]) -> str:
        across = _shares(sketch.across, sketch.grid[1])
        down = _shares(sketch.down, sketch.grid[0])
        cells = panel.columns.stop - panel.columns.start
        share = sum(across[panel.columns]) / sum(across)
        wide = share * (width - GAP * (len(across) - 1)) + GAP * (cells - 1)
        tall = sum(down[panel.rows]) / sum(down) * width * sketch.height / sketch.width
        found, note = chart(panel, self.numbers)
        live = ""
        if found is not None:
            live = f' data-chart="{len(self.charts)}" data-height="{tall:.0f}"'
            self.charts.append(found)
        if note:
            notes[note] = None
        cell = (panel.rows.start + 1, panel.columns.start + 1, panel.rows.stop + 1, panel.columns.stop + 1)
        area = " / ".join(map(str, cell))
        head = f"<b>{html.escape(panel.title)}</b>{_key(panel)}"
        return (
            f'<div class="panel" style="grid-area:{area}"><div class="head">{head}</div>'
            f'<div class="plot{" wide" if wide > 500 else ""}"{live}>{svg(panel, round(wide), round(tall))}</div>'
            f"{'<output></output>' if live else ''}</div>"
        )


def _shares(given: Sequence[float] | None, count: int) -> list[float]:
    return [1.0] * count if given is None else list(given)


def _key(panel: Panel) -> str:
    """The names of what is drawn, each with a sample of its look."""
    known: dict[str, Mark] = {}
    for mark in panel.marks:
        label = mark.style.get("label")
        if label and mark.kind != "imshow":
            known.setdefault(label, mark)
    return "".join(
        f'<span><i class="{_sample(mark)}" style="--c:{css(mark.style.get("color", "black"))}"></i>'
        f"{html.escape(label)}</span>"
        for label, mark in known.items()
    )


def _sample(mark: Mark) -> str:
    if mark.kind in ("fill_between", "axhspan", "axvspan", "bar", "barh"):
        return "filled"
    form = mark.values[2] if mark.kind == "plot" else ""
    if mark.kind == "errorbar" or (form and "-" not in form):
        return "dot"
    return "dashed" if mark.style.get("linestyle") in ("--", ":") else "line"
