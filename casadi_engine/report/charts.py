"""Panels of a sketch as numbers that a browser draws and zooms."""

from __future__ import annotations

import base64
import json
import math
from typing import Any

import numpy as np

from casadi_engine.report.colours import DASHES, paint
from casadi_engine.report.envelope import ascending, envelope
from casadi_engine.report.sketch import Array, Mark, Panel

# A line of a page has at most so many points, the smallest and the largest of each bin of a longer one.
MOST_POINTS = 20_000
# A panel whose longest line has fewer points shows them all as it is.
FEWEST_POINTS = 300
_STATIC = {"bar", "barh", "imshow", "errorbar", "vlines"}


class Numbers:
    """The arrays of a page, each once: evenly spaced ones by their ends, others as little-endian floats in base64."""

    def __init__(self) -> None:
        self.entries: list[Any] = []
        self._known: dict[Any, int] = {}

    def add(self, values: Array, *, exact: bool = False) -> int:
        """The number of an array in the list; ``exact`` keeps all digits, else there are seven."""
        key = (exact, values.tobytes())
        if key not in self._known:
            self._known[key] = len(self.entries)
            self.entries.append(_even(values) if exact and _is_even(values) else _packed(values, exact=exact))
        return self._known[key]


def _is_even(values: Array) -> bool:
    """Whether the values are those of an even grid, but for the rounding of a data file."""
    if values.size < 3:
        return False
    step = (values[-1] - values[0]) / (values.size - 1)
    grid = values[0] + step * np.arange(values.size)
    return bool(step > 0 and np.max(np.abs(values - grid)) <= 1e-3 * step)


def _even(values: Array) -> list[float]:
    return [float(values[0]), float(values[-1]), int(values.size)]


def _packed(values: Array, *, exact: bool) -> str:
    kind = "<f8" if exact else "<f4"
    return kind[2] + base64.b64encode(np.asarray(values).astype(kind).tobytes()).decode()


def chart(panel: Panel, numbers: Numbers) -> tuple[dict[str, Any] | None, str]:
    """What a browser needs to draw a panel, and how it was thinned; None where there is nothing to zoom into."""
    lines = [mark for mark in panel.marks if mark.kind == "plot"]
    fixed = panel.note or panel.xnames or panel.ynames or "symlog" in (panel.xscale, panel.yscale)
    if fixed or any(mark.kind in _STATIC for mark in panel.marks) or not lines:
        return None, ""
    longest = max(mark.values[0].size for mark in lines)
    if longest < FEWEST_POINTS or not all(ascending(mark.values[0]) for mark in lines):
        return None, ""
    made = {
        "x": panel.x,
        "y": panel.y.replace("\n", " "),
        "log": [panel.xscale == "log", panel.yscale == "log"],
        "limits": [*panel.limits("x"), *panel.limits("y")],
        "linked": panel.linked,
        "lines": [_line(mark, numbers) for mark in lines],
        "marks": [_other(mark, numbers) for mark in panel.marks if mark.kind != "plot"],
    }
    return made, _thinned(longest)


def _thinned(longest: int) -> str:
    if longest <= MOST_POINTS:
        return ""
    width = -(-2 * longest // MOST_POINTS)
    return f"{longest} samples, of which the smallest and the largest of each {width} are drawn"


def _line(mark: Mark, numbers: Numbers) -> dict[str, Any]:
    x, y, form = mark.values
    x, y = envelope(x, y, bins=MOST_POINTS // 2)
    style = mark.style
    marker = form.strip("-")
    return _look(mark) | {
        "x": numbers.add(x, exact=True),
        "y": numbers.add(y),
        "label": style.get("label") or "",
        "size": style.get("markersize", 5) * (1 if marker == "." else 1.3) if marker else 0,
        "joined": "-" in form or not form,
    }


def _look(mark: Mark) -> dict[str, Any]:
    style = mark.style
    return {
        "color": paint(style.get("color", "black")),
        "width": 1.2 * style.get("linewidth", 1.0),
        "dash": DASHES.get(style.get("linestyle", ""), ()),
    }


def _other(mark: Mark, numbers: Numbers) -> dict[str, Any]:
    """A line or band across, a band along a curve, or words."""
    made = _look(mark) | {"kind": mark.kind}
    if mark.kind == "write":
        x, y, words = mark.values
        style = mark.style
        place = {
            "shift": style.get("shift", (0, 0)),
            "middle": style.get("ha") == "center",
            "size": style.get("size", 8),
        }
        return made | place | {"at": [x, y], "words": words}
    if mark.kind == "fill_between":
        x, low, high = mark.values
        band = {"x": numbers.add(x, exact=True), "low": numbers.add(low), "high": numbers.add(high)}
        return made | band | {"alpha": mark.style.get("alpha", 1.0)}
    return made | {"at": [one if math.isfinite(one) else None for one in mark.values]}


def as_json(value: Any) -> str:
    """JSON that can stand in a script element: nothing in it ends the element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
