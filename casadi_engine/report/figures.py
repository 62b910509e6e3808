"""Figures of results, built from panels with matplotlib's object interface (no display is needed)."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import singledispatch
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.errors import OutputError, ResultError
from casadi_engine.estimation.fit import Fit, Trace
from casadi_engine.experiment import Experiment
from casadi_engine.report import panels
from casadi_engine.report.envelope import envelope
from casadi_engine.report.files import write_file
from casadi_engine.report.kinds import Simulated, not_shown
from casadi_engine.report.panels import Subject
from casadi_engine.validation import autocorrelation
from casadi_engine.validation.validate import Validation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Maker = Callable[[], Any]  # () -> matplotlib Figure
FORMATS = ("png", "svg", "pdf")
# Records drawn in one overview; the pages have a figure for each.
OVERVIEW = 4
STYLE = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "svg.hashsalt": "casadi-engine",
    "figure.facecolor": "white",
    "axes.facecolor": "white",
}


def plot(result: Any, *, path: Any = None, what: str = "overview") -> Figure:
    """Draw a result and return the matplotlib Figure; with ``path`` (.png, .svg, .pdf) also write it.

    result : a Fit, a Validation, a Simulated, a Repair, an Experiment, Orders, Modes, a Reduction, or a loaded
    result
    what : "overview", or one of the figures that ``figures(result)`` lists

    Raises ResultError for an unknown kind or figure, OutputError when the file cannot be written.
    """
    known = figures(result)
    if what not in known:
        raise ResultError(
            "there is no such figure of this result",
            seen=repr(what),
            allowed=", ".join(map(repr, known)),
            cure="give one of them, or leave `what` out",
        )
    with styled():
        figure = known[what]()
    if path is not None:
        _save(figure, path)
    return figure


@singledispatch
def figures(result: Any) -> dict[str, Maker]:
    """Name -> function that makes the figure, in the order of a report; "overview" is the first."""
    raise not_shown(result, "plot")


@figures.register
def _(result: Fit) -> dict[str, Maker]:
    made: dict[str, Maker] = {"overview": lambda: _overview(result.traces, result, result.data)}
    made |= _trace_figures(result.traces, result, result.data)
    made |= {
        f"autocorrelation {record} {output}": _later(
            _autocorrelation, trace, subject_of(result, record, output)
        )
        for record, output, trace in each(result.traces)
    }
    if result.free:
        made["parameters"] = lambda: _parameters(result)
    if len(result.free) > 1:
        made["correlation matrix"] = lambda: _matrix(result)
    if sum(optimum.starts for optimum in result.optima) > 1:
        made["waterfall"] = lambda: _waterfall(result)
    return made


@figures.register
def _(result: Validation) -> dict[str, Maker]:
    traces = {
        record: {output: check.trace for output, check in outputs.items()}
        for record, outputs in result.records.items()
    }
    made: dict[str, Maker] = {"overview": lambda: _overview(traces, result.fit, result.fit.data)}
    made |= _trace_figures(traces, result.fit, result.fit.data)
    made |= {
        f"correlation {record} {output}": _later(_correlations, check, subject_of(result.fit, record, output))
        for record, output, check in each(result.records)
    }
    return made


@figures.register
def _(result: Experiment) -> dict[str, Maker]:
    return {"overview": lambda: _channels(result, result.names)}


@figures.register
def _(result: Simulated) -> dict[str, Maker]:
    names = [variable.name for variable in result.model.outputs]
    made: dict[str, Maker] = {"overview": lambda: _simulated(result, names)}
    made |= {f"record {one.name}": _later(_channels, one, one.names) for one in result.simulated}
    return made


def each(nested: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[str, str, Any]]:
    """(record, output, entry) of everything by record and output."""
    for record, outputs in nested.items():
        for output, entry in outputs.items():
            yield record, output, entry


def subject_of(fit: Fit, record: str, output: str) -> Subject:
    """Record, output, unit and noise for labels."""
    unit = {variable.name: variable.unit for variable in fit.model.outputs}.get(output, "1")
    sigma, estimated = fit.noise.get(output, (None, False))
    return Subject(record, output, unit, sigma, estimated)


def last_cycle(trace: Trace, experiment: Experiment | None) -> tuple[float, float]:
    """First and last time [s] of the last engine cycle, or of the last twentieth without a crank angle."""
    end = float(trace.time[-1])
    begin = end - (end - float(trace.time[0])) / 20
    if experiment is not None and "theta" in experiment:
        theta = experiment["theta"]
        turned = theta.values <= np.interp(end, theta.time, theta.values) - 4 * math.pi
        if turned.any():
            begin = float(theta.time[np.flatnonzero(turned)[-1]])
    return max(begin, float(trace.time[0])), end


# ---- whole figures ------------------------------------------------------------------------------------


def _new(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _later(make: Callable[..., Figure], *arguments: Any) -> Maker:
    return lambda: make(*arguments)


def _of(data: tuple[Experiment, ...], record: str) -> Experiment | None:
    return next((experiment for experiment in data if experiment.name == record), None)


def _trace_figures(
    traces: Mapping[str, Mapping[str, Trace]], fit: Fit, data: tuple[Experiment, ...]
) -> dict[str, Maker]:
    made: dict[str, Maker] = {}
    for record, output, trace in each(traces):
        subject = subject_of(fit, record, output)
        made[f"trace {record} {output}"] = _later(_trace, trace, subject, _of(data, record))
        made[f"residual {record} {output}"] = _later(_residual, trace, subject)
    return made


def _trace(trace: Trace, subject: Subject, experiment: Experiment | None) -> Figure:
    figure = _new(9, 4.6)
    whole, zoom = figure.subplots(2, 1)
    panels.draw_trace(whole, trace, subject)
    window = last_cycle(trace, experiment)
    whole.axvspan(*window, color=panels.BAND, linewidth=0, zorder=0)
    panels.draw_trace(zoom, trace, subject, window=window)
    _legend(figure, zoom)
    return figure


def _legend(figure: Figure, ax: Any) -> None:
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper right", ncols=3, frameon=False)


def _residual(trace: Trace, subject: Subject) -> Figure:
    figure = _new(9, 4.8)
    time, spectrum = figure.subplots(2, 1)
    panels.draw_residual(time, trace, subject)
    if time.get_legend_handles_labels()[0]:
        time.legend(frameon=False, loc="upper right")
    panels.draw_spectrum(spectrum, trace, subject)
    return figure


def _overview(traces: Mapping[str, Mapping[str, Trace]], fit: Fit, data: tuple[Experiment, ...]) -> Figure:
    """Whole trace, last cycle and residual of the first records."""
    entries = list(each(traces))
    shown = entries[:OVERVIEW]
    figure = _new(10, 2.6 * max(len(shown), 1) + 0.4)
    axes = figure.subplots(max(len(shown), 1), 3, squeeze=False, width_ratios=(1.2, 1, 1))
    for row, (record, output, trace) in zip(axes, shown, strict=False):
        subject = subject_of(fit, record, output)
        panels.draw_trace(row[0], trace, subject)
        panels.draw_trace(row[1], trace, subject, window=last_cycle(trace, _of(data, record)))
        panels.draw_residual(row[2], trace, subject)
        row[2].set_title("residual and ±2σ", loc="left")
    if shown:
        _legend(figure, axes[0][1])
    if len(entries) > len(shown):
        figure.supxlabel(f"{len(entries) - len(shown)} more outputs are not drawn here", fontsize=9)
    return figure


def _autocorrelation(trace: Trace, subject: Subject) -> Figure:
    figure = _new(9, 2.6)
    residual = trace.residual
    mask = np.isfinite(residual)
    found = autocorrelation(residual, mask=mask, lags=25)
    panels.draw_correlation(
        figure.subplots(), found, title=f"{subject.title}: residual with itself", with_itself=True
    )
    return figure


def _correlations(check: Any, subject: Subject) -> Figure:
    names = list(check.cross_correlation)
    rows = 1 + -(-len(names) // 2)
    figure = _new(9, 2.3 * rows)
    grid = figure.add_gridspec(rows, 2)
    title = f"{subject.title}: residual with itself"
    panels.draw_correlation(
        figure.add_subplot(grid[0, :]), check.autocorrelation, title=title, with_itself=True
    )
    for index, name in enumerate(names):
        ax = figure.add_subplot(
            grid[1 + index // 2, index % 2 if index < len(names) - 1 or index % 2 else slice(0, 2)]
        )
        panels.draw_correlation(
            ax,
            check.cross_correlation[name],
            title=f"residual with {name} (its past: lag > 0)",
            with_itself=False,
        )
    return figure


def _parameters(fit: Fit) -> Figure:
    names = [name for name in fit.free if name in fit.estimates]
    figure = _new(9, 1.3 + 0.36 * len(names))
    left, right = figure.subplots(1, 2, width_ratios=(1.6, 1))
    panels.draw_parameters(left, fit, names)
    panels.draw_precision(right, fit, names)
    return figure


def _matrix(fit: Fit) -> Figure:
    size = min(max(4.2, 1.6 + 0.5 * len(fit.free)), 11)
    figure = _new(size + 1, size)
    ax = figure.subplots()
    image = panels.draw_matrix(ax, fit.correlation, fit.free)
    figure.colorbar(image, ax=ax, label="correlation [1]")
    return figure


def _waterfall(fit: Fit) -> Figure:
    figure = _new(9, 3.2)
    panels.draw_waterfall(figure.subplots(), fit.optima)
    return figure


def _channels(experiment: Experiment, names: Any) -> Figure:
    chosen = [experiment[name] for name in names]
    figure = _new(9, 0.6 + 1.35 * len(chosen))
    axes = figure.subplots(len(chosen), 1, squeeze=False, sharex=True)[:, 0]
    for ax, channel in zip(axes, chosen, strict=True):
        ax.plot(*envelope(channel.time, channel.values), color=panels.SIMULATED, linewidth=0.9)
        title = f"{experiment.name}: {channel.name} ({channel.origin})"
        panels.dress(ax, x="", y=f"{channel.name}\n[{channel.unit}]", title=title)
    for ax in axes:
        ax.set_xlabel("time [s]" if ax is axes[-1] else "")
    return figure


def _simulated(result: Simulated, names: list[str]) -> Figure:
    """Simulated outputs, over the measured ones where there are any."""
    entries = [(one, name) for one in result.simulated for name in names if name in one][:OVERVIEW]
    figure = _new(9, 0.8 + 2.0 * max(len(entries), 1))
    axes = figure.subplots(max(len(entries), 1), 1, squeeze=False)[:, 0]
    for ax, (one, name) in zip(axes, entries, strict=False):
        channel, source = one[name], _of(result.data, one.name)
        if source is not None and name in source:
            measured = source[name]
            ax.plot(
                *envelope(measured.time, measured.values),
                color=panels.MEASURED,
                linewidth=1.6,
                label="measured",
            )
        ax.plot(
            *envelope(channel.time, channel.values), color=panels.SIMULATED, linewidth=0.9, label="simulated"
        )
        panels.dress(ax, x="time [s]", y=f"{name} [{channel.unit}]", title=f"{one.name}: {name}")
    if entries:
        _legend(figure, axes[0])
    return figure


# ---- files --------------------------------------------------------------------------------------------


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


def _save(figure: Figure, path: Any) -> None:
    ending = (
        os.path.splitext(os.fsdecode(os.fspath(path)))[1].lower().removeprefix(".") if _is_path(path) else ""
    )
    if _is_path(path) and ending not in FORMATS:
        raise OutputError(
            f"{path}: not a kind of figure file that can be written",
            seen=repr(ending),
            allowed=", ".join("." + form for form in FORMATS),
            cure="give the file one of these endings",
        )
    write_file(path, drawn(figure, ending or "png", dpi=150))


def _is_path(path: Any) -> bool:
    return isinstance(path, str | bytes | os.PathLike)
