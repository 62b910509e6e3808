"""Figures of results, built from panels."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from functools import partial, singledispatch
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.errors import OutputError, ResultError
from casadi_engine.estimation.fit import Fit, Trace
from casadi_engine.experiment import Experiment
from casadi_engine.report import panels
from casadi_engine.report.files import write_file
from casadi_engine.report.kinds import Simulated, shown_by_others
from casadi_engine.report.matplotlib_figure import drawn, figure_of
from casadi_engine.report.panels import Subject
from casadi_engine.report.sketch import Sketch
from casadi_engine.validation import autocorrelation
from casadi_engine.validation.validate import Validation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Maker = Callable[[], Sketch]
FORMATS = ("png", "svg", "pdf")
# Records drawn in one overview; the pages have a figure for each.
OVERVIEW = 4


def plot(result: Any, *, path: Any = None, what: str = "overview") -> Figure:
    """Draw a result and return the matplotlib Figure; with ``path`` (.png, .svg, .pdf) also write it.

    result : a Fit, a Validation, a Simulated, a Prediction, a Repair, a Posterior, an Experiment, Orders, Modes, a
        Reduction, or a loaded result
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
    figure = figure_of(known[what]())
    if path is not None:
        _save(figure, path)
    return figure


@singledispatch
def figures(result: Any) -> dict[str, Maker]:
    """Name -> function that makes the sketch of a figure, in the order of a report; "overview" is the first."""
    made: dict[str, Maker] = shown_by_others(figures, result, "plot")(result)
    return made


@figures.register
def _(result: Fit) -> dict[str, Maker]:
    made: dict[str, Maker] = {"overview": lambda: _overview(result.traces, result, result.data)}
    made |= _trace_figures(result.traces, result, result.data)
    made |= {
        f"autocorrelation {record} {output}": partial(
            _autocorrelation, trace, subject_of(result, record, output)
        )
        for record, output, trace in each(result.traces)
    }
    if result.free:
        names = [name for name in result.free if name in result.estimates]
        made["parameters"] = partial(parameter_sketch, result, names)
    if len(result.free) > 1:
        made["correlation matrix"] = partial(matrix_sketch, result.correlation, result.free)
    if sum(optimum.starts for optimum in result.optima) > 1:
        made["waterfall"] = partial(waterfall_sketch, result.optima)
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
        f"correlation {record} {output}": partial(
            _correlations, check, subject_of(result.fit, record, output)
        )
        for record, output, check in each(result.records)
    }
    return made


@figures.register
def _(result: Experiment) -> dict[str, Maker]:
    return {"overview": partial(_channels, result)}


@figures.register
def _(result: Simulated) -> dict[str, Maker]:
    names = [variable.name for variable in result.model.outputs]
    made: dict[str, Maker] = {"overview": lambda: _simulated(result, names)}
    made |= {f"record {one.name}": partial(_channels, one) for one in result.simulated}
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


def _of(data: tuple[Experiment, ...], record: str) -> Experiment | None:
    return next((experiment for experiment in data if experiment.name == record), None)


def _trace_figures(
    traces: Mapping[str, Mapping[str, Trace]], fit: Fit, data: tuple[Experiment, ...]
) -> dict[str, Maker]:
    made: dict[str, Maker] = {}
    for record, output, trace in each(traces):
        subject = subject_of(fit, record, output)
        made[f"trace {record} {output}"] = partial(_trace, trace, subject, _of(data, record))
        made[f"residual {record} {output}"] = partial(_residual, trace, subject)
    return made


def _trace(trace: Trace, subject: Subject, experiment: Experiment | None) -> Sketch:
    sketch = Sketch(9, 4.6, (2, 1), key=True)
    whole, zoom = sketch.cells()
    panels.draw_trace(whole, trace, subject)
    window = last_cycle(trace, experiment)
    whole.axvspan(*window, color=panels.BAND, linewidth=0, zorder=0)
    panels.draw_trace(zoom, trace, subject, window=window)
    return sketch


def _residual(trace: Trace, subject: Subject) -> Sketch:
    sketch = Sketch(9, 4.8, (2, 1))
    time, spectrum = sketch.cells()
    panels.draw_residual(time, trace, subject)
    panels.draw_spectrum(spectrum, trace, subject)
    return sketch


def _overview(traces: Mapping[str, Mapping[str, Trace]], fit: Fit, data: tuple[Experiment, ...]) -> Sketch:
    """Whole trace, last cycle and residual of the first records."""
    entries = list(each(traces))
    shown = entries[:OVERVIEW]
    rows = max(len(shown), 1)
    sketch = Sketch(10, 2.6 * rows + 0.4, (rows, 3), across=(1.2, 1, 1), key=True)
    cells = sketch.cells()
    for record, output, trace in shown:
        subject = subject_of(fit, record, output)
        panels.draw_trace(next(cells), trace, subject)
        panels.draw_trace(next(cells), trace, subject, window=last_cycle(trace, _of(data, record)))
        residual = next(cells)
        panels.draw_residual(residual, trace, subject)
        residual.title, residual.key = "residual and ±2σ", None
    if len(entries) > len(shown):
        sketch.foot = f"{len(entries) - len(shown)} more outputs are not drawn here"
    return sketch


def _autocorrelation(trace: Trace, subject: Subject) -> Sketch:
    sketch = Sketch(9, 2.6)
    residual = trace.residual
    found = autocorrelation(residual, mask=np.isfinite(residual), lags=25)
    title = f"{subject.title}: residual with itself"
    panels.draw_correlation(sketch.panel(), found, title=title, with_itself=True)
    return sketch


def _correlations(check: Any, subject: Subject) -> Sketch:
    names = list(check.cross_correlation)
    rows = 1 + -(-len(names) // 2)
    sketch = Sketch(9, 2.3 * rows, (rows, 2))
    title = f"{subject.title}: residual with itself"
    panels.draw_correlation(sketch.panel(columns=2), check.autocorrelation, title=title, with_itself=True)
    for index, name in enumerate(names):
        alone = index == len(names) - 1 and index % 2 == 0
        panel = sketch.panel(1 + index // 2, index % 2, columns=2 if alone else 1)
        title = f"residual with {name} (its past: lag > 0)"
        panels.draw_correlation(panel, check.cross_correlation[name], title=title, with_itself=False)
    return sketch


def parameter_sketch(fit: Any, names: list[str]) -> Sketch:
    """Estimates with their intervals, and how sure they are; ``fit`` has estimates, parameters and start."""
    sketch = Sketch(9, 1.3 + 0.36 * len(names), (1, 2), across=(1.6, 1))
    left, right = sketch.cells()
    panels.draw_parameters(left, fit, names)
    panels.draw_precision(right, fit, names)
    return sketch


def matrix_sketch(matrix: Any, names: Any) -> Sketch:
    """The correlation matrix of the estimates."""
    size = min(max(4.2, 1.6 + 0.5 * len(names)), 11)
    sketch = Sketch(size + 1, size)
    panels.draw_matrix(sketch.panel(), matrix, names)
    return sketch


def waterfall_sketch(optima: Any) -> Sketch:
    """Where the starts of a multi-start ended."""
    sketch = Sketch(9, 3.2)
    panels.draw_waterfall(sketch.panel(), optima)
    return sketch


def _channels(experiment: Experiment) -> Sketch:
    names = experiment.names
    sketch = Sketch(9, 0.6 + 1.35 * len(names), (len(names), 1))
    for panel, name in zip(sketch.cells(), names, strict=False):
        channel = experiment[name]
        panel.plot(channel.time, channel.values, color=panels.SIMULATED, linewidth=0.9)
        title = f"{experiment.name}: {channel.name} ({channel.origin})"
        label = "time [s]" if name == names[-1] else ""
        panels.dress(panel, x=label, y=f"{channel.name}\n[{channel.unit}]", title=title)
        panel.linked, panel.margin = experiment.name, 0.01
    return sketch


def _simulated(result: Simulated, names: list[str]) -> Sketch:
    """Simulated outputs, over the measured ones where there are any."""
    entries = [(one, name) for one in result.simulated for name in names if name in one][:OVERVIEW]
    sketch = Sketch(9, 0.8 + 2.0 * max(len(entries), 1), (max(len(entries), 1), 1), key=True)
    for one, name in entries:
        panel = sketch.panel(len(sketch.panels))
        channel, source = one[name], _of(result.data, one.name)
        if source is not None and name in source:
            measured = source[name]
            panel.plot(measured.time, measured.values, color=panels.MEASURED, linewidth=1.6, label="measured")
        panel.plot(channel.time, channel.values, color=panels.SIMULATED, linewidth=0.9, label="simulated")
        panels.dress(panel, x="time [s]", y=f"{name} [{channel.unit}]", title=f"{one.name}: {name}")
        panel.linked, panel.margin = one.name, 0.01
    return sketch


# ---- files --------------------------------------------------------------------------------------------


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
    if _is_path(path) and os.path.isfile(path) and not _is_figure(path, ending):
        raise OutputError(
            f"a file of this name would be lost: {os.fsdecode(os.fspath(path))}",
            seen=f"a file that is no {ending} figure",
            allowed="a new file, or an earlier figure, which is replaced",
            cure="give another name, or move the file away",
        )
    write_file(path, drawn(figure, ending or "png", dpi=150))


def _is_figure(path: Any, ending: str) -> bool:
    """True if a file begins as one of its kind does, or is empty."""
    try:
        with open(path, "rb") as stream:
            begun = stream.read(512)
    except OSError:  # the writer says why
        return True
    marks = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<svg"}
    return not begun or marks.get(ending, b"") in begun


def _is_path(path: Any) -> bool:
    return isinstance(path, str | bytes | os.PathLike)
