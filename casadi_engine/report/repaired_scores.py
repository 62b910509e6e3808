"""What was looked for: scores of every effect, which effects look alike, and which parameters moved."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.discrepancy.repaired import ClassMatrix, FoundEffect, Repair, ScoreRow
from casadi_engine.estimation.summary import number
from casadi_engine.report import panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FOUND, IN_CLASS, ABOVE, BELOW = panels.SIMULATED, "#56B4E9", "0.55", "0.8"
MOST_ROWS, MOST_IN_MATRIX = 24, 16
_NORMAL_95 = panels.NORMAL_95


def standing(repair: Repair, row: ScoreRow) -> str:
    """What became of a score: "found", "in its class", "above", "below" the threshold, or "not testable"."""
    key = (row.effect, row.at)
    if key in {(one.name, one.at) for one in repair.effects}:
        return "found"
    if key in {(member.name, member.at) for one in repair.effects for member in one.members}:
        return "in its class"
    if not row.testable:
        return "not testable"
    return "above" if row.significant else "below"


WORDS = {
    "found": "found",
    "in its class": "in the class of one found",
    "above": "above the threshold, but not asked for beside those found",
    "below": "below the threshold",
    "not testable": "not testable with these data",
}
COLOURS = {"found": FOUND, "in its class": IN_CLASS, "above": ABOVE, "below": BELOW, "not testable": BELOW}


def chart_rows(repair: Repair, most: int = MOST_ROWS) -> tuple[list[ScoreRow], int]:
    """Rows of the chart, the highest first, and how many are left out; those found and their class always stay."""
    every = list(repair.best_scores)
    chosen = [k for k, row in enumerate(every) if standing(repair, row) in ("found", "in its class")]
    chosen += [k for k in range(len(every)) if k not in chosen][: max(most - len(chosen), 0)]
    return [every[k] for k in sorted(chosen)], len(every) - len(chosen)


def draw_scores(ax: Axes, repair: Repair, most: int = MOST_ROWS) -> None:
    """Best score of each effect at each port before the repair, with the threshold of the whole library."""
    rows, rest = chart_rows(repair, most)
    title = f"scores of the model without effects, α = {repair.alpha:g} over {repair.candidates} candidates"
    title += f"\n({rest} effects with lower scores are not drawn)" if rest else ""
    panels.dress(ax, x="score |z| [1]", y="", title=title)
    if not rows or repair.threshold is None:
        panels.note(ax, "no effect was scored")
        return
    labelled: set[str] = set()
    for place, row in enumerate(rows):
        kind = standing(repair, row)
        label = None if kind in labelled or kind == "not testable" else WORDS[kind]
        labelled.add(kind)
        ax.barh(place, row.statistic, 0.7, color=COLOURS[kind], label=label)
        words = "not testable" if kind == "not testable" else f"{row.statistic:.3g}"
        ax.annotate(
            words, (row.statistic, place), (3, 0), textcoords="offset points", va="center", fontsize=7
        )
    ax.axvline(
        repair.threshold,
        color="black",
        linewidth=1.0,
        linestyle="--",
        label=f"threshold {repair.threshold:.3g}",
    )
    top = max(row.statistic for row in rows)
    if top > 6 * repair.threshold:
        _bent_axis(ax, repair.threshold, top)
        ax.set_xlabel("score |z| [1], linear up to the threshold and logarithmic above")
    else:
        ax.set_xlim(0, 1.15 * max(top, repair.threshold))
    ax.set_yticks(range(len(rows)), [f"{row.effect} at {row.at}" for row in rows], fontsize=8)
    ax.set_ylim(len(rows) - 0.4, -0.6)
    ax.legend(frameon=False, loc="lower right", fontsize=7)


def _bent_axis(ax: Axes, threshold: float, top: float) -> None:
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    ax.set_xscale("symlog", linthresh=threshold, linscale=1.0)
    ax.set_xlim(0, 2.2 * top)
    decades = [a * 10.0**k for k in range(0, math.ceil(math.log10(top)) + 1) for a in (1, 2, 5)]
    axis: Any = ax.xaxis
    axis.set_major_locator(FixedLocator([0, *(v for v in decades if 1.15 * threshold < v <= 2 * top)]))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def draw_matrix(ax: Axes, matrix: ClassMatrix) -> Any:
    """Correlation of the scores of the leading effects: 1 looks the same in these data. Returns the image."""
    names = [f"{effect} at {port}" for effect, port in matrix.keys[:MOST_IN_MATRIX]]
    rho = np.asarray(matrix.rho, dtype=float)[: len(names), : len(names)]
    image = ax.imshow(rho, vmin=-1, vmax=1, cmap="RdBu_r", interpolation="nearest")
    ax.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    ax.set_yticks(range(len(names)), names, fontsize=7)
    ax.set_title("which effects look alike in these data (±1: the same)", loc="left")
    for (i, j), value in np.ndenumerate(rho):
        colour = "white" if abs(value) > 0.6 else "black"
        ax.text(j, i, f"{round(value, 2) + 0.0:.2f}", ha="center", va="center", fontsize=6, color=colour)
    return image


def draw_shift(ax: Axes, repair: Repair, effect: FoundEffect) -> None:
    """Change of the old parameters when an effect was added: predicted by the score, and found, with 95 % intervals."""
    names = [name for name in effect.found_shift if name in repair.fit.estimates]
    places = np.arange(len(names))
    words: list[str] = []
    for place, name in zip(places, names, strict=True):
        estimate = repair.fit.estimates[name]
        scale = abs(estimate.value) or 1.0
        error = panels.half_width(estimate)
        found = 100 * effect.found_shift[name] / scale
        ax.errorbar(
            found, place, xerr=None if error is None else 100 * error / scale, fmt="o", color=panels.SIMULATED,
            capsize=3, markersize=5, label=None if words else "found by the refit, with its 95 % interval",
        )  # fmt: skip
        predicted = effect.predicted_shift.get(name, math.nan)
        ax.plot(
            100 * predicted / scale, place, "D", markerfacecolor="none", color=panels.PREDICTED, markersize=7,
            label=None if words else "predicted by the score",
        )  # fmt: skip
        words.append(f"{name} = {number(estimate.value, '.4g')} {estimate.unit}")
    ax.axvline(0.0, color="0.4", linewidth=0.8, linestyle=":")
    ax.set_yticks(places, words)
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.margins(x=0.12)
    panels.dress(
        ax,
        x="change of the parameter [% of its value now]",
        y="",
        title=f"what the model without {effect.key} had wrong",
    )
    if names:
        ax.legend(frameon=False, loc="best")
