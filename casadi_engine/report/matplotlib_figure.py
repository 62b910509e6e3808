"""Sketches drawn with matplotlib's object interface (no display is needed)."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.report.envelope import ascending, envelope
from casadi_engine.report.sketch import Array, Mark, Panel, Sketch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLE: dict[str, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "svg.hashsalt": "casadi-engine",
    "figure.facecolor": "white",
    "axes.facecolor": "white",
}
# More single dots than this are stored as pixels: as paths they would make a vector figure of megabytes.
DOTS = 400
# Width of a character as a share of the font size; inches that numbers beside a panel, and handles of a key, take.
_CHARACTER, _BESIDE, _HANDLE = 0.55, 0.6, 0.5
# Maps of more rows than this have no numbers in their cells.
NUMBERED = 16


@contextmanager
def styled() -> Iterator[None]:
    """Our sizes over matplotlib's defaults: a report must not depend on the user's settings."""
    import matplotlib
    import matplotlib.style

    with matplotlib.style.context("default"), matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        yield


def drawn(figure: Figure, form: str, *, dpi: int = 110) -> bytes:
    """The file of a figure; the same figure gives the same bytes."""
    stream = io.BytesIO()
    metadata: dict[str, Any] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(form, {})
    with styled():
        figure.savefig(stream, format=form, dpi=dpi, metadata=metadata)
    return stream.getvalue()


def figure_of(sketch: Sketch) -> Figure:
    """The matplotlib Figure of a sketch."""
    from matplotlib.figure import Figure

    with styled():
        figure = Figure(figsize=(sketch.width, sketch.height), layout="constrained")
        grid = figure.add_gridspec(*sketch.grid, width_ratios=sketch.across, height_ratios=sketch.down)
        for panel in sketch.panels:
            ax = figure.add_subplot(grid[panel.rows, panel.columns])
            _draw(ax, panel, _inches(sketch, panel))
            if sketch.grid[1] > 2 and panel.xscale == "linear" and panel.xnames is panel.xticks is None:
                ax.locator_params(axis="x", nbins=4)
        if sketch.key:
            _one_key(figure)
        if sketch.foot:
            figure.supxlabel(sketch.foot, fontsize=9)
    return figure


def _inches(sketch: Sketch, panel: Panel) -> float:
    """The width of a panel [in], about."""
    shares = np.ones(sketch.grid[1]) if sketch.across is None else np.asarray(sketch.across, dtype=float)
    return sketch.width * float(shares[panel.columns].sum() / shares.sum())


def _wrapped(words: str, inches: float, size: float) -> str:
    """Words in lines that go into so many inches at a font size [pt]: what is wider than its panel has no place."""
    most = max(int(72 * inches / (_CHARACTER * size)), 16)
    return "\n".join(line for part in words.split("\n") for line in textwrap.wrap(part, most) or [""])


def _one_key(figure: Figure) -> None:
    """The names of the lines of all panels, each once, above them."""
    known: dict[str, Any] = {}
    for ax in figure.axes:
        handles, labels = ax.get_legend_handles_labels()
        known |= {label: handle for handle, label in zip(handles, labels, strict=True) if label not in known}
    if known:
        figure.legend(list(known.values()), list(known), loc="outside upper right", ncols=4, frameon=False)


def _draw(ax: Axes, panel: Panel, inches: float) -> None:
    scales = {"x": panel.xscale, "y": panel.yscale}
    for axis, scale in scales.items():
        if scale != "linear":
            bend = {"linthresh": panel.threshold} if scale == "symlog" else {}
            getattr(ax, f"set_{axis}scale")(scale, **bend)
    for mark in panel.marks:
        _add(ax, mark)
    if any(mark.kind != "imshow" for mark in panel.marks):
        ax.set_xlim(*panel.limits("x"))
        low, high = panel.limits("y")
        ax.set_ylim(low, high + panel.room * (high - low))
        ax.grid(True, color="0.92", linewidth=0.6)
        for side in ("top", "right"):
            ax.spines[side].set_visible(False)
    if panel.flipped:
        ax.invert_yaxis()
    _ticks(ax, panel, scales)
    ax.set_axisbelow(True)
    names = max((len(name) for name in panel.ynames[1]), default=0) if panel.ynames is not None else 0
    inside = inches - _BESIDE - _CHARACTER * STYLE["font.size"] * names / 72
    ax.set_xlabel(_wrapped(panel.x, inside, STYLE["axes.labelsize"]))
    ax.set_ylabel(panel.y)
    ax.set_title(_wrapped(panel.title, inside, STYLE["axes.titlesize"]), loc="left")
    if panel.key and panel.labels:
        _key(ax, panel, inside)


def _key(ax: Axes, panel: Panel, inches: float) -> None:
    """The names of a panel's lines: inside it they take no part in the layout, else a long one leaves no panel."""
    place: dict[str, Any] = {"loc": panel.key, "frameon": False}
    if panel.key == "center left":
        ax.legend(bbox_to_anchor=(1.0, 0.5), **place)
        return
    handles, names = ax.get_legend_handles_labels()
    names = [_wrapped(name, inches - _HANDLE, STYLE["legend.fontsize"]) for name in names]
    ax.legend(handles, names, **place).set_in_layout(False)


def _ticks(ax: Axes, panel: Panel, scales: dict[str, str]) -> None:
    from matplotlib.ticker import FixedLocator, FuncFormatter, LogFormatter, NullLocator

    for axis, names in ((ax.xaxis, panel.xnames), (ax.yaxis, panel.ynames)):
        scale = scales[axis.axis_name]
        if names is not None:
            axis.set_ticks(*names)
        elif axis is ax.xaxis and panel.xticks is not None:
            axis.set_major_locator(FixedLocator(panel.xticks))
            axis.set_minor_locator(NullLocator())
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        elif scale == "log":  # powers set as formulas take half of the time of a figure
            axis.set_major_formatter(LogFormatter())
            axis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.5)))
        elif scale == "linear":
            axis.get_major_formatter().set_useOffset(False)  # type: ignore[attr-defined]
    if panel.xnames is not None and len("".join(panel.xnames[1])) > 40:
        ax.tick_params(axis="x", labelsize=7, labelrotation=90 if panel.tilted else 35)
    if panel.note:
        words = "\n".join(textwrap.wrap(panel.note, 42))
        ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", va="center", color="0.3", fontsize=8)
        ax.set_xticks([])
        ax.set_yticks([])


def _add(ax: Axes, mark: Mark) -> None:
    style = dict(mark.style)
    values = mark.values
    if mark.kind == "write":
        _write(ax, values, style)
    elif mark.kind == "plot":
        x, y, form = values
        if form and "-" not in form:
            style["rasterized"] = x.size > DOTS
        elif ascending(x):
            x, y = envelope(x, y)
        ax.plot(x, y, *([form] if form else []), **style)
    elif mark.kind == "imshow":
        _map(ax, values[0], style["label"])
    else:
        getattr(ax, mark.kind)(*values, **style)


def _write(ax: Axes, values: tuple[Any, ...], style: dict[str, Any]) -> None:
    x, y, words = values
    box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}
    behind: dict[str, Any] = {"bbox": box} if style.get("clear") else {}
    places: Any = ("axes fraction" if style.get("inside") else "data", "data")
    ax.annotate(
        words, (x, y), style.get("shift", (0, 0)), xycoords=places,
        textcoords="offset points", ha=style.get("ha", "left"), va=style.get("va", "baseline"),
        fontsize=style.get("size", 8), color=style.get("color", "black"), **behind,
    )  # fmt: skip


def _map(ax: Axes, values: Array, label: str) -> None:
    """A map of numbers from -1 to 1, grey where there is none."""
    ax.set_facecolor("0.93")
    image = ax.imshow(np.ma.masked_invalid(values), vmin=-1, vmax=1, cmap="RdBu_r", interpolation="nearest")
    figure: Any = ax.figure
    figure.colorbar(image, ax=ax, label=label)
    for (i, j), value in np.ndenumerate(values) if len(values) <= NUMBERED else ():
        if np.isfinite(value):
            colour = "white" if abs(value) > 0.6 else "black"
            size = 8 if len(values) < 9 else 6
            ax.text(
                j, i, f"{round(value, 2) + 0.0:.2f}", ha="center", va="center", fontsize=size, color=colour
            )
