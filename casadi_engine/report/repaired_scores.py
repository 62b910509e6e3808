"""What was looked for: scores of every effect, which effects look alike, and which parameters moved."""

from __future__ import annotations

import math

import numpy as np

from casadi_engine.discrepancy.repaired import ClassMatrix, FoundEffect, Repair, ScoreRow
from casadi_engine.discrepancy.wording import in_unit
from casadi_engine.estimation.summary import number
from casadi_engine.report import panels
from casadi_engine.report.sketch import Panel

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


# Characters of a name beside other panels; room below the bars for each line of the key there, as a share of them.
_BESIDE, _KEY_ROOM = 24, 0.16

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


def draw_scores(panel: Panel, repair: Repair, most: int = MOST_ROWS) -> None:
    """Best score of each effect at each port before the repair, with the threshold of the whole library."""
    rows, rest = chart_rows(repair, most)
    title = f"scores of the model without effects, α = {repair.alpha:g} over {repair.candidates} candidates"
    title += f"\n({rest} effects with lower scores are not drawn)" if rest else ""
    panels.dress(panel, x="score |z| [1]", y="", title=title)
    if not rows or repair.threshold is None:
        panel.note = "no effect was scored"
        return
    for place, row in enumerate(rows):
        kind = standing(repair, row)
        testable = kind != "not testable"
        label = WORDS[kind] if testable and WORDS[kind] not in panel.labels else None
        panel.barh(place, row.statistic, 0.7, color=COLOURS[kind], label=label)
        words = f"{row.statistic:.3g}" if testable else kind
        panel.write(words, row.statistic, place, shift=(3, 0), va="center", size=7)
    words = f"threshold {repair.threshold:.3g}"
    panel.axvline(repair.threshold, color="black", linewidth=1.0, linestyle="--", label=words)
    top = max(row.statistic for row in rows)
    if top > 6 * repair.threshold:
        _bent_axis(panel, repair.threshold, top)
    else:
        panel.xlim = (0, 1.15 * max(top, repair.threshold))
    names = [f"{row.effect} at {row.at}" for row in rows]
    below = len(rows) - 0.4
    if most < MOST_ROWS:  # beside other panels, and all of it stands in the chart of its own
        names = [name if len(name) <= _BESIDE else f"{name[: _BESIDE - 1]}…" for name in names]
        panel.title, panel.x = "scores of the model without effects", "score |z| [1]"
        below += _KEY_ROOM * len(panel.labels) * len(rows)
    panel.ynames = (range(len(rows)), names)
    panel.ylim, panel.flipped = (-0.6, below), True
    panel.key = "lower right"


def _bent_axis(panel: Panel, threshold: float, top: float) -> None:
    panel.x = "score |z| [1], linear up to the threshold and logarithmic above"
    panel.xscale, panel.threshold, panel.xlim = "symlog", threshold, (0, 4.0 * top)
    decades = [a * 10.0**k for k in range(0, math.ceil(math.log10(top)) + 1) for a in (1, 2, 5)]
    panel.xticks = [0, *(v for v in decades if 1.15 * threshold < v <= 4 * top)]


def draw_matrix(panel: Panel, matrix: ClassMatrix) -> None:
    """Correlation of the scores of the leading effects: 1 looks the same in these data."""
    names = [f"{effect} at {port}" for effect, port in matrix.keys[:MOST_IN_MATRIX]]
    rho = np.asarray(matrix.rho, dtype=float)[: len(names), : len(names)]
    panel.imshow(rho, label="correlation ρ of the scores [1]")
    panel.xnames = panel.ynames = (range(len(names)), names)
    panel.tilted = True
    panel.title = "which effects look alike in these data (±1: the same)"


def draw_shift(panel: Panel, repair: Repair, effect: FoundEffect) -> None:
    """Change of the old parameters when an effect was added, with 95 % intervals."""
    names = [name for name in effect.found_shift if name in repair.fit.estimates]
    words: list[str] = []
    for place, name in enumerate(names):
        estimate = repair.fit.estimates[name]
        scale = abs(estimate.value) or 1.0
        error = panels.half_width(estimate)
        found = 100 * effect.found_shift[name] / scale
        panel.errorbar(
            found, place, xerr=None if error is None else 100 * error / scale, color=panels.SIMULATED, capsize=3,
            markersize=5, label=None if words else "found by the refit, with its 95 % interval",
        )  # fmt: skip
        words.append(f"{name} = {number(estimate.value, '.4g')}{in_unit(estimate.unit)}")
    panel.axvline(0.0, color="0.4", linewidth=0.8, linestyle=":")
    panel.ynames = (range(len(names)), words)
    panel.ylim, panel.flipped = (-0.6, len(names) - 0.4), True
    panel.margin, panel.key = 0.12, "best"
    title = f"what the model without {effect.key} had wrong"
    panels.dress(panel, x="change of the parameter [% of its value now]", y="", title=title)
