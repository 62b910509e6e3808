"""What stands in each section of report.html, by the kind of result."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping, Sequence
from functools import singledispatch
from importlib.metadata import version
from typing import Any

import casadi
import numpy

import casadi_engine
from casadi_engine.errors import ResultError
from casadi_engine.estimation import summary as fits
from casadi_engine.estimation.fit import Fit
from casadi_engine.experiment import Experiment
from casadi_engine.experiment.units import unit_words
from casadi_engine.model import Model
from casadi_engine.report import tables
from casadi_engine.report.figures import each, figures
from casadi_engine.report.kinds import Simulated, shown_by_others
from casadi_engine.report.page import Folded, Section
from casadi_engine.report.tables import table
from casadi_engine.validation import summary as validations
from casadi_engine.validation.validate import Validation

# Outputs of records that get figures of their own; the tables hold all of them.
DRAWN = 4

Page = tuple[str, str, list[Section]]


@singledispatch
def page_of(result: Any, validation: Any, arguments: Mapping[str, Any]) -> Page:
    """Title, subtitle and sections of a page."""
    made: Page = shown_by_others(page_of, result, "report")(result, validation, arguments)
    return made


@page_of.register
def _(result: Fit, validation: Any, arguments: Mapping[str, Any]) -> Page:
    if validation is not None and not isinstance(validation, Validation):
        raise ResultError(
            "the validation of a report is not one",
            seen=type(validation).__name__,
            allowed="a Validation, or None",
            cure="give what validate(fit) returned",
        )
    data = list(result.data)
    if validation is not None:
        known = {id(experiment) for experiment in data}
        data += [experiment for experiment in validation.fit.data if id(experiment) not in known]
    return (
        f"Fit of {result.model.name}",
        result.model.description,
        [
            _verdict_of_fit(result, validation),
            _model(result.model),
            _parameters(result),
            _fit(result),
            _tests(validation, fitted=result) if validation is not None else _untested(result),
            _data(data),
            _how(arguments, result.options, result.timing),
        ],
    )


@page_of.register
def _(result: Validation, _validation: Any, arguments: Mapping[str, Any]) -> Page:
    fit: Fit = result.fit
    verdict = Section(
        "verdict",
        "Verdict",
        [validations.verdict(result), f"Next: {validations.next_step(result)}"],
        "good" if result.passed else "poor",
    )
    return (
        f"Validation of {fit.model.name}",
        fit.model.description,
        [
            verdict,
            _model(fit.model),
            _parameters(fit),
            _tests(result, fitted=None),
            _data(result.fit.data),
            _how(arguments, fit.options, fit.timing),
        ],
    )


@page_of.register
def _(result: Simulated, _validation: Any, arguments: Mapping[str, Any]) -> Page:
    header = ("record", "samples", "duration [s]", "file")
    simulated = Section(
        "simulation",
        "Simulation",
        tables=[table(header, tables.simulated_rows(result), right=(1, 2))],
        wanted=[(result, "overview", "Simulated outputs, over the measured ones where there are any")],
    )
    rows = [
        (name, f"{value:.6g}", unit_words(result.parameters[name].unit), result.parameters[name].description)
        for name, value in result.parameters.as_dict().items()
    ]
    given = Section(
        "parameters",
        "Parameters",
        tables=[table(("parameter", "value", "unit", "meaning"), rows, right=(1,))],
    )
    return (
        f"Simulation of {result.model.name}",
        result.model.description,
        [simulated, _model(result.model), given, _data(result.data), _how(arguments, {}, {})],
    )


# ---- sections -----------------------------------------------------------------------------------------


def _verdict_of_fit(fit: Fit, validation: Any) -> Section:
    lines = [f"The fit: {fit.status}."]
    percents = [
        value
        for _, _, found in each(fit.fit_percent)
        if (value := found.get("simulation")) is not None and math.isfinite(value)
    ]
    if percents:
        low, high = f"{min(percents):.2f}", f"{max(percents):.2f}"
        span = f"{low} %" if low == high else f"{low} to {high} %"
        lines.append(f"Fit in simulation (2.32): {span}.")
    if validation is not None:
        lines.append(f"Residual tests {validations.verdict(validation)}.")
    lines += [f"Not determined by these data: {direction.text}." for direction in fit.undetermined]
    at_bounds = [name for name, estimate in fit.estimates.items() if estimate.at_bound]
    if at_bounds:
        lines.append(f"At a bound, so without a symmetric error: {', '.join(at_bounds)}.")
    assumed = fits.assumed_words(fit)
    if assumed:
        lines.append(f"Inputs{assumed}.")
    lines += list(fit.messages)
    steps = fits.next_steps(fit)
    if steps == [fits.FRESH] and validation is not None and not set(validation.records) <= set(fit.traces):
        steps = [validations.next_step(validation)]  # it has seen fresh data
    lines.append(f"Next: {'; '.join(steps)}.")
    sound = fit.converged and not fit.undetermined and (validation is None or validation.passed)
    return Section("verdict", "Verdict", lines, "good" if sound else "poor")


def _model(model: Model) -> Section:
    rows = [
        (kind, variable.name, variable.unit, variable.description)
        for kind, group in (
            ("state", model.states),
            ("input", model.inputs),
            ("drive", model.drives),
            ("output", model.outputs),
        )
        for variable in group
    ]
    return Section(
        "model",
        "Model",
        preformatted=[model.equations()],
        folded=[Folded("The equations in LaTeX", model.latex())],
        tables=[table(("kind", "name", "unit", "meaning"), rows)],
    )


def _parameters(fit: Fit) -> Section:
    known = figures(fit)
    wanted = [
        (fit, name, caption)
        for name, caption in (
            ("parameters", "Change of the free parameters from their start values, and how sure they are"),
            ("correlation matrix", "Correlation of the estimated parameters"),
        )
        if name in known
    ]
    made = [tables.parameter_table(fit), tables.initial_table(fit), tables.correlation_table(fit)]
    return Section("parameters", "Parameters", tables=[one for one in made if one], wanted=wanted)


def _fit(fit: Fit) -> Section:
    wanted = _traces(fit, fit.traces)
    if "waterfall" in figures(fit):
        wanted.append((fit, "waterfall", "Cost at which each start of the multi-start ended"))
    return Section(
        "fit",
        "Fit",
        lines=_not_drawn(fit.traces),
        tables=[tables.cost_table(fit), tables.percent_table(fit)],
        wanted=wanted,
    )


def _tests(validation: Any, *, fitted: Fit | None) -> Section:
    records = validation.records
    wanted = []
    if fitted is None or not set(records) <= set(fitted.traces):
        wanted += _traces(validation, records)
    wanted += [
        (
            validation,
            f"correlation {record} {output}",
            f"Correlation of the residual of {output} in {record} with itself and with the drives",
        )
        for record, output, _ in list(each(records))[:DRAWN]
    ]
    on = f"Records: {', '.join(records)}." if fitted is not None else ""
    note = "Bands are for the eye, one lag at a time; the verdict is by the p-values."
    return Section(
        "tests",
        "Fit and residual tests" if fitted is None else "Residual tests",
        lines=[
            line
            for line in (validations.verdict(validation), *validations.parameter_words(validation), on, note)
            if line
        ]
        + (_not_drawn(records) if fitted is None else []),
        tables=[tables.measure_table(validation), tables.residual_table(validation)],
        wanted=wanted,
    )


def _untested(fit: Fit) -> Section:
    wanted = [
        (
            fit,
            f"autocorrelation {record} {output}",
            f"Autocorrelation of the residual of {output} in {record}",
        )
        for record, output, _ in list(each(fit.traces))[:DRAWN]
    ]
    line = "The residual tests were not made: ce.validate(fit) makes them."
    return Section("tests", "Residual tests", lines=[line], wanted=wanted)


def _traces(result: Any, nested: Mapping[str, Mapping[str, Any]]) -> list[tuple[Any, str, str]]:
    wanted = []
    for record, output, _ in list(each(nested))[:DRAWN]:
        caption = f"{output} of {record}, measured and by the model; below, its last part"
        wanted.append((result, f"trace {record} {output}", caption))
        wanted.append((result, f"residual {record} {output}", f"Residual of {output} in {record}"))
    return wanted


def _not_drawn(nested: Mapping[str, Mapping[str, Any]]) -> list[str]:
    rest = sum(1 for _ in each(nested)) - DRAWN
    return [f"{rest} more outputs are in the tables, but not drawn here."] if rest > 0 else []


def _data(data: Sequence[Experiment]) -> Section:
    files, channels, history = [], [], []
    for experiment in data:
        files.append(
            (
                experiment.name,
                experiment.source or "(made of arrays)",
                fits.count(experiment.samples),
                f"{experiment.duration:.6g}",
                ", ".join(experiment.ignored) or "-",
                experiment.sha256 or "-",
            )
        )
        for channel in experiment.channels:
            rate = "uneven" if channel.rate is None else f"{channel.rate:.6g}"
            missing = fits.count(channel.missing)
            channels.append(
                (
                    experiment.name,
                    channel.name,
                    channel.unit,
                    fits.count(len(channel)),
                    missing,
                    rate,
                    channel.origin,
                )
            )
        history += [(experiment.name, str(step)) for step in experiment.history]
    header = ("record", "file", "samples", "duration [s]", "ignored columns", "SHA-256")
    made = [table(header, files, right=(2, 3), caption="Records")]
    names = ("record", "channel", "unit", "samples", "missing", "rate [Hz]", "origin")
    made.append(table(names, channels, right=(3, 4, 5), caption="Channels"))
    if history:
        made.append(table(("record", "step"), history, caption="What was done to them, in this order"))
    return Section("data", "Data", tables=made)


def _how(arguments: Mapping[str, Any], options: Mapping[str, Any], timing: Mapping[str, float]) -> Section:
    rows = [("argument", name, _shown(value)) for name, value in arguments.items()]
    rows += [("option", name, _shown(value)) for name, value in options.items()]
    rows += [("seconds", name, f"{value:.3g}") for name, value in timing.items()]
    versions = {
        "casadi-engine": casadi_engine.__version__,
        "Python": platform.python_version(),
        "CasADi": casadi.CasadiMeta.version(),
        "NumPy": numpy.__version__,
        "SciPy": version("scipy"),
    }
    rows += [("version", name, value) for name, value in versions.items()]
    return Section("how", "How it was made", tables=[table(("kind", "name", "value"), rows)])


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= 300 else text[:299] + "…"
