"""Figures of a repair: the gap before and after, the law found, the scores, the classes, the parameters that moved."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from casadi_engine.discrepancy.repaired import FoundEffect, Repair
from casadi_engine.report import panels
from casadi_engine.report.figures import Maker, _new, figures
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

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    """Records for the overview: those of the search, and a fresh one last if there is any."""
    old, fresh = [one for one in gaps if not one.fresh], [one for one in gaps if one.fresh]
    return old[: _ACROSS - bool(fresh)] + fresh[: _ACROSS - min(len(old), _ACROSS - bool(fresh))]


def _widest(chosen: list[Pair]) -> Pair:
    """The record of the search in which the gap was largest."""
    old = [one for one in chosen if not one.fresh] or chosen
    return max(old, key=lambda one: float(np.nanmean(one.before**2)))


def _overview(repair: Repair, gaps: tuple[Pair, ...]) -> Figure:
    """The gap that shrank, its orders, its spread, and the law that closed it."""
    chosen = _chosen(gaps)
    figure = _new(11, 6.2)
    top, bottom = figure.subfigures(2, 1, squeeze=False)[:, 0]
    axes = top.subplots(1, len(chosen), squeeze=False)[0]
    for ax, pair in zip(axes, chosen, strict=True):
        draw_folded(ax, pair)
    same_height(list(axes))
    top.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    left, middle, right = bottom.subplots(1, 3)
    draw_orders(left, _widest(chosen))
    if left.get_legend_handles_labels()[0]:
        left.legend(frameon=False, loc="upper right", fontsize=7)
    draw_density(middle, tuple(gaps))
    middle.set_ylim(0, 0.56)
    middle.legend(frameon=False, loc="upper center", fontsize=7)
    _last(right, repair)
    return figure


def _last(ax: Axes, repair: Repair) -> None:
    """The law found over the signal it depends on; else the scores."""
    latent = latent_at(repair)
    laws = () if latent is None else laws_at(repair, latent.port)
    if latent is None or not laws:
        draw_scores(ax, repair, _ROWS_BESIDE)
        return
    records = seen(repair, latent)
    signal = _signal_of(repair, [name for name in AXES if all(name in one.signals for one in records)])
    if signal is None:
        draw_scores(ax, repair, _ROWS_BESIDE)
        return
    draw_over(ax, records, signal, law_words(laws))
    ax.set_title(f"torque at {latent.port} {ax.get_title(loc='left')}", loc="left")
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.4 * (high - low))
    ax.legend(frameon=False, loc="upper left", fontsize=7)


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


def _gap(pair: Pair) -> Figure:
    """One output of one record: its residual before and after over time, by crank angle, and by order."""
    figure = _new(11, 6.4)
    grid = figure.add_gridspec(3, 2, width_ratios=(1.35, 1))
    shown = pair.shown
    times = [figure.add_subplot(grid[row, 0]) for row in range(len(shown))]
    for row, ax in enumerate(times):
        draw_course(ax, pair, row)
    same_height(times)
    spread = figure.add_subplot(grid[len(shown), 0]) if len(shown) < 3 else None
    if spread is not None:
        draw_density(spread, (pair,))
        spread.legend(frameon=False, loc="upper right", fontsize=7)
    half = grid[:, 1].subgridspec(2, 1)
    folded, orders = figure.add_subplot(half[0]), figure.add_subplot(half[1])
    draw_folded(folded, pair)
    draw_orders(orders, pair)
    for ax in (folded, orders):
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.35 * (high - low))
        if ax.get_legend_handles_labels()[0]:
            ax.legend(frameon=False, loc="upper right", fontsize=7, ncols=2)
    return figure


def _latent(repair: Repair, port: str) -> Figure:
    """The latent torque at a port over time in each record, and over each signal."""
    latent = latent_at(repair, port)
    assert latent is not None
    records = seen(repair, latent)
    words = law_words(laws_at(repair, port))
    signals = [name for name in AXES if all(name in one.signals for one in records)]
    panels_there = min(len(records), _ACROSS) + len(signals)
    down = -(-panels_there // _ACROSS)
    figure = _new(11, 3.0 * down + 0.3)
    axes = figure.subplots(down, _ACROSS, squeeze=False).ravel()
    for ax, one in zip(axes, records[:_ACROSS], strict=False):
        draw_over_time(ax, one, words)
    rest = axes[min(len(records), _ACROSS) :]
    for ax, signal in zip(rest, signals, strict=False):
        draw_over(ax, records, signal, words)
    for ax in rest[len(signals) :]:
        ax.set_visible(False)
    handles, labels = axes[0].get_legend_handles_labels()
    dots, dot_words = rest[0].get_legend_handles_labels() if signals else ([], [])
    for handle, label in zip(dots, dot_words, strict=True):
        if label not in labels and not label.endswith("(mean)"):
            handles.append(handle)
            labels.append(label)
    figure.legend(handles, labels, loc="outside upper right", ncols=5, frameon=False, fontsize=7)
    return figure


def _unknown(repair: Repair) -> Figure:
    """The function that explains most of what no effect of the library does."""
    unknown = repair.unknown
    assert unknown is not None
    assert unknown.course is not None
    course = unknown.course
    figure = _new(6.5, 3.4)
    ax = figure.subplots()
    ax.fill_between(
        course.signal, course.mean - 2 * course.band, course.mean + 2 * course.band, color=panels.BAND, linewidth=0,
        label="±2 standard errors",
    )  # fmt: skip
    ax.plot(course.signal, course.mean, color=panels.SIMULATED, linewidth=1.3, label="most likely course")
    ax.axhline(0.0, color="0.6", linewidth=0.6)
    alike = next(iter(course.looks_like.items()), None)
    title = f"unknown torque at {unknown.port}"
    if alike is not None:
        title += f": looks {alike[0]} ({100 * alike[1]:.0f} % of its variance)"
    panels.dress(ax, x=_with_unit(course.family.signal), y="torque [N m]", title=title)
    ax.legend(frameon=False, loc="best")
    return figure


def _with_unit(signal: str) -> str:
    units = {"twist": "rad", "twist_rate": "rad/s", "speed": "rad/s", "angle": "rad", "time": "s"}
    return f"{signal.replace('_', ' ')} [{units.get(signal, '1')}]"


def _scores(repair: Repair) -> Figure:
    rows, _ = chart_rows(repair)
    figure = _new(9, 1.3 + 0.22 * max(len(rows), 4))
    draw_scores(figure.subplots(), repair)
    return figure


def _classes(repair: Repair) -> Figure:
    matrix = repair.matrix
    assert matrix is not None
    size = 2.6 + 0.34 * min(len(matrix.keys), MOST_IN_MATRIX)
    figure = _new(size + 1.0, size)
    ax = figure.subplots()
    figure.colorbar(draw_matrix(ax, matrix), ax=ax, label="correlation ρ of the scores [1]")
    return figure


def _shift(repair: Repair, effect: FoundEffect) -> Figure:
    figure = _new(8, 1.4 + 0.36 * max(len(effect.found_shift), 2))
    draw_shift(figure.subplots(), repair, effect)
    return figure
