"""Panels of a sketch as static SVG, thinned to what a pixel can show: what a page holds where no script runs."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.report.colours import DASHES, css, shade
from casadi_engine.report.envelope import ascending, envelope
from casadi_engine.report.matplotlib_figure import NUMBERED
from casadi_engine.report.sketch import Array, Axis, Limits, Mark, Panel, forward
from casadi_engine.report.ticks import tick_words, ticks

# Coordinates inside a panel are whole tenths of a pixel.
FINE = 10
# Width of a letter and height of a line, in pixels.
LETTER, LINE = 6.9, 14
# Names that stand upright beneath a panel have at most so many pixels.
UPRIGHT = 240
# Free pixels at the right, for half of the last number.
RIGHT = 20.0
# Corners of markers in units of their size; one that is not closed is drawn by its lines.
_CORNERS: dict[str, list[tuple[float, float]]] = {
    "D": [(0, -0.7), (0.7, 0), (0, 0.7), (-0.7, 0)],
    "^": [(0, -0.55), (0.55, 0.5), (-0.55, 0.5)],
    "v": [(0, 0.55), (0.55, -0.5), (-0.55, -0.5)],
    "<": [(-0.55, 0), (0.5, -0.55), (0.5, 0.55)],
    ">": [(0.55, 0), (-0.5, -0.55), (-0.5, 0.55)],
}


@dataclass(frozen=True)
class _Frame:
    """Where a panel's data stand: the pixels of its inner field, and its limits."""

    panel: Panel
    left: float
    top: float
    width: float
    height: float
    x: Limits
    y: Limits

    def along(self, axis: Axis, values: Any) -> Array:
        """Tenths of pixels from the left or the top of the field; NaN where there is no place."""
        scale = self.panel.xscale if axis == "x" else self.panel.yscale
        first, last = forward(self.x if axis == "x" else self.y, scale, self.panel.threshold)
        share = (forward(values, scale, self.panel.threshold) - first) / (last - first)
        if axis == "x":
            return np.asarray(FINE * self.width * share)
        return np.asarray(FINE * self.height * (share if self.panel.flipped else 1 - share))


def svg(panel: Panel, width: float, height: float) -> str:
    """The SVG element of a panel of so many pixels; its title and key stand outside."""
    frame = _framed(panel, width, height)
    back = [part for mark in panel.marks if _behind(mark) for part in _drawn(frame, mark)]
    front = [part for mark in panel.marks if not _behind(mark) for part in _drawn(frame, mark)]
    inner = (
        f'<svg x="{frame.left:g}" y="{frame.top:g}" width="{frame.width:g}" height="{frame.height:g}" '
        f'viewBox="0 0 {FINE * frame.width:g} {FINE * frame.height:g}" preserveAspectRatio="none">'
    )
    words = html.escape(f"{panel.title}: {panel.y} over {panel.x}".replace("\n", " "))
    square = any(mark.kind == "imshow" for mark in panel.marks)
    body = [inner, *back, "" if square or panel.note else _lines(frame), *front, "</svg>"]
    return (
        f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{words}">'
        + "".join(body) + "".join(_outside(frame)) + "</svg>"
    )  # fmt: skip


def _behind(mark: Mark) -> bool:
    return mark.kind in ("axhspan", "axvspan", "fill_between", "imshow")


def _framed(panel: Panel, width: float, height: float) -> _Frame:
    limits = panel.limits("x"), panel.limits("y")
    square = any(mark.kind == "imshow" for mark in panel.marks)
    beside, below = _labels(panel, "y", limits[1], height), _labels(panel, "x", limits[0], width)
    letters = max((len(words) for _, words in beside), default=0)
    letters = (
        max(letters, 6) if panel.linked else letters
    )  # panels over one time stand exactly beneath each other
    left = min(LETTER * letters + 14, 0.5 * width) + (LINE + 4 if panel.y else 0)
    under = (
        LINE + 6 if not _slanted(panel) else min(max(len(words) for _, words in below) * LETTER, UPRIGHT) + 8
    )
    bottom = under + (LINE + 4 if panel.x else 0)
    right, top = (100.0 if square else RIGHT), 8.0
    inner = (max(width - left - right, 20.0), max(height - top - bottom, 20.0))
    if square:
        inner = (min(inner), min(inner))
        ends = (-0.5, len(panel.marks[0].values[0]) - 0.5)
        limits = (ends, ends[::-1])
    return _Frame(panel, left, top, *inner, *limits)


def _slanted(panel: Panel) -> bool:
    return panel.xnames is not None and len("".join(panel.xnames[1])) > 40


def _labels(panel: Panel, axis: Axis, limits: Limits, length: float) -> list[tuple[float, str]]:
    """(place, words) along an axis."""
    names, scale = (panel.xnames, panel.xscale) if axis == "x" else (panel.ynames, panel.yscale)
    if panel.note:
        return []
    if names is not None:
        return [(float(place), name) for place, name in zip(*names, strict=True)]
    places = [float(one) for one in panel.xticks or ()] if axis == "x" and panel.xticks is not None else None
    if places is None:
        most = max(4, int(length / 70)) if axis == "x" else max(5, int(length / 32))
        places = ticks(limits, scale, most=most, threshold=panel.threshold)
    return list(zip(places, tick_words(places), strict=True))


# ---- axes ---------------------------------------------------------------------------------------------


def _lines(frame: _Frame) -> str:
    """The light grid."""
    wide, tall = round(FINE * frame.width), round(FINE * frame.height)
    made = [f"M{x} 0V{tall}" for x, _ in _placed(frame, "x")] + [
        f"M0 {y}H{wide}" for y, _ in _placed(frame, "y")
    ]
    return f'<path class="grid" d="{"".join(made)}"/>'


def _placed(frame: _Frame, axis: Axis) -> list[tuple[int, str]]:
    limits, length = (frame.x, frame.width) if axis == "x" else (frame.y, frame.height)
    there = _labels(frame.panel, axis, limits, length)
    places = frame.along(axis, [place for place, _ in there])
    inside = [
        (round(float(at)), words) for at, (_, words) in zip(places, there, strict=True) if np.isfinite(at)
    ]
    return [(at, words) for at, words in inside if -1 <= at <= FINE * length + 1]


def _apart(labels: list[tuple[int, str]], *, slanted: bool) -> list[tuple[int, str]]:
    """Words along x without those that would run into the ones before them."""
    found: list[tuple[int, str]] = []
    for at, words in labels:
        wide = LETTER * (len(words) + len(found[-1][1])) / 2 + 4 if found else 0.0
        if slanted or not found or at - found[-1][0] >= FINE * wide:
            found.append((at, words))
    return found


def _outside(frame: _Frame) -> Iterator[str]:
    """Axis lines, numbers and labels around the field."""
    panel, left, top = frame.panel, frame.left, frame.top
    right, bottom = left + frame.width, top + frame.height
    yield f'<path class="axis" d="M{left:g} {top:g}V{bottom:g}H{right:g}"/>'
    for at, words in _apart(_placed(frame, "x"), slanted=_slanted(panel)):
        yield _tick(left + at / FINE, bottom + LINE, words, slanted=_slanted(panel))
    for at, words in _placed(frame, "y"):
        yield f'<text class="end" x="{left - 6:g}" y="{top + at / FINE + 4:g}">{html.escape(words)}</text>'
    if panel.x:
        low = bottom + _below(frame)
        room = right + RIGHT
        long = min(LETTER * len(panel.x), room - 4)
        middle = min(max((left + right) / 2, 2 + long / 2), room - 2 - long / 2)
        fitted = (
            f' textLength="{long:g}" lengthAdjust="spacingAndGlyphs"' if LETTER * len(panel.x) > long else ""
        )
        yield f'<text class="mid" x="{middle:g}" y="{low:g}"{fitted}>{html.escape(panel.x)}</text>'
    if panel.y:
        place = f"translate({LINE - 2} {(top + bottom) / 2:g}) rotate(-90)"
        yield f'<text class="mid" transform="{place}">{html.escape(panel.y.replace(chr(10), " "))}</text>'
    for mark in panel.marks:
        if mark.kind == "imshow":
            yield _scale_of_map(right + 12, top, frame.height, mark.style["label"])
    for k, line in enumerate(textwrap.wrap(panel.note, 42)):
        middle = (top + bottom) / 2 + LINE * k
        yield f'<text class="mid" x="{(left + right) / 2:g}" y="{middle:g}">{html.escape(line)}</text>'


def _below(frame: _Frame) -> float:
    longest = max((len(words) for _, words in _placed(frame, "x")), default=0)
    return (min(longest * LETTER, UPRIGHT) + 8 if _slanted(frame.panel) else LINE + 6) + LINE


def _tick(x: float, y: float, words: str, *, slanted: bool) -> str:
    if slanted:
        return f'<text class="end" transform="translate({x + 4:g} {y - 6:g}) rotate(-90)">{html.escape(words)}</text>'
    return f'<text class="mid" x="{x:g}" y="{y + 2:g}">{html.escape(words)}</text>'


# ---- marks --------------------------------------------------------------------------------------------


def _drawn(frame: _Frame, mark: Mark) -> list[str]:
    values, style = mark.values, mark.style
    colour = css(style.get("color", "black"))
    wide, tall = FINE * frame.width, FINE * frame.height
    stroke = _stroke(colour, style.get("linewidth", 1.0), style.get("linestyle", ""))
    match mark.kind:
        case "axhline" | "axvline":
            at = float(frame.along("y" if mark.kind == "axhline" else "x", values[0]))
            line = f"M0 {at:.0f}H{wide:.0f}" if mark.kind == "axhline" else f"M{at:.0f} 0V{tall:.0f}"
            return [f'<path d="{line}" {stroke}/>'] if np.isfinite(at) else []
        case "axhspan" | "axvspan":
            ends = np.sort(frame.along("y" if mark.kind == "axhspan" else "x", values))
            box = (
                (0, ends[0], wide, np.ptp(ends))
                if mark.kind == "axhspan"
                else (ends[0], 0, np.ptp(ends), tall)
            )
            return [_box(box, colour)]
        case "fill_between":
            return _band(frame, mark, colour)
        case "bar" | "barh":
            return _bars(frame, mark, colour)
        case "vlines":
            x, y = frame.along("x", [values[0], values[0]]), frame.along("y", values[1:])
            return [f'<path d="{_pieces(x.T, y.T)}" {stroke}/>']
        case "plot":
            return _line(frame, values, style, colour)
        case "errorbar":
            return _errors(frame, mark, stroke) + _line(frame, (*values, style["fmt"]), style, colour)
        case "imshow":
            return _cells(frame, values[0])
    return _words(frame, mark)


def _stroke(colour: str, width: float, dash: str) -> str:
    broken = (
        f";stroke-dasharray:{' '.join(f'{FINE * one:g}' for one in DASHES[dash])}" if dash in DASHES else ""
    )
    return f'style="fill:none;stroke:{colour};stroke-width:{FINE * max(1.2 * width, 0.8):.0f}{broken}"'


def _box(box: Any, colour: str) -> str:
    x, y, width, height = box
    return f'<rect x="{x:.0f}" y="{y:.0f}" width="{width:.0f}" height="{height:.0f}" style="fill:{colour}"/>'


def _line(frame: _Frame, values: tuple[Any, ...], style: Any, colour: str) -> list[str]:
    x, y, form = values
    if ascending(x):
        x, y = envelope(x, y, bins=max(int(frame.width), 1))
    across, down = frame.along("x", x), frame.along("y", y)
    made = []
    marker = form.strip("-")
    if marker == form == "" or "-" in form:
        path = _path(across, down)
        made.append(
            f'<path d="{path}" {_stroke(colour, style.get("linewidth", 1.2), style.get("linestyle", ""))}/>'
        )
    if marker:
        size = style.get("markersize", 5.0) * (0.75 if marker == "." else 1.3)
        made += _markers(across, down, marker, size, colour, hollow=style.get("markerfacecolor") == "none")
    return made


def _path(x: Array, y: Array) -> str:
    """A line through points in whole tenths of a pixel, broken where one is missing."""
    good = np.isfinite(x) & np.isfinite(y)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]])))
    points = np.stack([x, y], axis=1)
    return "".join(
        "M"
        + " ".join(map(str, np.rint(points[a:b]).astype(int).ravel().tolist()))
        + ("h0" if b - a == 1 else "")
        for a, b in edges.reshape(-1, 2)
    )


def _pieces(x: Array, y: Array) -> str:
    """Separate lines: (N, 2) places."""
    return "".join(_path(*one) for one in zip(x, y, strict=True))


def _markers(x: Array, y: Array, marker: str, size: float, colour: str, *, hollow: bool) -> list[str]:
    good = np.isfinite(x) & np.isfinite(y)
    places: NDArray[np.int_] = np.rint(np.stack([x[good], y[good]], axis=1)).astype(int)
    if len(places) > 500:  # dots on one pixel are one
        places = np.unique(places // FINE, axis=0) * FINE
    round_, s = marker in "o.s", FINE * size
    if round_ and not hollow:
        cap = "square" if marker == "s" else "round"
        path = "".join(f"M{a} {b}h0" for a, b in places.tolist())
        return [f'<path d="{path}" style="stroke:{colour};stroke-width:{s:.0f};stroke-linecap:{cap}"/>']
    fill = "none" if hollow or marker in "x|" else colour
    look = f'style="fill:{fill};stroke:{colour};stroke-width:{1.2 * FINE:.0f}"'
    if round_:
        return [f'<circle cx="{a}" cy="{b}" r="{s / 2:.0f}" {look}/>' for a, b in places.tolist()]
    h = 0.5 * s
    if marker == "|":
        shape = f"m0 {-h:.0f}v{s:.0f}"
    elif marker in _CORNERS:
        corners = np.rint(s * np.diff([(0, 0), *_CORNERS[marker]], axis=0)).astype(int)
        shape = "".join(f"{'m' if k == 0 else 'l'}{a} {b}" for k, (a, b) in enumerate(corners.tolist())) + "z"
    else:
        shape = f"m{-h:.0f} {-h:.0f}l{s:.0f} {s:.0f}m0 {-s:.0f}l{-s:.0f} {s:.0f}"
    return [f'<path d="{"".join(f"M{a} {b}{shape}" for a, b in places.tolist())}" {look}/>']


def _errors(frame: _Frame, mark: Mark, stroke: str) -> list[str]:
    x, y = mark.values
    made = []
    for axis, error in (("x", mark.style.get("xerr")), ("y", mark.style.get("yerr"))):
        if error is not None:
            across, down = (
                np.stack([one - error, one + error] if name == axis else [one, one]).T
                for name, one in (("x", x), ("y", y))
            )
            made.append(f'<path d="{_pieces(frame.along("x", across), frame.along("y", down))}" {stroke}/>')
    return made


def _band(frame: _Frame, mark: Mark, colour: str) -> list[str]:
    x, low, high = mark.values
    if mark.style.get("step") == "mid":
        middle = 0.5 * (x[1:] + x[:-1])
        x = np.concatenate([x[:1], np.repeat(middle, 2), x[-1:]])
        low, high = np.repeat(low, 2), np.repeat(high, 2)
    elif ascending(x):
        kept = envelope(x, high, bins=max(int(frame.width), 1))[0]
        x, low, high = kept, np.interp(kept, x, low), np.interp(kept, x, high)
    across = frame.along("x", np.concatenate([x, x[::-1]]))
    path = _path(across, frame.along("y", np.concatenate([low, high[::-1]])))
    through = f";fill-opacity:{mark.style['alpha']:g}" if "alpha" in mark.style else ""
    return [f'<path d="{path}z" style="fill:{colour}{through}"/>'] if path else []


def _bars(frame: _Frame, mark: Mark, colour: str) -> list[str]:
    at, length, width = mark.values
    upright = mark.kind == "bar"
    sides = frame.along("x" if upright else "y", np.stack([at - width / 2, at + width / 2]))
    axis: Axis = "y" if upright else "x"
    ends = np.nan_to_num(frame.along(axis, np.stack([np.zeros_like(length), length])), nan=0.0)
    (a, b), (c, d) = (sides, ends) if upright else (ends, sides)
    boxes = zip(np.minimum(a, b), np.minimum(c, d), np.abs(b - a), np.abs(d - c), strict=True)
    return [_box(box, colour) for box in boxes]


def _words(frame: _Frame, mark: Mark) -> list[str]:
    x, y, words = mark.values
    style = mark.style
    right, up = style.get("shift", (0, 0))
    left = FINE * frame.width * x if style.get("inside") else float(frame.along("x", x))
    down = float(frame.along("y", y))
    if not (np.isfinite(left) and np.isfinite(down)):
        return []
    size = FINE * (style.get("size", 8) + 3)
    down += 0.35 * size if style.get("va") == "center" else 0.0
    place = f'x="{left + FINE * right:.0f}" y="{down - FINE * up:.0f}"'
    classes = (
        f"{'mid' if style.get('ha') == 'center' else ''} {'clear' if style.get('clear') else ''}".strip()
    )
    look = f"font-size:{size:g}px;fill:{css(style.get('color', 'black'))}"
    return [f'<text class="{classes}" {place} style="{look}">{html.escape(words)}</text>']


# ---- maps ---------------------------------------------------------------------------------------------


def _cells(frame: _Frame, values: Array) -> list[str]:
    side = FINE * frame.width / len(values)
    made = []
    for (i, j), value in np.ndenumerate(values):
        made.append(_box((j * side, i * side, side + 1, side + 1), shade(float(value))))
        if np.isfinite(value) and len(values) <= NUMBERED:
            colour = "#fff" if abs(value) > 0.6 else "#111"
            size = min(FINE * 12, 0.36 * side)
            place = f'x="{(j + 0.5) * side:.0f}" y="{(i + 0.5) * side + 0.35 * size:.0f}"'
            look = f"font-size:{size:.0f}px;fill:{colour}"
            made.append(f'<text class="mid" {place} style="{look}">{round(value, 2) + 0.0:.2f}</text>')
    return made


def _scale_of_map(x: float, top: float, height: float, label: str) -> str:
    steps = np.linspace(1, -1, 41)
    piece = height / len(steps)
    made = [
        f'<rect x="{x:g}" y="{top + k * piece:g}" width="12" height="{piece + 0.5:g}" style="fill:{shade(step)}"/>'
        for k, step in enumerate(steps.tolist())
    ]
    made += [
        f'<text x="{x + 17:g}" y="{top + (1 - value) / 2 * height + 4:g}">{value:g}</text>'
        for value in (1, 0.5, 0, -0.5, -1)
    ]
    place = f"translate({x + 60:g} {top + height / 2:g}) rotate(-90)"
    return "".join(made) + f'<text class="mid" transform="{place}">{html.escape(label)}</text>'
