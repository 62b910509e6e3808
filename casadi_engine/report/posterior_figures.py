"""Figures and tables of a posterior: marginals, pairs, modes with their mass, and what it foretells."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from casadi_engine.posterior.comparison import Comparison
from casadi_engine.posterior.predictive import Predictive
from casadi_engine.posterior.result import Posterior
from casadi_engine.report import panels
from casadi_engine.report.figures import Maker, figures, last_cycle
from casadi_engine.report.sketch import Panel, Sketch
from casadi_engine.report.tables import as_html, table, text

Array = NDArray[np.float64]

ACROSS = 3
BARS = 24
# More parameters than this are too many for pairs; more draws are not all drawn there.
PAIRED, DOTS = 8, 500
# Samples of a record that can be told apart in its figure.
SEEN = 400
# Modes with a smaller share of the draws are not marked.
SMALL = 0.01


@figures.register
def _(result: Posterior) -> dict[str, Maker]:
    made: dict[str, Maker] = {"overview": lambda: _marginals(result)}
    if 1 < len(result.names) <= PAIRED:
        made["pairs"] = lambda: _pairs(result)
    made["modes"] = lambda: _modes(result)
    made |= {
        f"prediction {record.name}": partial(_foretold, result, record.name) for record in result.fit.data
    }
    return made


@figures.register
def _(result: Comparison) -> dict[str, Maker]:
    return {"overview": lambda: _evidence(result)}


@figures.register
def _(result: Predictive) -> dict[str, Maker]:
    return {"overview": lambda: _prediction(result, None)}


def _marginals(post: Posterior) -> Sketch:
    across = min(ACROSS, len(post.names))
    down = -(-len(post.names) // across)
    sketch = Sketch(3.5 * across + 0.4, 2.6 * down + 0.4, (down, across), key=True)
    for place, name in enumerate(post.names):
        draw_marginal(sketch.panel(*divmod(place, across)), post, name)
    return sketch


def draw_marginal(panel: Panel, post: Posterior, name: str) -> None:
    """Density of one parameter: draws, 95 % interval, modes, prior, and the normal density of the fit's error."""
    own, k = post[name], post.names.index(name)
    height, edges = np.histogram(own, BARS, density=True)
    low, high = post.interval(name, 0.95)
    panel.axvspan(low, high, color=panels.BAND, linewidth=0, zorder=0)
    # a figure that zooms knows one value for each place: the two ends of a step stand a little apart
    apart = 1e-4 * (edges[1] - edges[0]) * np.tile([1.0, -1.0], len(height))
    steps, tops = np.repeat(edges, 2)[1:-1] + apart, np.repeat(height, 2)
    panel.fill_between(steps, tops, color=panels.SIMULATED, alpha=0.35)
    panel.plot(steps, tops, color=panels.SIMULATED, linewidth=0.9, label="posterior, its 95 % shaded")
    fine = np.linspace(edges[0], edges[-1], 200)
    estimate, room = post.fit.estimates.get(name), 1.15
    if estimate is not None and estimate.stderr:
        room = 1.7
        normal = np.exp(-0.5 * ((fine - estimate.value) / estimate.stderr) ** 2)
        normal *= min(1 / (estimate.stderr * np.sqrt(2 * np.pi)), 1.6 * float(height.max()))
        panel.plot(fine, normal, color="0.45", linestyle="--", linewidth=1.0, label="the fit's error (cut)")
    if k < len(post.prior.low):
        density = post.prior.marginal(k, fine) * post.prior.coordinate_slope(k, fine)
        panel.plot(fine, density, color="#009E73", linewidth=1.0, label="prior")
    for mode in post.modes:
        if mode.mass >= SMALL:
            ends = [0.0, 0.06 * float(height.max())]
            panel.plot([mode.values[name]] * 2, ends, color=panels.PREDICTED, linewidth=2.0, label="modes")
    panel.ylim = (0.0, room * float(height.max()))
    unit = post.units[k]
    panels.dress(
        panel, x=f"{name} [{unit}]", y=f"density [1/({unit})]" if unit != "1" else "density", title=name
    )


def _pairs(post: Posterior) -> Sketch:
    """Draws of every two parameters; optima as crosses."""
    count = len(post.names)
    size = min(2.0 * (count - 1) + 1.2, 12.0)
    sketch = Sketch(size, size, (count - 1, count - 1))
    some = np.random.default_rng(0).choice(len(post.values), min(DOTS, len(post.values)), replace=False)
    for row in range(1, count):
        for column in range(row):
            panel = sketch.panel(row - 1, column)
            panel.plot(
                post.values[some, column], post.values[some, row], ".", color=panels.SIMULATED, markersize=2
            )
            for mode in post.modes:
                if mode.mass >= SMALL:
                    at = [mode.values[post.names[column]]], [mode.values[post.names[row]]]
                    panel.plot(*at, "x", color=panels.PREDICTED, markersize=6)
            panel.xticks = _two_ticks(post.values[some, column])
            last = row == count - 1
            panels.dress(
                panel,
                x=f"{post.names[column]} [{post.units[column]}]" if last else "",
                y=f"{post.names[row]} [{post.units[row]}]" if column == 0 else "",
            )
    return sketch


def _two_ticks(values: Array) -> list[float]:
    """Two round numbers well apart among the values: more do not fit under a small panel."""
    low, high = np.quantile(values, [0.03, 0.97])
    step = 10.0 ** np.floor(np.log10(max(high - low, 1e-300)))
    step = step if high - low > 2 * step else step / 2
    first, last = np.ceil(low / step) * step, np.floor(high / step) * step
    short = sum(len(f"{end:g}") for end in (first, last)) < 13
    return [float(first), float(last)] if last > first and short else [float(first)]


def _modes(post: Posterior) -> Sketch:
    """How far the modes lie below the highest, and the share of the probability in each."""
    sketch = Sketch(9, 3.0, (1, 2))
    left, right = sketch.cells()
    places = np.arange(1, len(post.modes) + 1)
    mass = np.array([mode.mass for mode in post.modes])
    below = np.array([mode.below for mode in post.modes])
    left.plot(places, below, "o-", color=panels.SIMULATED, markersize=4, linewidth=0.9)
    left.flipped, left.ylim = True, (-0.3, max(5.0, 1.1 * float(below.max())))
    right.bar(places, 100 * mass, 0.6, color=panels.SIMULATED)
    for panel, y, title in (
        (left, "log density below the highest", "height of the modes"),
        (right, "share of the draws [%]", "mass of the modes"),
    ):
        panel.xticks = places.tolist()
        panel.xlim = (0.4, len(places) + 0.6)
        panels.dress(panel, x="mode", y=y, title=title)
    right.ylim = (0.0, 105.0)
    return sketch


def _evidence(found: Comparison) -> Sketch:
    """How far the log evidence of each model lies below the best one's, with its standard error."""
    names = list(found.log_evidence)
    logs = np.array([found.log_evidence[name] for name in names])
    below, places = logs.max() - logs, np.arange(len(names))
    sketch = Sketch(8, 1.4 + 0.45 * len(names))
    panel = sketch.panel()
    for place, name in enumerate(names):
        panel.barh(place, float(below[place]), 0.5, color=panels.SIMULATED)
        share = 100 * found.probability[name]
        probable = f"{share:.3g} %" if share >= 1e-3 else "< 0.001 %"
        words = f" {below[place]:.2f} ± {found.error[name]:.2g}, probability {probable}"
        panel.write(words, float(below[place]), place, va="center")
    panel.ylim, panel.flipped = (-0.6, len(names) - 0.4), True
    panel.ynames = (places.tolist(), names)
    panel.xlim = (0.0, max(1.0, 1.8 * float(below.max())))
    panels.dress(
        panel, x="log evidence below that of the best model", y="", title="which model the records ask for"
    )
    return sketch


def _foretold(post: Posterior, record: str) -> Sketch:
    data = next(one for one in post.fit.data if one.name == record)
    return _prediction(post.predictive(data), post)


def _prediction(found: Predictive, post: Posterior | None) -> Sketch:
    """Measured outputs and the band of the simulated ones, whole and the last engine cycle; less their median below."""
    names = list(found.runs)
    sketch = Sketch(10, 2.4 * 2 * len(names) + 0.5, (2 * len(names), 1), key=True)
    for k, name in enumerate(names):
        low, high = found.band(name)
        middle = np.median(found.runs[name], axis=0)
        inside = found.time >= _zoom(found, post)
        part = "" if inside.all() else ", the last part"
        at, measured = found.time[inside], found.measured.get(name)
        top, bottom = sketch.panel(2 * k), sketch.panel(2 * k + 1)
        for panel, base in ((top, np.zeros_like(middle)), (bottom, middle)):
            if measured is not None:
                left = (measured - base)[inside]
                panel.plot(at, left, color=panels.MEASURED, linewidth=0.7, label="measured")
            panel.fill_between(
                at, (low - base)[inside], (high - base)[inside], color=panels.PREDICTED, alpha=0.6,
                label="95 % of the posterior's simulations",
            )  # fmt: skip
            panel.plot(
                at, (middle - base)[inside], color=panels.SIMULATED, linewidth=0.9, label="their median"
            )
        sigma = float(np.median(found.sigma[name]))
        for side in (-1.96, 1.96):
            bottom.axhline(side * sigma, color="0.6", linewidth=0.8, linestyle=":")
        label = f"{name} [{found.units[name]}]"
        panels.dress(top, x="", y=label, title=f"{found.record}: {name}{part}")
        panels.dress(bottom, x="time [s]", y=label, title="less the median; dotted: 95 % of the noise")
    return sketch


def _zoom(found: Predictive, post: Posterior | None) -> float:
    """Begin of what is drawn [s]: the last engine cycle, or the last twentieth, with as many samples as can be seen."""
    begin = found.time[-1] - (found.time[-1] - found.time[0]) / 20
    if post is not None:
        traces = post.fit.traces[found.record]
        data = next(one for one in post.fit.data if one.name == found.record)
        begin = last_cycle(next(iter(traces.values())), data)[0]
    return float(min(begin, found.time[-min(SEEN, len(found.time))]))


@text.register
def _(result: Posterior) -> str:
    return str(result)


@as_html.register
def _(result: Posterior) -> str:
    rows = [
        (name, f"{result.median[name]:.5g}", *(f"{end:.5g}" for end in result.interval(name, 0.95)), unit)
        for name, unit in zip(result.names, result.units, strict=True)
    ]
    caption = f"Posterior by {result.method}, {len(result.values)} draws; the intervals hold 95 %"
    return table(("parameter", "median", "from", "to", "unit"), rows, right=(1, 2, 3), caption=caption)
