"""Figures and tables of practical identifiability: profiles, loss sweeps, expected errors, chosen experiments."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.identifiability.choice import ExperimentChoice
from casadi_engine.identifiability.fisher import Information
from casadi_engine.identifiability.practical_summary import (
    choice_text,
    information_text,
    percent,
    profile_text,
    shape,
    sweep_text,
    verdict,
)
from casadi_engine.identifiability.profile import Profile, ProfileLine
from casadi_engine.identifiability.sweep import LossSweep
from casadi_engine.report import panels
from casadi_engine.report.figures import Maker, _new, figures
from casadi_engine.report.tables import as_html, table, text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ACROSS = 3
# Curves are drawn up to this many thresholds, so that the interval fills the panel.
_HEIGHT = 2.2


# ---- figures ------------------------------------------------------------------------------------------


@figures.register
def _(result: Profile) -> dict[str, Maker]:
    made: dict[str, Maker] = {"overview": lambda: _grid(list(result.lines), partial(_profile_at, result))}
    made |= {f"profile {name}": partial(_grid, [name], partial(_profile_at, result)) for name in result.lines}
    made |= {
        f"along {name}": partial(_along_figure, line) for name, line in result.lines.items() if line.others
    }
    return made


@figures.register
def _(result: LossSweep) -> dict[str, Maker]:
    made: dict[str, Maker] = {"overview": lambda: _grid(list(result.values), partial(_sweep_at, result))}
    made |= {f"sweep {name}": partial(_grid, [name], partial(_sweep_at, result)) for name in result.values}
    return made


@figures.register
def _(result: Information) -> dict[str, Maker]:
    return {"overview": lambda: _information(result)}


@figures.register
def _(result: ExperimentChoice) -> dict[str, Maker]:
    return {"overview": lambda: _choice(result)}


def _grid(names: list[str], draw: Any) -> Figure:
    across = min(ACROSS, len(names))
    down = -(-len(names) // across)
    figure = _new(3.3 * across + 0.4, 2.6 * down + 0.3)
    axes = figure.subplots(down, across, squeeze=False).ravel()
    for ax, name in zip(axes, names, strict=False):
        draw(ax, name)
    for ax in axes[len(names) :]:
        ax.set_visible(False)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=4, frameon=False)
    return figure


def _profile_at(profile: Profile, ax: Axes, name: str) -> None:
    draw_profile(ax, profile.lines[name], level=profile.level)


def _sweep_at(sweep: LossSweep, ax: Axes, name: str) -> None:
    draw_sweep(ax, sweep, name)


def draw_profile(ax: Axes, line: ProfileLine, *, level: float, title: str = "") -> None:
    """Rise of the cost along one parameter, the parabola of its standard error, the threshold and the interval."""
    fine = np.linspace(line.values[0], line.values[-1], 200)
    parabola = line.quadratic(fine)
    if parabola is not None:
        ax.plot(fine, parabola, color="0.6", linestyle="--", linewidth=1.0, label="by standard error")
    ax.plot(
        line.values, line.rise, "o-", color=panels.SIMULATED, markersize=3, linewidth=1.2, label="profile"
    )
    ax.axhline(line.threshold, color=panels.PREDICTED, linewidth=0.9, label=f"{100 * level:.4g} %")
    for end in (line.interval.low, line.interval.high):
        if end is not None:
            ax.plot([end, end], [0, line.threshold], color=panels.PREDICTED, linewidth=0.8, linestyle=":")
    ax.plot([line.estimate.value], [0], "o", color="black", markersize=4, zorder=3)
    ax.set_ylim(-0.05 * _HEIGHT * line.threshold, _HEIGHT * line.threshold)
    ax.locator_params(axis="x", nbins=3)
    ax.ticklabel_format(axis="x", useOffset=False)
    panels.dress(
        ax,
        x=f"{line.name} [{line.unit}]",
        y="rise of the cost [1]",
        title=title or f"{line.name}: {shape(line)}",
    )


def draw_sweep(ax: Axes, sweep: LossSweep, name: str, *, label: str = "loss V", colour: str = "") -> None:
    """The loss over one parameter, the others held, on a logarithmic axis; the reference is marked."""
    values, loss = sweep.values[name], sweep.loss[name]
    ax.plot(values, loss, color=colour or panels.SIMULATED, linewidth=1.3, label=label)
    ax.axvline(sweep.reference[name], color="0.5", linewidth=0.8, linestyle=":")
    at, lowest = sweep.minimum(name)
    ax.plot([at], [lowest], "o", color=colour or panels.SIMULATED, markersize=4)
    ax.set_yscale("log")
    words = "U-shape" if sweep.has_minimum(name) else "no minimum in the range"
    panels.dress(ax, x=f"{name} [{sweep.units[name]}]", y="V [squared output unit]", title=f"{name}: {words}")


def _along_figure(line: ProfileLine) -> Figure:
    """How the other parameters move along a profile, in per cent of their estimates."""
    figure = _new(6.5, 3.4)
    ax = figure.subplots()
    centre = int(np.argmin(np.abs(line.values - line.estimate.value)))
    for name, course in line.others.items():
        if course[centre] != 0:
            ax.plot(line.values, 100 * (course / course[centre] - 1), ".-", linewidth=1.0, label=name)
    ax.legend(frameon=False, ncols=2)
    panels.dress(
        ax,
        x=f"{line.name} [{line.unit}]",
        y="change of the others [%]",
        title=f"along the profile of {line.name}",
    )
    return figure


def _information(info: Information) -> Figure:
    names = [name for name, one in info.errors.items() if not one.fixed]
    figure = _new(9, 1.2 + 0.3 * max(len(names), 6))
    left, right = figure.subplots(1, 2)
    _errors(left, {"": [info.relative[name] for name in names]}, names)
    directions = info.directions[:8]
    rows = np.arange(len(directions))[::-1]
    for row, direction in zip(rows, directions, strict=True):
        lost = not math.isfinite(direction.stderr)
        if not lost:
            right.plot(100 * direction.stderr, row, "o", color=panels.SIMULATED)
        words = f"{direction.text}{' (not determined)' if lost else ''}"
        right.annotate(
            words,
            (0.02, row + 0.22),
            xycoords=("axes fraction", "data"),
            fontsize=7,
            color=panels.PREDICTED if lost else "black",
        )
    if any(math.isfinite(direction.stderr) for direction in directions):
        right.set_xscale("log")
    right.set_yticks([])
    right.set_ylim(-0.6, len(directions) - 0.2)
    panels.dress(right, x="standard error along the direction [%]", y="", title="sloppiest directions")
    return figure


def _choice(choice: ExperimentChoice) -> Figure:
    names = list(choice.criterion) if not isinstance(choice.criterion, str) else list(choice.free)
    figure = _new(9, 1.6 + 0.42 * max(len(names), 5))
    ax = figure.subplots()
    ordered = sorted(choice.candidates.values(), key=lambda one: one.value)[:8]
    series = {one.name: [one.relative.get(name) for name in names] for one in ordered}
    series["the set chosen"] = [choice.relative.get(name) for name in names]
    _errors(ax, series, names)
    if not isinstance(choice.criterion, str):
        for row, name in zip(range(len(names) - 1, -1, -1), names, strict=True):
            ax.plot(100 * choice.criterion[name], row, "|", color="black", markersize=22, zorder=1)
    ax.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    ax.set_title(f"expected errors; chosen: {', '.join(choice.chosen)}", loc="left")
    return figure


def _errors(ax: Axes, series: dict[str, list[float | None]], names: list[str]) -> None:
    """Expected errors in per cent by parameter, one mark for each series; the last one is drawn large."""
    rows = np.arange(len(names))[::-1]
    shapes = "osD^v<>phX"
    for k, (label, errors) in enumerate(series.items()):
        there = [(100 * one, row) for one, row in zip(errors, rows, strict=True) if one is not None]
        last = k == len(series) - 1
        colour: Any = panels.SIMULATED if last else f"C{k}"
        if there:
            x, y = zip(*there, strict=True)
            ax.plot(
                x,
                y,
                shapes[k % len(shapes)] if not last else "o",
                color=colour,
                markersize=8 if last else 5,
                alpha=1.0 if last else 0.7,
                label=label or "expected",
                linestyle="none",
            )
    if any(one is not None for errors in series.values() for one in errors):
        ax.set_xscale("log")
    for level in (1, 5, 50):
        ax.axvline(level, color="0.85", linewidth=0.8, zorder=0)
    ax.set_yticks(rows, names)
    ax.set_ylim(-0.7, len(names) - 0.3)
    panels.dress(ax, x="expected standard error [% of the value]", y="", title="Cramér-Rao")


# ---- text and tables ----------------------------------------------------------------------------------


@text.register
def _(result: Information) -> str:
    return information_text(result)


@text.register
def _(result: Profile) -> str:
    return profile_text(result)


@text.register
def _(result: LossSweep) -> str:
    return sweep_text(result)


@text.register
def _(result: ExperimentChoice) -> str:
    return choice_text(result)


@as_html.register
def _(result: Information) -> str:
    rows = [
        (
            name,
            f"{one.value:.6g}",
            "-" if one.stderr is None else f"{one.stderr:.2g}",
            one.unit,
            percent(one),
            verdict(one),
        )
        for name, one in result.errors.items()
        if not one.fixed
    ]
    header = ("parameter", "value", "expected standard error", "unit", "%", "")
    directions = [
        ("not determined" if not math.isfinite(one.stderr) else f"{100 * one.stderr:.2g} %", one.text)
        for one in result.directions
    ]
    return table(header, rows, right=(1, 2, 4), caption="What the data can tell (Cramér-Rao)") + table(
        ("known to", "relative changes that go together"), directions, caption="Directions, sloppiest first"
    )


@as_html.register
def _(result: Profile) -> str:
    rows = [
        (
            name,
            f"{line.estimate.value:.6g}",
            *("-" if end is None else f"{end:.6g}" for end in (line.interval.low, line.interval.high)),
            line.unit,
            "; ".join(why for why in (line.interval.low_why, line.interval.high_why) if why) or shape(line),
        )
        for name, line in result.lines.items()
    ]
    caption = f"{100 * result.level:.4g} % intervals by profile likelihood"
    return table(
        ("parameter", "estimate", "from", "to", "unit", "shape"), rows, right=(1, 2, 3), caption=caption
    )


@as_html.register
def _(result: LossSweep) -> str:
    rows = [
        (
            name,
            f"{result.reference[name]:.6g}",
            f"{result.minimum(name)[0]:.6g}",
            f"{result.minimum(name)[1]:.4g}",
            "U-shape" if result.has_minimum(name) else "no minimum in the range",
        )
        for name in result.values
    ]
    caption = f"Loss, one parameter at a time, initial states {result.start}"
    return table(
        ("parameter", "reference", "lowest at", "V there", ""), rows, right=(1, 2, 3), caption=caption
    )


@as_html.register
def _(result: ExperimentChoice) -> str:
    names = list(result.criterion) if not isinstance(result.criterion, str) else list(result.free)
    rows = [
        (
            "chosen" if one.name in result.chosen else "",
            one.name,
            *(percent(one.errors[name]) for name in names),
        )
        for one in sorted(result.candidates.values(), key=lambda one: one.value)
    ]
    rows.append(("", "the set chosen", *(percent(result.errors[name]) for name in names)))
    words = "Expected standard errors, % of the value"
    return table(("", "experiment", *names), rows, right=range(2, 2 + len(names)), caption=words)
