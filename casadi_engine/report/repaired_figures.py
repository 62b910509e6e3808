"""Figures of a repair: the gap before and after, the law found, the scores, the classes, the parameters that moved."""

from __future__ import annotations

from functools import partial

import numpy as np

from casadi_engine.discrepancy.clocks import clock_of
from casadi_engine.discrepancy.random_families import TIME
from casadi_engine.discrepancy.repaired import FoundEffect, Repair
from casadi_engine.report import panels
from casadi_engine.report.figures import Maker, figures
from casadi_engine.report.repaired_gap import (
    Pair,
    draw_course,
    draw_density,
    draw_folded,
    draw_orders,
    pairs,
    same_height,
)
from casadi_engine.report.repaired_latent import (
    AXES,
    acting,
    axis_of,
    draw_over,
    draw_over_time,
    latent_at,
    law_words,
    laws_at,
    seen,
)
from casadi_engine.report.repaired_scores import (
    MOST_IN_MATRIX,
    chart_rows,
    draw_matrix,
    draw_scores,
    draw_shift,
)
from casadi_engine.report.sketch import Panel, Sketch

# Records side by side in the overview.
_ACROSS = 3
_ROWS_BESIDE = 9


@figures.register
def _(result: Repair) -> dict[str, Maker]:
    if result.gaps is None:  # no answer: what there is to see is the fit that failed
        return figures(result.fit)
    gaps = pairs(result)
    made: dict[str, Maker] = {"overview": partial(_overview, result, gaps)}
    for pair in gaps:
        kind = "fresh gap" if pair.fresh else "gap"
        made[f"{kind} {pair.record} {pair.output}"] = partial(_gap, pair)
    for one in result.latent:
        made[f"latent {one.port}"] = partial(_latent, result, one.port)
    if result.unknown is not None and result.unknown.course is not None:
        made["unknown"] = partial(_unknown, result)
    if result.scores:
        made["scores"] = partial(_scores, result)
    if result.matrix is not None and len(result.matrix.keys) > 1:
        made["classes"] = partial(_classes, result)
    for effect in result.effects:
        made[f"shift {effect.key}"] = partial(_shift, result, effect)
    return made


def _chosen(gaps: tuple[Pair, ...]) -> list[Pair]:
    """Panels of the overview: every output once, as far as there is room, then further records of the search, and a
    fresh record last if there is any."""
    old = _outputs_first([one for one in gaps if not one.fresh])
    fresh = _outputs_first([one for one in gaps if one.fresh])
    room = _ACROSS - bool(fresh)
    return old[:room] + fresh[: _ACROSS - min(len(old), room)]


def _outputs_first(gaps: list[Pair]) -> list[Pair]:
    """The first record of each output before the others, the widest gap first among those."""
    first: dict[str, Pair] = {}
    for one in gaps:
        first.setdefault(one.output, one)
    wide = sorted(first.values(), key=_width, reverse=True)
    return wide + [one for one in gaps if one not in wide]


def _width(pair: Pair) -> float:
    """Mean square of a gap before the repair, in variances of its noise, so that outputs of any unit compare."""
    with np.errstate(invalid="ignore", divide="ignore"):
        width = float(np.nanmean((pair.before / pair.sigma) ** 2)) if np.isfinite(pair.before).any() else 0.0
    return width if np.isfinite(width) else 0.0


def _widest(chosen: list[Pair]) -> Pair:
    """The record of the search in which the gap was largest."""
    return max([one for one in chosen if not one.fresh] or chosen, key=_width)


def _overview(repair: Repair, gaps: tuple[Pair, ...]) -> Sketch:
    """The gap that shrank, its orders or course, its spread, and the law that closed it."""
    chosen = _chosen(gaps)
    sketch = Sketch(11, 6.2, (2, 6))  # six columns hold one, two or three panels
    share = 6 // len(chosen)
    tops = [sketch.panel(0, k * share, columns=share) for k in range(len(chosen))]
    for panel, pair in zip(tops, chosen, strict=True):
        draw_folded(panel, pair)
        panel.key, panel.room = "upper right", 0.35
    same_height(tops)
    left, middle, right = (sketch.panel(1, column, columns=2) for column in (0, 2, 4))
    widest = _widest(chosen)
    if widest.theta is None:  # nothing turns: the gap over time takes the place of engine orders
        draw_course(left, widest, 0)
        left.title = f"{widest.title}, {widest.shown[0][0]}"
    else:
        draw_orders(left, widest)
    left.key, left.room = "upper right", 0.35
    draw_density(middle, tuple(gaps))
    middle.key, middle.room = "upper center", 0.3
    _last(right, repair)
    return sketch


def _last(panel: Panel, repair: Repair) -> None:
    """The law found over the signal it depends on; else the scores."""
    latent = latent_at(repair)
    laws = () if latent is None else laws_at(repair, latent.port)
    if latent is None or not laws:
        draw_scores(panel, repair, _ROWS_BESIDE)
        return
    records = seen(repair, latent)
    signal = _signal_of(repair, [name for name in AXES if all(name in one.signals for one in records)])
    if signal is None:
        draw_scores(panel, repair, _ROWS_BESIDE)
        return
    port = latent.port
    draw_over(panel, records, signal, law_words(laws), axis_of(repair, port, signal), acting(repair, port))
    panel.title = f"{acting(repair, port, unit=False)} at {port} {panel.title}"
    panel.key, panel.room = "upper left", 0.4


def _signal_of(repair: Repair, known: list[str]) -> str | None:
    """The signal that a found law is drawn over: the one that the law is a function of, as its words say."""
    first = repair.effects[0].name
    for words, signal in (
        (("stiffness", "backlash", "hysteresis"), "twist"),
        (("friction", "damping", "drag"), "twist_rate"),
        (("friction", "drag"), "speed"),
    ):
        if signal in known and any(word in first for word in words):
            return signal
    return known[-1] if known else None


def _gap(pair: Pair) -> Sketch:
    """One output of one record: its residual before and after over time, by crank angle, and by order."""
    sketch = Sketch(11, 6.4, (6, 2), across=(1.35, 1))
    shown = pair.shown
    times = [sketch.panel(2 * row, 0, rows=2) for row in range(len(shown))]
    for row, panel in enumerate(times):
        draw_course(panel, pair, row)
    same_height(times)
    spread = sketch.panel(2 * len(shown), 0, rows=2)
    draw_density(spread, (pair,))
    beside = (
        [sketch.panel(row, 1, rows=3) for row in (0, 3)]
        if pair.theta is not None
        else [sketch.panel(0, 1, rows=6)]
    )
    draw_folded(beside[0], pair)
    if pair.theta is not None:
        draw_orders(beside[1], pair)
    for panel in (spread, *beside):
        panel.key, panel.room = "upper right", 0.35
    return sketch


def _latent(repair: Repair, port: str) -> Sketch:
    """The latent torque at a port over time in each record, and over each signal."""
    latent = latent_at(repair, port)
    assert latent is not None
    records = seen(repair, latent)
    words = law_words(laws_at(repair, port))
    signals = [name for name in AXES if all(name in one.signals for one in records)]
    shown = records[:_ACROSS]
    down = -(-(len(shown) + len(signals)) // _ACROSS)
    sketch = Sketch(11, 3.0 * down + 0.3, (down, _ACROSS), key=True)
    cells = sketch.cells()
    for one in shown:
        draw_over_time(next(cells), one, words, acting(repair, port), clock_of(repair.model))
    for signal in signals:
        draw_over(next(cells), records, signal, words, axis_of(repair, port, signal), acting(repair, port))
    return sketch


def _unknown(repair: Repair) -> Sketch:
    """The function that explains most of what no effect of the library does."""
    unknown = repair.unknown
    assert unknown is not None
    assert unknown.course is not None
    course = unknown.course
    sketch = Sketch(6.5, 3.4)
    panel = sketch.panel()
    low, high = course.mean - 2 * course.band, course.mean + 2 * course.band
    signal = clock_of(repair.model).of(course.signal) if course.family.signal == TIME else course.signal
    panel.fill_between(signal, low, high, color=panels.BAND, linewidth=0, label="±2 standard errors")
    panel.plot(signal, course.mean, color=panels.SIMULATED, linewidth=1.3, label="most likely course")
    panel.axhline(0.0, color="0.6", linewidth=0.6)
    alike = next(iter(course.looks_like.items()), None)
    port = str(unknown.port)
    title = f"unknown {acting(repair, port, unit=False)}"
    title += "" if port.startswith("parameter_") else f" at {port}"
    if alike is not None:
        title += f": looks {alike[0]} ({100 * alike[1]:.0f} % of its variance)"
    panels.dress(panel, x=axis_of(repair, port, course.family.signal), y=acting(repair, port), title=title)
    panel.key = "best"
    return sketch


def _scores(repair: Repair) -> Sketch:
    rows, _ = chart_rows(repair)
    sketch = Sketch(9, 1.3 + 0.22 * max(len(rows), 4))
    draw_scores(sketch.panel(), repair)
    return sketch


def _classes(repair: Repair) -> Sketch:
    matrix = repair.matrix
    assert matrix is not None
    size = 2.6 + 0.34 * min(len(matrix.keys), MOST_IN_MATRIX)
    sketch = Sketch(size + 1.0, size)
    draw_matrix(sketch.panel(), matrix)
    return sketch


def _shift(repair: Repair, effect: FoundEffect) -> Sketch:
    sketch = Sketch(8, 1.4 + 0.36 * max(len(effect.found_shift), 2))
    draw_shift(sketch.panel(), repair, effect)
    return sketch
