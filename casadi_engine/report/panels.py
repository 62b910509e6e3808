"""One panel of a figure each: a function that draws data into matplotlib axes."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.fit import Estimate, Fit, Optimum, Trace
from casadi_engine.estimation.summary import BOUND_WORDS, number, parameter_of
from casadi_engine.experiment.channel import sampling_rate
from casadi_engine.report.envelope import envelope
from casadi_engine.validation.correlation import Correlation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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


def dress(ax: Axes, *, x: str, y: str, title: str = "") -> None:
    """Labels, a light grid and no frame above and right."""
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    if title:
        ax.set_title(title, loc="left")
    ax.grid(True, color="0.92", linewidth=0.6)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def note(ax: Axes, text: str) -> None:
    """Say in the middle of a panel why it is empty."""
    wrapped = "\n".join(textwrap.wrap(text, 42))
    ax.text(0.5, 0.5, wrapped, transform=ax.transAxes, ha="center", va="center", color="0.3", fontsize=8)
    ax.set_xticks([])
    ax.set_yticks([])


def draw_trace(
    ax: Axes, trace: Trace, subject: Subject, *, window: tuple[float, float] | None = None
) -> None:
    """Measured, simulated and predicted output over time; ``window`` [s] shows a part, sample by sample."""
    inside = np.ones(trace.time.size, bool)
    if window is not None:
        inside = (trace.time >= window[0]) & (trace.time <= window[1])
    time = trace.time[inside]
    measured = np.where(trace.mask, trace.measured, np.nan)[inside]
    few = time.size <= MARKED
    if few or (window is not None and time.size <= 10 * MARKED):
        size = 3 if few else 1.5
        # Many dots as paths would make a vector figure of megabytes.
        ax.plot(time, measured, ".", color=MEASURED, markersize=size, label="measured", rasterized=not few)
    else:
        ax.plot(*envelope(time, measured), color=MEASURED, linewidth=1.6, label="measured")
    ax.plot(*envelope(time, trace.simulated[inside]), color=SIMULATED, linewidth=0.9, label="simulated")
    # Over a whole record the prediction would hide the simulation.
    if trace.predicted is not None and (window is not None or few):
        predicted = envelope(time, trace.predicted[inside])
        ax.plot(*predicted, color=PREDICTED, linewidth=0.9, linestyle="--", label="predicted one step ahead")
    title = subject.title if window is None else f"the last {1000 * (window[1] - window[0]):.3g} ms of it"
    dress(ax, x="time [s]", y=subject.label(), title=title)


def draw_residual(ax: Axes, trace: Trace, subject: Subject) -> None:
    """The residual over time with the band ±2σ of its noise, and the share of samples inside."""
    residual = trace.residual
    found = np.isfinite(residual)
    ax.axhline(0.0, color="0.6", linewidth=0.6)
    title = f"residual, measured less {'simulated' if trace.predicted is None else 'predicted'}"
    if subject.sigma is not None and math.isfinite(subject.sigma):
        band = 2 * subject.sigma
        known = "estimated" if subject.estimated else "known"
        label = f"±2σ, σ = {subject.sigma:.3g} {subject.unit} ({known})"
        ax.axhspan(-band, band, color=BAND, linewidth=0)
        for edge, words in ((band, label), (-band, None)):
            ax.axhline(edge, color=PREDICTED, linewidth=0.9, linestyle="--", zorder=3, label=words)
        if found.any():
            share = 100 * np.mean(np.abs(residual[found]) <= band)
            title += f" ({share:.1f} % inside ±2σ, 95.4 % expected)"
    if residual.size <= MARKED:
        ax.plot(trace.time, residual, ".", color=SIMULATED, markersize=3)
    else:
        ax.plot(*envelope(trace.time, residual), color=SIMULATED, linewidth=0.6)
    if found.any():
        tallest = max(float(np.max(np.abs(residual[found]))), 2 * (subject.sigma or 0.0))
        if tallest > 0 and math.isfinite(tallest):
            ax.set_ylim(-1.1 * tallest, 1.5 * tallest)  # room for the legend
    else:
        note(ax, "no sample counts")
    dress(ax, x="time [s]", y=subject.label("residual"), title=title)


def draw_spectrum(ax: Axes, trace: Trace, subject: Subject) -> None:
    """Power spectral density of the residual (Welch), and the level of white noise of its sigma."""
    from scipy import signal  # slow to import, and only needed here

    residual, rate = trace.residual, sampling_rate(trace.time)
    found = np.isfinite(residual)
    dress(
        ax, x="frequency [Hz]", y=f"density [({subject.unit or '1'})²/Hz]", title="spectrum of the residual"
    )
    if rate is None:
        note(ax, "no spectrum: the times are not evenly spaced")
        return
    if found.sum() < 16:
        note(ax, "no spectrum: fewer than 16 samples")
        return
    # Missing samples count as zero; dividing by the share of valid ones keeps the level of white noise.
    filled = np.where(found, residual, 0.0) - np.where(found, residual[found].mean(), 0.0)
    segment = min(filled.size, max(256, filled.size // 8))
    frequency, density = signal.welch(filled, fs=rate, nperseg=segment, detrend=False)
    density = density / found.mean()
    positive = (frequency > 0) & (density > 0)
    if not positive.any():
        note(ax, "no spectrum: the residual is constant")
        return
    ax.loglog(frequency[positive], density[positive], color=SIMULATED, linewidth=0.8)
    _plain_log_labels(ax.xaxis)
    _plain_log_labels(ax.yaxis)
    if subject.sigma is not None and math.isfinite(subject.sigma) and subject.sigma > 0:
        level = 2 * subject.sigma**2 / rate
        _mark_lines(ax, frequency, density, level)
        ax.axhline(level, color=PREDICTED, linewidth=0.9, linestyle="--", label="white noise of this σ")
        ax.legend(frameon=False, loc="best")
    if not found.all():
        ax.set_title(
            f"spectrum of the residual ({100 * (1 - found.mean()):.2g} % missing, as zero)", loc="left"
        )


def _mark_lines(ax: Axes, frequency: Array, density: Array, level: float) -> None:
    """Write the frequencies of the strongest peaks over them: there the model lacks something."""
    inner = np.flatnonzero(
        (density[1:-1] > density[:-2]) & (density[1:-1] >= density[2:]) & (density[1:-1] > NOTICED * level)
    )
    peaks = 1 + inner[np.argsort(density[1 + inner])[::-1][:MOST_LINES]]
    for peak in peaks:
        words = f"{frequency[peak]:.3g} Hz"
        ax.annotate(
            words,
            (frequency[peak], density[peak]),
            (0, 2),
            textcoords="offset points",
            ha="center",
            fontsize=7,
        )


def _plain_log_labels(axis: Any) -> None:
    """Labels such as 100 and 2e-05: powers set as formulas take half of the time of a figure."""
    from matplotlib.ticker import LogFormatter

    axis.set_major_formatter(LogFormatter())
    axis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.5)))


def draw_correlation(ax: Axes, correlation: Correlation, *, title: str, with_itself: bool) -> None:
    """Correlation coefficients over lags with their 99 % band."""
    dress(ax, x="lag [samples]", y="correlation [1]", title=title)
    if correlation.values is None or correlation.band is None:
        note(ax, correlation.why or "no correlation")
        return
    lags = correlation.lags
    first = 1 if with_itself else 0  # lag 0 of an autocorrelation is 1 and would squeeze the rest
    lags, values, band = lags[first:], correlation.values[first:], correlation.band[first:]
    ax.fill_between(lags, -band, band, color=BAND, linewidth=0, step="mid", label="99 % band")
    outside = np.abs(values) > band
    ax.axhline(0.0, color="0.6", linewidth=0.6)
    for chosen, colour, label in ((~outside, SIMULATED, "inside"), (outside, PREDICTED, "outside")):
        if chosen.any():
            ax.vlines(lags[chosen], 0, values[chosen], color=colour, linewidth=1.0)
            ax.plot(lags[chosen], values[chosen], "o", color=colour, markersize=2.5, label=label)
    ax.legend(frameon=False, loc="upper right", ncols=3)
    tallest = max(float(np.nanmax(np.abs(values))), float(np.nanmax(band)))
    ax.set_ylim(-1.2 * tallest, 1.6 * tallest)


def draw_parameters(ax: Axes, fit: Fit, names: Sequence[str]) -> None:
    """Change of each free parameter from its start in percent, with its 95 % interval."""
    rows = np.arange(len(names))[::-1]
    for row, name in zip(rows, names, strict=True):
        estimate = fit.estimates[name]
        scale = _scale(fit, name)
        change = 100 * (estimate.value - fit.start.get(name, estimate.value)) / scale
        error = half_width(estimate)
        if estimate.at_bound:
            shape = "<" if estimate.at_bound == "min" else ">"
            ax.plot(change, row, shape, color=PREDICTED, markersize=7)
            words = f"at its {BOUND_WORDS[estimate.at_bound]} bound"
            ax.annotate(words, (change, row), (8, 6), textcoords="offset points", fontsize=8, color=PREDICTED)
        elif error is None:
            ax.plot(change, row, "x", color=PREDICTED, markersize=6)
            ax.annotate(
                "no error", (change, row), (8, 6), textcoords="offset points", fontsize=8, color=PREDICTED
            )
        else:
            ax.errorbar(
                change, row, xerr=100 * error / scale, fmt="o", color=SIMULATED, capsize=3, markersize=4
            )
    ax.axvline(0.0, color="0.4", linewidth=0.8, linestyle=":")
    ax.set_yticks(rows, list(names))
    ax.set_ylim(-0.7, len(names) - 0.3)
    ax.margins(x=0.15)
    title = "estimates with 95 % intervals"
    if _mark_bounds(ax, fit, names):
        title += " (black: bounds)"
    dress(ax, x="change from the start value [%]", y="parameter", title=title)


def _mark_bounds(ax: Axes, fit: Fit, names: Sequence[str]) -> bool:
    """Mark the bounds that lie within the panel; the others are too far off to matter."""
    low, high = ax.get_xlim()
    marked = False
    for row, name in zip(range(len(names) - 1, -1, -1), names, strict=True):
        parameter = parameter_of(fit, name)
        for bound in () if parameter is None else (parameter.min, parameter.max):
            start = fit.start.get(name, fit.estimates[name].value)
            place = 100 * (bound - start) / _scale(fit, name) if math.isfinite(bound) else math.nan
            if low < place < high:
                ax.plot(place, row, "|", color="black", markersize=14, zorder=1)
                marked = True
    ax.set_xlim(low, high)
    return marked


def draw_precision(ax: Axes, fit: Fit, names: Sequence[str]) -> None:
    """Half width of each 95 % interval as a share of the value, on a logarithmic axis."""
    rows = np.arange(len(names))[::-1]
    widths = []
    for row, name in zip(rows, names, strict=True):
        estimate = fit.estimates[name]
        error = half_width(estimate)
        if error is None or error <= 0 or estimate.value == 0:
            why = "at its bound" if estimate.at_bound else "none"
            ax.annotate(why, (0.02, row), xycoords=("axes fraction", "data"), va="center", fontsize=8)
            continue
        widths.append(100 * error / abs(estimate.value))
        ax.plot(widths[-1], row, "o", color=SIMULATED, markersize=5)
        ax.annotate(
            f"{number(widths[-1], '.2g')} %",
            (widths[-1], row),
            (6, 4),
            textcoords="offset points",
            fontsize=8,
        )
    if widths:
        ax.set_xscale("log")
        _plain_log_labels(ax.xaxis)
        ax.set_xlim(min(widths) / 4, max(widths) * 8)
    ax.set_yticks(rows, [""] * len(names))
    ax.set_ylim(-0.7, len(names) - 0.3)
    dress(ax, x="95 % half width [% of the value]", y="", title="how sure")


def half_width(estimate: Estimate) -> float | None:
    """Half width of the 95 % interval in the parameter's unit; None where there is no symmetric error."""
    if estimate.at_bound or estimate.stderr is None or not math.isfinite(estimate.stderr):
        return None
    return NORMAL_95 * estimate.stderr


def _scale(fit: Fit, name: str) -> float:
    """What a change is measured against: the start, or the value if that is zero."""
    return abs(fit.start.get(name, 0.0)) or abs(fit.estimates[name].value) or 1.0


def draw_matrix(ax: Axes, matrix: Array, names: Sequence[str]) -> Any:
    """Correlation matrix as a map from −1 to 1, hatched where there is no number; returns the image."""
    shown = np.ma.masked_invalid(matrix)
    ax.set_facecolor("0.93")
    image = ax.imshow(shown, vmin=-1, vmax=1, cmap="RdBu_r", interpolation="nearest")
    places = range(len(names))
    ax.set_xticks(
        places, list(names), rotation=90 if len(names) > 6 else 45, ha="center" if len(names) > 6 else "right"
    )
    ax.set_yticks(places, list(names))
    ax.set_xlabel("parameter")
    ax.set_ylabel("parameter")
    ax.set_title("correlation of the estimates (grey: no error)", loc="left")
    if len(names) <= 12:
        for (i, j), value in np.ndenumerate(matrix):
            if np.isfinite(value):
                colour = "white" if abs(value) > 0.6 else "black"
                ax.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=8, color=colour)
    return image


def draw_waterfall(ax: Axes, optima: Sequence[Optimum]) -> None:
    """Cost of every start above the lowest one, sorted; starts in one optimum stand beside each other in one colour."""
    from matplotlib.ticker import MaxNLocator

    ordered = sorted((o for o in optima if math.isfinite(o.cost)), key=lambda optimum: optimum.cost)
    dress(ax, x="start, sorted by cost", y="cost above the lowest [1]", title="where the starts ended")
    if not ordered:
        note(ax, "no start ended at a finite cost")
        return
    above = [optimum.cost - ordered[0].cost for optimum in ordered]
    ends = np.cumsum([optimum.starts for optimum in ordered])
    ax.plot(
        np.arange(1, ends[-1] + 1),
        np.repeat(above, [o.starts for o in ordered]),
        color="0.8",
        linewidth=0.8,
        zorder=1,
    )
    named = 0
    for optimum, cost, end in zip(ordered, above, ends, strict=True):
        places = np.arange(end - optimum.starts + 1, end + 1)
        good = optimum.status == "converged"
        colour = OPTIMA[min(named, len(OPTIMA) - 1)] if good else MEASURED
        label = _optimum_words(optimum, cost) if named < len(OPTIMA) else None
        if not good:
            label = None if "not converged" in ax.get_legend_handles_labels()[1] else "not converged"
        ax.plot(
            places, np.full(places.size, cost), "o" if good else "x", color=colour, markersize=5, label=label
        )
        named += good
    # Linear up to 1, where costs cannot be told apart by the data, logarithmic above.
    ax.set_yscale("symlog", linthresh=1.0)
    # room below for the lowest points, above for the names
    ax.set_ylim(-0.3, max(3.0, 3 * above[-1]))
    ax.set_xlim(0.5, ends[-1] + 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    lost = sum(o.starts for o in optima if not math.isfinite(o.cost))
    if lost:
        ax.set_title(f"where the starts ended ({lost} without a finite cost are not shown)", loc="left")
    ax.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8)


def _optimum_words(optimum: Optimum, above: float) -> str:
    """An optimum in a legend: how many starts, how far above, in which direction."""
    starts = f"{optimum.starts} start{'s' if optimum.starts > 1 else ''}"
    if not optimum.apart:
        return f"{starts}, the lowest" if above == 0 else f"{starts}, +{number(above)}"
    return textwrap.fill(f"{starts}, +{number(above)}: {optimum.apart}", 34)
