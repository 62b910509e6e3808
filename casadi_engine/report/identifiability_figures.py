"""Figures and tables of practical identifiability: profiles, loss sweeps, expected errors, chosen experiments."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

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
from casadi_engine.report.figures import Maker, figures
from casadi_engine.report.sketch import Panel, Sketch
from casadi_engine.report.tables import as_html, table, text

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


def _grid(names: list[str], draw: Any) -> Sketch:
    across = min(ACROSS, len(names))
    down = -(-len(names) // across)
    sketch = Sketch(3.3 * across + 0.4, 2.6 * down + 0.3, (down, across), key=True)
    for place, name in enumerate(names):
        draw(sketch.panel(*divmod(place, across)), name)
    return sketch


def _profile_at(profile: Profile, panel: Panel, name: str) -> None:
    draw_profile(panel, profile.lines[name], level=profile.level)


def _sweep_at(sweep: LossSweep, panel: Panel, name: str) -> None:
    draw_sweep(panel, sweep, name)


def draw_profile(panel: Panel, line: ProfileLine, *, level: float, title: str = "") -> None:
    """Rise of the cost along one parameter, the parabola of its standard error, the threshold and the interval."""
    fine = np.linspace(line.values[0], line.values[-1], 200)
    parabola = line.quadratic(fine)
    if parabola is not None:
        panel.plot(fine, parabola, color="0.6", linestyle="--", linewidth=1.0, label="by standard error")
    points = {"markersize": 3, "linewidth": 1.2, "label": "profile"}
    panel.plot(line.values, line.rise, "o-", color=panels.SIMULATED, **points)
    panel.axhline(line.threshold, color=panels.PREDICTED, linewidth=0.9, label=f"{100 * level:.4g} %")
    for end in (line.interval.low, line.interval.high):
        if end is not None:
            ends = [end, end], [0, line.threshold]
            panel.plot(*ends, color=panels.PREDICTED, linewidth=0.8, linestyle=":")
    panel.plot([line.estimate.value], [0], "o", color="black", markersize=4, zorder=3)
    panel.ylim = (-0.05 * _HEIGHT * line.threshold, _HEIGHT * line.threshold)
    title = title or f"{line.name}: {shape(line)}"
    panels.dress(panel, x=f"{line.name} [{line.unit}]", y="rise of the cost [1]", title=title)


def draw_sweep(
    panel: Panel, sweep: LossSweep, name: str, *, label: str = "loss V", colour: str = panels.SIMULATED
) -> None:
    """The loss over one parameter, the others held, on a logarithmic axis; the reference is marked."""
    values, loss = sweep.values[name], sweep.loss[name]
    panel.yscale = "log"
    panel.plot(values, loss, color=colour, linewidth=1.3, label=label)
    panel.axvline(sweep.reference[name], color="0.5", linewidth=0.8, linestyle=":")
    at, lowest = sweep.minimum(name)
    panel.plot([at], [lowest], "o", color=colour, markersize=4)
    words = "U-shape" if sweep.has_minimum(name) else "no minimum in the range"
    title = f"{name}: {words}"
    panels.dress(panel, x=f"{name} [{sweep.units[name]}]", y="V [squared output unit]", title=title)


def _along_figure(line: ProfileLine) -> Sketch:
    """How the other parameters move along a profile, in per cent of their estimates."""
    sketch = Sketch(6.5, 3.4)
    panel = sketch.panel()
    centre = int(np.argmin(np.abs(line.values - line.estimate.value)))
    for k, (name, course) in enumerate(line.others.items()):
        if course[centre] != 0:
            change = 100 * (course / course[centre] - 1)
            panel.plot(line.values, change, ".-", color=f"C{k % 10}", linewidth=1.0, label=name)
    panel.key = "best"
    title, words = f"along the profile of {line.name}", "change of the others [%]"
    panels.dress(panel, x=f"{line.name} [{line.unit}]", y=words, title=title)
    return sketch


def _information(info: Information) -> Sketch:
    names = [name for name, one in info.errors.items() if not one.fixed]
    sketch = Sketch(9, 1.2 + 0.3 * max(len(names), 6), (1, 2))
    left, right = sketch.cells()
    _errors(left, {"": [info.relative[name] for name in names]}, names)
    directions = info.directions[:8]
    for row, direction in zip(range(len(directions) - 1, -1, -1), directions, strict=True):
        lost = not math.isfinite(direction.stderr)
        if not lost:
            right.plot(100 * direction.stderr, row, "o", color=panels.SIMULATED)
        words = f"{direction.text}{' (not determined)' if lost else ''}"
        colour = panels.PREDICTED if lost else "black"
        right.write(words, 0.02, row + 0.22, inside=True, size=7, color=colour)
    if any(math.isfinite(direction.stderr) for direction in directions):
        right.xscale = "log"
    right.ynames = ([], [])
    right.ylim = (-0.6, len(directions) - 0.2)
    panels.dress(right, x="standard error along the direction [%]", y="", title="sloppiest directions")
    return sketch


def _choice(choice: ExperimentChoice) -> Sketch:
    names = list(choice.criterion) if not isinstance(choice.criterion, str) else list(choice.free)
    sketch = Sketch(9, 1.6 + 0.42 * max(len(names), 5))
    panel = sketch.panel()
    ordered = sorted(choice.candidates.values(), key=lambda one: one.value)[:8]
    series = {one.name: [one.relative.get(name) for name in names] for one in ordered}
    series["the set chosen"] = [choice.relative.get(name) for name in names]
    _errors(panel, series, names)
    if not isinstance(choice.criterion, str):
        for row, name in zip(range(len(names) - 1, -1, -1), names, strict=True):
            panel.plot(100 * choice.criterion[name], row, "|", color="black", markersize=22, zorder=1)
    panel.key = "center left"
    panel.title = f"expected errors; chosen: {', '.join(choice.chosen)}"
    return sketch


def _errors(panel: Panel, series: dict[str, list[float | None]], names: list[str]) -> None:
    """Expected errors in per cent by parameter, one mark for each series; the last one is drawn large."""
    rows = range(len(names) - 1, -1, -1)
    shapes = "osD^v<>"
    for k, (label, errors) in enumerate(series.items()):
        there = [(100 * one, row) for one, row in zip(errors, rows, strict=True) if one is not None]
        last = k == len(series) - 1
        if there:
            style: Any = {"color": panels.SIMULATED, "markersize": 8}
            if not last:
                style = {"color": f"C{k}", "markersize": 5, "alpha": 0.7}
            shape = "o" if last else shapes[k % len(shapes)]
            x, y = zip(*there, strict=True)
            panel.plot(x, y, shape, label=label or "expected", **style)
    if any(one is not None for errors in series.values() for one in errors):
        panel.xscale = "log"
    for level in (1, 5, 50):
        panel.axvline(level, color="0.85", linewidth=0.8, zorder=0)
    panel.ynames = (list(rows), names)
    panel.ylim = (-0.7, len(names) - 0.3)
    panels.dress(panel, x="expected standard error [% of the value]", y="", title="Cramér-Rao")


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
