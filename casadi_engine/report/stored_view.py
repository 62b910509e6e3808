"""Figures and page of a result that was read back: what result.json holds, which are no traces."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from casadi_engine.errors import ResultError
from casadi_engine.estimation.fit import Estimate, Optimum
from casadi_engine.estimation.summary import with_interval
from casadi_engine.experiment import read_experiment
from casadi_engine.report import panels
from casadi_engine.report.figures import (
    Maker,
    each,
    figures,
    matrix_sketch,
    parameter_sketch,
    waterfall_sketch,
)
from casadi_engine.report.page import Section
from casadi_engine.report.repaired_stored import stored_sections, stored_verdict
from casadi_engine.report.sections import Page, page_of
from casadi_engine.report.sketch import Sketch
from casadi_engine.report.stored import Result
from casadi_engine.report.tables import table


@dataclass(frozen=True)
class _Bounds:
    min: float
    max: float


class _Estimates:
    """The parameters of a stored result as the panels of a fit take them."""

    def __init__(self, result: Result):
        entries = result["parameters"]
        self.estimates = {
            name: Estimate(
                _number(one["value"]),
                one["stderr"],
                one["unit"],
                one["at_bound"],
                one.get("why", {}).get("stderr"),
                fixed=not one["vary"] and one["tie"] is None,
                interval=tuple(one["interval"]) if "interval" in one else None,
            )
            for name, one in entries.items()
        }
        self.parameters = {
            name: _Bounds(
                -math.inf if one["min"] is None else one["min"],
                math.inf if one["max"] is None else one["max"],
            )
            for name, one in entries.items()
        }
        self.start = {name: _number(value) for name, value in result.get("start", {}).items()}
        free = result.get("free", [name for name, one in entries.items() if one["stderr"] is not None])
        self.free = tuple(name for name in free if name in self.estimates)
        self.optima = tuple(
            Optimum(
                _number(one["cost"]), dict(one["values"]), one["starts"], one["status"], one.get("apart", "")
            )
            for one in result.get("optima", ())
        )


# ---- figures


@figures.register
def _(result: Result) -> dict[str, Maker]:
    made: dict[str, Maker] = {}
    known = _Estimates(result)
    if list(each(_percents(result))):
        made["fit"] = partial(_percent_figure, result)
    if known.free:
        made["parameters"] = partial(parameter_sketch, known, list(known.free))
    if "covariance" in result and len(known.free) > 1:
        made["correlation matrix"] = partial(_matrix_figure, result, known)
    if sum(one.starts for one in known.optima) > 1:
        made["waterfall"] = partial(waterfall_sketch, known.optima)
    if _p_values(result):
        made["residual tests"] = partial(_test_figure, result)
    for name in result.get("files", ()):
        made[f"file {name}"] = partial(_file_figure, result, name)
    if not made:
        raise ResultError(
            f"{result.path}: there is nothing in this result that can be drawn",
            seen=f"a result of {result['command']}, {result['status']}",
            allowed="estimated parameters, fit percentages, residual tests or simulated files",
            cure="run the command again for the figures of its report.html",
        )
    return {"overview": next(iter(made.values()))} | made


def _percent_figure(result: Result) -> Sketch:
    """Bars of the fit percentages, simulation and prediction."""
    entries = list(each(_percents(result)))
    sketch = Sketch(8, 1.2 + 0.42 * len(entries))
    panel = sketch.panel()
    both = any(found.get("prediction") is not None for _, _, found in entries)
    kinds = [("simulation", panels.SIMULATED, -0.18 * both, "simulation")]
    kinds += [("prediction", panels.PREDICTED, 0.18, "one-step prediction")] * both
    for kind, color, shift, label in kinds:
        for row, (_, _, found) in enumerate(entries):
            value = found.get(kind)
            if value is not None:
                panel.barh(
                    row + shift, value, 0.32, color=color, label=None if label in panel.labels else label
                )
                panel.write(f" {value:.2f} %", max(value, 0.0), row + shift, va="center")
    panel.ylim, panel.flipped = (-0.6, len(entries) - 0.4), True
    panel.ynames = (range(len(entries)), [f"{record}: {output}" for record, output, _ in entries])
    panel.xlim = (None, 115)
    panel.key = "best" if both else None
    panels.dress(panel, x="fit (2.32) [%]", y="", title=f"{result['command']}: {result['status']}")
    return sketch


def _matrix_figure(result: Result, known: _Estimates) -> Sketch:
    covariance = result.covariance
    errors = np.sqrt(np.where(np.diag(covariance) > 0, np.diag(covariance), np.nan))
    return matrix_sketch(covariance / np.outer(errors, errors), known.free)


def _test_figure(result: Result) -> Sketch:
    """p-values of the residual tests on a logarithmic axis, cut at 1e-16."""
    tests = _p_values(result)
    sketch = Sketch(8, 1.2 + 0.3 * len(tests))
    panel = sketch.panel()
    values = np.maximum([value for _, value in tests], 1e-16)
    panel.plot(values, range(len(tests)), "o", color=panels.SIMULATED, markersize=5)
    checked = result if "alpha" in result else result["validation"]
    panel.axvline(checked["alpha"], color=panels.PREDICTED, linewidth=0.9, linestyle="--")
    words = f"{'passed' if checked['passed'] else 'not passed'}; dashed: alpha = {checked['alpha']:g}, for all together"
    panel.xscale, panel.xlim, panel.flipped = "log", (1e-17, 3.0), True
    panel.ynames = (range(len(tests)), [name for name, _ in tests])
    panels.dress(panel, x="p-value [1]", y="", title=words)
    return sketch


def _file_figure(result: Result, name: str) -> Sketch:
    """The outputs of a simulated file, which lies beside the result."""
    place = Path(result.path).parent / name
    if not place.is_file():
        raise ResultError(
            f"{place}: a file of this result is not there",
            seen=result.path,
            allowed="the folder as the command wrote it",
            cure="keep result.json beside its data files, or run the command again",
        )
    experiment = read_experiment(place)
    wanted = result["inputs"][list(result["files"]).index(name)]["outputs"]
    shown = [one for one in experiment.names if one in wanted] or list(experiment.names)
    return figures(experiment.only(*shown))["overview"]()


# ---- page


@page_of.register
def _(result: Result, _validation: Any, arguments: Mapping[str, Any]) -> Page:
    drawn = [(result, name, name) for name in _drawable(result) if name != "overview"]
    of_repair = result["command"] == "repair"
    verdict = stored_verdict(result) if of_repair else [f"{result['command']}: {result['status']}."]
    checked = result if "passed" in result else result.get("validation", {})
    if "passed" in checked:
        verdict.append(f"Residual tests {'passed' if checked['passed'] else 'failed'}.")
    verdict += [f"Not determined by these data: {one['text']}." for one in result.get("undetermined", ())]
    verdict += list(result.get("messages", ()))
    sound = result["status"] in ("converged", "answered") and checked.get("passed", True)
    sound = sound and result.get("verdict", "named") in ("named", "nothing missing")
    note = (
        "Traces are not stored in result.json; the page that the command wrote beside it has their figures."
    )
    sections = [
        Section("verdict", "Verdict", verdict, "good" if sound else "poor", lines=[note]),
        Section(
            "parameters", "Parameters", tables=[_parameter_table(result)], wanted=_of(drawn, _PARAMETERS)
        ),
    ]
    if list(each(_percents(result))) or _p_values(result):
        tables = [_percent_table(result)] + ([_test_table(result)] if _p_values(result) else [])
        sections.append(Section("fit", "Fit and residual tests", tables=tables, wanted=_of(drawn, _FIT)))
    if of_repair:
        sections[1:1] = stored_sections(result)
    files = [entry for entry in drawn if entry[1].startswith("file ")]
    if files:
        sections.append(Section("simulation", "Simulation", wanted=files))
    sections += [_data_section(result), _how_section(result, arguments)]
    return (
        f"{result['command']} of {result.get('model', 'a model')}",
        f"read back from {result.path}",
        sections,
    )


_PARAMETERS, _FIT = ("parameters", "correlation matrix"), ("fit", "residual tests", "waterfall")


def _of(drawn: list[tuple[Any, str, str]], names: tuple[str, ...]) -> list[tuple[Any, str, str]]:
    return [entry for entry in drawn if entry[1] in names]


def _drawable(result: Result) -> list[str]:
    try:
        return list(figures(result))
    except ResultError:
        return []


def _parameter_table(result: Result) -> str:
    rows = []
    for name, one in result["parameters"].items():
        error = "" if one["stderr"] is None else f" ± {one['stderr']:.2g}"
        tie = f"== {one['tie']}" if one["tie"] else "" if one["vary"] else "fixed"
        bound = f"at its {one['at_bound']} bound" if one["at_bound"] else ""
        low, high = one.get("interval", (0.0, 0.0))
        ends = with_interval(low, high, one["value"]) if "interval" in one else ""
        notes = ", ".join(filter(None, (tie, bound, ends)))
        rows.append((name, f"{_text(one['value'])}{error}", one["unit"], notes))
    return table(("parameter", "value ± standard error", "unit", "note"), rows, caption="Parameters")


def _percent_table(result: Result) -> str:
    rows = [
        (record, output, _text(found.get("simulation")), _text(found.get("prediction")))
        for record, output, found in each(_percents(result))
    ]
    return table(("record", "output", "fit %, simulation", "fit %, one-step prediction"), rows, right=(2, 3))


def _test_table(result: Result) -> str:
    rows = [(name, f"{value:.3g}") for name, value in _p_values(result)]
    return table(("residual test", "p"), rows, right=(1,))


def _data_section(result: Result) -> Section:
    rows = []
    for one in result["inputs"]:
        file, outputs = one["file"] or "(made of arrays)", ", ".join(one["outputs"])
        rows.append((one.get("name") or "-", file, str(one["samples"]), outputs, one["sha256"] or "-"))
    header = ("record", "file", "samples", "outputs", "sha256")
    return Section("data", "Data", tables=[table(header, rows, right=(2,))])


def _how_section(result: Result, arguments: Mapping[str, Any]) -> Section:
    rows = [("written by", f"casadi-engine {result['version']}"), ("seconds", _text(result["seconds"]))]
    rows += [("cost", _text(result["cost"])), ("samples that count", _text(result["n"]))]
    rows += [(key, str(value)) for key, value in ({**result["arguments"]} | dict(arguments)).items() if value]
    return Section("how", "How it was made", tables=[table(("what", "value"), rows)])


# ---- reading


def _percents(result: Result) -> Mapping[str, Mapping[str, Any]]:
    """record -> output -> percentages, of a fit or a validation."""
    if "fit_percent" in result:
        found: Mapping[str, Mapping[str, Any]] = result["fit_percent"]
        return found
    return {
        record: {output: check["fit_percent"] for output, check in outputs.items()}
        for record, outputs in result.get("records", {}).items()
    }


def _p_values(result: Result) -> list[tuple[str, float]]:
    """Name -> p of every residual test that was made."""
    checks = result.get("records", {}) or result.get("validation", {}).get("records", {})
    made = []
    for record, output, check in each(checks):
        # results from before 0.35 have no tests of mean and size
        level = {name: check.get(f"{name}_p") for name in ("mean", "size")}
        tests = {"whiteness": check["whiteness_p"], **level, **check["cross_p"]}
        made += [(f"{record}/{output}/{name}", float(p)) for name, p in tests.items() if p is not None]
    return made


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _text(value: Any) -> str:
    return "-" if value is None else f"{value:.6g}" if isinstance(value, int | float) else str(value)
