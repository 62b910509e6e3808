"""One panel of a figure each: a function that puts data into a panel."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.fit import Estimate, Fit, Optimum, Trace
from casadi_engine.estimation.summary import BOUND_WORDS, number, parameter_of
from casadi_engine.experiment.channel import sampling_rate
from casadi_engine.report.sketch import Panel
from casadi_engine.report.spectrum import welch
from casadi_engine.validation.correlation import Correlation

Array = NDArray[np.float64]

# Okabe and Ito's colours: told apart by colour-blind readers and in grey print.
MEASURED, SIMULATED, PREDICTED, BAND = "0.45", "#0072B2", "#D55E00", "0.88"
# Optima of a multi-start by rising cost, the last colour for all that are left.
OPTIMA = (SIMULATED, PREDICTED, "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
NORMAL_95 = 1.959964
# With more samples than this, single ones are not marked.
MARKED = 400
# Peaks of a residual's spectrum are named above this multiple of white noise (at 15 averages noise reaches 3), so many.
NOTICED, MOST_LINES = 5.0, 4


@dataclass(frozen=True)
class Subject:
    """What a trace is of: record, output, unit, sigma of its noise and whether it was estimated."""

    record: str
    output: str
    unit: str
    sigma: float | None = None
    estimated: bool = False

    @property
    def title(self) -> str:
        return f"{self.record}: {self.output}"

    def label(self, what: str = "") -> str:
        return f"{what or self.output} [{self.unit or '1'}]"


def dress(panel: Panel, *, x: str, y: str, title: str = "") -> None:
    """Labels and title."""
    panel.x, panel.y, panel.title = x, y, title or panel.title


def draw_trace(
    panel: Panel, trace: Trace, subject: Subject, *, window: tuple[float, float] | None = None
) -> None:
    """Measured, simulated and predicted output over time; ``window`` [s] shows a part, sample by sample."""
    inside = np.ones(trace.time.size, bool)
    if window is not None:
        inside = (trace.time >= window[0]) & (trace.time <= window[1])
    time = trace.time[inside]
    measured = np.where(trace.mask, trace.measured, np.nan)[inside]
    few = time.size <= MARKED
    if few or (window is not None and time.size <= 10 * MARKED):
        panel.plot(time, measured, ".", color=MEASURED, markersize=3 if few else 1.5, label="measured")
    else:
        panel.plot(time, measured, color=MEASURED, linewidth=1.6, label="measured")
    panel.plot(time, trace.simulated[inside], color=SIMULATED, linewidth=0.9, label="simulated")
    # Over a whole record the prediction would hide the simulation.
    if trace.predicted is not None and (window is not None or few):
        words = "predicted one step ahead"
        panel.plot(time, trace.predicted[inside], color=PREDICTED, linewidth=0.9, linestyle="--", label=words)
    panel.margin = 0.01
    if window is None:
        panel.linked = subject.title
    title = subject.title if window is None else f"the last {1000 * (window[1] - window[0]):.3g} ms of it"
    dress(panel, x="time [s]", y=subject.label(), title=title)


def draw_residual(panel: Panel, trace: Trace, subject: Subject) -> None:
    """The residual over time with the band ±2σ of its noise, and the share of samples inside."""
    residual = trace.residual
    found = np.isfinite(residual)
    panel.linked, panel.margin = subject.title, 0.01
    panel.axhline(0.0, color="0.6", linewidth=0.6)
    title = f"residual, measured less {'simulated' if trace.predicted is None else 'predicted'}"
    if subject.sigma is not None and math.isfinite(subject.sigma):
        band = 2 * subject.sigma
        known = "estimated" if subject.estimated else "known"
        label = f"±2σ, σ = {subject.sigma:.3g} {subject.unit} ({known})"
        panel.axhspan(-band, band, color=BAND, linewidth=0)
        for edge, words in ((band, label), (-band, None)):
            panel.axhline(edge, color=PREDICTED, linewidth=0.9, linestyle="--", zorder=3, label=words)
        if found.any():
            share = 100 * np.mean(np.abs(residual[found]) <= band)
            title += f" ({share:.1f} % inside ±2σ, 95.4 % expected)"
    if residual.size <= MARKED:
        panel.plot(trace.time, residual, ".", color=SIMULATED, markersize=3)
    else:
        panel.plot(trace.time, residual, color=SIMULATED, linewidth=0.6)
    if found.any():
        tallest = max(float(np.max(np.abs(residual[found]))), 2 * (subject.sigma or 0.0))
        if tallest > 0 and math.isfinite(tallest):
            panel.ylim, panel.room = (-1.1 * tallest, 1.1 * tallest), 0.2
    else:
        panel.note = "no sample counts"
    panel.key = "upper right"
    dress(panel, x="time [s]", y=subject.label("residual"), title=title)


def draw_spectrum(panel: Panel, trace: Trace, subject: Subject) -> None:
    """Power spectral density of the residual (Welch), and the level of white noise of its sigma."""
    residual, rate = trace.residual, sampling_rate(trace.time)
    found = np.isfinite(residual)
    title, unit = "spectrum of the residual", f"density [({subject.unit or '1'})²/Hz]"
    dress(panel, x="frequency [Hz]", y=unit, title=title)
    if rate is None:
        panel.note = "no spectrum: the times are not evenly spaced"
        return
    if found.sum() < 16:
        panel.note = "no spectrum: fewer than 16 samples"
        return
    # Missing samples count as zero; dividing by the share of valid ones keeps the level of white noise.
    filled = np.where(found, residual, 0.0) - np.where(found, residual[found].mean(), 0.0)
    frequency, density = welch(filled, rate, min(filled.size, max(256, filled.size // 8)))
    density = density / found.mean()
    positive = (frequency > 0) & (density > 0)
    if not positive.any():
        panel.note = "no spectrum: the residual is constant"
        return
    panel.xscale = panel.yscale = "log"
    panel.plot(frequency[positive], density[positive], color=SIMULATED, linewidth=0.8)
    if subject.sigma is not None and math.isfinite(subject.sigma) and subject.sigma > 0:
        level = 2 * subject.sigma**2 / rate
        _mark_lines(panel, frequency, density, level)
        panel.axhline(level, color=PREDICTED, linewidth=0.9, linestyle="--", label="white noise of this σ")
        panel.key = "best"
    if not found.all():
        panel.title = f"{title} ({100 * (1 - found.mean()):.2g} % missing, as zero)"


def _mark_lines(panel: Panel, frequency: Array, density: Array, level: float) -> None:
    """Write the frequencies of the strongest peaks over them: there the model lacks something."""
    inner = np.flatnonzero(
        (density[1:-1] > density[:-2]) & (density[1:-1] >= density[2:]) & (density[1:-1] > NOTICED * level)
    )
    for peak in 1 + inner[np.argsort(density[1 + inner])[::-1][:MOST_LINES]]:
        words = f"{frequency[peak]:.3g} Hz"
        panel.write(words, frequency[peak], density[peak], shift=(0, 2), ha="center", size=7)


def draw_correlation(panel: Panel, correlation: Correlation, *, title: str, with_itself: bool) -> None:
    """Correlation coefficients over lags with their 99 % band."""
    dress(panel, x="lag [samples]", y="correlation [1]", title=title)
    if correlation.values is None or correlation.band is None:
        panel.note = correlation.why or "no correlation"
        return
    lags = correlation.lags
    first = 1 if with_itself else 0  # lag 0 of an autocorrelation is 1 and would squeeze the rest
    lags, values, band = lags[first:], correlation.values[first:], correlation.band[first:]
    told = np.isfinite(values) & np.isfinite(band)
    if not told.any():  # no two samples are so few steps apart
        panel.note = "no correlation: too few pairs of samples"
        return
    lags, values, band = lags[told], values[told], band[told]
    panel.fill_between(lags, -band, band, color=BAND, linewidth=0, step="mid", label="99 % band")
    outside = np.abs(values) > band
    panel.axhline(0.0, color="0.6", linewidth=0.6)
    for chosen, colour, label in ((~outside, SIMULATED, "inside"), (outside, PREDICTED, "outside")):
        if chosen.any():
            panel.vlines(lags[chosen], 0, values[chosen], color=colour, linewidth=1.0)
            panel.plot(lags[chosen], values[chosen], "o", color=colour, markersize=2.5, label=label)
    panel.key = "upper right"
    tallest = max(float(np.abs(values).max()), float(band.max()))
    panel.ylim, panel.room = (-1.2 * tallest, 1.2 * tallest), 0.2


def draw_parameters(panel: Panel, fit: Fit, names: Sequence[str]) -> None:
    """Change of each free parameter from its start in percent, with its 95 % interval."""
    rows = range(len(names) - 1, -1, -1)
    for row, name in zip(rows, names, strict=True):
        estimate = fit.estimates[name]
        scale = _scale(fit, name)
        change = 100 * (estimate.value - fit.start.get(name, estimate.value)) / scale
        error = half_width(estimate)
        if estimate.interval is not None:
            ends = [change + 100 * (end - estimate.value) / scale for end in estimate.interval]
            panel.plot(ends, [row, row], "|-", color=SIMULATED)
            panel.plot(change, row, "o", color=SIMULATED, markersize=4)
            continue
        if error is not None:
            width = 100 * error / scale
            panel.errorbar(change, row, xerr=width, color=SIMULATED, capsize=3, markersize=4)
            continue
        shape, words = "x", "no error"
        if estimate.at_bound:
            shape, words = (
                "<" if estimate.at_bound == "min" else ">",
                f"at its {BOUND_WORDS[estimate.at_bound]} bound",
            )
        panel.plot(change, row, shape, color=PREDICTED, markersize=7)
        panel.write(words, change, row, shift=(8, 6), color=PREDICTED)
    panel.axvline(0.0, color="0.4", linewidth=0.8, linestyle=":")
    panel.ynames = (list(rows), list(names))
    panel.ylim = (-0.7, len(names) - 0.3)
    panel.margin = 0.15
    title = "estimates with 95 % intervals"
    if _mark_bounds(panel, fit, names):
        title += " (black: bounds)"
    dress(panel, x="change from the start value [%]", y="parameter", title=title)


def _mark_bounds(panel: Panel, fit: Fit, names: Sequence[str]) -> bool:
    """Mark the bounds that lie within the panel; the others are too far off to matter."""
    panel.xlim = low, high = panel.limits("x")
    marked = False
    for row, name in zip(range(len(names) - 1, -1, -1), names, strict=True):
        parameter = parameter_of(fit, name)
        for bound in () if parameter is None else (parameter.min, parameter.max):
            start = fit.start.get(name, fit.estimates[name].value)
            place = 100 * (bound - start) / _scale(fit, name) if math.isfinite(bound) else math.nan
            if low < place < high:
                panel.plot(place, row, "|", color="black", markersize=14, zorder=1)
                marked = True
    return marked


def draw_precision(panel: Panel, fit: Fit, names: Sequence[str]) -> None:
    """Half width of each 95 % interval as a share of the value, on a logarithmic axis."""
    rows = range(len(names) - 1, -1, -1)
    widths = []
    for row, name in zip(rows, names, strict=True):
        estimate = fit.estimates[name]
        error = half_width(estimate)
        if error is None or error <= 0 or estimate.value == 0:
            panel.write("at its bound" if estimate.at_bound else "none", 0.02, row, inside=True, va="center")
            continue
        widths.append(100 * error / abs(estimate.value))
        panel.plot(widths[-1], row, "o", color=SIMULATED, markersize=5)
        panel.write(f"{number(widths[-1], '.2g')} %", widths[-1], row, shift=(6, 4))
    if widths:
        panel.xscale, panel.xlim = "log", (min(widths) / 4, max(widths) * 8)
    panel.ynames = (list(rows), [""] * len(names))
    panel.ylim = (-0.7, len(names) - 0.3)
    dress(panel, x="95 % half width [% of the value]", y="", title="how sure")


def half_width(estimate: Estimate) -> float | None:
    """Half width of the 95 % interval in the parameter's unit; None where there is none."""
    if estimate.interval is not None:
        return (estimate.interval[1] - estimate.interval[0]) / 2
    if estimate.at_bound or estimate.stderr is None or not math.isfinite(estimate.stderr):
        return None
    return NORMAL_95 * estimate.stderr


def _scale(fit: Fit, name: str) -> float:
    """What a change is measured against: the start, or the value if that is zero."""
    return abs(fit.start.get(name, 0.0)) or abs(fit.estimates[name].value) or 1.0


def draw_matrix(panel: Panel, matrix: Array, names: Sequence[str]) -> None:
    """Correlation matrix as a map from −1 to 1, grey where there is no number."""
    panel.imshow(matrix, label="correlation [1]")
    panel.xnames = panel.ynames = (range(len(names)), list(names))
    panel.tilted = len(names) > 6
    dress(panel, x="parameter", y="parameter", title="correlation of the estimates (grey: no error)")


def draw_waterfall(panel: Panel, optima: Sequence[Optimum]) -> None:
    """Cost of every start above the lowest one, sorted; starts in one optimum stand beside each other in one colour."""
    ordered = sorted((o for o in optima if math.isfinite(o.cost)), key=lambda optimum: optimum.cost)
    dress(panel, x="start, sorted by cost", y="cost above the lowest [1]", title="where the starts ended")
    if not ordered:
        panel.note = "no start ended at a finite cost"
        return
    above = [optimum.cost - ordered[0].cost for optimum in ordered]
    ends = np.cumsum([optimum.starts for optimum in ordered])
    every = np.repeat(above, [o.starts for o in ordered])
    panel.plot(np.arange(1, ends[-1] + 1), every, color="0.8", linewidth=0.8, zorder=1)
    named = 0
    for optimum, cost, end in zip(ordered, above, ends, strict=True):
        places = np.arange(end - optimum.starts + 1, end + 1)
        good = optimum.status == "converged"
        colour = OPTIMA[min(named, len(OPTIMA) - 1)] if good else MEASURED
        label = _optimum_words(optimum, cost) if named < len(OPTIMA) else None
        if not good:
            label = None if "not converged" in panel.labels else "not converged"
        shape = "o" if good else "x"
        panel.plot(places, np.full(places.size, cost), shape, color=colour, markersize=5, label=label)
        named += good
    # Linear up to 1, where costs cannot be told apart by the data, logarithmic above.
    panel.yscale = "symlog"
    panel.ylim = (-0.3, max(3.0, 3 * above[-1]))  # room below for the lowest points
    panel.xlim = (0.5, ends[-1] + 0.5)
    panel.xticks = range(1, ends[-1] + 1, -(-ends[-1] // 10))
    lost = sum(o.starts for o in optima if not math.isfinite(o.cost))
    if lost:
        panel.title = f"where the starts ended ({lost} without a finite cost are not shown)"
    panel.key = "center left"


def _optimum_words(optimum: Optimum, above: float) -> str:
    """An optimum in a legend: how many starts, how far above, in which direction."""
    starts = f"{optimum.starts} start{'s' if optimum.starts > 1 else ''}"
    if not optimum.apart:
        return f"{starts}, the lowest" if above == 0 else f"{starts}, +{number(above)}"
    return textwrap.fill(f"{starts}, +{number(above)}: {optimum.apart}", 34)
