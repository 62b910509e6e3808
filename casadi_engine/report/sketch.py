"""What a figure shows, as numbers and words: drawn by matplotlib for `plot`, as SVG and by a browser for pages.

A panel takes marks by the names and styles of matplotlib's methods, of which it knows a few; nothing is drawn here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Axis = Literal["x", "y"]
Limits = tuple[float, float]

# Free space around the data, as a share of their range.
MARGIN = 0.05


@dataclass(frozen=True, eq=False)
class Mark:
    """One thing in a panel.

    kind : plot, axhline, axvline, axhspan, axvspan, fill_between, vlines, errorbar, bar, barh, imshow, write
    values : its numbers (and, for write, its words).  style : by the names of matplotlib
    """

    kind: str
    values: tuple[Any, ...]
    style: Mapping[str, Any]

    def reach(self, axis: Axis) -> list[Any]:
        """Numbers that the axis has to hold."""
        v, upright = self.values, axis == "y"
        match self.kind:
            case "plot":
                return [v[upright]]
            case "errorbar":
                error = self.style.get(f"{axis}err")
                return [v[upright]] if error is None else [v[upright] - error, v[upright] + error]
            case "axhline" | "axhspan":
                return list(v) if upright else []
            case "axvline" | "axvspan":
                return [] if upright else list(v)
            case "fill_between" | "vlines":
                return [v[1], v[2]] if upright else [v[0]]
            case "bar" | "barh":
                if (self.kind == "bar") == upright:
                    return [0.0, v[1]]
                half = 0.5 * v[2]
                return [v[0] - half, v[0] + half]
            case "imshow":
                return [-0.5, len(v[0]) - 0.5]
        return []


@dataclass(eq=False)
class Panel:
    """Axes with what stands in them.

    x, y, title : words.  xscale, yscale : "linear", "log" or "symlog", linear up to ``threshold``
    xlim, ylim : limits; None, or None for an end, leaves them to the data.  flipped : y grows downwards
    xnames, ynames : (places, names) in place of numbers.  xticks : places of the numbers
    note : why there is nothing to see.  key : where matplotlib puts the names of the lines, None for nowhere
    room : free space above for that key, as a share of the height; a page has its key elsewhere
    margin : free space left and right, as a share of the data's range.  tilted : names along x stand upright
    linked : panels of a page with the same word are zoomed together
    """

    rows: slice
    columns: slice
    x: str = ""
    y: str = ""
    title: str = ""
    xscale: str = "linear"
    yscale: str = "linear"
    threshold: float = 1.0
    xlim: tuple[float | None, float | None] | None = None
    ylim: tuple[float | None, float | None] | None = None
    flipped: bool = False
    xnames: tuple[Sequence[float], Sequence[str]] | None = None
    ynames: tuple[Sequence[float], Sequence[str]] | None = None
    xticks: Sequence[float] | None = None
    note: str = ""
    key: str | None = None
    room: float = 0.0
    margin: float = MARGIN
    tilted: bool = False
    linked: str = ""
    marks: list[Mark] = field(default_factory=list)

    def _add(self, kind: str, *values: Any, **style: Any) -> None:
        self.marks.append(Mark(kind, values, style))

    def plot(self, x: Any, y: Any, fmt: str = "", **style: Any) -> None:
        """A line or, with a marker in ``fmt`` and no "-", points."""
        self._add(
            "plot", np.atleast_1d(np.asarray(x, float)), np.atleast_1d(np.asarray(y, float)), fmt, **style
        )

    def errorbar(self, x: Any, y: Any, *, fmt: str = "o", **style: Any) -> None:
        """Points with intervals: xerr or yerr is half of one."""
        numbers = (np.atleast_1d(np.asarray(one, float)) for one in (x, y))
        self._add("errorbar", *numbers, fmt=fmt, **style)

    def axhline(self, y: float, **style: Any) -> None:
        self._add("axhline", float(y), **style)

    def axvline(self, x: float, **style: Any) -> None:
        self._add("axvline", float(x), **style)

    def axhspan(self, low: float, high: float, **style: Any) -> None:
        self._add("axhspan", float(low), float(high), **style)

    def axvspan(self, low: float, high: float, **style: Any) -> None:
        self._add("axvspan", float(low), float(high), **style)

    def fill_between(self, x: Any, low: Any, high: Any = 0.0, **style: Any) -> None:
        """A band; ``high`` may be one number."""
        at = np.asarray(x, float)
        self._add("fill_between", at, np.asarray(low, float), np.broadcast_to(high, at.shape), **style)

    def vlines(self, x: Any, low: Any, high: Any, **style: Any) -> None:
        at = np.asarray(x, float)
        self._add(
            "vlines", at, *(np.broadcast_to(np.asarray(end, float), at.shape) for end in (low, high)), **style
        )

    def bar(self, at: Any, length: Any, width: float, **style: Any) -> None:
        self._add(
            "bar",
            np.atleast_1d(np.asarray(at, float)),
            np.atleast_1d(np.asarray(length, float)),
            width,
            **style,
        )

    def barh(self, at: Any, length: Any, width: float, **style: Any) -> None:
        self._add(
            "barh",
            np.atleast_1d(np.asarray(at, float)),
            np.atleast_1d(np.asarray(length, float)),
            width,
            **style,
        )

    def imshow(self, values: Array, *, label: str) -> None:
        """A square map of numbers from -1 to 1; ``label`` says what its colours mean."""
        self._add("imshow", np.asarray(values, float), label=label)

    def write(self, words: str, x: float, y: float, **style: Any) -> None:
        """Words at a place.

        shift : (right, up) in points.  ha : left, center.  size, color : of the letters
        inside : x is a share of the width.  clear : hide what is behind
        """
        self._add("write", float(x), float(y), words, **style)

    @property
    def labels(self) -> list[str]:
        """Names of what is drawn, for a key."""
        return [
            mark.style["label"] for mark in self.marks if mark.style.get("label") and mark.kind != "imshow"
        ]

    def limits(self, axis: Axis) -> Limits:
        """Ends of an axis: the given ones, else those of the data with a margin."""
        given = (self.xlim if axis == "x" else self.ylim) or (None, None)
        margin = self.margin if axis == "x" else MARGIN
        reach, scale = self._reach(axis), self._scale(axis)
        standing = any(mark.kind == ("barh" if axis == "x" else "bar") for mark in self.marks)
        if standing and given[0] is None and scale == "linear" and reach is not None and reach[0] == 0:
            given = (0.0, given[1])  # bars stand on their axis
        return _ends(reach, given, scale, self.threshold, margin)

    def _scale(self, axis: Axis) -> str:
        return self.xscale if axis == "x" else self.yscale

    def _reach(self, axis: Axis) -> Limits | None:
        """Smallest and largest number; None without any."""
        low, high = math.inf, -math.inf
        for mark in self.marks:
            for part in mark.reach(axis):
                numbers = np.asarray(part, float)
                good = np.isfinite(numbers) & ((numbers > 0) if self._scale(axis) == "log" else True)
                if good.any():
                    low, high = min(low, float(numbers[good].min())), max(high, float(numbers[good].max()))
        return (low, high) if low <= high else None


def forward(values: Any, scale: str, threshold: float = 1.0) -> Array:
    """Numbers as lengths along an axis; what a logarithm cannot take becomes NaN."""
    numbers = np.asarray(values, float)
    if scale == "linear":
        return numbers
    with np.errstate(divide="ignore", invalid="ignore"):
        if scale == "log":
            return np.where(numbers > 0, np.log10(np.where(numbers > 0, numbers, 1.0)), np.nan)
        size = np.abs(numbers) / threshold
        return np.sign(numbers) * np.where(size <= 1, size, 1 + np.log10(np.maximum(size, 1.0)))


def _back(length: float, scale: str, threshold: float) -> float:
    if scale == "linear":
        return length
    if scale == "log":
        return float(10.0**length)
    size = abs(length)
    return math.copysign(threshold * (size if size <= 1 else 10 ** (size - 1)), length)


def _ends(
    reach: Limits | None,
    given: tuple[float | None, float | None],
    scale: str,
    threshold: float,
    margin: float,
) -> Limits:
    low, high = reach or ((0.1, 1.0) if scale == "log" else (0.0, 1.0))
    first, last = (float(forward(end, scale, threshold)) for end in (low, high))
    spare = margin * (last - first) or max(0.05 * abs(first), 0.05 if scale == "linear" else 0.5)
    made = tuple(
        _back(place, scale, threshold) if end is None else end
        for end, place in zip(given, (first - spare, last + spare), strict=True)
    )
    return (made[0], made[1]) if made[0] < made[1] else (made[0], made[0] + 1.0)


@dataclass(eq=False)
class Sketch:
    """A figure: panels in the cells of a grid.

    width, height : inches.  grid : rows and columns.  across, down : relative widths and heights of them
    key : the names of the lines of all panels stand together above.  foot : words beneath
    """

    width: float
    height: float
    grid: tuple[int, int] = (1, 1)
    across: Sequence[float] | None = None
    down: Sequence[float] | None = None
    key: bool = False
    foot: str = ""
    panels: list[Panel] = field(default_factory=list)

    def panel(self, row: int = 0, column: int = 0, *, rows: int = 1, columns: int = 1) -> Panel:
        """A new panel in a cell, or over several."""
        made = Panel(slice(row, row + rows), slice(column, column + columns))
        self.panels.append(made)
        return made

    def cells(self) -> Iterator[Panel]:
        """A new panel for each cell, row by row, as they are asked for."""
        for row in range(self.grid[0]):
            for column in range(self.grid[1]):
                yield self.panel(row, column)
